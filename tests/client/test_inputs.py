# SPDX-License-Identifier: MIT
"""Files, URLs, datasets and tensors -> trajectories, and frames made smaller."""

from __future__ import annotations

import json
import re
import socket
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import product
from pathlib import Path
from threading import Thread
from typing import Any

import av
import numpy as np
import pytest
import torch
from PIL import Image

import clip
from paths import VIDEOS
from rfm.engine import Engine
from rfm.rewind.encoders import ImagePreprocessor
from rfm.vlm.images import Normalisation, QwenImages, SmolImages, _scaled_to_longest, fitted_size
from rfm_client import InvalidSampleError, ProgressResult, ProgressSample, Trajectory
from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.inputs import as_trajectory, load_trajectory
from rfm_client.data.resize import resize_frames
from rfm_client.data.video import read_video

FRAMES = np.random.default_rng(0).integers(0, 256, (4, 6, 8, 3), np.uint8)
SHAPED = "uint8 or float in 0..1 [T, H, W, 3] or [T, 3, H, W]"
TOP, WRIST = "observation.images.top", "observation.images.wrist"


def channels_first(frames: UInt8Array) -> torch.Tensor:
    """Float in 0..1 [T, 3, H, W], as a LeRobot dataset gives frames."""
    return torch.from_numpy(frames).permute(0, 3, 1, 2) / 255


# Tensors where arrays are taken


def as_bfloat16(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array).bfloat16()


TENSORS: dict[str, Callable[[np.ndarray], Any]] = {
    "plain": torch.from_numpy,
    "with a gradient": lambda array: torch.from_numpy(array).requires_grad_(),
    "bfloat16": as_bfloat16,
    "float16": lambda array: torch.from_numpy(array).half(),
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


def test_a_tensor_that_does_not_fit_is_refused_as_an_array_is() -> None:
    with pytest.raises(InvalidSampleError) as refused:
        Trajectory(frames=channels_first(FRAMES).bfloat16())  # type: ignore[arg-type]
    assert str(refused.value).endswith(
        "expected uint8 [T, H, W, 3] (see float_frames_to_uint8), got float32 [4, 3, 6, 8]"
    )
    with pytest.raises(InvalidSampleError, match=r"^video_embeddings: expected finite values, got nan at \[1, 0\]$"):
        Trajectory(video_embeddings=torch.tensor([[0.0], [torch.nan]]))  # type: ignore[arg-type]


@pytest.mark.gpu
def test_tensors_are_fetched_from_the_gpu() -> None:
    frames = Trajectory(frames=torch.from_numpy(FRAMES).cuda()).frames  # type: ignore[arg-type]
    np.testing.assert_array_equal(frames, FRAMES)
    filmed = as_trajectory({TOP: channels_first(FRAMES).cuda().requires_grad_()})
    np.testing.assert_array_equal(filmed.positions, FRAMES)


def test_inputs_import_nothing_heavy() -> None:
    check = (
        "import sys, rfm_client, rfm_client.data.inputs, rfm_client.data.resize\n"
        "rfm_client.data.inputs.as_trajectory({'observation.image': [[[[0.5] * 3]]]})\n"
        "print(sorted({'torch', 'PIL', 'av', 'pandas'} & set(sys.modules)))"
    )
    output = subprocess.run([sys.executable, "-c", check], check=True, capture_output=True, text=True).stdout
    assert output.strip() == "[]"


# Datasets


def items(**more: Any) -> list[dict[str, Any]]:
    """One dict a step, as indexing a LeRobot dataset gives them."""
    return [
        {TOP: image, "action": torch.zeros(7), "task": "lift the cup", "episode_index": torch.tensor(5), **more}
        for image in channels_first(FRAMES)
    ]


EPISODES: dict[str, Any] = {
    "tensor, channels first": {TOP: channels_first(FRAMES)},
    "tensor, channels last": {TOP: torch.from_numpy(FRAMES) / 255},
    "uint8 tensor, channels first": {TOP: torch.from_numpy(FRAMES).permute(0, 3, 1, 2)},
    "with a gradient": {TOP: channels_first(FRAMES).requires_grad_()},
    "float16": {TOP: channels_first(FRAMES).half()},
    "float64 array": {TOP: FRAMES / 255},
    "uint8 array, channels first": {TOP: FRAMES.transpose(0, 3, 1, 2)},
    "list of float tensors": {TOP: list(channels_first(FRAMES))},
    "tuple of uint8 arrays": {TOP: tuple(FRAMES)},
    "PIL images": {TOP: [Image.fromarray(frame) for frame in FRAMES]},
    "a camera without a name": {"observation.image": channels_first(FRAMES)},
    "our own keys": {"frames": FRAMES},
    "our own keys, float": {"frames": channels_first(FRAMES)},
    "one dict a step": items(),
    "a generator of dicts": (item for item in items()),
}


@pytest.mark.parametrize("episode", EPISODES.values(), ids=EPISODES)
def test_an_episode_is_read_to_the_grey_level(episode: Any) -> None:
    trajectory = as_trajectory(episode)
    assert trajectory.frames is not None
    assert trajectory.frames.dtype == np.uint8
    np.testing.assert_array_equal(trajectory.frames, FRAMES)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64], ids=str)
def test_every_grey_level_survives_its_way_through_floats(dtype: torch.dtype) -> None:
    levels = np.arange(256, dtype=np.uint8).repeat(3).reshape(1, 16, 16, 3)
    np.testing.assert_array_equal(as_trajectory({TOP: channels_first(levels).to(dtype)}).positions, levels)


def test_bfloat16_images_are_read_as_closely_as_they_are_told() -> None:
    levels = np.arange(256, dtype=np.uint8).repeat(3).reshape(1, 16, 16, 3)
    read = as_trajectory({TOP: channels_first(levels).bfloat16()}).positions
    assert np.abs(read.astype(int) - levels).max() <= 1


TASKS: dict[str, tuple[Any, str]] = {
    "text": ("lift", "lift"),
    "a list of one": (["lift"], "lift"),
    "one a step": (["lift"] * 4, "lift"),
    "an array": (np.array("lift"), "lift"),
    "an array of one a step": (np.array(["lift", "lift"]), "lift"),
}


@pytest.mark.parametrize(("told", "task"), TASKS.values(), ids=TASKS)
def test_the_task_comes_with_the_episode(told: Any, task: str) -> None:
    assert as_trajectory({TOP: FRAMES, "task": told}).task == task
    assert as_trajectory({TOP: FRAMES, "task": told}, task="drop").task == "drop"


def test_an_episode_need_not_tell_its_task() -> None:
    assert as_trajectory({TOP: FRAMES}).task == ""
    assert as_trajectory(items()).task == "lift the cup"


def test_the_camera_is_picked_by_name() -> None:
    dark = np.zeros_like(FRAMES)
    episode = {TOP: dark, WRIST: FRAMES, f"{TOP}_is_pad": torch.zeros(4, dtype=torch.bool), "observation.image": dark}
    np.testing.assert_array_equal(as_trajectory(episode, camera="wrist").positions, FRAMES)
    np.testing.assert_array_equal(as_trajectory(episode, camera="image").positions, dark)
    np.testing.assert_array_equal(as_trajectory(episode | {"frames": dark}, camera="wrist").positions, FRAMES)


def test_steps_beyond_the_episode_s_ends_are_left_out() -> None:
    episode = {TOP: channels_first(FRAMES), f"{TOP}_is_pad": torch.tensor([True, True, False, False])}
    np.testing.assert_array_equal(as_trajectory(episode).positions, FRAMES[2:])


def test_embeddings_are_read_from_a_dict() -> None:
    episode = {"video_embeddings": torch.ones(3, 5, requires_grad=True), "text_embedding": torch.ones(2).bfloat16()}
    trajectory = as_trajectory(episode)
    np.testing.assert_array_equal(trajectory.positions, np.ones((3, 5), np.float32))
    np.testing.assert_array_equal(trajectory.text_embedding, np.ones(2, np.float32))


BAD_EPISODES: dict[str, tuple[Any, str | None, str]] = {
    "no images": ({TOP: torch.ones(4, 5)}, None, f"{TOP}: expected {SHAPED}, got float32 [4, 5]"),
    "one image": ({TOP: FRAMES[0]}, None, f"{TOP}: expected {SHAPED}, got uint8 [6, 8, 3]"),
    "grey images": ({TOP: FRAMES[..., :1]}, None, f"{TOP}: expected {SHAPED}, got uint8 [4, 6, 8, 1]"),
    "a number": ({TOP: 0.5}, None, f"{TOP}: expected {SHAPED}, got float64 [1]"),
    "integers": ({TOP: FRAMES.astype(np.int64)}, None, f"{TOP}: expected {SHAPED}, got int64 [4, 6, 8, 3]"),
    "nothing in it": ({TOP: []}, None, f"{TOP}: expected images of one type and size, got none"),
    "pixels without an edge": ({TOP: FRAMES[:, :0]}, None, f"{TOP}: expected {SHAPED}, got uint8 [4, 0, 8, 3]"),
    "images of several sizes": (
        {TOP: [FRAMES[0], FRAMES[0, :3]]},
        None,
        f"{TOP}: expected images of one type and size, got uint8 [3, 8, 3] and uint8 [6, 8, 3]",
    ),
    "a PIL image of depths": (
        {TOP: [Image.new("I;16", (8, 6))]},
        None,
        f"{TOP}: expected {SHAPED}, got uint16 [1, 6, 8]",
    ),
    "floats in 0..255": (
        {TOP: FRAMES.astype(np.float32)},
        None,
        f"{TOP}: expected {SHAPED}, got values from 0 to 249 (of floats in 0..255: float_frames_to_uint8)",
    ),
    "normalised floats": (
        {"frames": np.full((1, 2, 2, 3), -0.5)},
        None,
        f"frames: expected {SHAPED}, got values from -0.5 to -0.5 (of floats in 0..255: float_frames_to_uint8)",
    ),
    "NaN": (
        {TOP: np.full((1, 2, 2, 3), np.nan)},
        None,
        f"{TOP}: expected {SHAPED}, got values from nan to nan (of floats in 0..255: float_frames_to_uint8)",
    ),
    "several cameras": ({TOP: FRAMES, WRIST: FRAMES}, None, "camera: expected one of top, wrist, got None"),
    "another camera": ({TOP: FRAMES, WRIST: FRAMES}, "side", "camera: expected one of top, wrist, got 'side'"),
    "no camera": (
        {"observation.state": FRAMES, "action": FRAMES},
        None,
        "episode: expected observation.images.<camera>, frames or video_embeddings, got the keys "
        "observation.state, action",
    ),
    "frames and embeddings": (
        {"frames": FRAMES, "video_embeddings": np.ones((4, 5), np.float32)},
        None,
        "trajectory: expected either frames or video_embeddings, got both",
    ),
    "several tasks": ({TOP: FRAMES, "task": ["a", "b"]}, None, "task: expected the same at all steps, got 'a' and 'b'"),
    "a task that is no text": ({TOP: FRAMES, "task": torch.tensor(3)}, None, "task: expected str, got int"),
    "several episodes": (
        [*items(), *items(episode_index=torch.tensor(6))],
        None,
        "episode_index: expected the same at all steps, got 5 and 6",
    ),
    "a step without the camera": (
        [*items(), {"task": "lift the cup", "episode_index": 5}],
        None,
        f"{TOP}: expected images of one type and size, got float32 [3, 6, 8] and object []",
    ),
    "marks of another length": (
        {TOP: FRAMES, f"{TOP}_is_pad": np.array([True])},
        None,
        f"{TOP}_is_pad: expected bool [4], got bool [1]",
    ),
    "nothing but padding": (
        {TOP: FRAMES, f"{TOP}_is_pad": np.ones(4, bool)},
        None,
        "frames: expected at least one frame of at least one pixel, got uint8 [0, 6, 8, 3]",
    ),
    "an array": (FRAMES, None, "episode: expected a dict, or one dict a step, got ndarray"),
    "a path": ("film.mp4", None, "episode: expected a dict, or one dict a step, got str"),
    "None": (None, None, "episode: expected a dict, or one dict a step, got NoneType"),
    "no steps": ([], None, "episode: expected a dict, or one dict a step, got nothing"),
}


@pytest.mark.parametrize(("episode", "camera", "message"), BAD_EPISODES.values(), ids=BAD_EPISODES)
def test_an_episode_that_is_none_is_refused_with_the_place(episode: Any, camera: str | None, message: str) -> None:
    with pytest.raises(InvalidSampleError) as refused:
        as_trajectory(episode, camera=camera)
    assert str(refused.value) == message


# Files


def test_npy_files_hold_frames_or_embeddings(tmp_path: Path) -> None:
    embeddings = np.arange(6, dtype=np.float32).reshape(2, 3)
    np.save(tmp_path / "frames.npy", FRAMES)
    np.save(tmp_path / "floats.npy", channels_first(FRAMES).numpy())
    np.save(tmp_path / "embeddings.npy", embeddings)
    for name in ("frames.npy", "floats.npy"):
        filmed = load_trajectory(tmp_path / name, task="lift")
        np.testing.assert_array_equal(filmed.positions, FRAMES)
        assert filmed.task == "lift"
    np.testing.assert_array_equal(load_trajectory(str(tmp_path / "embeddings.npy")).video_embeddings, embeddings)


def test_npz_files_hold_a_whole_trajectory(tmp_path: Path) -> None:
    embeddings, text = np.arange(6, dtype=np.float32).reshape(2, 3), np.arange(4, dtype=np.float32)
    np.savez(tmp_path / "film.npz", frames=FRAMES, task="lift the cup")
    np.savez_compressed(tmp_path / "seen.NPZ", video_embeddings=embeddings, text_embedding=text)
    (tmp_path / "seen.NPZ.npz").rename(tmp_path / "seen.NPZ")
    film, seen = load_trajectory(tmp_path / "film.npz"), load_trajectory(tmp_path / "seen.NPZ")
    np.testing.assert_array_equal(film.positions, FRAMES)
    assert film.task == "lift the cup"
    np.testing.assert_array_equal(seen.video_embeddings, embeddings)
    np.testing.assert_array_equal(seen.text_embedding, text)


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
    with pytest.raises(InvalidSampleError) as refused:
        load_trajectory(file)
    assert str(refused.value) == (
        "file: expected arrays of numbers and text, none pickled, got "
        f"Object arrays cannot be loaded when allow_pickle=False ({file})"
    )
    assert not sprung.exists()


def text_file(file: Path) -> None:
    file.write_text("frames")


def broken_npz(file: Path) -> None:
    np.savez(file, frames=FRAMES)
    content = bytearray(file.read_bytes())
    content[200:240] = bytes(40)
    file.write_bytes(content)


def broken_header(file: Path) -> None:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3\n"  # a bracket is missing
    file.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(24))


BAD_FILES: dict[str, tuple[str, Callable[[Path], Any], str]] = {
    "a text": ("text.npy", text_file, r"^file: expected arrays .*, got .*pickled.* \(.*text\.npy\)$"),
    "an empty file": ("empty.npy", Path.touch, r"^file: expected arrays .*, got No data left in file \(.*\)$"),
    "a broken archive": ("film.npz", broken_npz, r"^file: expected arrays .*, got Bad CRC-32 .*film\.npz\)$"),
    "a broken header": ("film.npy", broken_header, r"^file: expected arrays .*, got .*film\.npy\)$"),
    "no file": ("nothing.npy", lambda file: None, r"^file: expected arrays .*, got .*No such file.*nothing\.npy\)$"),
    "one text embedding": (
        "text.npy",
        lambda file: np.save(file, np.ones(4, np.float32)),
        rf"^frames: expected {re.escape(SHAPED)}, got float32 \[4\] \(.*text\.npy\)$",
    ),
    "other arrays": (
        "log.npz",
        lambda file: np.savez(file, actions=np.ones(4)),
        r"^episode: expected .*, got the keys actions \(.*log\.npz\)$",
    ),
}


@pytest.mark.parametrize(("name", "write", "message"), BAD_FILES.values(), ids=BAD_FILES)
def test_a_file_that_holds_no_trajectory_is_refused(
    tmp_path: Path, name: str, write: Callable[[Path], Any], message: str
) -> None:
    write(tmp_path / name)
    with pytest.raises(InvalidSampleError, match=message):
        load_trajectory(tmp_path / name)


def test_arrays_have_no_frame_rate(tmp_path: Path) -> None:
    np.save(tmp_path / "frames.npy", FRAMES)
    with pytest.raises(InvalidSampleError, match=r"^fps: expected None with arrays, .*, got 3$"):
        load_trajectory(tmp_path / "frames.npy", fps=3)


# Videos


def write_video(file: Path, frames: UInt8Array, times: list[int] | None = None, *, shown_from: int = 0) -> None:
    """A video of 10 fps, or of frames at these tenths of a second; frames before ``shown_from`` are not to be shown."""
    with av.open(str(file), "w", options={"avoid_negative_ts": "disabled"} if shown_from else {}) as container:
        stream = container.add_stream("libx264", rate=Fraction(10), options={"bf": "0", "crf": "1"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv444p"
        packets = []
        for time, image in zip(times or range(len(frames)), frames, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 10)
            packets += stream.encode(frame)
        for packet in [*packets, *stream.encode()]:
            packet.pts -= shown_from
            packet.dts -= shown_from
            container.mux(packet)


def numbered(count: int) -> UInt8Array:
    """Grey frames [count, 32, 32, 3], each of its own brightness; ``numbers`` reads them back."""
    grey = (np.arange(count) * 240 // count).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(grey[:, None, None, None], (count, 32, 32, 3)))


def numbers(frames: UInt8Array, count: int) -> list[int]:
    """Which of ``numbered(count)`` the frames are."""
    means = frames.mean(axis=(1, 2, 3))
    return np.abs(means[:, None] - numbered(count)[:, 0, 0, 0]).argmin(axis=1).tolist()


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("film") / "clip.mp4"
    clip.write(file)
    return file


def test_a_video_is_read_whole_or_at_a_frame_rate(film: Path) -> None:
    whole = load_trajectory(film, task=clip.TASK)
    assert whole.task == clip.TASK
    assert np.abs(whole.positions.astype(int) - clip.render()).mean() < 8  # lossy, but the same picture
    sampled = load_trajectory(str(film), fps=3).positions
    indices = np.linspace(0, clip.NUM_FRAMES - 1, round(clip.NUM_FRAMES * 3 / clip.FPS)).astype(int)
    np.testing.assert_array_equal(sampled, whole.positions[indices])


@pytest.mark.parametrize("fps", [0, -1, float("nan"), float("inf")])
def test_a_frame_rate_is_a_number_above_0(film: Path, fps: float) -> None:
    with pytest.raises(InvalidSampleError, match=rf"^fps: expected a number above 0, got {fps}$"):
        read_video(film, fps)


def test_frames_of_a_variable_rate_are_even_in_number(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", numbered(10), [0, 1, 2, 3, 4, 5, 6, 20, 40, 60])  # 1.6 fps on average
    assert numbers(read_video(tmp_path / "film.mp4"), 10) == list(range(10))
    assert numbers(read_video(tmp_path / "film.mp4", 0.82), 10) == [0, 2, 4, 6, 9]


def test_packets_without_a_frame_do_not_count(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", numbered(10), shown_from=4)
    with av.open(str(tmp_path / "film.mp4")) as container:
        assert container.streams.video[0].frames == 10  # as the container tells, wrongly
    assert numbers(read_video(tmp_path / "film.mp4"), 10) == [4, 5, 6, 7, 8, 9]
    assert numbers(read_video(tmp_path / "film.mp4", 5), 10) == [4, 6, 9]


# The display matrix of a track: (a, b, c, d) of x' = a x + c y, y' = b x + d y, y downwards (ISO 14496-12).
TURNS: dict[str, tuple[tuple[int, int, int, int], int]] = {
    "clockwise": ((0, 1, -1, 0), -1),
    "upside down": ((-1, 0, 0, -1), 2),
    "counter-clockwise": ((0, -1, 1, 0), 1),
}


@pytest.mark.parametrize(("matrix", "quarter_turns"), TURNS.values(), ids=TURNS)
def test_a_turned_video_is_read_upright(tmp_path: Path, matrix: tuple[int, int, int, int], quarter_turns: int) -> None:
    picture = np.zeros((1, 32, 64, 3), np.uint8)
    picture[:, :16, :32], picture[:, :16, 32:], picture[:, 16:, :32] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    write_video(tmp_path / "film.mp4", picture)
    content = (tmp_path / "film.mp4").read_bytes()
    a, b, c, d = (value << 16 for value in matrix)
    start = content.index(b"tkhd") + 4 + 40  # version 0: the matrix follows 40 bytes of other fields
    turned = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    (tmp_path / "film.mp4").write_bytes(content[:start] + turned + content[start + len(turned) :])
    upright = np.rot90(picture[0], quarter_turns)
    read = read_video(tmp_path / "film.mp4")[0]
    assert read.shape == upright.shape
    assert np.abs(read.astype(int) - upright).mean() < 3


def test_only_the_picked_frames_of_a_long_video_are_held(tmp_path: Path) -> None:
    frames = numbered(200)
    write_video(tmp_path / "film.mp4", frames)
    read_video(tmp_path / "film.mp4", 0.1)  # imports done
    tracemalloc.start()
    picked = read_video(tmp_path / "film.mp4", 0.2)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert numbers(picked, 200) == [0, 66, 132, 199]
    assert peak < 40 * frames[0].nbytes


def test_a_sound_is_no_video(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=16_000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16_000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(InvalidSampleError) as refused:
        read_video(tmp_path / "sound.mp4")
    assert str(refused.value) == f"video: expected a file with a video stream, got none ({tmp_path / 'sound.mp4'})"


# URLs


class FileServer(ThreadingHTTPServer):
    """Serves the files of a folder, and notes what was asked for; ``/short/...`` ends before its end."""

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), FileRequest)
        self.folder = folder
        self.asked: list[str] = []

    def url(self, path: str) -> str:
        return f"http://127.0.0.1:{self.server_port}/{path}"


class FileRequest(BaseHTTPRequestHandler):
    server: FileServer

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        file = self.server.folder / Path(self.path.partition("?")[0]).name
        if not file.exists():
            self.send_error(404)
            return
        content = file.read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content[:-9] if self.path.startswith("/short/") else content)

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def serving(folder: Path) -> Iterator[FileServer]:
    with FileServer(folder) as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def test_a_url_is_downloaded_once_and_read_as_the_file_is(film: Path) -> None:
    with serving(film.parent) as server:
        loaded = load_trajectory(server.url("clip.mp4?token=3"), task=clip.TASK, fps=3)
        assert server.asked == ["/clip.mp4?token=3"]
    np.testing.assert_array_equal(loaded.positions, read_video(film, 3))


@pytest.mark.parametrize("file", sorted(VIDEOS.glob("*.mp4")), ids=lambda file: file.stem)
def test_a_robot_video_is_the_same_behind_a_url(file: Path) -> None:
    with serving(VIDEOS) as server:
        np.testing.assert_array_equal(read_video(server.url(file.name), 3), read_video(file, 3))


BAD_URLS = {
    "not there": ("nothing.mp4", "HTTP Error 404: Not Found"),
    "broken off": ("short/clip.mp4", "[0-9]+ of [0-9]+ bytes came"),
    "no video": ("text.mp4", "Invalid data found when processing input"),
}


@pytest.mark.parametrize(("path", "reason"), BAD_URLS.values(), ids=BAD_URLS)
def test_a_url_that_fails_is_told_with_its_reason(film: Path, path: str, reason: str) -> None:
    (film.parent / "text.mp4").write_text("no video")
    with serving(film.parent) as server, pytest.raises(InvalidSampleError) as refused:
        load_trajectory(server.url(path))
    expected = f"video: expected a file with a video stream, got {reason} "
    assert re.fullmatch(expected + re.escape(f"({server.url(path)})"), str(refused.value))


def test_a_server_that_says_nothing_is_given_up() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/clip.mp4"
        with pytest.raises(InvalidSampleError, match=r"^video: expected .*, got timed out \(http://.*\)$"):
            read_video(url, 3, timeout_s=0.1)
    with pytest.raises(InvalidSampleError, match=r"^video: expected .*, got .*Connection refused.* \(http://.*\)$"):
        read_video(url, 3)


@pytest.mark.parametrize("url", ["http://", "http://localhost:none/", "http://local host/", "https://lücke/\n"])
def test_a_url_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(InvalidSampleError, match=r"^video: expected a file with a video stream, got "):
        read_video(url, 3)


# Frames made smaller


@pytest.mark.parametrize("text", ["shortest 256", "longest 512", "exact 224x320"])
def test_a_frame_size_is_read_and_written(text: str) -> None:
    assert str(FrameSize.parse(text)) == text


def test_a_frame_size_tells_its_parts() -> None:
    assert FrameSize.parse("shortest 256") == FrameSize("shortest", (256,))
    assert FrameSize.parse("exact 224x320") == FrameSize("exact", (224, 320))


@pytest.mark.parametrize(
    "text",
    ["", "256", "shortest", "shortest 0", "shortest -1", "shortest 2x3", "exact 224", "longest 512 ", "exact ٣x٣"],
)
def test_a_frame_size_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError) as refused:
        FrameSize.parse(text)
    forms = "'shortest PX', 'longest PX' or 'exact HEIGHTxWIDTH'"
    assert str(refused.value) == f"frame_size: expected {forms}, got {text!r}"


FITTED = {
    "landscape": ("shortest 256", (480, 640), (256, 341)),
    "portrait": ("shortest 256", (640, 480), (341, 256)),
    "square": ("shortest 256", (300, 300), (256, 256)),
    "small enough": ("shortest 256", (256, 4000), (256, 4000)),
    "longest landscape": ("longest 512", (480, 640), (384, 512)),
    "longest to an even edge": ("longest 512", (1000, 701), (512, 358)),
    "longest, rounded as by the server": ("longest 512", (186, 1024), (92, 512)),  # 93 by another expression
    "longest small enough": ("longest 512", (511, 333), (511, 333)),
    "exact": ("exact 224x320", (480, 640), (224, 320)),
    "exact of smaller frames": ("exact 224x320", (200, 300), (200, 300)),
    "exact of a longer edge": ("exact 224x320", (200, 640), (200, 320)),
}


@pytest.mark.parametrize(("text", "size", "fitted"), FITTED.values(), ids=FITTED)
def test_frames_are_only_ever_made_smaller(text: str, size: tuple[int, int], fitted: tuple[int, int]) -> None:
    frames = np.zeros((1, *size, 3), np.uint8)
    resized = resize_frames(frames, FrameSize.parse(text))
    assert resized.shape == (1, *fitted, 3)
    assert resized.dtype == np.uint8
    assert (resized is frames) == (size == fitted)


NO_COLOURS = Normalisation((0.0,) * 3, (1 / 255,) * 3)  # so that the network reads grey levels


def preprocessor(resize_px: int) -> ImagePreprocessor:
    return ImagePreprocessor(resize_px, (resize_px, resize_px), (0.0,) * 3, (1 / 255,) * 3)


def blank(height: int, width: int) -> torch.Tensor:
    """uint8 [1, 3, H, W] that takes no memory."""
    return torch.zeros(1, 1, 1, 1, dtype=torch.uint8).expand(1, 3, height, width)


def test_rewind_s_encoder_has_nothing_left_to_resize() -> None:
    small, size = preprocessor(16), FrameSize.parse("shortest 16")
    for height, width in product(range(17, 150, 4), range(17, 150, 3)):
        assert small._resize(blank(height, width)).shape[2:] == size.fitted(height, width)
    server, size = preprocessor(256), FrameSize.parse("shortest 256")
    for height, width in np.random.default_rng(0).integers(257, 3000, (5000, 2)).tolist():
        resized = blank(*size.fitted(height, width))
        assert server._resize(resized) is resized, (height, width)


def test_smolvlm_has_nothing_left_to_scale() -> None:
    size = FrameSize.parse("longest 512")
    for height, width in np.random.default_rng(0).integers(30, 5000, (20_000, 2)).tolist():
        fitted = size.fitted(height, width)
        if max(height, width) > 512:
            assert fitted == _scaled_to_longest(height, width, 512) == _scaled_to_longest(*fitted, 512)


@pytest.fixture(scope="module")
def large() -> UInt8Array:
    """A picture with edges, text-like detail and noise: uint8 [2, 300, 401, 3]."""
    random = np.random.default_rng(1)
    rows, columns = np.mgrid[:300, :401]
    waves = 127 * (1 + np.sin(rows * columns / 900))
    frames = np.stack([waves, 255 * (columns // 40 % 2), random.integers(0, 256, (300, 401))], axis=-1)
    return np.stack([frames, frames[::-1]]).astype(np.uint8)


def test_rewind_s_encoder_reads_what_it_would_have_read_to_a_grey_level(large: UInt8Array) -> None:
    size = FrameSize.parse("shortest 256")
    for frames in (large, np.ascontiguousarray(large.transpose(0, 2, 1, 3))):
        whole = preprocessor(256)(torch.from_numpy(frames))
        resized = preprocessor(256)(torch.from_numpy(resize_frames(frames, size)))
        assert (whole - resized).abs().max() <= 1
        assert (whole - resized).abs().mean() < 0.01


def test_smolvlm_reads_the_very_pixels_that_it_would_have_read(large: UInt8Array) -> None:
    images = SmolImages(256, int(Image.Resampling.LANCZOS), 1, NO_COLOURS)
    for frames in (large, large.transpose(0, 2, 1, 3)):
        resized = resize_frames(frames, FrameSize.parse("longest 256"))
        assert torch.equal(images.images(np.ascontiguousarray(frames)), images.images(resized))


def test_qwen_reads_the_very_pixels_that_it_would_have_read(large: UInt8Array) -> None:
    height, width = fitted_size(224, 320, 28)
    images = QwenImages(14, NO_COLOURS, (224, 320))
    whole, resized = (
        images.images(frames) for frames in (large, resize_frames(large, FrameSize("exact", (height, width))))
    )
    assert all(torch.equal(one.patches, other.patches) for one, other in zip(whole, resized, strict=True))


def test_scores_of_resized_frames_are_close(engine: Callable[[str], Engine]) -> None:
    frames = clip.render()[::4]
    samples = [
        ProgressSample(Trajectory(frames=film, task=clip.TASK))
        for film in (frames, resize_frames(frames, FrameSize.parse("shortest 64")))
    ]
    assert samples[1].trajectory.positions.shape == (8, 64, 64, 3)
    whole, resized = engine("enc_c1_t1_disc10").evaluate(samples)
    assert isinstance(whole, ProgressResult)
    assert isinstance(resized, ProgressResult)
    np.testing.assert_allclose(resized.progress, whole.progress, rtol=0, atol=1e-4)
    np.testing.assert_allclose(resized.success, whole.success, rtol=0, atol=1e-4)


# Video files of LeRobot datasets


def lerobot_dataset(root: Path, version: str, video: str, episodes: int, more: dict[str, Any] | None = None) -> Path:
    """A dataset's folder, as far as a video's reader looks: ``meta/info.json`` and one film. Gives the film."""
    film = root / video
    film.parent.mkdir(parents=True)
    write_video(film, numbered(10))
    (root / "meta").mkdir()
    info = {"codebase_version": version, "total_episodes": episodes, **(more or {})}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return film


V30_FILM = f"videos/{TOP}/chunk-000/file-000.mp4"
V21_FILM = f"videos/chunk-000/{TOP}/episode_000000.mp4"
ONE_EPISODE = "video: expected a film of one episode, got "
INSTEAD = "cut one episode out into a file of its own"


def test_a_lerobot_v3_file_of_several_episodes_is_refused(tmp_path: Path) -> None:
    film = lerobot_dataset(tmp_path, "v3.0", V30_FILM, 10)
    for read in (read_video, load_trajectory):
        with pytest.raises(InvalidSampleError) as caught:
            read(film)
        assert str(caught.value).startswith(f"{ONE_EPISODE}a LeRobot v3.0 file that holds 10 episodes: {INSTEAD}")
        assert str(caught.value).endswith(f"({film})")


def test_of_several_lerobot_v3_files_none_is_told_to_hold_all_episodes(tmp_path: Path) -> None:
    film = lerobot_dataset(tmp_path, "v3.0", V30_FILM, 10)
    film.with_name("file-001.mp4").write_bytes(film.read_bytes())
    with pytest.raises(InvalidSampleError, match=r"v3\.0 file that holds some of the dataset's 10 episodes: "):
        read_video(film)


@pytest.mark.parametrize("version", ["v3.1", "v4.0", 3])
def test_a_lerobot_version_that_is_not_known_to_keep_a_film_an_episode_is_refused(tmp_path: Path, version: Any) -> None:
    film = lerobot_dataset(tmp_path, version, "films/000.mp4", 10)
    with pytest.raises(InvalidSampleError, match=f"{ONE_EPISODE}a LeRobot {version} file that holds some of"):
        read_video(film)


def test_a_lerobot_v3_file_is_known_behind_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = lerobot_dataset(tmp_path / "data", "v3.0", V30_FILM, 10)
    blob = tmp_path / "blob"
    film.rename(blob)
    film.symlink_to(blob)  # as a Hub download consists of links into a cache
    outside = tmp_path / "film.mp4"
    outside.symlink_to(lerobot_dataset(tmp_path / "other", "v3.0", V30_FILM, 10))
    monkeypatch.chdir(film.parent)
    for path in (film, Path(film.name), outside):
        with pytest.raises(InvalidSampleError, match=r"a LeRobot v3\.0 file that holds 10 episodes"):
            read_video(path)


def test_a_lerobot_v3_file_without_its_dataset_is_known_by_its_path(tmp_path: Path) -> None:
    film = lerobot_dataset(tmp_path, "v3.0", V30_FILM, 10)
    (tmp_path / "meta" / "info.json").unlink()
    with pytest.raises(
        InvalidSampleError, match=f"{ONE_EPISODE}a file in the layout of LeRobot v3.0, which holds many"
    ):
        read_video(film)


@pytest.mark.parametrize("camera", [TOP, TOP.replace(".", "%2E")])
def test_a_lerobot_v3_file_behind_a_url_is_refused_and_not_downloaded(camera: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        url = f"http://127.0.0.1:{server.getsockname()[1]}/toy/resolve/main/videos/{camera}/chunk-000/file-000.mp4?a=b"
        with pytest.raises(InvalidSampleError, match=f"{ONE_EPISODE}a file in the layout of LeRobot v3.0"):
            load_trajectory(url)
        with pytest.raises(BlockingIOError):
            server.accept()


@pytest.mark.parametrize(
    ("version", "video", "episodes"),
    [("v2.1", V21_FILM, 10), ("v2.0", V21_FILM, 10), ("v3.0", V30_FILM, 1)],
    ids=["v2.1", "v2.0", "v3.0 with one episode in all"],
)
def test_a_lerobot_film_of_one_episode_is_read(tmp_path: Path, version: str, video: str, episodes: int) -> None:
    film = lerobot_dataset(tmp_path, version, video, episodes)
    assert numbers(read_video(film), 10) == list(range(10))


def test_what_is_no_lerobot_dataset_is_read(tmp_path: Path) -> None:
    film = lerobot_dataset(tmp_path, "v3.0", "films/file-000.mp4", 10)
    (tmp_path / "meta" / "info.json").write_text('{"about": "another project"}')
    assert numbers(read_video(film), 10) == list(range(10))


def test_a_lerobot_dataset_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    film = lerobot_dataset(tmp_path, "v3.0", V30_FILM, 10)
    (tmp_path / "meta" / "info.json").write_text('{"codebase_version": "v3')
    with pytest.raises(InvalidSampleError, match=r"^meta/info\.json: expected a readable JSON file, got Unterminated"):
        read_video(film)
