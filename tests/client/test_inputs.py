# SPDX-License-Identifier: MIT
"""Trajectories from tensors, episodes and files of arrays."""

from __future__ import annotations

import re
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import av
import numpy as np
import pytest
import torch
from PIL import Image

from pictures import TOP, WRIST
from rfm_client import InvalidSampleError, Trajectory, UInt8Array, as_trajectory, load_trajectory
from rfm_client.frames import Correction, FrameFileError, Orientation, Picture, Video

FRAMES = np.random.default_rng(0).integers(0, 256, (4, 6, 8, 3), np.uint8)
SHAPED = "uint8 or float in 0..1 [T, H, W, 3] or [T, 3, H, W]"
LFS = "Git LFS's note of where it is; `git lfs pull` fetches it"
LFS_POINTER = (
    "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1048576\n"  # git leaves in place of a file
)


def channels_first(frames: UInt8Array) -> torch.Tensor:
    """Float in 0..1 [T, 3, H, W], as a LeRobot dataset gives frames."""
    return torch.from_numpy(frames).permute(0, 3, 1, 2) / 255


TENSORS: dict[str, Callable[[np.ndarray], Any]] = {
    "with a gradient": lambda array: torch.from_numpy(array).requires_grad_(),
    "bfloat16": lambda array: torch.from_numpy(array).bfloat16(),
    "a list of tensors with gradients": lambda array: [torch.from_numpy(row).requires_grad_() for row in array],
}


@pytest.mark.parametrize("made", TENSORS.values(), ids=TENSORS)
def test_a_trajectory_of_tensors_is_that_of_arrays(made: Callable[[np.ndarray], Any]) -> None:
    embeddings = np.arange(6, dtype=np.float32).reshape(2, 3) / 4  # bfloat16 holds them exactly
    trajectory = Trajectory(video_embeddings=made(embeddings), text_embedding=made(embeddings)[0])
    assert trajectory.video_embeddings is not None
    assert trajectory.video_embeddings.dtype == np.float32
    np.testing.assert_array_equal(trajectory.video_embeddings, embeddings)
    np.testing.assert_array_equal(trajectory.text_embedding, embeddings[0])


def test_frames_are_taken_from_a_tensor_without_a_copy() -> None:
    tensor = torch.from_numpy(FRAMES)
    frames = Trajectory(frames=tensor).frames  # type: ignore[arg-type]
    assert frames is not None
    np.testing.assert_array_equal(frames, FRAMES)
    assert np.shares_memory(frames, FRAMES)


def items(**more: Any) -> list[dict[str, Any]]:
    """One dict a step, as indexing a LeRobot dataset gives them."""
    return [
        {TOP: image, "action": torch.zeros(7), "task": "lift the cup", "episode_index": torch.tensor(5), **more}
        for image in channels_first(FRAMES)
    ]


EPISODES: dict[str, Any] = {
    "tensor, channels first": {TOP: channels_first(FRAMES)},
    "tensor, channels last": {TOP: torch.from_numpy(FRAMES) / 255},
    "float64 array": {TOP: FRAMES / 255},
    "uint8 array, channels first": {TOP: FRAMES.transpose(0, 3, 1, 2)},
    "list of float tensors": {TOP: list(channels_first(FRAMES))},
    "PIL images": {TOP: [Image.fromarray(frame) for frame in FRAMES]},
    "our own keys": {"frames": FRAMES},
    "one dict a step": items(),
    "a generator of dicts": (item for item in items()),
}


@pytest.mark.parametrize("episode", EPISODES.values(), ids=EPISODES)
def test_an_episode_is_read_to_the_grey_level(episode: Any) -> None:
    trajectory = as_trajectory(episode)
    assert trajectory.frames is not None
    assert trajectory.frames.dtype == np.uint8
    np.testing.assert_array_equal(trajectory.frames, FRAMES)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64, torch.bfloat16], ids=str)
def test_every_grey_level_survives_its_way_through_floats(dtype: torch.dtype) -> None:
    levels = np.arange(256, dtype=np.uint8).repeat(3).reshape(1, 16, 16, 3)
    read = as_trajectory({TOP: channels_first(levels).to(dtype)}).positions
    assert np.abs(read.astype(int) - levels).max() <= (dtype == torch.bfloat16)  # which has too few bits


def test_the_task_comes_with_the_episode() -> None:
    for told in ("lift", ["lift"], ["lift"] * 4, np.array(["lift", "lift"])):
        assert as_trajectory({TOP: FRAMES, "task": told}).task == "lift"
        assert as_trajectory({TOP: FRAMES, "task": told}, task="drop").task == "drop"


def test_the_camera_is_picked_by_name() -> None:
    dark = np.zeros_like(FRAMES)
    episode = {TOP: dark, WRIST: FRAMES, f"{TOP}_is_pad": torch.zeros(4, dtype=torch.bool), "observation.image": dark}
    np.testing.assert_array_equal(as_trajectory(episode, camera="wrist").positions, FRAMES)
    np.testing.assert_array_equal(as_trajectory(episode, camera="image").positions, dark)
    np.testing.assert_array_equal(as_trajectory(episode | {"frames": dark}, camera="wrist").positions, FRAMES)
    for camera in (None, "side"):
        with pytest.raises(InvalidSampleError, match=f"^camera: expected one of .*top, wrist.*, got {camera!r}$"):
            as_trajectory(episode, camera=camera)


@pytest.mark.parametrize("key", [TOP, "frames", "video_embeddings"])
def test_steps_beyond_the_episode_s_ends_are_left_out(key: str) -> None:
    values = np.ones((4, 5), np.float32) * np.arange(4)[:, None] if key == "video_embeddings" else FRAMES
    for padding in (torch.tensor([True, True, False, False]), [True, True, False, False]):
        episode = {key: values, f"{key}_is_pad": padding}
        np.testing.assert_array_equal(as_trajectory(episode).positions, values[2:])


BAD_EPISODES: dict[str, tuple[Any, str]] = {
    "one image": ({TOP: FRAMES[0]}, f"{TOP}: expected {SHAPED}, got uint8 [6, 8, 3]"),
    "nothing in it": ({TOP: []}, f"{TOP}: expected images of one type and size, got none"),
    "images of several sizes": (
        {TOP: [FRAMES[0], FRAMES[0, :3]]},
        f"{TOP}: expected images of one type and size, got uint8 [3, 8, 3] and uint8 [6, 8, 3]",
    ),
    "a PIL image of depths": ({TOP: [Image.new("I;16", (8, 6))]}, f"{TOP}: expected {SHAPED}, got uint16 [1, 6, 8]"),
    "a PIL image of other colours, which would be read as RGB": (
        {TOP: [Image.fromarray(FRAMES[0]).convert("HSV")]},
        f'{TOP}.picture: expected mode RGB, got mode HSV: call picture.convert("RGB")',
    ),
    "NaN": (
        {TOP: np.full((1, 2, 2, 3), np.nan)},
        f"{TOP}: expected {SHAPED}, got values from nan to nan (of floats in 0..255: float_frames_to_uint8)",
    ),
    "no camera": (
        {"observation.state": FRAMES, "action": FRAMES},
        "episode: expected observation.images.<camera>, frames or video_embeddings, got the keys "
        "observation.state, action",
    ),
    "several tasks": ({TOP: FRAMES, "task": ["a", "b"]}, "task: expected the same at all steps, got 'a' and 'b'"),
    "a task as text and as numbers": (
        {TOP: FRAMES, "task": ["1", 1, 1]},
        "task: expected the same at all steps, got '1' and 1",
    ),
    "a task in a list, once": (
        {TOP: FRAMES, "task": ["a", ["a"]]},
        "task: expected the same at all steps, got 'a' and ['a']",
    ),
    "episodes of several numbers": (
        {TOP: FRAMES, "episode_index": [[1], [1, 1]]},
        "episode_index: expected the same at all steps, got [1] and [1, 1]",
    ),
    "several episodes": (
        [*items(), *items(episode_index=torch.tensor(6))],
        "episode_index: expected the same at all steps, got 5 and 6",
    ),
    "marks of another length": (
        {TOP: FRAMES, f"{TOP}_is_pad": np.array([True])},
        f"{TOP}_is_pad: expected bool [4], got bool [1]",
    ),
    "an array": (FRAMES, "episode: expected a dict, or one dict a step, got ndarray"),
}


@pytest.mark.parametrize(("episode", "message"), BAD_EPISODES.values(), ids=BAD_EPISODES)
def test_an_episode_that_is_none_is_refused_with_the_place(episode: Any, message: str) -> None:
    with pytest.raises(InvalidSampleError) as refused:
        as_trajectory(episode)
    assert str(refused.value) == message


def test_files_of_arrays_hold_frames_or_embeddings(tmp_path: Path) -> None:
    embeddings, text = np.arange(6, dtype=np.float32).reshape(2, 3), np.arange(4, dtype=np.float32)
    np.save(tmp_path / "frames.npy", FRAMES)
    np.save(tmp_path / "floats.npy", channels_first(FRAMES).numpy())
    np.savez(tmp_path / "video.npz", frames=FRAMES, task="lift")
    for name, task in {"frames.npy": "lift", "floats.npy": "lift", "video.npz": None}.items():
        filmed = load_trajectory(tmp_path / name, task=task)
        np.testing.assert_array_equal(filmed.positions, FRAMES)
        assert filmed.task == "lift"
    np.save(tmp_path / "embeddings.npy", embeddings)
    np.savez_compressed(tmp_path / "seen", video_embeddings=embeddings, text_embedding=text)
    seen = load_trajectory((tmp_path / "seen.npz").rename(tmp_path / "seen.NPZ"))
    for read in (seen, load_trajectory(str(tmp_path / "embeddings.npy"))):
        np.testing.assert_array_equal(read.video_embeddings, embeddings)
    np.testing.assert_array_equal(seen.text_embedding, text)


def test_views_and_goal_stand_beside_the_frames_of_a_file(tmp_path: Path) -> None:
    for name, frames in {"front": FRAMES, "left": FRAMES[::-1], "short": FRAMES[:1]}.items():
        np.save(tmp_path / f"{name}.npy", frames)
    Image.fromarray(FRAMES[1]).save(tmp_path / "goal.png")
    front, left = tmp_path / "front.npy", tmp_path / "left.npy"
    goal = tmp_path / "goal.png"
    loaded = load_trajectory(front, orient="rotate180", views=[left, front], goal=goal)
    turned = FRAMES[:, ::-1, ::-1]
    for array, expected in zip((loaded.positions, *loaded.views), (turned, turned[::-1], turned), strict=True):
        np.testing.assert_array_equal(array, expected)
    np.testing.assert_array_equal(loaded.goal, FRAMES[1])
    with pytest.raises(InvalidSampleError, match=rf"short\.npy: expected {len(FRAMES)} frames, as {front}, got 1$"):
        load_trajectory(front, views=[tmp_path / "short.npy"])
    for content, found in (("words", ".*cannot identify"), (LFS_POINTER, re.escape(LFS))):
        goal.write_text(content)
        with pytest.raises(InvalidSampleError, match=rf"goal\.png: expected an image, got {found}"):
            load_trajectory(front, goal=goal)


def test_frames_of_files_are_corrected_as_the_caller_says_and_embeddings_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "video.npz", frames=FRAMES[..., ::-1], task="lift")
    np.save(tmp_path / "seen.npy", np.zeros((2, 3), np.float32))
    upright = load_trajectory(tmp_path / "video.npz", channels="bgr", orient="rotate90").positions
    np.testing.assert_array_equal(upright, np.rot90(FRAMES, -1, axes=(1, 2)))
    for name, value in {"orient": "rotate180", "channels": "bgr"}.items():
        with pytest.raises(InvalidSampleError, match=rf"^{name}: expected \w+ for embeddings, .*, got {value}"):
            load_trajectory(tmp_path / "seen.npy", **{name: value})  # type: ignore[arg-type]


TURNED: dict[Orientation, Callable[[Any], Any]] = {
    "none": lambda frames: frames,
    "rotate180": lambda frames: frames[:, ::-1, ::-1],
    "flip-vertical": lambda frames: frames[:, ::-1],
    "flip-horizontal": lambda frames: frames[:, :, ::-1],
    "rotate90": lambda frames: np.rot90(frames, -1, axes=(1, 2)),
    "rotate270": lambda frames: np.rot90(frames, axes=(1, 2)),
}


def test_a_correction_turns_frames_and_swaps_red_and_blue() -> None:
    """All readers and episodes end here."""
    assert TURNED.keys() == set(get_args(Orientation))
    for orient, turned in TURNED.items():
        np.testing.assert_array_equal(Correction(orient).applied(FRAMES), turned(FRAMES))
        np.testing.assert_array_equal(Correction(orient, "bgr").applied(FRAMES), turned(FRAMES)[..., ::-1])
    for wrong in ({"orient": "rotate45"}, {"channels": "RGB"}):
        ((name, value),) = wrong.items()
        with pytest.raises(ValueError, match=rf"^{name}: expected one of .*, got '{value}'$"):
            Correction(**wrong)  # type: ignore[arg-type]


PICTURES = {".jpg": "jpeg", ".tif": "tiff", ".png": "png", ".webp": "webp"}


@pytest.mark.parametrize("suffix", PICTURES)
def test_exif_data_turn_pictures(tmp_path: Path, suffix: str) -> None:
    """Also opened ones, and those with EXIF data but without a turn."""
    stored = np.repeat(np.repeat(FRAMES[0], 8, axis=0), 8, axis=1)
    for orientation, upright in ((1, stored), (6, np.rot90(stored, -1))):
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(stored).save(tmp_path / f"a{suffix}", quality=100, exif=exif)
        frame = Picture(tmp_path / f"a{suffix}").pixels()
        assert frame.shape == upright.shape
        assert np.abs(frame.astype(int) - upright).mean() < 16  # JPEG halves the colours' resolution
        with Image.open(tmp_path / f"a{suffix}") as opened:
            np.testing.assert_array_equal(as_trajectory({TOP: [opened]}).positions, [frame])


@pytest.mark.parametrize("kind", PICTURES.values())
def test_pictures_are_no_video(tmp_path: Path, kind: str) -> None:
    """Releases of PyAV turn them in different ways."""
    one, *others = (Image.fromarray(np.full((32, 48, 3), 80 * t, np.uint8)) for t in range(3))
    one.save(tmp_path / "one", kind)
    one.save(tmp_path / "several", kind, **({} if kind == "jpeg" else {"save_all": True, "append_images": others}))
    with tarfile.open(tmp_path / "tar", "w") as packed:  # FFmpeg finds the JPEG files in it
        packed.add(tmp_path / "one", "0")
        packed.add(tmp_path / "several", "1")
    for name in ("one", "several", *(["tar"] if kind == "jpeg" else [])):
        refused = r"expected a video file \(make one of pictures: ffmpeg .*\), got a picture file, or several"
        with pytest.raises(InvalidSampleError, match=rf"^video: {refused}"):
            load_trajectory(tmp_path / name)
        with pytest.raises(FrameFileError, match=refused):
            _ = Video(tmp_path / name).packets


def test_motion_jpeg_with_exif_data_is_turned_or_refused_with_a_remedy(tmp_path: Path) -> None:
    """PyAV 17.1 to 18.1 cannot read the EXIF data of frames."""
    exif, file = Image.Exif(), tmp_path / "all.avi"
    exif[0x0112] = 6
    with (tmp_path / "all.mjpeg").open("wb") as stored:
        for t in range(3):
            Image.fromarray(np.full((32, 48, 3), 80 * t, np.uint8)).save(stored, "jpeg", exif=exif)
    with av.open(str(tmp_path / "all.mjpeg")) as pictures, av.open(str(file), "w") as video:
        copied = video.add_stream_from_template(pictures.streams.video[0])
        for packet in pictures.demux(video=0):
            if packet.size:
                packet.stream = copied
                video.mux(packet)
    if not (17, 1) <= tuple(map(int, av.__version__.split(".")[:2])) < (19, 0):
        assert load_trajectory(file).positions.shape == (3, 48, 32, 3)
    else:
        with pytest.raises(InvalidSampleError, match=r"^video: expected frames without EXIF .*ffmpeg -i IN .*all\.avi"):
            load_trajectory(file)


class Trap:
    """Leaves a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Callable[[Path], None], tuple[Path]]:
        return Path.touch, (self.file,)


@pytest.mark.parametrize("name", ["trap.npy", "trap.npz"])
def test_pickled_objects_are_refused_unread(tmp_path: Path, name: str) -> None:
    file, sprung = tmp_path / name, tmp_path / "sprung"
    trap = np.array([Trap(sprung)], dtype=object)
    if file.suffix == ".npy":
        np.save(file, trap, allow_pickle=True)
    else:
        np.savez(file, frames=trap)
    with pytest.raises(InvalidSampleError, match=r"none pickled, got Object arrays cannot be loaded when allow_pickle"):
        load_trajectory(file)
    assert not sprung.exists()


BAD_FILES: dict[str, tuple[str, str]] = {
    "text.npy": ("frames", r"^file: expected arrays .*, got a file of another kind \("),
    "cup.npy": (LFS_POINTER, rf"^file: expected arrays .*, got {re.escape(LFS)} \("),
    "cup.mp4": (LFS_POINTER, rf"^video: expected a video file, got {re.escape(LFS)} \("),
}


@pytest.mark.parametrize(("name", "content", "message"), [(name, *told) for name, told in BAD_FILES.items()])
def test_a_file_that_holds_no_trajectory_is_refused(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InvalidSampleError, match=rf"{message}.*{name}\)$"):
        load_trajectory(tmp_path / name)


def test_arrays_have_no_frame_rate(tmp_path: Path) -> None:
    np.save(tmp_path / "frames.npy", FRAMES)
    with pytest.raises(InvalidSampleError, match=r"^fps: expected None with arrays, .*, got 3$"):
        load_trajectory(tmp_path / "frames.npy", fps=3)
