# SPDX-License-Identifier: MIT
"""HDF5 files: demonstrations, cameras, orientation, and labels."""

from __future__ import annotations

import json
import random
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import h5py
import numpy as np
import pytest
from PIL import Image
from pyarrow import parquet

from client_commands import invoke
from hdf5_writers import write_robomimic
from labelling import BrightnessScorer, Notes, brightness
from paths import ROOT
from rfm_client import FrameSize, InvalidSampleError, ProgressResult, ProgressSample, RewardError, UInt8Array
from rfm_client.frames import Correction, Orientation, resize_frames
from rfm_labels import (
    CheckpointFacts,
    DatasetError,
    LabelOptions,
    find_label_files,
    label,
    open_dataset,
    read_episode_labels,
    read_provenance,
)

LENGTHS = (5, 7, 3)
TASK = "open the drawer"
CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")
LIBERO = {
    "problem_info": json.dumps({"problem_name": "libero_kitchen", "language_instruction": TASK}),
    "bddl_file_name": "open_the_drawer.bddl",
    "macros_image_convention": "opengl",
}
ROBOMIMIC = {"env_args": json.dumps({"env_name": "Lift", "lang": "lift the cube"})}


def frames_of(index: int, camera: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    size = 24 if camera == "agentview_rgb" else 16
    return np.random.default_rng([index, size]).integers(0, 256, (LENGTHS[index], size, 16, 3), np.uint8)


def expected(index: int) -> Any:
    """Progress as the scorer gives it: the mean of the cameras' brightness."""
    return np.mean([brightness(frames_of(index, camera)) for camera in CAMERAS], axis=0)


def write(file: Path, attributes: Mapping[str, Any], *observations: Mapping[str, Any]) -> Path:
    """A file of demonstrations with these observations."""
    with h5py.File(file, "w") as opened:
        opened.create_group("data").attrs.update(attributes)
        for index, of_demo in reversed(list(enumerate(observations))):
            demo = opened["data"].create_group(f"demo_{index}")
            demo["actions"] = np.zeros((LENGTHS[index], 7))
            demo.create_group("obs")
            for name, value in of_demo.items():
                demo[f"obs/{name}"] = value
    return file


def pictures(index: int = 0, **more: Any) -> dict[str, Any]:
    return {**{camera: frames_of(index, camera) for camera in CAMERAS}, **more}


@pytest.fixture
def demos(tmp_path: Path) -> Path:
    states = [{"gripper_states": np.zeros((length, 2))} for length in LENGTHS]
    return write(tmp_path / "demos.hdf5", LIBERO, *(pictures(index, **states[index]) for index in range(3)))


TURNED_BY_PILLOW: dict[Orientation, Image.Transpose] = {
    "rotate180": Image.Transpose.ROTATE_180,
    "flip-vertical": Image.Transpose.FLIP_TOP_BOTTOM,
    "flip-horizontal": Image.Transpose.FLIP_LEFT_RIGHT,
    "rotate90": Image.Transpose.ROTATE_270,  # Pillow turns to the left
    "rotate270": Image.Transpose.ROTATE_90,
}


def turned(frames: UInt8Array, orientation: Orientation) -> UInt8Array:
    """Return frames [T, H, W, 3] as Pillow turns them."""
    if orientation == "none":
        return frames
    return np.stack([np.asarray(Image.fromarray(frame).transpose(TURNED_BY_PILLOW[orientation])) for frame in frames])


@pytest.mark.parametrize("orientation", get_args(Orientation))
def test_pictures_are_turned_as_pillow_turns_them(tmp_path: Path, orientation: Orientation) -> None:
    file = write(tmp_path / "demos.hdf5", ROBOMIMIC, pictures())
    dataset = open_dataset(file, task="lift the cube", orient=orientation)
    for camera in CAMERAS:
        read = np.stack(list(dataset.frames(dataset.episodes[0], camera)))
        np.testing.assert_array_equal(read, turned(pictures()[camera], orientation))


BOTH = ", ".join(CAMERAS)
TOLD = f"orient: {BOTH} flip-vertical (LIBERO stores its pictures upside down; --orient none leaves them)"
TOLD_WRIST = TOLD.replace(BOTH, CAMERAS[1])
DOUBT = (
    f"orient: {BOTH} as stored, but LIBERO, which names cameras so, stores them upside down: look at a frame, and turn "
    "them with --orient flip-vertical if they are upside down"
)
UPRIGHT, FLIPPED = ("none", "none"), ("flip-vertical", "flip-vertical")
ENV_ARGS = {"env_args": json.dumps({"env_name": "Libero_Kitchen_Tabletop_Manipulation"})}
ONE_AND_OTHERS = {"": "rotate90", "eye_in_hand_rgb": "flip-horizontal"}
STATED: dict[str, tuple[Mapping[str, Any], Any, tuple[str, str], list[str]]] = {
    "LIBERO": (LIBERO, None, FLIPPED, [TOLD]),
    "LIBERO by its task file": ({"bddl_file_name": "a.bddl"}, None, FLIPPED, [TOLD]),
    "LIBERO by its environment": (ENV_ARGS, None, FLIPPED, [TOLD]),
    "LIBERO, one camera otherwise": (LIBERO, {"agentview_rgb": "none"}, ("none", "flip-vertical"), [TOLD_WRIST]),
    "LIBERO rendered upright": ({**LIBERO, "macros_image_convention": "opencv"}, None, UPRIGHT, []),
    "robomimic with LIBERO's cameras": (ROBOMIMIC, None, UPRIGHT, [DOUBT]),
    "robomimic, one and all others": (ROBOMIMIC, ONE_AND_OTHERS, ("rotate90", "flip-horizontal"), []),
}


@pytest.mark.parametrize(("attributes", "orient", "orientations", "notes"), STATED.values(), ids=STATED)
def test_pictures_are_turned_as_the_file_says_or_as_the_caller_says(
    tmp_path: Path, attributes: Mapping[str, Any], orient: Any, orientations: Any, notes: list[str]
) -> None:
    file = write(tmp_path / "demos.hdf5", attributes, pictures())
    task = None if "lang" in str(attributes) else "lift the cube"
    dataset = open_dataset(file, task=task, orient=orient)
    by_camera = dict(zip(CAMERAS, orientations, strict=True))
    assert dataset.corrections == {camera: Correction(one) for camera, one in by_camera.items() if one != "none"}
    assert list(dataset.notes) == notes
    (episode,) = dataset.episodes
    for camera, orientation in by_camera.items():
        read = np.stack(list(dataset.frames(episode, camera)))
        np.testing.assert_array_equal(read, turned(pictures()[camera], orientation))


FRAMES = np.random.default_rng(3).integers(0, 256, (5, 16, 24, 3), np.uint8)


def virtual(file: Path, *sources: tuple[str, str, int, slice]) -> None:
    """Replaces a camera of the first demonstration by a virtual dataset.

    sources: file and name, the claimed frames, and the camera's frames that they make up
    """
    layout = h5py.VirtualLayout(FRAMES.shape, np.uint8)
    for name, dataset, count, part in sources:
        source = h5py.VirtualSource(name, dataset, (count, *FRAMES.shape[1:]))
        layout[part] = source[: part.stop - part.start]
    with h5py.File(file, "r+") as opened:
        del opened[OF_VIRTUAL]
        opened.create_virtual_dataset(OF_VIRTUAL, layout)


OF_VIRTUAL = "data/demo_0/obs/agentview_rgb"
SOURCES: dict[str, tuple[list[tuple[str, str, int, slice]], str | None]] = {
    "whole": ([("one.h5", "x", 3, slice(0, 3)), ("two.h5", "deep/x", 2, slice(3, 5))], None),
    "without a file": ([("one.h5", "x", 3, slice(0, 3)), ("gone.h5", "x", 2, slice(3, 5))], "the file gone.h5"),
    "without a dataset": ([("one.h5", "y", 5, slice(0, 5))], "y in .*one.h5"),
    "with a shorter dataset": (
        [("one.h5", "x", 5, slice(0, 4)), ("two.h5", "deep/x", 2, slice(4, 5))],
        "4 frames of x in .*",
    ),
    "with a hole": ([("one.h5", "x", 3, slice(0, 3))], "a source for each frame"),
    "of one that lacks a file": ([("nested.h5", "x", 5, slice(0, 5))], "the file gone.h5"),
}


@pytest.mark.parametrize(("sources", "lacks"), SOURCES.values(), ids=SOURCES)
def test_a_virtual_camera_is_refused_if_h5py_would_fill_its_frames_with_zeros(
    tmp_path: Path, sources: list[tuple[str, str, int, slice]], lacks: str | None
) -> None:
    file = write(tmp_path / "demos.hdf5", LIBERO, pictures())
    for name, dataset, part in (("one.h5", "x", slice(0, 3)), ("two.h5", "deep/x", slice(3, 5))):
        with h5py.File(tmp_path / name, "w") as opened:
            opened[dataset] = FRAMES[part]
    layout = h5py.VirtualLayout(FRAMES.shape, np.uint8)
    layout[:] = h5py.VirtualSource("gone.h5", "x", FRAMES.shape)
    with h5py.File(tmp_path / "nested.h5", "w") as opened:
        opened.create_virtual_dataset("x", layout)
    virtual(file, *sources)
    dataset = open_dataset(file)
    (episode,) = dataset.episodes
    if lacks is None:
        np.testing.assert_array_equal(list(dataset.stored_frames(episode, "agentview_rgb")), FRAMES)
        return
    expected = rf"{file}: {OF_VIRTUAL}: expected {lacks}, a source of this virtual dataset, got none"
    for read in (dataset.check, lambda *of: list(dataset.frames(*of))):
        with pytest.raises(DatasetError, match=expected):
            read(episode, "agentview_rgb")


def test_external_storage_without_its_file_is_an_error(tmp_path: Path) -> None:
    file = write(tmp_path / "demos.hdf5", LIBERO, pictures())
    with h5py.File(file, "r+") as opened:
        del opened[OF_VIRTUAL]
        stored = opened.create_dataset(OF_VIRTUAL, FRAMES.shape, np.uint8, external=str(tmp_path / "raw"))
        stored[()] = FRAMES
    dataset = open_dataset(file)
    np.testing.assert_array_equal(list(dataset.stored_frames(dataset.episodes[0], "agentview_rgb")), FRAMES)
    (tmp_path / "raw").unlink()
    with pytest.raises(DatasetError, match=rf"{OF_VIRTUAL}: expected readable frames, got .*external raw data file"):
        label(dataset, BrightnessScorer(), LabelOptions(output=tmp_path))


NO_COLOURS = "a depth map, a mask or another form: no colours as uint8 [T, H, W, 3]"
UNLIKE: dict[str, tuple[Any, str]] = {
    "floats": (FRAMES / np.float32(255), "float32 [5, 16, 24, 3], not uint8: store colours as 0..255"),
    "channels first": (
        FRAMES.transpose(0, 3, 1, 2),
        "uint8 [5, 3, 16, 24], channels first: store it as uint8 [T, H, W, 3]",
    ),
    "RGBA": (
        np.concatenate([FRAMES, FRAMES[..., :1]], -1),
        "uint8 [5, 16, 24, 4], RGBA: store its first three channels, if they are uint8 RGB",
    ),
    "depth": (FRAMES[..., 0].astype(np.uint16), f"uint16 [5, 16, 24], {NO_COLOURS}"),
}


@pytest.mark.parametrize(("value", "reason"), UNLIKE.values(), ids=UNLIKE)
def test_a_picture_that_is_no_8_bit_colours_is_left_out_with_the_reason(
    tmp_path: Path, value: Any, reason: str
) -> None:
    numbers = {"ee_pos": np.zeros((5, 3)), "poses": np.zeros((5, 4, 4)), "gripper": np.ones((5, 1), np.uint8)}
    file = tmp_path / "demos.hdf5"
    dataset = open_dataset(write(file, LIBERO, pictures(other=value, **numbers)))
    assert (tuple(dataset.cameras), dataset.left_out) == (CAMERAS, {"other": reason})
    with pytest.raises(DatasetError) as refused:
        dataset.chosen_cameras(["other"])
    assert str(refused.value) == f"cameras: expected some of {BOTH}, got 'other', which is left out: {reason}"
    with pytest.raises(DatasetError) as refused:
        open_dataset(write(file, LIBERO, {"other": value, **numbers}))
    form = "a camera as uint8 [T, H, W, 3] in every demonstration"
    assert str(refused.value) == f"{file}: data/demo_0/obs: expected {form}, got other: {reason}"


@pytest.mark.parametrize(
    ("first", "last", "reason"),
    [
        ({}, {"other": FRAMES}, "missing in demo_0"),
        ({"other": FRAMES}, {"other": FRAMES / 255}, "float64 [5, 16, 24, 3], not uint8: store colours as 0..255"),
    ],
    ids=["missing in the first", "of another form in the last"],
)
def test_a_camera_of_some_demonstrations_is_left_out_with_the_reason(
    tmp_path: Path, first: Any, last: Any, reason: str
) -> None:
    dataset = open_dataset(write(tmp_path / "demos.hdf5", LIBERO, pictures(0, **first), pictures(1, **last)))
    assert (tuple(dataset.cameras), dataset.left_out, len(dataset.episodes)) == (CAMERAS, {"other": reason}, 2)


def test_labels_say_which_cameras_are_turned_and_which_are_left_out(demos: Path) -> None:
    with h5py.File(demos, "r+") as opened:
        for index, length in enumerate(LENGTHS):
            opened[f"data/demo_{index}/obs/tactile"] = np.zeros((length, 16, 16, 3), np.float32)
    dataset, notes = open_dataset(demos, orient={CAMERAS[1]: "rotate180"}), Notes()
    (reason,) = dataset.left_out.values()
    label(dataset, BrightnessScorer(), LabelOptions(), notes)
    assert f"left out: tactile: {reason}" in notes.lines
    told = [line for line in notes.lines if line.startswith("orient: ")]
    assert told == [*dataset.notes, f"orient: {CAMERAS[1]} rotate180 (asked for)"]
    provenance = read_provenance(demos.with_name("demos.rfm_progress.parquet"))
    assert provenance["orientations"] == dict(zip(CAMERAS, ("flip-vertical", "rotate180"), strict=True))
    assert provenance["decoders"] == dict.fromkeys(CAMERAS)
    with pytest.raises(DatasetError, match=rf"got orientations\.{CAMERAS[1]}: rotate180 there, flip-vertical now: ch"):
        label(open_dataset(demos), BrightnessScorer(), LabelOptions())
    notes = Notes()
    label(dataset, BrightnessScorer(), LabelOptions(cameras=CAMERAS[:1], name="front"), notes)
    assert not [line for line in notes.lines if "tactile" in line or CAMERAS[1] in line]


def test_a_demonstration_s_own_task_goes_before_that_of_the_file(demos: Path) -> None:
    with h5py.File(demos, "r+") as opened:
        opened["data/demo_1"].attrs["ep_meta"] = json.dumps({"lang": "close the drawer", "layout_id": 3})
        opened["data/demo_2"].attrs["language_instruction"] = np.bytes_("turn on the stove")
        opened["data/demo_0"].attrs["ep_meta"] = json.dumps({"layout_id": 3})
    tasks = [TASK, "close the drawer", "turn on the stove"]
    assert [episode.task for episode in open_dataset(demos).episodes] == tasks
    with h5py.File(demos, "r+") as opened:
        del opened["data"].attrs["problem_info"]
    assert [open_dataset(demos).episode(number).task for number in (1, 2)] == tasks[1:]
    with pytest.raises(DatasetError, match=r"demo_0: ep_meta, or data: problem_info or env_args: expected a task as a"):
        open_dataset(demos).episode(0)
    assert [episode.task for episode in open_dataset(demos, task="stack").episodes] == ["stack", *tasks[1:]]


MASKS = {"train": ["demo_2", "demo_0"], "valid": ["demo_1"], "gone": ["demo_7"]}


@pytest.fixture
def masked(demos: Path) -> Path:
    with h5py.File(demos, "r+") as opened:
        for key, names in MASKS.items():
            opened[f"mask/{key}"] = np.array(names, dtype="S8")  # as robomimic's split_train_val.py
    return demos


FILTERS: dict[str, tuple[LabelOptions, str]] = {
    "another key": (LabelOptions(filter_key="test"), "filter_key: expected one of gone, train, valid, got 'test'"),
    "no episode of both": (
        LabelOptions(filter_key="valid", episodes=[0, 2]),
        "filter_key: expected some of the 3 episodes of the dataset, got none in valid",
    ),
    "an episode that is not there": (LabelOptions(filter_key="gone"), "filter_key: expected some .* got 7 in gone"),
}


@pytest.mark.parametrize(("options", "message"), FILTERS.values(), ids=FILTERS)
def test_a_filter_key_without_episodes_is_refused(masked: Path, options: LabelOptions, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        label(open_dataset(masked), BrightnessScorer(), options)


class Comparer(BrightnessScorer):
    """Reads views and a goal, and keeps them."""

    def __init__(self) -> None:
        super().__init__(max_frames=None)
        self.shown: list[ProgressSample] = []

    def checkpoint(self) -> CheckpointFacts:
        return replace(super().checkpoint(), reads_views=True, frame_size=FrameSize("exact", (8, 8)))

    def _result(self, sample: ProgressSample) -> ProgressResult:
        self.shown.append(sample)
        return super()._result(sample)


def test_views_and_a_goal_are_shown_beside_one_camera_and_stand_in_the_provenance(demos: Path) -> None:
    picture = demos.with_name("done.png")
    Image.fromarray(frames_of(0, CAMERAS[0])[1]).save(picture)
    front, wrist = CAMERAS
    scorer, several = Comparer(), {"formats": ("progress",), "mode": "whole", "episodes": [1], "views": (wrist, front)}
    options = LabelOptions(**several, cameras=(front,), goal=str(picture), resize=True)
    dataset = open_dataset(demos, orient="none")
    report = label(dataset, scorer, options)
    (shown,) = (sample.trajectory for sample in scorer.shown)
    small = [resize_frames(frames_of(1, camera), FrameSize("exact", (8, 8))) for camera in (front, wrist, front)]
    for array, frames in zip((shown.positions, *shown.views), small, strict=True):
        np.testing.assert_array_equal(array, frames)
    assert shown.goal is not None
    assert shown.goal.shape == (8, 8, 3)
    provenance = json.loads(parquet.read_schema(report.files[0]).metadata[b"rfm.provenance"])
    assert (provenance["cameras"], provenance["views"]) == ([front], [wrist, front])
    assert provenance["goal"]["picture"] == "done.png"

    last = LabelOptions(**several, cameras=(front,), goal="last", output=demos.parent / "last")
    recipe = label(dataset, scorer, last).plan.recipe
    np.testing.assert_array_equal(scorer.shown[-1].trajectory.goal, frames_of(1, front)[-1])
    assert recipe.document()["goal"] == {"picture": "last"}


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"views": CAMERAS},
            "^views: expected none with this model, which reads one camera and no goal, got agentview",
        ),
        ({"goal": "last"}, "^goal: expected none with this model, which reads one camera and no goal, got last"),
    ],
)
def test_views_and_a_goal_are_refused_for_a_model_of_one_camera(demos: Path, given: Any, told: str) -> None:
    with pytest.raises(InvalidSampleError, match=told):
        label(open_dataset(demos), BrightnessScorer(), LabelOptions(cameras=CAMERAS[:1], **given))


def test_views_stand_beside_a_single_camera_and_a_goal_is_a_picture(demos: Path) -> None:
    with pytest.raises(InvalidSampleError, match=r"^views: expected a single camera, .*; choose one \(--cameras\)$"):
        label(open_dataset(demos), Comparer(), LabelOptions(cameras=CAMERAS, views=CAMERAS))
    text = demos.with_name("text.png")
    text.write_text("no picture")
    for goal, told in ((text, "an image"), (demos.with_name("gone.png"), "a picture, or last")):
        with pytest.raises(InvalidSampleError, match=f"^goal: expected {told}, got "):
            label(open_dataset(demos), Comparer(), LabelOptions(cameras=CAMERAS[:1], mode="whole", goal=str(goal)))


def test_labels_go_to_files_beside_it_in_both_formats(demos: Path) -> None:
    before = demos.read_bytes()
    report = label(open_dataset(demos), BrightnessScorer())
    folder = demos.parent
    assert report.files == [folder / "demos.rfm_progress.parquet", folder / "reward_signals" / "demos.rfm.parquet"]
    assert find_label_files(demos) == find_label_files(folder) == report.files[:1]
    assert demos.read_bytes() == before
    assert read_provenance(report.files[0])["dataset"]["kind"] == "HDF5"
    assert parquet.read_table(report.files[0])["index"].to_pylist() == list(range(15))
    for index in range(3):
        labels = read_episode_labels(report.files[0], index)
        assert labels is not None
        np.testing.assert_allclose(labels.fused.progress, expected(index), atol=1e-6)
        of_camera = brightness(frames_of(index, CAMERAS[0]))
        np.testing.assert_allclose(labels.cameras[CAMERAS[0]].progress, of_camera, atol=1e-6)


def test_labels_of_two_files_in_a_folder_are_kept_apart(demos: Path) -> None:
    more = demos.with_name("demos.v2.hdf5")
    shutil.copy(demos, more)
    for file in (demos, more):
        label(open_dataset(file), BrightnessScorer(), LabelOptions(name="mine"))
    names = r"demos, demos\.v2: name one of the HDF5 files"
    with pytest.raises(DatasetError, match=rf"expected labels of one dataset, got {names}"):
        find_label_files(demos.parent)
    for file in (demos, more):
        assert find_label_files(file) == [file.with_name(f"{file.stem}.mine_progress.parquet")]
        told = invoke("label", file, "--report", "--name", "mine")
        assert told.exit_code == 0, told.stderr
        assert str(file.with_name(f"{file.stem}.mine_summary.png")) in told.stdout.replace("\n", "")
    assert invoke("evaluate", demos).exit_code == 0
    told = invoke("label", demos, "--report", "--name", "gone")
    assert "demos.gone_progress.parquet: expected a file of labels, got none: label the dataset first" in told.stderr


def test_a_filter_key_chooses_demonstrations(masked: Path) -> None:
    assert open_dataset(masked).filter_keys == {"gone": [7], "train": [0, 2], "valid": [1]}
    report = label(open_dataset(masked), BrightnessScorer(), LabelOptions(filter_key="train"))
    assert [item.episode.name for item in report.plan.items] == ["demo_0", "demo_2"]


def test_the_guide_s_lines_copy_a_column_back(demos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    label(open_dataset(demos), BrightnessScorer())
    guide = (ROOT / "docs" / "guides" / "label_a_dataset.md").read_text()
    (code,) = (block for block in re.findall(r"```python\n(.*?)```", guide, re.DOTALL) if "import h5py" in block)
    monkeypatch.chdir(demos.parent)
    exec(compile(code, "guide", "exec"), {})
    with h5py.File(demos) as opened:
        for index in range(3):
            np.testing.assert_allclose(opened[f"data/demo_{index}/rfm_progress"], expected(index), atol=1e-6)


TASK_OF_THREE = "open the drawer"
NUM_FRAMES = 5


@pytest.fixture
def three(tmp_path: Path) -> Path:
    """Three demonstrations as robomimic writes them."""
    shown = [np.random.default_rng(index).integers(0, 256, (NUM_FRAMES, 16, 16, 3), np.uint8) for index in range(3)]
    return write_robomimic(tmp_path / "demos.hdf5", [{"front": frames} for frames in shown], TASK_OF_THREE)


def changed(file: Path, change: Callable[[Any], object]) -> Path:
    with h5py.File(file, "r+") as opened:
        change(opened)
    return file


def put(path: str, value: Any) -> Callable[[Any], None]:
    """Replace the object at a path."""

    def change(opened: Any) -> None:
        opened.pop(path, None)
        opened[path] = value

    return change


def told(path: str, name: str, value: Any) -> Callable[[Any], None]:
    """Set an attribute of the object at a path."""

    def change(opened: Any) -> None:
        opened[path].attrs[name] = value

    return change


GONE, OUTSIDE = h5py.SoftLink("/nowhere"), h5py.ExternalLink("gone.hdf5", "/data")
PICTURES = np.zeros((NUM_FRAMES, 16, 16, 3), np.uint8)
NO_CAMERA = "data/demo_1/obs: expected a camera as uint8 [T, H, W, 3], got front: "
NOWHERE = "demo_1 has a broken link or no array"
NO_TASK = "data/demo_0: ep_meta, or data: "
REFUSED: dict[str, tuple[Callable[[Any], object], str]] = {
    "a demonstration that is no longer there": (put("data/demo_1", GONE), f"{NO_CAMERA}demo_1 is a broken link"),
    "a demonstration in a lost file": (put("data/demo_1", OUTSIDE), f"{NO_CAMERA}demo_1 is a broken link"),
    "observations that are no longer there": (put("data/demo_1/obs", GONE), f"{NO_CAMERA}missing in demo_1"),
    "a camera that is no longer there": (put("data/demo_1/obs/front", GONE), NO_CAMERA + NOWHERE),
    "a camera in a lost file": (put("data/demo_1/obs/front", OUTSIDE), NO_CAMERA + NOWHERE),
    "a camera without data": (put("data/demo_1/obs/front", h5py.Empty("u1")), NO_CAMERA + NOWHERE),
    "a camera of no pixels": (put("data/demo_1/obs/front", PICTURES[:, :0]), "uint8 [5, 0, 16, 3], no pixels"),
    "a camera of no frames": (put("data/demo_1/obs/front", PICTURES[:0]), "expected one length, above 0, got obs/fron"),
    "a link to itself": (put("data/demo_1/obs/front", h5py.SoftLink("/data/demo_1/obs/front")), "undamaged HDF5 file"),
    "data in a lost file": (
        put("data", OUTSIDE),
        "data: expected demo_0, demo_1 and so on, got none: the file holds d",
    ),
    "two demonstrations of one number": (
        lambda opened: opened["data"].copy("demo_0", "demo_00"),
        "data: expected one demonstration of each number, got demo_0 and demo_00: rename one of them",
    ),
    "two sentences in an attribute": (
        told("data/demo_0", "language", ["open", "close"]),
        "expected a task as a sentence, got ['open', 'close']",
    ),
    "an attribute that is no JSON": (
        told("data", "env_args", "{'env_name': 'Lift'}"),
        f"{NO_TASK}problem_info or env_args (no JSON object): expected a task as a sentence, got none",
    ),
    "an attribute of numbers": (told("data", "env_args", [1, 2]), "env_args (no JSON object): expected a task as a se"),
    "fewer actions than frames": (put("data/demo_1/actions", np.zeros((3, 7))), "got obs/front 5, actions 3"),
}


@pytest.mark.parametrize(("break_it", "message"), REFUSED.values(), ids=REFUSED)
def test_a_broken_file_is_refused_with_the_place(three: Path, break_it: Callable[[Any], object], message: str) -> None:
    scorer = BrightnessScorer()
    with pytest.raises(DatasetError) as refused:
        label(open_dataset(changed(three, break_it)), scorer)
    assert message in str(refused.value)
    assert scorer.num_samples == 0


def test_a_lost_demonstration_does_not_stop_the_others(three: Path) -> None:
    changed(three, put("data/demo_1", GONE))
    report = label(open_dataset(three), BrightnessScorer(), LabelOptions(episodes=[0, 2]))
    assert [item.episode.name for item in report.plan.items] == ["demo_0", "demo_2"]


def test_all_demonstrations_without_the_most_common_camera_are_left_out_by_the_list_that_is_printed(
    tmp_path: Path,
) -> None:
    file = tmp_path / "three.hdf5"
    with h5py.File(file, "w") as opened:
        for index in range(5):
            opened[f"data/demo_{index}/obs/front"] = PICTURES
            opened[f"data/demo_{index}/obs/wrist"] = PICTURES
        for gone in ("demo_1", "demo_3/obs/front", "demo_0/obs/wrist", "demo_2/obs/wrist", "demo_4/obs/wrist"):
            del opened[f"data/{gone}"]
        opened["data/demo_1"] = GONE
    with pytest.raises(DatasetError) as refused:
        label(open_dataset(file, task="stack the cups"), BrightnessScorer())
    form, nowhere = "expected a camera as uint8 [T, H, W, 3], got ", "demo_1 is a broken link"
    assert str(refused.value).splitlines() == [
        "episodes: expected 5 that can be labelled, got 2 with faults:",
        f"{file}: data/demo_1/obs: {form}front: {nowhere}; wrist: {nowhere}",
        f"{file}: data/demo_3/obs: {form}front: missing in demo_3",
        "to continue without the faulty episodes: --episodes 0,2,4",
    ]
    label(open_dataset(file, task="stack the cups"), BrightnessScorer(), LabelOptions(episodes=[0, 2, 4]))


def others(opened: Any) -> None:
    for name in ("data/demo_a/obs", "data/demo_0_rollout/obs", "rollouts/demo_0/obs"):
        opened.create_group(name)


def masks(opened: Any) -> None:
    opened["mask/train"] = np.array(["demo_0", "demo_2"], "S8")
    opened["mask/numbers"] = np.arange(2)
    opened["mask/others"] = np.array(["demo_0", "demo_00"], "S8")
    opened["mask/lost"] = GONE


def without_last_action(opened: Any) -> None:
    for demo in opened["data"].values():
        del demo["actions"]
        demo["actions"] = np.zeros((NUM_FRAMES - 1, 7))


NOTES: dict[str, tuple[Callable[[Any], object], list[str]]] = {
    "groups with other names": (
        others,
        ["left out: data/demo_0_rollout, data/demo_a, rollouts: demonstrations are data/demo_<number>"],
    ),
    "filter keys of others": (
        masks,
        [
            "left out: mask/lost: expected names of demonstrations, got no text",
            "left out: mask/numbers: expected names of demonstrations, got 0, 1",
            "left out: mask/others: expected names of demonstrations, got demo_00",
        ],
    ),
    "an observation after the last action": (
        without_last_action,
        ["lengths: demo_0, demo_1, demo_2: one observation more than actions: each observation gets a label"],
    ),
    "another number of samples": (
        told("data/demo_1", "num_samples", 7),
        ["lengths: num_samples differs: demo_1 (7, has 5): each observation gets a label"],
    ),
    "a picture that is no longer there": (
        lambda opened: [put(f"data/demo_{index}/obs/wrist", GONE)(opened) for index in range(3)],
        ["left out: wrist: demo_0 has a broken link or no array"],
    ),
    "observations in a circle": (
        put("data/demo_0/obs/all", h5py.SoftLink("/data/demo_0/obs")),
        ["left out: all: a group: expected its pictures one level up"],
    ),
    "an attribute that is no JSON": (
        told("data", "problem_info", b"libero"),
        ["data: problem_info is not a JSON object, so it states neither a task nor LIBERO"],
    ),
    "one sentence in an array": (told("data/demo_0", "language", np.array(["close it"], object)), []),
    "no text": (told("data/demo_0", "language", h5py.Empty("S4")), []),
    "numbers of another form": (put("data/demo_0/obs/point", np.zeros(NUM_FRAMES, [("x", "f4"), ("y", "f4")])), []),
    "actions that are no array": (put("data/demo_0/actions", GONE), []),
    "a type": (put("data/demo_0/obs/kind", np.dtype("f4")), [f"left out: kind: {NOWHERE.replace('1', '0')}"]),
}


@pytest.mark.parametrize(("change", "lines"), NOTES.values(), ids=NOTES)
def test_what_is_left_out_or_differs_is_told_and_the_rest_is_labelled(
    three: Path, change: Callable[[Any], object], lines: list[str]
) -> None:
    notes = Notes()
    report = label(open_dataset(changed(three, change)), BrightnessScorer(), LabelOptions(), notes)
    assert report.summary is not None
    assert report.summary.num_frames == 3 * NUM_FRAMES
    settings = ("cameras:", "sampling:", "frames:", "orient:")
    assert [line for line in notes.lines if not line.startswith(settings)] == lines


@pytest.mark.parametrize("seed", range(2))
def test_a_damaged_file_is_read_or_refused(three: Path, seed: int) -> None:
    whole, draw = three.read_bytes(), random.Random(seed)
    for number in range(15):
        damaged = bytearray(whole)
        for _ in range(draw.choice((1, 4, 16))):
            damaged[draw.randrange(len(whole))] = draw.randrange(256)
        three.write_bytes(damaged)
        try:
            options = LabelOptions(overwrite=True, parts=str(three.with_name(f"{number}")))
            label(open_dataset(three, task=TASK_OF_THREE), BrightnessScorer(), options)
        except (RewardError, OSError):
            pass
