# SPDX-License-Identifier: MIT
"""Datasets in layouts that are not read: the message names the layout, and what makes one of it that is."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from rfm_client.labelling import DatasetError, open_dataset


def aloha(file: Path) -> None:
    with h5py.File(file, "w") as opened:
        opened["observations/images/cam_high"] = np.zeros((3, 8, 8, 3), np.uint8)


TO_ALOHA = "got ALOHA's layout, an episode a file (observations/images): convert its folder to LeRobot with openpi's "
UNREAD: dict[str, tuple[list[str], str, str]] = {  # files, what is opened of them, what the message ends in
    "RLDS": (["1.0.0/features.json"], "", "got an RLDS (TensorFlow) dataset: convert it to "),
    "RLDS, a version": (["1.0.0/a.tfrecord-00000-of-00001"], "1.0.0", "got an RLDS (TensorFlow) dataset: convert it"),
    "Zarr": ([".zgroup", "data/.zgroup"], "", "got Zarr arrays: convert them to LeRobot with "),
    "Zarr in an archive": (["buffer.zarr.zip"], "buffer.zarr.zip", "got Zarr arrays: convert them to LeRobot with "),
    "a rosbag of ROS 2": (["metadata.yaml", "a_0.db3"], "", "got a rosbag: convert it to LeRobot with "),
    "a rosbag of ROS 1": (["a.bag"], "a.bag", "got a rosbag: convert it to LeRobot with "),
    "MCAP files": (["a.mcap", "b.mcap"], "", "got a rosbag: convert it to LeRobot with "),
    "LeRobot v1": (["meta_data/info.json"], "", "got a LeRobot dataset of v1: convert it to v2.0 with "),
    "HDF5 files in folders": (["a/x.hdf5"], "", 'for f in ROOT/*/*.hdf5; do rfm-client label "$f"; done'),
    "an ALOHA file": (["episode_0.aloha.hdf5"], "episode_0.aloha.hdf5", TO_ALOHA),
    "ALOHA files": (["episode_0.aloha.hdf5"], "", TO_ALOHA),
    "pictures": (["1.png", "2.png"], "", "make a video of each episode (cat $(ls -v ROOT/*.png) | ffmpeg -framerate "),
    "pictures in folders": (["a/1.jpg"], "", "(for e in ROOT/*/; do cat $(ls -v $e*.jpg) | ffmpeg -framerate 10 -i -"),
    "a video": (["a.mp4"], "a.mp4", "got a video: label its folder, with tasks.csv in it (columns video, task)"),
    "videos without a table": (["a.mp4"], "", "(cd ROOT; (echo video; ls *.mp4) > tasks.csv) and --task "),
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
        aloha(root / name) if "aloha" in name else (root / name).write_bytes(b"x")
    with pytest.raises(DatasetError) as refused:
        open_dataset(root / opened)
    assert message.replace("ROOT", str(root)) in str(refused.value)
