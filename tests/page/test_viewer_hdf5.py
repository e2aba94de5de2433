# SPDX-License-Identifier: MIT
"""HDF5 datasets on the page: labels, pictures as videos, refusals."""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest

from gateway_requests import failure
from gateways import inside
from labelling import LEROBOT, BrightnessScorer
from rfm_client.options import ConfigError
from rfm_labels import LabelOptions, label, open_dataset, read_episode_labels

TASK = "open the drawer"
NUMBERS, LENGTH, FPS = (3, 7), 12, 10


@pytest.fixture
def demos(tmp_path: Path) -> Path:
    """Write two demonstrations with smooth pictures of odd size."""
    file = tmp_path / "shelf" / "demos.hdf5"
    file.parent.mkdir()
    rows, columns = np.mgrid[:63, :81]
    with h5py.File(file, "w") as opened:
        for number in NUMBERS:
            pictures = [np.stack([rows * 3, columns * 3, rows * 0 + 10 * t + number], -1) for t in range(LENGTH)]
            opened[f"data/demo_{number}/obs/front"] = np.array(pictures, np.uint8)
        about = {"env_name": "Lift", "lang": TASK, "env_kwargs": {"control_freq": FPS}}
        opened["data"].attrs["env_args"] = json.dumps(about)
    return file


def test_the_page_shows_an_hdf5_dataset_with_its_labels(demos: Path) -> None:
    label(open_dataset(demos), BrightnessScorer(), LabelOptions())
    name = "demos.rfm_progress.parquet"
    labels = read_episode_labels(demos.parent / name, NUMBERS[1])
    assert labels is not None
    with inside(dataset=(str(demos),)) as gateway:
        (about,) = gateway.get("/viewer/datasets").json()["datasets"]
        table = gateway.get("/viewer/datasets/0").json()
        curves = gateway.get(f"/viewer/datasets/0/episodes/{NUMBERS[1]}").json()
        video = gateway.get(f"/viewer/datasets/0/episodes/{NUMBERS[1]}/videos/0")
        faults = gateway.get("/viewer/datasets/0/faults").json()
        missing = gateway.get("/viewer/datasets/0/episodes/0")
    assert about == {"name": "demos.hdf5", "kind": "HDF5", "labels": [name]}
    assert (table["cameras"], table["fps"], table["has_stored_pixels"]) == (["front"], FPS, False)
    assert [(row["episode"], row["task"], row["num_frames"]) for row in table["episodes"]] == [
        (number, TASK, LENGTH) for number in NUMBERS
    ]
    assert table["episodes"][1]["final_progress"] == pytest.approx(labels.fused.progress[-1])
    assert table["provenance"]["dataset"]["kind"] == "HDF5"
    np.testing.assert_array_equal(np.float32(curves["curves"][0]["progress"]), labels.fused.progress)
    assert curves["times_s"] == pytest.approx(np.arange(LENGTH) / FPS)
    with av.open(io.BytesIO(video.content)) as container:
        frames = [(float(frame.time or 0), frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    assert [time_s for time_s, _ in frames] == pytest.approx(np.arange(LENGTH) / FPS, abs=1e-3)
    with h5py.File(demos) as opened:
        stored = opened[f"data/demo_{NUMBERS[1]}/obs/front"][()]
    shown = np.stack([frame[:63, :81] for _, frame in frames])
    assert np.abs(shown.astype(int) - stored).mean() < 3  # colours at half the resolution
    assert faults == {}
    assert failure(missing, 404) == "episode: expected one from 3 to 7, with gaps, got 0"


def external_link(opened: Any, other: Path) -> None:
    opened["data/demo_3/obs/wrist"] = h5py.ExternalLink(str(other), "/data")


def virtual(opened: Any, other: Path) -> None:
    layout = h5py.VirtualLayout((LENGTH, 16, 16, 3), np.uint8)
    layout[:] = h5py.VirtualSource(str(other), "data", (LENGTH, 16, 16, 3))
    opened.create_virtual_dataset("data/demo_3/obs/wrist", layout)


def raw(opened: Any, other: Path) -> None:
    shape = (LENGTH, 16, 16, 3)
    opened.create_dataset("data/demo_3/obs/wrist", shape, np.uint8, external=[(str(other), 0, int(np.prod(shape)))])


OUTSIDE: dict[str, Callable[[Any, Path], None]] = {"a link": external_link, "a part": virtual, "raw data": raw}


@pytest.mark.parametrize("change", OUTSIDE.values(), ids=OUTSIDE)
def test_a_file_that_would_show_another_file_is_refused(
    demos: Path, tmp_path: Path, change: Callable[[Any, Path], None]
) -> None:
    other = tmp_path / "other"
    with h5py.File(other, "w") as opened:
        opened["data"] = np.zeros((LENGTH, 16, 16, 3), np.uint8)
    with h5py.File(demos, "r+") as opened:
        change(opened, other)
    message = r"demos\.hdf5: data/demo_3/obs/wrist: expected data in the file, got data in another file"
    with pytest.raises(ConfigError, match=message), inside(dataset=(str(demos),)):
        pass


def test_a_file_that_changes_to_show_another_file_is_not_read(demos: Path, tmp_path: Path) -> None:
    path, other = "/viewer/datasets/0/episodes/3/videos/0", tmp_path / "other.hdf5"
    shutil.copy(demos, other)
    with inside(dataset=(str(demos),)) as gateway:
        assert gateway.get(path).status_code == 200
        with h5py.File(demos, "r+") as opened:
            del opened["data/demo_3/obs/front"]
            opened["data/demo_3/obs/front"] = h5py.ExternalLink(str(other), "/data/demo_3/obs/front")
        assert "expected data in the file, got data in another file" in failure(gateway.get(path), 500)
        demos.unlink()
        demos.symlink_to(other)
        assert "got a link that leaves it" in failure(gateway.get(path), 500)
        demos.unlink()
        os.mkfifo(demos)  # opening it would block until a writer comes
        assert "an HDF5 file, got a folder, a pipe, a socket or a device" in failure(gateway.get(path), 500)


def test_the_faults_are_those_that_labelling_refuses(tmp_path: Path) -> None:
    root = shutil.copytree(LEROBOT / "toy_v21", tmp_path / "toy_v21")
    with inside(dataset=(str(root),)) as gateway:
        assert gateway.get("/viewer/datasets/0/faults").json() == {}
        next(root.rglob("*front/episode_000002.mp4")).write_bytes(b"no video")
        faults = gateway.get("/viewer/datasets/0/faults").json()
    assert list(faults) == ["2"]
    assert "episode_000002.mp4: expected a whole video file, got " in faults["2"]
    assert str(tmp_path) not in faults["2"]
