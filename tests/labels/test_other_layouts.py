# SPDX-License-Identifier: MIT
"""Unsupported layouts of datasets: the message names the layout and the conversion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from rfm_labels import DatasetError, open_dataset

JPEGS = np.array([b"\xff\xd8\xff\xe0"] * 3, "S4")
HDF5: dict[str, tuple[str, Any]] = {  # datasets by a part of the file name
    "aloha": ("observations/images/cam_high", np.zeros((3, 8, 8, 3), np.uint8)),
    "robomind": ("observations/rgb_images/camera_top", JPEGS),
    "robotwin": ("observation/head_camera/rgb", JPEGS),
    "maniskill": ("traj_0/obs/sensor_data/base_camera/rgb", np.zeros((3, 8, 8, 3), np.uint8)),
}


def write_hdf5(file: Path, layout: str) -> None:
    path, value = HDF5[layout]
    with h5py.File(file, "w") as opened:
        opened[path] = value


TO_ALOHA = (
    "got ALOHA's layout, one episode per file (observations/images): convert its folder to LeRobot with openpi's "
)
UNREAD: dict[str, tuple[list[str], str, str]] = {  # files, the opened path, the end of the message
    "TFRecord files alone": (["1.0.0/a.tfrecord-00000-of-00001"], "1.0.0", "got TFRecord files without features.json"),
    "Zarr": ([".zgroup", "data/.zgroup"], "", "got Zarr arrays: convert them to LeRobot with "),
    "Zarr in an archive": (["buffer.zarr.zip"], "buffer.zarr.zip", "got Zarr arrays: convert them to LeRobot with "),
    "a rosbag of ROS 2": (["metadata.yaml", "a_0.db3"], "", "got a rosbag: convert it to LeRobot with "),
    "a rosbag of ROS 1": (["a.bag"], "a.bag", "got a rosbag: convert it to LeRobot with "),
    "MCAP files": (["a.mcap", "b.mcap"], "", "got a rosbag: convert it to LeRobot with "),
    "LeRobot v1": (["meta_data/info.json"], "", "got a LeRobot dataset of v1: convert it to v2.0 with "),
    "HDF5 files in folders": (["a/x.hdf5"], "", "each a dataset of its own: rfm-client label takes the folder, open_"),
    "an ALOHA file": (["episode_0.aloha.hdf5"], "episode_0.aloha.hdf5", TO_ALOHA),
    "ALOHA files": (["episode_0.aloha.hdf5"], "", TO_ALOHA),
    "a RoboMIND file": (
        ["trajectory.robomind.hdf5"],
        "trajectory.robomind.hdf5",
        "got RoboMIND's layout, one episode per file (observations/rgb_images) with JPEG files as pictures: convert its fol",
    ),
    "a RoboTwin file": (
        ["episode0.robotwin.hdf5"],
        "episode0.robotwin.hdf5",
        "got RoboTwin's layout, one episode per file (observation/CAMERA/rgb) with JPEG files as pictures: label the folder",
    ),
    "RoboTwin files": (["episode0.robotwin.hdf5"], "", "got RoboTwin's layout, one episode per file"),
    "a ManiSkill file": (
        ["trajectory.maniskill.h5"],
        "trajectory.maniskill.h5",
        "got ManiSkill's layout (traj_0, traj_1 and so on): link its pictures (obs/sensor_data/CAMERA/rgb) into data/dem",
    ),
    "pictures": (["1.png", "2.png"], "", "the folder of an episode: mkdir ROOT/0 && mv ROOT/*.png ROOT/0"),
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
        layout = next((each for each in HDF5 if f".{each}." in name), None)
        write_hdf5(root / name, layout) if layout else (root / name).write_bytes(b"x")
    with pytest.raises(DatasetError) as refused:
        open_dataset(root / opened)
    assert message.replace("ROOT", str(root)) in str(refused.value)
