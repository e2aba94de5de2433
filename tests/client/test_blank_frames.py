# SPDX-License-Identifier: MIT
"""Blank frames: black or of a single colour, but no dark scene."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from encoding import encode
from rfm_client import AsyncRewardClient, ProgressSample, RewardClient, Trajectory, UInt8Array
from rfm_client.frames import BlankFrames, read_video
from rfm_client.frames.blank_frames import is_blank
from shelves import Shelf

VIDEOS = Path(__file__).parents[1] / "videos"
SIZE = (48, 64, 3)
BLACK = np.zeros(SIZE, np.uint8)
NOISE = np.random.default_rng(0).integers(0, 256, SIZE, np.uint8)


def with_pixel(frame: UInt8Array, value: int) -> UInt8Array:
    """Return the frame with a pixel of this value between the points of a coarse grid."""
    marked = frame.copy()
    marked[13, 17] = value
    return marked


FRAMES: dict[str, tuple[UInt8Array, bool]] = {
    "black": (BLACK, True),
    "floats in 0..1 that became uint8": ((NOISE / 255).astype(np.uint8), True),
    "a covered sensor": (NOISE // 29, True),
    "a grey value beside black": (with_pixel(BLACK, 9), False),
    "blue": (BLACK + np.array([0, 0, 255], np.uint8), True),
    "green that differs by 4": (with_pixel(BLACK + np.array([0, 135, 0], np.uint8), 4), False),
    "grey that differs by 4": (with_pixel(BLACK + np.uint8(60), 64), True),
    "grey that differs by 5": (with_pixel(BLACK + np.uint8(60), 65), False),
    "a light in the dark": (with_pixel(BLACK, 200), False),
    "a strip of one pixel": (NOISE[:1], False),
    "a pixel": (NOISE[:1, :1], True),
}


@pytest.mark.parametrize(("frame", "expected"), FRAMES.values(), ids=FRAMES)
def test_a_frame_is_blank_if_it_is_black_or_of_one_colour(frame: UInt8Array, expected: bool) -> None:
    assert is_blank(frame) is expected


@pytest.mark.parametrize("codec", ["libx264", "libsvtav1"])
def test_a_film_of_one_colour_stays_blank(tmp_path: Path, codec: str) -> None:
    encode(tmp_path / "flat.mp4", [BLACK + np.array((37, 201, 90), np.uint8)] * 12, codec, {})
    assert BlankFrames(read_video(tmp_path / "flat.mp4")).told


@pytest.mark.parametrize("file", sorted(VIDEOS.glob("*.mp4")), ids=lambda file: file.stem)
def test_a_real_scene_in_a_twentieth_of_its_light_is_no_blank_one(file: Path) -> None:
    frames = read_video(file)
    assert not any(is_blank((frame * 0.05).astype(np.uint8)) for frame in frames)
    assert all(is_blank((frame * 0.03).astype(np.uint8)) for frame in frames)


RUNS: dict[str, tuple[str, bool]] = {  # blank frames are dots
    "none": ("", False),
    "all of nine": ("." * 9, True),
    "nine of ten": ("." * 9 + "x", False),
    "ten of many": ("x" + "." * 10 + "xx", True),
    "many apart": ((".........x") * 3, False),
}


@pytest.mark.parametrize(("shown", "expected"), RUNS.values(), ids=RUNS)
def test_a_camera_shows_nothing_in_ten_frames_in_a_row_or_in_all_of_fewer(shown: str, expected: bool) -> None:
    frames = BlankFrames(BLACK if each == "." else NOISE for each in shown)
    assert (frames.highest == 0) is expected
    assert frames.told == ("black pictures" if expected else "")


FLOATS, VIDEO = np.stack([(NOISE / 255).astype(np.uint8)] * 3), np.stack([NOISE] * 3)


def filmed(frames: UInt8Array) -> Trajectory:
    return Trajectory(frames=frames, task="stack the cups")


CALLS: dict[str, tuple[Callable[[RewardClient], object], int]] = {  # and how many frames show nothing
    "samples": (lambda client: client.evaluate([ProgressSample(filmed(FLOATS))] * 3), 3),
    "the second of a pair": (lambda client: client.preference(filmed(VIDEO), filmed(FLOATS)), 3),
    "an episode": (lambda client: [*map(client.episode("stack the cups", sampling="all").add, FLOATS)], 2),
    "one of two pictures": (lambda client: client.progress(filmed(np.stack([BLACK, NOISE]))), 0),
    "a picture": (lambda client: client.progress(filmed(BLACK[np.newaxis])), 0),
}


@pytest.mark.parametrize(("ask", "count"), CALLS.values(), ids=CALLS)
def test_a_client_warns_once_of_a_video_of_black_pictures(
    caplog: pytest.LogCaptureFixture, ask: Callable[[RewardClient], object], count: int
) -> None:
    with RewardClient("", transports=[Shelf(has_encoder=False)]) as client:
        for _ in range(2):
            ask(client)
    told = "black pictures, no value above 1 (multiply floats in 0..1 by 255 before they become uint8)"
    expected = f"frames: expected pictures that show something, got {count} frames: {told} (logged once)"
    assert caplog.messages == [expected] * (count > 0)


def test_a_probe_warns_of_nothing(caplog: pytest.LogCaptureFixture) -> None:
    async def probe() -> None:
        async with AsyncRewardClient("", transports=[Shelf(has_encoder=False)]) as client:
            await client.probe(await client.model_info(frames=True))

    asyncio.run(probe())
    assert not caplog.messages
