# SPDX-License-Identifier: MIT
"""A warning about cameras that show the same picture, or nothing."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from coded_env import CodedEnv, Recorder
from rfm_client import InvalidSampleError, RewardClient, ServerUnavailableError, UInt8Array
from rfm_rl import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions
from shelves import Shelf
from transports import Answer

TASK = "stack the cups"
COUNT = 10
BLACK = np.zeros((8, 8, 3), np.uint8)
GREY = BLACK + 9
OF_BLACK = "expected pictures that change, got 10 black ones in a row: simulators in one process can blacken each"
OF_STILL = "expected pictures that change, got 10 equal ones in a row: look at a frame, since the camera may be stuck"


@pytest.fixture
def recorder() -> Iterator[Recorder]:
    with Recorder() as client:
        yield client


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.message for record in caplog.records if record.levelno == logging.WARNING]


@pytest.mark.parametrize(("frame", "message"), [(BLACK, f"frame: {OF_BLACK}"), (GREY, f"frame: {OF_STILL}")])
def test_an_episode_warns_once_of_equal_frames_and_the_next_episode_again(
    recorder: Recorder, caplog: pytest.LogCaptureFixture, frame: UInt8Array, message: str
) -> None:
    with recorder.episode(TASK) as episode:
        for _ in range(COUNT - 1):
            episode.add(frame)
        assert warnings(caplog) == []
        for _ in range(COUNT * 2):
            episode.add(frame)
        assert [text.startswith(message) for text in warnings(caplog)] == [True]
        episode.reset()
        for _ in range(COUNT):
            episode.add(frame)
    assert [text.startswith(message) for text in warnings(caplog)] == [True, True]


def test_frames_that_change_now_and_then_are_no_still_ones(
    recorder: Recorder, caplog: pytest.LogCaptureFixture
) -> None:
    with recorder.episode(TASK) as episode:
        for t in range(5 * COUNT):
            frame = GREY.copy()
            frame[0, 0, 0] = t // (COUNT - 1)  # a pixel
            episode.add(frame)
    assert warnings(caplog) == []


def dim(t: int, highest: int) -> UInt8Array:
    """Noise up to a value, another picture at each step."""
    return np.random.default_rng(t).integers(0, highest + 1, (32, 32, 3), np.uint8)


SHOWN: dict[str, tuple[int, str | None]] = {
    "floats in 0..1 that became uint8": (
        1,
        "black pictures, no value above 1 (multiply floats in 0..1 by 255 before they become uint8), 10 in a row",
    ),
    "a covered sensor": (8, "black pictures, no value above 8, 10 in a row"),
    "a dark scene": (20, None),
}


@pytest.mark.parametrize(("highest", "told"), SHOWN.values(), ids=SHOWN)
def test_an_episode_warns_of_pictures_that_change_but_show_nothing(
    recorder: Recorder, caplog: pytest.LogCaptureFixture, highest: int, told: str | None
) -> None:
    with recorder.episode(TASK) as episode:
        for t in range(COUNT - 1):
            episode.add(dim(t, highest))
        assert warnings(caplog) == []
        for t in range(COUNT):
            episode.add(dim(COUNT + t, highest))
    assert warnings(caplog) == ([f"frame: expected pictures that show something, got {told}"] if told else [])


@pytest.mark.parametrize("ending", ["reset", "close"])
def test_a_short_episode_warns_at_its_end_if_none_of_its_frames_shows_anything(
    recorder: Recorder, caplog: pytest.LogCaptureFixture, ending: str
) -> None:
    episode = recorder.episode(TASK)
    for _ in range(3):
        episode.add(BLACK)
    getattr(episode, ending)()
    expected = "frame: expected pictures that show something, got black pictures, 3 in a row"
    assert warnings(caplog) == [expected]
    if ending == "reset":
        episode.add(BLACK)
        episode.add(dim(0, 255)[:8, :8])
        episode.close()
    assert warnings(caplog) == [expected]


class Failing(Shelf):
    """A server that fails once, at the fourth question."""

    has_failed = False

    async def infer(self, *asked: Any, **more: Any) -> Answer:
        if self.count == 3 and not self.has_failed:
            self.has_failed = True
            raise ServerUnavailableError("the server is restarting")
        return await super().infer(*asked, **more)


def test_a_frame_that_was_not_added_does_not_count(caplog: pytest.LogCaptureFixture) -> None:
    server = Failing(has_encoder=False)
    with RewardClient("", transports=[server], retry=False) as client, client.episode(TASK) as episode:
        for _ in range(3):
            episode.add(GREY)
        with pytest.raises(ServerUnavailableError):
            episode.add(GREY)
        with pytest.raises(InvalidSampleError):
            episode.add(GREY[:, :, 0])
        assert server.has_failed
        for _ in range(COUNT - 4):
            episode.add(GREY)
        assert warnings(caplog) == []
        episode.add(GREY)
    assert len(warnings(caplog)) == 1


def test_the_warning_names_the_episode_and_the_camera(recorder: Recorder, caplog: pytest.LogCaptureFixture) -> None:
    front, wrist = (np.stack([BLACK, GREY]) for _ in range(2))
    with recorder.episodes(2, TASK, cameras=["front", "wrist"]) as episodes:
        for t in range(COUNT):
            front[:, 0, 0, 0] = t
            wrist[1, 0, 0, 0] = t
            episodes.add({"front": front, "wrist": wrist})
    assert [text.startswith(f"episodes[0]: frame['wrist']: {OF_BLACK}") for text in warnings(caplog)] == [True]


class Dim(CodedEnv):
    """The pictures are floats in 0..1 that became uint8."""

    def _drawn(self) -> UInt8Array:
        return dim(self.t, 1)


class Dark(CodedEnv):
    """The pictures are black."""

    def _drawn(self) -> UInt8Array:
        return np.zeros((32, 32, 3), np.uint8)


def options(**more: Any) -> RewardOptions:
    return RewardOptions(sampling="all", **more)


def test_a_wrapper_warns_once_an_episode(recorder: Recorder, caplog: pytest.LogCaptureFixture) -> None:
    with closing(RewardModelWrapper(Dark(0, (15,)), recorder, TASK, options())) as env:
        for _ in range(2):
            env.reset()
            for _ in range(15):
                env.step(0)
    assert [text.startswith(f"frame: {OF_BLACK}") for text in warnings(caplog)] == [True, True]


def test_wrappers_warn_of_pictures_that_show_nothing_also_in_short_episodes(
    recorder: Recorder, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(RewardModelWrapper(Dim(0, (4, 12)), recorder, TASK, options())) as env:
        for steps in (4, 12):
            env.reset()
            for _ in range(steps):
                env.step(0)
    got = "black pictures, no value above 1 (multiply floats in 0..1 by 255 before they become uint8)"
    told = [f"frame: expected pictures that show something, got {got}, {count} in a row" for count in (5, 10)]
    assert warnings(caplog) == told


def test_a_vector_warns_of_the_environment_whose_pictures_are_black(
    recorder: Recorder, caplog: pytest.LogCaptureFixture
) -> None:
    makers = [partial(CodedEnv, 0, (20,)), partial(Dark, 1, (20,))]
    vector = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.NEXT_STEP)
    with closing(RewardModelVectorWrapper(vector, recorder, TASK, options(frames_from="pixels"))) as env:
        env.reset()
        for _ in range(15):  # no more frames than in training
            env.step(np.zeros(2, int))
    assert [text.startswith(f"envs[1]: frame: {OF_BLACK}") for text in warnings(caplog)] == [True]
