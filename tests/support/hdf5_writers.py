# SPDX-License-Identifier: MIT
"""Write HDF5 files of one episode as the recorders of ALOHA, RoboTwin, RoboMIND and ManiSkill do."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from PIL import Image

from rfm_client import UInt8Array

TASK = "stack the red block on the blue block"
RGB_MARK = b"\xff\xfe\x00\x0aXPL-RGB1"


def video(num_frames: int, seed: int = 0) -> UInt8Array:
    """Smooth pictures, reddish, uint8 [T, 48, 64, 3]."""
    rows, columns = np.mgrid[:48, :64]
    frames = [np.stack([180 + rows, columns * 2 + seed * 9, rows * 0 + 8 * t], -1) for t in range(num_frames)]
    return np.array(frames).clip(0, 255).astype(np.uint8)


def jpeg(frame: UInt8Array, mark: bytes = b"") -> bytes:
    """A JPEG file of an RGB frame. mark: a segment behind the first one"""
    file = io.BytesIO()
    Image.fromarray(frame).save(file, "JPEG", quality=90)
    stored = file.getvalue()
    end = 4 + int.from_bytes(stored[4:6], "big")
    return stored[:end] + mark + stored[end:]


def decoded(file: bytes) -> UInt8Array:
    """The pixels of a picture, by Pillow alone."""
    return np.asarray(Image.open(io.BytesIO(file)).convert("RGB"))


def write_robomimic(
    file: Path, demos: Sequence[Mapping[str, Any]] | Mapping[int, Mapping[str, Any]], task: str | None = TASK
) -> Path:
    """robomimic: a group for each demonstration, with pixels and actions. demos: observations, by number"""
    file.parent.mkdir(parents=True, exist_ok=True)
    by_number = demos if isinstance(demos, Mapping) else dict(enumerate(demos))
    with h5py.File(file, "w") as opened:
        told = {"env_name": "Lift", **({} if task is None else {"lang": task})}
        opened.create_group("data").attrs["env_args"] = json.dumps(told)
        for number, observations in by_number.items():
            demo = opened.create_group(f"data/demo_{number}")
            for name, stored in observations.items():
                demo[f"obs/{name}"] = stored
            length = len(next(iter(observations.values())))
            demo["actions"] = np.zeros((length, 7))
            demo.attrs["num_samples"] = length
    return file


def write_aloha(file: Path, cameras: Mapping[str, Any], **attributes: Any) -> Path:
    """ALOHA: arrays of pixels, or files in rows of bytes that zeros make equally long, with ``compress_len``."""
    file.parent.mkdir(parents=True, exist_ok=True)
    files = {name: stored for name, stored in cameras.items() if isinstance(stored, list)}
    width = max((len(each) for stored in files.values() for each in stored), default=0)
    with h5py.File(file, "w") as opened:
        opened.attrs.update({"sim": False, "compress": bool(files), **attributes})
        for name, stored in cameras.items():
            padded = [np.frombuffer(each.ljust(width, b"\0"), np.uint8) for each in files.get(name, ())]
            opened[f"observations/images/{name}"] = np.stack(padded) if padded else stored
        length = len(next(iter(cameras.values())))
        opened["observations/qpos"] = np.zeros((length, 14))
        opened["action"] = np.zeros((length, 14))
        if files:
            opened["compress_len"] = np.array([[len(each) for each in stored] for stored in files.values()], float)
    return file


def write_robotwin(root: Path, cameras: Mapping[str, Sequence[bytes]], sentences: Sequence[str] = (TASK,)) -> Path:
    """RoboTwin 2.0: texts of fixed length in ``data/``, the sentences in ``instructions/``."""
    file = root / "data" / "episode0.hdf5"
    file.parent.mkdir(parents=True)
    with h5py.File(file, "w") as opened:
        for name, files in cameras.items():
            width = max(map(len, files))
            opened.create_dataset(f"observation/{name}/rgb", data=list(files), dtype=f"S{width}")
            opened[f"observation/{name}/intrinsic_cv"] = np.zeros((len(files), 3, 3))
        opened["joint_action/vector"] = np.zeros((len(files), 14))
        opened["pointcloud"] = np.zeros((len(files), 0))
    if sentences:
        side = root / "instructions" / "episode0.json"
        side.parent.mkdir()
        side.write_text(json.dumps({"seen": [*sentences, "another sentence"], "unseen": ["a third"]}))
    return file


def write_robomind(file: Path, cameras: Mapping[str, Sequence[bytes]], task: str | None = TASK) -> Path:
    """RoboMIND: an array of its own length for each frame, and depth beside the colours."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(file, "w") as opened:
        for group in ("rgb_images", "depth_images"):
            for name, files in cameras.items():
                of_bytes = h5py.vlen_dtype(np.uint8)
                stored = opened.create_dataset(f"observations/{group}/{name}", (len(files),), dtype=of_bytes)
                for t, each in enumerate(files):
                    stored[t] = np.frombuffer(each, np.uint8)
        opened["puppet/joint_position"] = np.zeros((len(files), 8))
        if task is not None:
            opened["language_raw"] = np.array([task], h5py.string_dtype())
    return file


def write_maniskill(file: Path, episodes: Mapping[int, Mapping[str, UInt8Array]]) -> Path:
    """ManiSkill: pixels, with one observation more than actions, depth beside the colours, and a JSON file."""
    with h5py.File(file, "w") as opened:
        for number, cameras in episodes.items():
            group = opened.create_group(f"traj_{number}")
            for name, frames in cameras.items():
                folder = f"obs/sensor_data/{name}"
                group.create_dataset(f"{folder}/rgb", data=frames, compression="gzip", compression_opts=5)
                group.create_dataset(f"{folder}/depth", data=np.zeros((*frames.shape[:3], 1), np.int16))
            group["obs/agent/qpos"] = np.zeros((len(frames), 9))
            group["actions"] = np.zeros((len(frames) - 1, 8))
            group["success"] = np.zeros(len(frames) - 1, bool)
    told = {"env_info": {"env_id": "StackCube-v1"}, "episodes": [{"episode_id": number} for number in episodes]}
    file.with_suffix(".json").write_text(json.dumps(told))
    return file
