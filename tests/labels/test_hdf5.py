# SPDX-License-Identifier: MIT
"""HDF5 files: orientation and colours, files of frames, tasks, filter keys, views, broken data."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image
from pyarrow import parquet

import hdf5_writers as writers
from client_commands import invoke
from hdf5_writers import TASK
from labelling import BrightnessScorer, ByCurve, Notes
from rfm_client import FrameSize, InvalidSampleError, ProgressResult, ProgressSample
from rfm_client.frames import Correction, resize_frames
from rfm_labels import CheckpointFacts, DatasetError, LabelOptions, find_label_files, label, open_dataset

NUM_FRAMES = 5
CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")
FRAMES = np.random.default_rng(3).integers(0, 256, (NUM_FRAMES, 16, 24, 3), np.uint8)
LIBERO = {
    "problem_info": json.dumps({"problem_name": "libero_kitchen", "language_instruction": TASK}),
    "bddl_file_name": "open_the_drawer.bddl",
    "macros_image_convention": "opengl",
}


def pictures(**more: Any) -> dict[str, Any]:
    return {CAMERAS[0]: FRAMES, CAMERAS[1]: FRAMES[:, :, :16], **more}


def write(file: Path, attributes: Mapping[str, Any], *observations: Mapping[str, Any]) -> Path:
    """A file of demonstrations with these observations."""
    writers.write_robomimic(file, observations)
    return changed(file, lambda opened: opened["data"].attrs.update(attributes))


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
    return lambda opened: opened[path].attrs.__setitem__(name, value)


@pytest.fixture
def three(tmp_path: Path) -> Path:
    """Three demonstrations as robomimic writes them."""
    return writers.write_robomimic(tmp_path / "demos.hdf5", [{"front": FRAMES + seed} for seed in range(3)])


BOTH = ", ".join(CAMERAS)
TOLD = f"orient: {BOTH} flip-vertical (LIBERO stores its pictures upside down; --orient none leaves them)"
DOUBT = (
    f"orient: {BOTH} as stored, but LIBERO, which names cameras so, stores them upside down: look at a frame, and turn "
    "them with --orient flip-vertical if they are upside down"
)
UPRIGHT, FLIPPED = ("none", "none"), ("flip-vertical", "flip-vertical")
ENV_ARGS = {"env_args": json.dumps({"env_name": "Libero_Kitchen_Tabletop_Manipulation", "lang": TASK})}
ONE_AND_OTHERS = {"": "rotate90", "eye_in_hand_rgb": "flip-horizontal"}
STATED: dict[str, tuple[Mapping[str, Any], Any, tuple[str, str], list[str]]] = {
    "LIBERO": (LIBERO, None, FLIPPED, [TOLD]),
    "LIBERO by its task file": ({"bddl_file_name": "a.bddl"}, None, FLIPPED, [TOLD]),
    "LIBERO by its environment": (ENV_ARGS, None, FLIPPED, [TOLD]),
    "LIBERO, one camera otherwise": (
        LIBERO,
        {"agentview_rgb": "none"},
        ("none", "flip-vertical"),
        [TOLD.replace(BOTH, CAMERAS[1])],
    ),
    "LIBERO rendered upright": ({**LIBERO, "macros_image_convention": "opencv"}, None, UPRIGHT, []),
    "robomimic with LIBERO's cameras": ({}, None, UPRIGHT, [DOUBT]),
    "robomimic, one and all others": ({}, ONE_AND_OTHERS, ("rotate90", "flip-horizontal"), []),
}


@pytest.mark.parametrize(("attributes", "orient", "orientations", "notes"), STATED.values(), ids=STATED)
def test_pictures_are_turned_as_the_file_says_or_as_the_caller_says(
    tmp_path: Path, attributes: Mapping[str, Any], orient: Any, orientations: Any, notes: list[str]
) -> None:
    dataset = open_dataset(write(tmp_path / "demos.hdf5", attributes, pictures()), orient=orient)
    by_camera = dict(zip(CAMERAS, orientations, strict=True))
    assert dataset.corrections == {camera: Correction(one) for camera, one in by_camera.items() if one != "none"}
    assert list(dataset.notes) == notes
    for camera, orientation in by_camera.items():
        expected = Correction(orientation).applied(pictures()[camera])
        np.testing.assert_array_equal(list(dataset.frames(dataset.episodes[0], camera)), expected)


CAMERA = "data/demo_0/obs/agentview_rgb"


def test_external_storage_without_its_file_is_an_error(tmp_path: Path) -> None:
    file = write(tmp_path / "demos.hdf5", LIBERO, pictures())
    with h5py.File(file, "r+") as opened:
        del opened[CAMERA]
        stored = opened.create_dataset(CAMERA, FRAMES.shape, np.uint8, external=str(tmp_path / "raw"))
        stored[()] = FRAMES
    dataset = open_dataset(file)
    np.testing.assert_array_equal(list(dataset.stored_frames(dataset.episodes[0], "agentview_rgb")), FRAMES)
    (tmp_path / "raw").unlink()
    with pytest.raises(DatasetError, match=rf"{CAMERA}: expected readable frames, got .*external raw data file"):
        label(dataset, BrightnessScorer(), LabelOptions(output=tmp_path))


RGBA = np.concatenate([FRAMES, FRAMES[..., :1]], -1)
NO_COLOURS = "a depth map, a mask or another form: no colours as uint8 [T, H, W, 3]"
UNLIKE: dict[str, tuple[Any, str]] = {
    "floats": (FRAMES / np.float32(255), "float32 [5, 16, 24, 3], not uint8: store colours as 0..255"),
    "channels first": (
        FRAMES.transpose(0, 3, 1, 2),
        "uint8 [5, 3, 16, 24], channels first: store it as uint8 [T, H, W, 3]",
    ),
    "RGBA": (RGBA, "uint8 [5, 16, 24, 4], RGBA: store its first three channels, if they are uint8 RGB"),
    "depth": (FRAMES[..., 0].astype(np.uint16), f"uint16 [5, 16, 24], {NO_COLOURS}"),
}


@pytest.mark.parametrize(("value", "reason"), UNLIKE.values(), ids=UNLIKE)
def test_a_picture_that_is_no_8_bit_colours_or_not_in_all_demonstrations_is_left_out_with_the_reason(
    tmp_path: Path, value: Any, reason: str
) -> None:
    numbers = {"ee_pos": np.zeros((5, 3)), "poses": np.zeros((5, 4, 4)), "gripper": np.ones((5, 1), np.uint8)}
    file = tmp_path / "demos.hdf5"
    dataset = open_dataset(write(file, LIBERO, pictures(other=FRAMES), pictures(other=value, **numbers)))
    assert (tuple(dataset.cameras), dataset.left_out) == (CAMERAS, {"other": reason})
    with pytest.raises(DatasetError) as refused:
        dataset.chosen_cameras(["other"])
    assert str(refused.value) == f"cameras: expected some of {BOTH}, got 'other', which is left out: {reason}"
    with pytest.raises(DatasetError) as refused:
        open_dataset(write(file, LIBERO, {"other": value, **numbers}))
    form = "a camera as uint8 [T, H, W, 3] in every episode"
    assert str(refused.value) == f"{file}: data/demo_0/obs: expected {form}, got other: {reason}"
    write(file, LIBERO, pictures(), pictures(other=FRAMES))
    assert open_dataset(file).left_out == {"other": "missing in demo_0"}


def test_a_demonstration_s_own_task_goes_before_that_of_the_file(three: Path) -> None:
    with h5py.File(three, "r+") as opened:
        opened["data/demo_1"].attrs["ep_meta"] = json.dumps({"lang": "close the drawer", "layout_id": 3})
        opened["data/demo_2"].attrs["language_instruction"] = np.bytes_("turn on the stove")
        opened["data/demo_0"].attrs["ep_meta"] = json.dumps({"layout_id": 3})
    tasks = [TASK, "close the drawer", "turn on the stove"]
    assert [episode.task for episode in open_dataset(three).episodes] == tasks
    changed(three, lambda opened: opened["data"].attrs.pop("env_args"))
    assert [open_dataset(three).episode(number).task for number in (1, 2)] == tasks[1:]
    with pytest.raises(DatasetError, match=r"demo_0: ep_meta, or data: problem_info or env_args: expected a task as a"):
        open_dataset(three).episode(0)
    assert [episode.task for episode in open_dataset(three, task="stack").episodes] == ["stack", *tasks[1:]]


FILTERS: dict[str, tuple[dict[str, Any], str]] = {
    "another key": ({"filter_key": "test"}, "filter_key: expected one of gone, train, valid, got 'test'"),
    "no episode of both": (
        {"filter_key": "valid", "episodes": [0, 2]},
        "filter_key: expected some of the 3 episodes of the dataset, got none in valid",
    ),
    "an episode that is not there": ({"filter_key": "gone"}, "filter_key: expected some .* got 7 in gone"),
}


def test_a_filter_key_chooses_demonstrations(three: Path) -> None:
    for key, names in {"train": ["demo_2", "demo_0"], "valid": ["demo_1"], "gone": ["demo_7"]}.items():
        changed(three, put(f"mask/{key}", np.array(names, dtype="S8")))  # as robomimic's split_train_val.py
    changed(three, put("mask/others", np.array(["demo_0", "demo_00"], dtype="S8")))  # demo_00 is not in the file
    assert open_dataset(three).filter_keys == {"gone": [7], "train": [0, 2], "valid": [1]}
    report = label(open_dataset(three), BrightnessScorer(), LabelOptions(filter_key="train"))
    assert [item.episode.name for item in report.plan.items] == ["demo_0", "demo_2"]
    for options, message in FILTERS.values():
        with pytest.raises(DatasetError, match=message):
            label(open_dataset(three), BrightnessScorer(), LabelOptions(**options))


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


class ComparerByCurve(ByCurve, Comparer):
    """Is asked for all prefixes at once."""


def test_views_and_a_goal_are_shown_beside_one_camera_and_stand_in_the_provenance(tmp_path: Path) -> None:
    Image.fromarray(FRAMES[1]).save(tmp_path / "done.png")
    front, wrist = CAMERAS
    scorer, several = Comparer(), {"formats": ("progress",), "mode": "whole", "views": (wrist, front)}
    options = LabelOptions(**several, cameras=(front,), goal=str(tmp_path / "done.png"), resize=True)
    dataset = open_dataset(write(tmp_path / "demos.hdf5", LIBERO, pictures()), orient="none")
    report = label(dataset, scorer, options)
    (shown,) = (sample.trajectory for sample in scorer.shown)
    small = [resize_frames(pictures()[camera], FrameSize("exact", (8, 8))) for camera in (front, wrist, front)]
    for array, frames in zip((shown.positions, *shown.views), small, strict=True):
        np.testing.assert_array_equal(array, frames)
    assert shown.goal is not None
    assert shown.goal.shape == (8, 8, 3)
    provenance = json.loads(parquet.read_schema(report.files[0]).metadata[b"rfm.provenance"])
    assert (provenance["cameras"], provenance["views"]) == ([front], [wrist, front])
    assert provenance["goal"]["picture"] == "done.png"

    by_curve = ComparerByCurve()
    own = {**vars(options), "mode": "prefix", "frames": 2, "name": "prefixes"}
    sampling = label(dataset, by_curve, LabelOptions(**own)).plan.recipe.sampling
    assert len(by_curve.shown) == len(small[0])
    for t, sample in enumerate(by_curve.shown):
        asked = sample.trajectory
        for array, frames in zip((asked.positions, *asked.views), small, strict=True):
            np.testing.assert_array_equal(array, frames[sampling.prefix(t).indices])
        np.testing.assert_array_equal(asked.goal, shown.goal)

    last = LabelOptions(**several, cameras=(front,), goal="last", output=tmp_path / "last")
    recipe = label(dataset, scorer, last).plan.recipe
    np.testing.assert_array_equal(scorer.shown[-1].trajectory.goal, FRAMES[-1])
    assert recipe.document()["goal"] == {"picture": "last"}


NO_VIEWS: dict[str, tuple[BrightnessScorer, dict[str, Any], str]] = {
    "views of a model of one camera": (
        BrightnessScorer(),
        {"views": CAMERAS},
        r"views: expected none .*, got agentview",
    ),
    "a goal of a model of one camera": (BrightnessScorer(), {"goal": "last"}, "goal: expected none with this model, "),
    "views of two cameras": (Comparer(), {"cameras": CAMERAS, "views": CAMERAS}, r"views: expected a single .*\(--cam"),
    "a goal that is no picture": (Comparer(), {"mode": "whole", "goal": __file__}, "goal: expected an image, got "),
    "a goal that is gone": (Comparer(), {"mode": "whole", "goal": "gone.png"}, "goal: expected a picture, or last"),
}


@pytest.mark.parametrize(("scorer", "given", "message"), NO_VIEWS.values(), ids=NO_VIEWS)
def test_views_and_a_goal_that_cannot_be_shown_are_refused(
    tmp_path: Path, scorer: BrightnessScorer, given: Any, message: str
) -> None:
    dataset = open_dataset(write(tmp_path / "demos.hdf5", LIBERO, pictures()))
    with pytest.raises(InvalidSampleError, match=f"^{message}"):
        label(dataset, scorer, LabelOptions(**{"cameras": CAMERAS[:1], **given}))


def test_labels_of_two_files_in_a_folder_are_kept_apart(three: Path) -> None:
    more, before = three.with_name("demos.v2.hdf5"), three.read_bytes()
    shutil.copy(three, more)
    for file in (three, more):
        report = label(open_dataset(file), BrightnessScorer(), LabelOptions(name="mine"))
        names = (f"{file.stem}.mine_progress.parquet", f"reward_signals/{file.stem}.mine.parquet")
        assert report.files == [file.parent / name for name in names]
    assert three.read_bytes() == before
    names = r"demos, demos\.v2: name one of the HDF5 files"
    with pytest.raises(DatasetError, match=rf"expected labels of one dataset, got {names}"):
        find_label_files(three.parent)
    for file in (three, more):
        assert find_label_files(file) == [file.with_name(f"{file.stem}.mine_progress.parquet")]
        shown = invoke("label", file, "--report", "--name", "mine")
        assert shown.exit_code == 0, shown.stderr
    assert invoke("evaluate", three).exit_code == 0
    shown = invoke("label", three, "--report", "--name", "gone")
    assert f"{three.parent}: expected --name with one of the labels mine, got 'gone'" in shown.stderr


GONE, OUTSIDE = h5py.SoftLink("/nowhere"), h5py.ExternalLink("gone.hdf5", "/data")
NO_CAMERA = "data/demo_1/obs: expected a camera as uint8 [T, H, W, 3], got front: "
NOWHERE = "demo_1 has a broken link or no array"
NO_TASK = "data/demo_0: ep_meta, or data: "
REFUSED: dict[str, tuple[Callable[[Any], object], str]] = {
    "a demonstration in a lost file": (put("data/demo_1", OUTSIDE), f"{NO_CAMERA}demo_1 is a broken link"),
    "observations that are no longer there": (put("data/demo_1/obs", GONE), f"{NO_CAMERA}missing in demo_1"),
    "a camera in a lost file": (put("data/demo_1/obs/front", OUTSIDE), NO_CAMERA + NOWHERE),
    "a camera without data": (put("data/demo_1/obs/front", h5py.Empty("u1")), NO_CAMERA + NOWHERE),
    "a camera of no pixels": (put("data/demo_1/obs/front", FRAMES[:, :0]), "uint8 [5, 0, 24, 3], no pixels"),
    "a camera of no frames": (put("data/demo_1/obs/front", FRAMES[:0]), "expected one length, above 0, got obs/front"),
    "a link to itself": (put("data/demo_1/obs/front", h5py.SoftLink("/data/demo_1/obs/front")), "undamaged HDF5 file"),
    "data in a lost file": (put("data", OUTSIDE), "expected demo_0, demo_1 and so on, got none: the file holds data"),
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


def test_all_demonstrations_without_the_most_common_camera_are_left_out_by_the_list_that_is_printed(
    tmp_path: Path,
) -> None:
    both: list[dict[str, Any]] = [{"front": FRAMES, "wrist": FRAMES} for _ in range(5)]
    both[3].pop("front")
    for number in (0, 2, 4):
        both[number].pop("wrist")
    file = changed(writers.write_robomimic(tmp_path / "five.hdf5", both), put("data/demo_1", GONE))
    with pytest.raises(DatasetError) as refused:
        label(open_dataset(file), BrightnessScorer())
    form, nowhere = "expected a camera as uint8 [T, H, W, 3], got ", "demo_1 is a broken link"
    assert str(refused.value).splitlines() == [
        "episodes: expected 5 that can be labelled, got 2 with faults:",
        f"{file}: data/demo_1/obs: {form}front: {nowhere}; wrist: {nowhere}",
        f"{file}: data/demo_3/obs: {form}front: missing in demo_3",
        "to continue without the faulty episodes: --episodes 0,2,4",
    ]
    label(open_dataset(file), BrightnessScorer(), LabelOptions(episodes=[0, 2, 4]))


def others(opened: Any) -> None:
    for name in ("data/demo_a/obs", "data/demo_0_rollout/obs", "rollouts/demo_0/obs"):
        opened.create_group(name)


def masks(opened: Any) -> None:
    opened["mask/numbers"] = np.arange(2)
    opened["mask/others"] = np.array(["demo_0", "demo_00"], "S8")
    opened["mask/lost"] = GONE


NOTES: dict[str, tuple[Callable[[Any], object], list[str]]] = {
    "groups with other names": (others, []),
    "filter keys of others": (masks, []),
    "an observation after the last action": (put("data/demo_2/actions", np.zeros((NUM_FRAMES - 1, 7))), []),
    "a camera whose frames lie in other files": (
        lambda opened: opened.create_virtual_dataset("data/demo_0/obs/wrist", h5py.VirtualLayout(FRAMES.shape, "u1")),
        ["left out: wrist: a virtual dataset: copy its frames into the file"],
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
def test_notes_list_omitted_parts_and_the_rest_is_labelled(
    three: Path, change: Callable[[Any], object], lines: list[str]
) -> None:
    notes = Notes()
    report = label(open_dataset(changed(three, change)), BrightnessScorer(), LabelOptions(), notes)
    assert report.summary is not None
    assert report.summary.num_frames == 3 * NUM_FRAMES
    settings = ("cameras:", "sampling:", "frames:", "orient:")
    assert [line for line in notes.lines if not line.startswith(settings)] == lines


def test_another_layout_is_refused_with_the_readers_that_open_others(tmp_path: Path) -> None:
    file = writers.write_aloha(tmp_path / "other.hdf5", {"high": FRAMES})
    message = "data: expected demo_0, demo_1 and so on, got none: the file holds action, observations; a reader opens"
    with pytest.raises(DatasetError, match=message):
        open_dataset(file)


def test_a_camera_of_picture_files_is_left_out_with_the_reader_that_decodes_them(three: Path) -> None:
    files = np.stack([np.frombuffer(writers.jpeg(frame).ljust(2000, b"\0"), np.uint8) for frame in FRAMES])
    dataset = open_dataset(changed(three, put("data/demo_1/obs/wrist", files)))
    assert dataset.left_out == {"wrist": "missing in demo_0"}
    for number in (0, 2):
        changed(three, put(f"data/demo_{number}/obs/wrist", files))
    assert open_dataset(three).left_out["wrist"].startswith("JPEG or PNG files: a reader decodes them (--reader")
