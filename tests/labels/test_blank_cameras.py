# SPDX-License-Identifier: MIT
"""Cameras with black frames or without colours: warnings, and the cameras that labelling leaves out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest
from PIL import Image

from client_commands import invoke
from encoding import encode
from in_process import rfm
from labelling import FRONT, LEROBOT, WRIST, BrightnessScorer, Notes
from paths import ROOT
from rfm_labels import DatasetError, LabelOptions, label, open_dataset
from rfm_labels.plan import plan_labels
from rfm_labels.ray_engine import EpisodeActor, RayJob

TASK = "stack the cups"
ADVICE = "its scores mean nothing there; leave out the camera (--cameras) or the episodes (--episodes)"
MODELS = ROOT / "model_repository"
ENGINE = (
    *("--checkpoint", MODELS / "rfm" / "1" / "checkpoint"),
    *("--image-encoder", MODELS / "rfm_encoder" / "1" / "image_encoder"),
    *("--text-encoder", MODELS / "rfm_encoder" / "1" / "text_encoder"),
)


def noise(count: int = 12) -> np.ndarray[Any, Any]:
    return np.random.default_rng(count).integers(0, 256, (count, 16, 16, 3), np.uint8)


def black(count: int = 12) -> np.ndarray[Any, Any]:
    return np.zeros((count, 16, 16, 3), np.uint8)


def lines_of(source: Path, output: Path, **options: Any) -> list[str]:
    """Return a run's lines about blank pictures."""
    notes = Notes()
    dataset = open_dataset(source, task=TASK, override_task=True)
    label(dataset, BrightnessScorer(), LabelOptions(output=output, frames=2, **options), notes)
    return [line for line in notes.lines if "pictures" in line]


def blackened(video: Path) -> None:
    """Replace a video by the same number of black frames."""
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") * 0 for frame in container.decode(video=0)]
    encode(video, frames, "libx264", {"g": "2", "bf": "0"})


def with_black_wrist(folder: Path, *episodes: int) -> Path:
    root = Path(shutil.copytree(LEROBOT / "toy_v21", folder / "toy"))
    for episode in episodes:
        blackened(root / "videos" / "chunk-000" / WRIST / f"episode_{episode:06d}.mp4")
    return root


def hdf5(file: Path, cameras: Sequence[dict[str, Any]]) -> Path:
    with h5py.File(file, "w") as opened:
        for index, of_demo in enumerate(cameras):
            for camera, frames in of_demo.items():
                opened[f"data/demo_{index}/obs/{camera}"] = frames
    return file


def of_hdf5(folder: Path) -> Path:
    shown = [{"front": noise(), "video": black() if index in (0, 2) else noise()} for index in range(3)]
    return hdf5(folder / "demos.hdf5", shown)


def of_videos(folder: Path) -> Path:
    for index in range(3):
        encode(folder / f"{index}.mp4", list(noise() if index == 1 else black()), "libx264", {})
    return folder


def of_pictures(folder: Path) -> Path:
    for index in range(3):
        (folder / f"{index}").mkdir(parents=True)
        for t, frame in enumerate(noise() if index == 1 else black()):
            Image.fromarray(frame).save(folder / f"{index}" / f"{t}.png")
    return folder


def of_arrays(folder: Path) -> Path:
    for index in range(3):
        np.save(folder / f"{index}.npy", noise() if index == 1 else black())
    return folder


KINDS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "HDF5": (of_hdf5, "video"),
    "videos": (of_videos, "video"),
    "pictures": (of_pictures, "frames"),
    "arrays": (of_arrays, "frames"),
}


@pytest.mark.parametrize(("write", "camera"), KINDS.values(), ids=KINDS)
def test_a_line_tells_in_which_episodes_a_camera_shows_nothing(
    tmp_path: Path, write: Callable[[Path], Path], camera: str
) -> None:
    (tmp_path / "data").mkdir()
    told = lines_of(write(tmp_path / "data"), tmp_path / "labels")
    assert told == [f"{camera}: black pictures, in 2 of 3 episodes (0,2): {ADVICE}"]


def test_a_black_camera_of_a_lerobot_dataset_is_told_in_each_run_also_of_labels_that_are_kept(tmp_path: Path) -> None:
    root, output = with_black_wrist(tmp_path, 0, 1, 3), tmp_path / "labels"
    expected = f"{WRIST}: black pictures, in 2 of 3 episodes (0:2): {ADVICE}"
    assert lines_of(root, output, limit=3) == [expected]
    assert lines_of(root, output, limit=3) == [expected]
    shutil.rmtree(output / ".rfm_parts")  # now only the label files know
    assert lines_of(root, output, limit=3) == [expected]
    assert lines_of(root, output, limit=4) == [expected.replace("2 of 3 episodes (0:2)", "3 of 4 episodes (0:2,3)")]


def test_kept_labels_of_an_hdf5_file_tell_it_too(tmp_path: Path) -> None:
    file, output = of_hdf5(tmp_path), tmp_path / "labels"
    told = lines_of(file, output)
    shutil.rmtree(output / ".rfm_parts")
    assert lines_of(file, output) == told != []


@pytest.mark.parametrize("write", [of_hdf5, of_videos], ids=["HDF5", "Parquet"])
def test_a_report_of_labels_tells_it_too(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    source, output = write(tmp_path), tmp_path / "labels"
    (line,) = lines_of(source, output)
    result = invoke("label", source, "--report", "--no-picture", "--output", output)
    assert (result.exit_code, f"note: {line}" in result.stderr) == (0, True)


def test_a_dry_run_tells_of_the_episodes_that_it_tries(tmp_path: Path) -> None:
    root = with_black_wrist(tmp_path, 1)
    words = [root, *ENGINE, "--dry-run", "--workers", 2, "--frames", 2]
    result = rfm("label", *words)
    assert result.exit_code == 0, result.output
    assert f"note: {WRIST}: black pictures, in 1 of 2 episodes (1): {ADVICE}" in result.stderr


FAULTS: dict[str, tuple[np.ndarray[Any, Any], str | None]] = {
    "floats in 0..1 that became uint8": (
        (noise() / 255).astype(np.uint8),
        "black pictures, no value above 1 (multiply floats in 0..1 by 255 before they become uint8)",
    ),
    "a covered sensor": (noise() // 40, "black pictures, no value above 6"),
    "grey": (black() + np.uint8(128), "pictures that are black or of one colour"),
    "black for ten frames": (np.concatenate([noise(5), black(10), noise(5)]), "black pictures"),
    "black for nine frames": (np.concatenate([noise(5), black(9), noise(5)]), None),
    "a short black episode": (black(2), "black pictures"),
    "a dark scene": (noise() // 20, None),
}


@pytest.mark.parametrize(("frames", "told"), FAULTS.values(), ids=FAULTS)
def test_the_line_tells_what_the_pictures_show(tmp_path: Path, frames: np.ndarray[Any, Any], told: str | None) -> None:
    file = hdf5(tmp_path / "demos.hdf5", [{"front": frames}])
    expected = [f"front: {told}, in 1 of 1 episodes (0): {ADVICE}"] if told else []
    assert lines_of(file, tmp_path / "labels") == expected


def test_many_episodes_are_abbreviated(tmp_path: Path) -> None:
    shown = [{"front": noise(3) if index % 2 else black(3)} for index in range(40)]
    (told,) = lines_of(hdf5(tmp_path / "demos.hdf5", shown), tmp_path / "labels")
    assert "in 20 of 40 episodes (0,2,4,6,8,10,12,14,16,18,20,22,...): " in told


NO_COLOURS = ("agentview_depth", "depth_head", "seg_instance_id", "topDepth", "depth2", "optical-flow", "normals.0")
COLOURS = ("deep_camera", "segway", "masked_rgb", "overflow", "abnormal")


@pytest.mark.parametrize("camera", NO_COLOURS)
def test_a_camera_that_is_named_like_a_depth_map_or_a_mask_is_scored_only_if_named(tmp_path: Path, camera: str) -> None:
    file = hdf5(tmp_path / "demos.hdf5", [{"front": noise(), camera: noise()}])
    notes, options = Notes(), LabelOptions(output=tmp_path / "labels", frames=2)
    dataset = open_dataset(file, task=TASK)
    report = label(dataset, BrightnessScorer(), options, notes)
    assert report.plan.recipe.cameras == ("front",)
    (told,) = [line for line in notes.lines if line.startswith(f"left out: {camera}: ")]
    assert told.endswith("by name or mark, without colours; --cameras includes it")
    assert dataset.chosen_cameras([camera]) == (camera,)


@pytest.mark.parametrize("camera", COLOURS)
def test_other_words_are_names_of_cameras(tmp_path: Path, camera: str) -> None:
    file = hdf5(tmp_path / "demos.hdf5", [{"front": noise(), camera: noise()}])
    assert sorted(open_dataset(file, task=TASK).chosen_cameras()) == sorted(("front", camera))


def renamed(folder: Path, *cameras: tuple[str, str, str]) -> Path:
    """A LeRobot dataset whose cameras have other names. cameras: key, new key and dtype"""
    root = Path(shutil.copytree(LEROBOT / "toy_v21", folder / "toy"))
    file = root / "meta" / "info.json"
    info = json.loads(file.read_text())
    for key, new, dtype in cameras:
        info["features"][new] = {**info["features"].pop(key), "dtype": dtype}
    file.write_text(json.dumps(info))
    return root


@pytest.mark.parametrize("dtype", ["video", "image"])
def test_words_in_names_count_for_videos_and_pictures_of_lerobot(tmp_path: Path, dtype: str) -> None:
    root = renamed(tmp_path, (WRIST, "observation.images.wrist_depth", dtype))
    dataset = open_dataset(root)
    assert sorted(dataset.cameras) == [FRONT, "observation.images.wrist_depth"]
    assert dataset.chosen_cameras() == (FRONT,)
    assert dataset.chosen_cameras(["wrist_depth"]) == ("observation.images.wrist_depth",)


def test_a_dataset_of_such_cameras_alone_needs_a_name(tmp_path: Path) -> None:
    seg, depth = "observation.images.seg", "observation.images.depth"
    root = renamed(tmp_path, (FRONT, seg, "video"), (WRIST, depth, "video"))
    with pytest.raises(DatasetError) as caught:
        open_dataset(root).chosen_cameras()
    expected = f"cameras: expected some of {seg}, {depth} named: all are seg and depth cameras, got none"
    assert str(caught.value) == expected


def test_labels_of_ray_s_actors_tell_it_too(tmp_path: Path) -> None:
    root, parts, scorer = with_black_wrist(tmp_path, 1), tmp_path / "parts", BrightnessScorer()
    options, notes = LabelOptions(output=tmp_path / "labels", frames=2, limit=2, parts=str(parts)), Notes()
    dataset = open_dataset(root)
    plan = plan_labels(dataset, scorer, options)
    actor = EpisodeActor(RayJob(str(root), {}, lambda: nullcontext(scorer), plan, str(parts), workers=1))
    assert actor({"places": [[0, 1]]})["reason"] == ["", ""]
    label(dataset, scorer, options, notes)
    assert f"{WRIST}: black pictures, in 1 of 2 episodes (1): {ADVICE}" in notes.lines
