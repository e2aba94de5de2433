# SPDX-License-Identifier: MIT
"""Unsupported layouts of datasets: the message names the layout and the conversion."""

from __future__ import annotations

from pathlib import Path

import pytest

from rfm_labels import DatasetError, open_dataset

UNREAD: dict[str, tuple[list[str], str, str]] = {  # files, the opened path, the end of the message
    "TFRecord files alone": (["1.0.0/a.tfrecord-00000-of-00001"], "1.0.0", "got TFRecord files without features.json"),
    "Zarr": ([".zgroup", "data/.zgroup"], "", "got Zarr arrays: convert them to LeRobot, or"),
    "Zarr in an archive": (["buffer.zarr.zip"], "buffer.zarr.zip", "got Zarr arrays: convert them to LeRobot, or"),
    "a rosbag of ROS 2": (["metadata.yaml", "a_0.db3"], "", "got a rosbag: convert it to LeRobot with "),
    "a rosbag of ROS 1": (["a.bag"], "a.bag", "got a rosbag: convert it to LeRobot with "),
    "MCAP files": (["a.mcap", "b.mcap"], "", "got a rosbag: convert it to LeRobot with "),
    "LeRobot v1": (["meta_data/info.json"], "", "got a LeRobot dataset of v1: convert it to v2.0 with LeRobot 0.3"),
    "HDF5 files in folders": (["a/x.hdf5"], "", "each a dataset of its own: rfm-client label takes the folder, open_"),
    "pictures": (["1.png", "2.png"], "", "got pictures outside of the folder of an episode (1.png)"),
    "pictures of cameras": (["a/front/1.jpg"], "", "list the folders of one camera (a/front) in tasks.csv"),
    "pictures and a video": (
        ["0/1.png", "a.mp4"],
        "",
        "expected episodes of one kind, got videos (a.mp4) and folders of pictures (0): give each kind a folder of its",
    ),
    "HDF5 files and arrays": (["a.hdf5", "a.npy"], "", "of one kind, got arrays (a.npy) and HDF5 files (a.hdf5): give"),
    "pictures beside folders": (
        ["0/1.png", "1.png"],
        "",
        "got folders of pictures (0) and pictures (1.png): give each",
    ),
    "folders without a table": (
        ["0/1.png"],
        "",
        "with the task of each folder, got none: write it, or, if all of them",
    ),
    "a video": (["a.mp4"], "a.mp4", 'got a video: label its folder, with --task "SENTENCE" or with tasks.csv in it'),
    "videos without a table": (
        ["a.mp4"],
        "",
        'got none: write it, or, if all of them have one task, give it: --task "SE',
    ),
    "an empty folder": ([".hidden"], "", "got an empty folder: put a video, an array or a folder of pictures for each"),
    "other files": (["a.txt"], "", "got other files: put a video, an array or a folder of pictures for each episode"),
    "another file": (["a.txt"], "a.txt", "or a Hub id org/name[@revision], got another file"),
}


@pytest.mark.parametrize("name", ["/nothing/here", "no dataset"])
def test_what_is_not_there_is_refused(name: str) -> None:
    with pytest.raises(DatasetError, match=f"^{name}: expected a LeRobot dataset .* got none$"):
        open_dataset(name)


@pytest.mark.parametrize(("files", "opened", "message"), UNREAD.values(), ids=UNREAD)
def test_a_layout_that_is_not_read_is_named_with_what_to_do(
    tmp_path: Path, files: list[str], opened: str, message: str
) -> None:
    root = tmp_path / "data"
    for name in files:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")
    with pytest.raises(DatasetError) as refused:
        open_dataset(root / opened)
    assert message.replace("ROOT", str(root)) in str(refused.value)
