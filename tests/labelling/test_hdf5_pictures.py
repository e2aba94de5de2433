# SPDX-License-Identifier: MIT
"""Which pictures of a dataset are scored, and which way up."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

from labelling import LEROBOT, BrightnessScorer
from pictures import numbered, write_video
from rfm_client.data.datasets.protocol import chosen_cameras
from rfm_client.data.orientation import ORIENTATIONS, Orient, Orientation, turned
from rfm_client.labelling import DatasetError, LabelOptions, Watch, label, open_dataset

TURNED_BY_PILLOW: dict[Orientation, Image.Transpose | None] = {
    "none": None,
    "rotate180": Image.Transpose.ROTATE_180,
    "flip-vertical": Image.Transpose.FLIP_TOP_BOTTOM,
    "flip-horizontal": Image.Transpose.FLIP_LEFT_RIGHT,
    "rotate90": Image.Transpose.ROTATE_270,  # Pillow turns to the left
    "rotate270": Image.Transpose.ROTATE_90,
}
LIBERO = {
    "problem_info": json.dumps({"problem_name": "libero_kitchen", "language_instruction": "open the drawer"}),
    "bddl_file_name": "open_the_drawer.bddl",
    "macros_image_convention": "opengl",
}
ROBOMIMIC = {"env_args": json.dumps({"env_name": "Lift", "lang": "lift the cube"})}
FRAMES = np.random.default_rng(3).integers(0, 256, (4, 16, 24, 3), np.uint8)
JPEG = np.frombuffer(b"\xff\xd8\xff\xe0" + bytes(60), np.uint8)


def write(file: Path, attributes: Mapping[str, Any], *demos: Mapping[str, Any]) -> Path:
    """A file of demonstrations with these observations."""
    with h5py.File(file, "w") as opened:
        data = opened.create_group("data")
        data.attrs.update(attributes)
        for index, observations in enumerate(demos):
            demo = data.create_group(f"demo_{index}")
            demo["actions"] = np.zeros((len(FRAMES), 7))
            demo.create_group("obs")
            for name, value in observations.items():
                if isinstance(value, list):  # of a file a step
                    stored = demo.create_dataset(f"obs/{name}", (len(value),), dtype=h5py.vlen_dtype(np.uint8))
                    stored[:] = value
                else:
                    demo[f"obs/{name}"] = value
    return file


def pictures(**more: Any) -> dict[str, Any]:
    return {"agentview_rgb": FRAMES, "eye_in_hand_rgb": FRAMES + np.uint8(7), **more}


@pytest.mark.parametrize(("orientation", "transpose"), TURNED_BY_PILLOW.items(), ids=TURNED_BY_PILLOW)
def test_a_picture_is_turned_as_pillow_turns_it(orientation: Orientation, transpose: Image.Transpose | None) -> None:
    assert set(TURNED_BY_PILLOW) == set(ORIENTATIONS)
    image = Image.fromarray(FRAMES[0])
    expected = np.asarray(image if transpose is None else image.transpose(transpose))
    np.testing.assert_array_equal(turned(FRAMES[0], orientation), expected)
    np.testing.assert_array_equal(turned(FRAMES, orientation)[0], expected)


BOTH = "agentview_rgb, eye_in_hand_rgb"
TOLD = f"orient: {BOTH} flip-vertical (LIBERO stores its pictures upside down; --orient none leaves them)"
TOLD_WRIST = TOLD.replace(BOTH, "eye_in_hand_rgb")
DOUBT = (
    f"orient: {BOTH} as stored, but LIBERO, which names cameras so, stores them upside down: look at a frame, and turn "
    "them with --orient flip-vertical if they are upside down"
)
UPRIGHT: tuple[Orientation, Orientation] = ("none", "none")
FLIPPED: tuple[Orientation, Orientation] = ("flip-vertical", "flip-vertical")
ENV_ARGS = {"env_args": json.dumps({"env_name": "Libero_Kitchen_Tabletop_Manipulation"})}
STATED: dict[str, tuple[Mapping[str, Any], list[str], tuple[Orientation, Orientation], list[str]]] = {
    "LIBERO": (LIBERO, [], FLIPPED, [TOLD]),
    "LIBERO by its sentence": ({"problem_info": LIBERO["problem_info"]}, [], FLIPPED, [TOLD]),
    "LIBERO by its task file": ({"bddl_file_name": "a.bddl"}, [], FLIPPED, [TOLD]),
    "LIBERO by its environment": (ENV_ARGS, [], FLIPPED, [TOLD]),
    "LIBERO, left as stored": (LIBERO, ["none"], UPRIGHT, []),
    "LIBERO, turned otherwise": (LIBERO, ["rotate180"], ("rotate180", "rotate180"), []),
    "LIBERO, one camera otherwise": (LIBERO, ["agentview_rgb=none"], ("none", "flip-vertical"), [TOLD_WRIST]),
    "LIBERO rendered upright": ({**LIBERO, "macros_image_convention": "opencv"}, [], UPRIGHT, []),
    "robomimic with LIBERO's cameras": (ROBOMIMIC, [], UPRIGHT, [DOUBT]),
    "robomimic, one and all others": (
        ROBOMIMIC,
        ["rotate90", "eye_in_hand_rgb=flip-horizontal"],
        ("rotate90", "flip-horizontal"),
        [],
    ),
}


@pytest.mark.parametrize(("attributes", "orient", "expected", "notes"), STATED.values(), ids=STATED)
def test_pictures_of_an_hdf5_file_are_turned_as_it_says_or_as_the_caller_says(
    tmp_path: Path,
    attributes: Mapping[str, Any],
    orient: list[str],
    expected: tuple[Orientation, Orientation],
    notes: list[str],
) -> None:
    file = write(tmp_path / "demos.hdf5", attributes, pictures())
    task = None if "lang" in str(attributes) else "lift the cube"
    dataset = open_dataset(file, task=task, orient=Orient.parse(orient))
    by_camera = dict(zip(("agentview_rgb", "eye_in_hand_rgb"), expected, strict=True))
    assert dataset.orientations == {camera: one for camera, one in by_camera.items() if one != "none"}
    assert list(dataset.notes) == notes
    (episode,) = dataset.episodes
    for camera, orientation in by_camera.items():
        read = np.stack(list(dataset.frames(episode, camera)))
        np.testing.assert_array_equal(read, turned(pictures()[camera], orientation))


class Notes(Watch):
    def __init__(self) -> None:
        self.texts: list[str] = []

    def note(self, text: str) -> None:
        self.texts.append(text)


def test_labelling_says_that_pictures_are_turned(tmp_path: Path) -> None:
    notes = Notes()
    label(open_dataset(write(tmp_path / "demos.hdf5", LIBERO, pictures())), BrightnessScorer(), LabelOptions(), notes)
    assert TOLD in notes.texts


@pytest.mark.parametrize("kind", ["LeRobot", "videos"])
def test_films_are_turned_as_the_caller_says(tmp_path: Path, kind: str) -> None:
    root, camera = LEROBOT / "toy_v21", "front"
    if kind == "videos":
        root, camera = tmp_path, "video"
        write_video(root / "a.mp4", numbered(5))
        (root / "tasks.csv").write_text("video,task\na.mp4,stack the cups\n")
    stored, dataset = open_dataset(root), open_dataset(root, orient=Orient.parse([f"{camera}=rotate90"]))
    (name,) = chosen_cameras(dataset, [camera])
    assert (stored.orientations, dataset.orientations) == ({}, {name: "rotate90"})
    episode = dataset.episodes[0]
    expected = turned(np.stack(list(stored.frames(episode, name))), "rotate90")
    np.testing.assert_array_equal(np.stack(list(dataset.frames(episode, name))), expected)
    with pytest.raises(DatasetError, match=f"orient: expected one of the cameras .*{name}.*, got 'top'"):
        open_dataset(root, orient=Orient.parse(["top=rotate90"]))


UNLIKE = {
    "floats": (FRAMES / np.float32(255), "float32 [4, 16, 24, 3], not uint8: store colours as 0..255"),
    "16 bits": (FRAMES.astype(np.uint16), "uint16 [4, 16, 24, 3], not uint8: store colours as 0..255"),
    "channels first": (
        FRAMES.transpose(0, 3, 1, 2),
        "uint8 [4, 3, 16, 24], channels first: store it as uint8 [T, H, W, 3]",
    ),
    "RGBA": (
        np.concatenate([FRAMES, FRAMES[..., :1]], -1),
        "uint8 [4, 16, 24, 4], RGBA: store its first three channels, if they are uint8 RGB",
    ),
    "JPEG files": ([JPEG] * 4, "object [4], JPEG or PNG files: store decoded pictures as uint8 [T, H, W, 3]"),
    "padded JPEG files": (
        np.stack([JPEG] * 4),
        "uint8 [4, 64], JPEG or PNG files: store decoded pictures as uint8 [T, H, W, 3]",
    ),
    "depth": (
        FRAMES[..., :1].astype(np.float32),
        "float32 [4, 16, 24, 1], a depth map, a mask or another form: no colours as uint8 [T, H, W, 3]",
    ),
    "depth without channels": (
        FRAMES[..., 0].astype(np.uint16),
        "uint16 [4, 16, 24], a depth map, a mask or another form: no colours as uint8 [T, H, W, 3]",
    ),
}


@pytest.mark.parametrize(("value", "reason"), UNLIKE.values(), ids=UNLIKE)
def test_a_picture_that_is_no_8_bit_colours_is_left_out_with_the_reason(
    tmp_path: Path, value: Any, reason: str
) -> None:
    numbers = {"ee_pos": np.zeros((4, 3)), "poses": np.zeros((4, 4, 4)), "gripper": np.ones((4, 1), np.uint8)}
    file = tmp_path / "demos.hdf5"
    dataset = open_dataset(write(file, LIBERO, pictures(other=value, **numbers), pictures(other=value)))
    assert list(dataset.cameras) == ["agentview_rgb", "eye_in_hand_rgb"]
    assert dataset.left_out == {"other": reason}
    with pytest.raises(DatasetError) as refused:
        chosen_cameras(dataset, ["other"])
    assert str(refused.value) == f"cameras: expected some of {BOTH}, got 'other', which is left out: {reason}"
    with pytest.raises(DatasetError) as refused:
        open_dataset(write(file, LIBERO, {"other": value, **numbers}))
    expected = "a camera as uint8 [T, H, W, 3] in every demonstration"
    assert str(refused.value) == f"{file}: data/demo_0/obs: expected {expected}, got other: {reason}"


PARTLY = {
    "missing in the last": ([{"other": FRAMES}, {}], "missing in demo_1"),
    "missing in the first": ([{}, {"other": FRAMES}], "missing in demo_0"),
    "of another form in the last": (
        [{"other": FRAMES}, {"other": FRAMES / 255}],
        "float64 [4, 16, 24, 3], not uint8: store colours as 0..255",
    ),
}


@pytest.mark.parametrize(("demos", "reason"), PARTLY.values(), ids=PARTLY)
def test_a_camera_of_some_demonstrations_is_left_out_with_the_reason(
    tmp_path: Path, demos: list[dict[str, Any]], reason: str
) -> None:
    dataset = open_dataset(write(tmp_path / "demos.hdf5", LIBERO, *(pictures(**demo) for demo in demos)))
    assert list(dataset.cameras) == ["agentview_rgb", "eye_in_hand_rgb"]
    assert dataset.left_out == {"other": reason}
    assert len(dataset.episodes) == 2


def test_a_file_without_pictures_says_what_it_holds_and_what_renders_them(tmp_path: Path) -> None:
    with pytest.raises(
        DatasetError, match=r"got ee_pos float64 \[4, 3\]: robomimic's dataset_states_to_obs\.py renders"
    ):
        open_dataset(write(tmp_path / "demos.hdf5", ROBOMIMIC, {"ee_pos": np.zeros((4, 3))}))
