# SPDX-License-Identifier: MIT
"""An episode scored step by step has the scores of the same frames asked as a whole, whatever the server knows."""

from __future__ import annotations

import asyncio
import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, cast, get_args
from unittest.mock import AsyncMock

import numpy as np
import pytest

import transports
from engine_server import EngineServer
from rfm_client import (
    DeadlineExceededError,
    FrameSize,
    InferenceFailedError,
    InvalidSampleError,
    ProgressResult,
    RewardClient,
    ServerUnavailableError,
    Trajectory,
    UInt8Array,
)
from rfm_client.episodes import Episode, StepScore, scorer
from rfm_client.frames import Rule, Sampling
from shelves import V1, V2, Shelf
from tolerances import BATCHED_VLM_TOLERANCE, TOLERANCE
from transports import Answer, Tensors

MODEL = "enc_c1_t1_disc10"
IMAGES, VIDEO = "q3_tok_disc10", "q25_video_avg_disc10"
TASK = "stack the cups"
FOUR = Sampling("rint_pad", 4)


def video(seed: int, count: int, size: tuple[int, int] = (40, 56)) -> UInt8Array:
    return np.random.default_rng(seed).integers(0, 256, (count, *size, 3), np.uint8)


def offline(client: RewardClient, frames: UInt8Array, sampling: Sampling = FOUR, task: str = TASK) -> ProgressResult:
    """Return the scores of all prefixes, with all pixels sent."""
    results = client.evaluate(list(sampling.samples(Trajectory(frames=frames, task=task))))
    return sampling.joined(cast("list[ProgressResult]", results))


def online(episode: Episode, frames: UInt8Array) -> tuple[list[float], list[float]]:
    return of_steps([episode.add(frame) for frame in frames])


def added(client: RewardClient, episodes: Sequence[Episode], frames: UInt8Array) -> list[StepScore]:
    """Keep a frame in each episode, and score all."""
    for episode, frame in zip(episodes, frames, strict=True):
        episode.keep(frame)
    return client.score_episodes(episodes)


def of_steps(scores: Sequence[StepScore]) -> tuple[list[float], list[float]]:
    """Progress and success of an episode's steps from the first on."""
    assert [score.step for score in scores] == list(range(len(scores)))
    return [score.progress for score in scores], [score.success for score in scores]


def assert_same(
    scores: tuple[Sequence[float], Sequence[float]], expected: ProgressResult, tolerance: float = TOLERANCE
) -> None:
    np.testing.assert_allclose(scores, (expected.progress, expected.success), rtol=0, atol=tolerance)


class Recording(transports.Recording):
    """A connection to the real server."""

    @property
    def digests(self) -> set[bytes]:
        """Digests of all frames in the requests."""
        return {row.tobytes() for inputs in self.requests for row in inputs["frame_digests"].reshape(-1, 32)}

    @property
    def most_bytes(self) -> int:
        return max(sum(array.nbytes for array in inputs.values()) for inputs in self.requests)


@pytest.fixture
def transport(engines: EngineServer) -> Recording:
    return Recording(engines.url)


@pytest.fixture
def client(transport: Recording) -> Iterator[RewardClient]:
    with RewardClient([], transports=[transport], model=MODEL) as client:
        yield client


STEPPED = [
    *((MODEL, rule) for rule in get_args(Rule)),
    *((model, rule) for model in (IMAGES, VIDEO) for rule in ("rint_pad", "linspace_trunc")),
]


@pytest.mark.parametrize(("model", "rule"), STEPPED)
def test_steps_have_the_scores_of_the_whole(engines: EngineServer, model: str, rule: Rule) -> None:
    number = None if rule == "all" or rule.startswith("rewind") else 7 if model == MODEL else 4
    frames = video(get_args(Rule).index(rule), 16 if rule == "all" else 24, (40, 56) if model == MODEL else (56, 84))
    with engines.client(model) as client, client.episode(TASK, sampling=rule, frames=number) as episode:
        assert client.model_info(frames=True).by_digest
        tolerance = TOLERANCE if model == MODEL else BATCHED_VLM_TOLERANCE
        assert_same(online(episode, frames), offline(client, frames, Sampling(rule, number)), tolerance)


def test_a_step_sends_its_new_frame_alone_and_nothing_is_encoded_twice(engines: EngineServer) -> None:
    """A video model encodes each new pair of frames; an image model encodes each frame."""
    encoders = {MODEL: f"{MODEL}_encoder", IMAGES: f"{IMAGES}_frames", VIDEO: f"{VIDEO}_frames"}
    frames = video(100, 12, (56, 84))

    def step(model: str) -> tuple[Recording, tuple[list[float], list[float]]]:
        transport = Recording(engines.url)
        with RewardClient([], transports=[transport], model=model) as client, client.episode(TASK, frames=4) as episode:
            first = online(episode, frames)
            episode.reset()
            np.testing.assert_allclose(online(episode, frames), first, rtol=0, atol=BATCHED_VLM_TOLERANCE)
        return transport, first

    before = {model: engines.encoded[encoder] for model, encoder in encoders.items()}
    firsts = {}
    for model in encoders:
        transport, firsts[model] = step(model)
        assert [len(inputs["frames"][0]) for inputs in transport.requests] == [1] * 2 * len(frames)
        assert transport.most_bytes < frames[0].nbytes + 512
        repeated = transport.requests[len(frames) :]
        assert {inputs["frames"].shape for inputs in repeated} == {(1, 1, 1, 1, 3)}  # known: not even sent
    for model in encoders:  # another client sends them, and a caller of plain tensors uses the cache, too
        np.testing.assert_allclose(step(model)[1], firsts[model], rtol=0, atol=BATCHED_VLM_TOLERANCE)
    with engines.client(MODEL) as plain:
        plain.progress(Trajectory(frames=frames[::-1], task=TASK))
    pairs = {tuple(pair) for t in range(12) for pair in FOUR.prefix(t).indices.reshape(-1, 2).tolist()}
    new = {model: engines.encoded[encoder] - before[model] for model, encoder in encoders.items()}
    assert new == {MODEL: 12, IMAGES: 12, VIDEO: 2 * len(pairs)}


@pytest.mark.parametrize("model", [MODEL, IMAGES, VIDEO])
@pytest.mark.parametrize("forgets", [False, True])
def test_a_curve_sends_each_frame_once_unless_the_server_forgets(
    engines: EngineServer, monkeypatch: pytest.MonkeyPatch, model: str, forgets: bool
) -> None:
    frames = video(130 + forgets, 24, (56, 84))
    monkeypatch.setattr(scorer, "MAX_NEW_BYTES_IN_TURN", 5 * frames[0].nbytes)
    monkeypatch.setattr(scorer, "MOST_REFUSALS", 1)
    transport, trajectory = Recording(engines.url), Trajectory(frames=frames, task=TASK)
    with RewardClient([], transports=[transport], model=model) as client:
        go_on = engines.forget_features if forgets else None
        scores = client.curve(trajectory, FOUR, go_on=go_on, request_id="mine")
        assert transport.request_ids == [f"mine-{number}" for number in range(1, len(transport.requests) + 1)]
        sent = [int(inputs["frames"].any(axis=(2, 3, 4)).sum()) for inputs in transport.requests]
        shown = [len(np.unique(inputs["frame_digests"].reshape(-1, 32), axis=0)) for inputs in transport.requests]
        if forgets:  # two requests were refused; then all frames came at once
            assert [few < all_frames for few, all_frames in zip(sent, shown, strict=True)] == [0, 1, 0, 1, 0, 0, 0]
        assert forgets or sum(sent) == len(frames)
        expected = offline(client, frames)
    assert_same((scores.progress, scores.success), expected, TOLERANCE if model == MODEL else BATCHED_VLM_TOLERANCE)


def test_a_curve_ends_where_its_caller_says(client: RewardClient, transport: Recording) -> None:
    def stop() -> None:
        if len(transport.requests) == 1:
            raise KeyError("enough")

    large = Trajectory(frames=video(132, 5, (700, 700)), task=TASK)  # two requests
    with pytest.raises(KeyError, match="enough"):
        client.curve(large, FOUR, go_on=stop)
    assert len(transport.requests) == 1


class Failing(Recording):
    """A connection to the real server, which can be down."""

    is_down = False

    async def infer(self, model: str, inputs: Tensors, outputs: Any, timeout_s: float, **more: str) -> Answer:
        if self.is_down:
            raise ServerUnavailableError("Connection refused")
        return await super().infer(model, inputs, outputs, timeout_s, **more)

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        return not self.is_down and await super().is_ready(model, timeout_s)


def test_episodes_are_shared_out_among_servers_and_stay(engines: EngineServer) -> None:
    transports = [Recording(engines.url) for _ in range(3)]
    videos = np.stack([video(seed, 6) for seed in range(210, 216)], axis=1)  # [T, N, H, W, 3]
    with RewardClient([], transports=transports, model=MODEL) as client:
        tasks = [TASK, "open the drawer"] * 3
        episodes = [client.episode(task, frames=4) for task in tasks]
        steps = [added(client, episodes, frames) for frames in videos]
        for transport in transports:
            assert [len(inputs["num_frames"]) for inputs in transport.requests] == [2] * len(videos)
            assert transport.most_bytes < 2 * (videos[0, 0].nbytes + 512)
        first, second, third = (transport.digests for transport in transports)
        assert len(first | second | third) == len(first) + len(second) + len(third) == videos[:, :, 0, 0, 0].size
        for index, task in enumerate(tasks):
            assert_same(of_steps([step[index] for step in steps]), offline(client, videos[:, index], task=task))
        for transport in transports:
            transport.requests.clear()
        for episode in episodes[:3]:
            episode.reset()
        added(client, episodes, videos[0])
        asked = [sum(len(inputs["num_frames"]) for inputs in transport.requests) for transport in transports]
        assert asked == [2, 2, 2]  # the new ones went to the servers with the fewest


def test_episodes_of_a_server_that_is_down_go_on_at_the_next(engines: EngineServer) -> None:
    transports = [Failing(engines.url) for _ in range(2)]
    videos = np.stack([video(seed, 6) for seed in (220, 221)], axis=1)
    with RewardClient([], transports=transports, model=MODEL, timeout_s=30) as client:
        episodes = [client.episode(TASK, frames=4) for _ in range(2)]
        steps = [added(client, episodes, frames) for frames in videos[:3]]
        transports[0].is_down = True
        steps += [added(client, episodes, frames) for frames in videos[3:]]
        assert len(transports[0].requests) == 3
        assert transports[1].most_bytes < videos[0, 0].nbytes + 512  # it knew the frames, since both are one server
        for index in range(2):
            assert_same(of_steps([step[index] for step in steps]), offline(client, videos[:, index]))


def test_some_episodes_grow_and_a_reset_begins_one_anew(client: RewardClient) -> None:
    frames = video(103, 4)
    episodes = [client.episode(TASK, frames=4) for _ in range(2)]
    added(client, episodes, frames[:2])
    (score,) = added(client, episodes[1:], frames[2:3])
    assert [episode.step for episode in episodes] == [0, 1]
    assert score.progress == pytest.approx(offline(client, frames[[1, 2]]).progress[-1], abs=TOLERANCE)
    episodes[1].reset("open the drawer")
    scores = added(client, episodes, frames[[3, 3]])
    assert [score.step for score in scores] == [1, 0]
    expected = offline(client, frames[[3]], task="open the drawer").progress[-1]
    assert scores[1].progress == pytest.approx(expected, abs=TOLERANCE)


def test_cameras_are_scored_apart_and_fused(client: RewardClient) -> None:
    front, wrist = video(104, 5), video(105, 5, (48, 48))  # of two sizes
    apart = [offline(client, frames).progress[-1] for frames in (front, wrist)]
    for fuse, expected in {"mean": np.mean(apart), "min": min(apart), "max": max(apart)}.items():
        episode = client.episode(TASK, frames=4, cameras=("front", "wrist"), fuse=fuse)  # type: ignore[arg-type]
        scores = [episode.add({"front": a, "wrist": b}) for a, b in zip(front, wrist, strict=True)]
        np.testing.assert_allclose(scores[-1].progress, expected, atol=TOLERANCE)
    wanted = r"frame: expected frames of the cameras \['front', 'wrist'\], got frames of \['front'\]"
    with pytest.raises(InvalidSampleError, match=wanted):
        episode.add({"front": front[0]})


def test_frames_of_each_camera_are_turned_and_become_rgb(client: RewardClient) -> None:
    front, wrist = video(104, 3), video(105, 3, (48, 44))
    upright = client.episode(TASK, sampling="all", cameras=("front", "wrist"))
    corrections: dict[str, Any] = {"orient": {"front": "rotate90"}, "channels": {"wrist": "bgr"}}
    stored = client.episode(TASK, sampling="all", cameras=("front", "wrist"), **corrections)
    for a, b in zip(front, wrist, strict=True):
        expected = upright.add({"front": np.rot90(a, -1), "wrist": b[..., ::-1]})
        assert stored.add({"front": a, "wrist": b}).progress == pytest.approx(expected.progress, abs=TOLERANCE)


def test_a_frame_that_is_wrong_leaves_the_episode_as_it_was(client: RewardClient) -> None:
    frames = video(107, 3)
    episode = client.episode(TASK, frames=4)
    episode.add(frames[0])
    with pytest.raises(InvalidSampleError, match=r"^frame: expected uint8 \[H, W, 3\], got float64 \[2, 2, 3\]"):
        episode.add(np.zeros((2, 2, 3)))
    with pytest.raises(InvalidSampleError, match=r"expected uint8 \[40, 56, 3\], as the episode's first, got"):
        episode.add(video(0, 1, (8, 8))[0])
    first = client.episode(TASK, frames=4).add(frames[0])
    assert_same(of_steps([first, *map(episode.add, frames[1:])]), offline(client, frames))


def test_an_episode_keeps_its_client(engines: EngineServer) -> None:
    episode = RewardClient(engines.url, model=MODEL).episode(TASK, frames=4)
    gc.collect()
    assert [episode.add(frame).step for frame in video(115, 2)] == [0, 1]


def test_kept_frames_are_scored_when_asked_and_several_episodes_in_one_request(
    transport: Recording, client: RewardClient
) -> None:
    videos = video(120, 6), video(121, 4)
    episodes = [client.episode(TASK, env=env, frames=4) for env in (2, 5)]
    for episode, frames in zip(episodes, videos, strict=True):
        for frame in frames:
            buffer = frame.copy()
            episode.keep(buffer)
            buffer[:] = 0
    assert transport.requests == []
    scores = client.score_episodes(episodes)
    assert len(transport.requests) == 1
    assert [score.step for score in scores] == [episode.step for episode in episodes] == [5, 3]
    for score, frames in zip(scores, videos, strict=True):
        assert score.progress == pytest.approx(offline(client, frames).progress[-1], abs=TOLERANCE)
    answer = client.submit_episodes(episodes[:1])
    episodes[0].keep(videos[0][0])  # which the open question does not see
    (score,) = answer.result()
    assert score.step == 5
    assert score.progress == pytest.approx(scores[0].progress, abs=TOLERANCE)


SHORT, LONG = replace(V1, max_frames=4), replace(V2, max_frames=8)


def test_an_episode_is_scored_by_one_checkpoint_and_the_next_one_as_the_served_checkpoint_was_trained() -> None:
    shelf, frames = Shelf(SHORT, LONG, after=3, has_encoder=False), video(123, 5)
    with RewardClient("", transports=[shelf]) as client, client.episode(TASK) as episode:
        for frame in frames[:3]:
            episode.add(frame)
        for _ in range(2):
            got = r"weights-of-v2\) instead of rfm_frames \(weights weights-of-v1\): reset the episode"
            with pytest.raises(InferenceFailedError, match=rf"^episode: expected the checkpoint .* got .*{got}"):
                episode.add(frames[3])
        episode.reset()
        assert episode.add(frames[4]).step == 0
    assert [shape[1] for shape in shelf.shapes] == [4, 4, 4, 4, 8, 8]  # the fourth answer is by another checkpoint


def test_an_episode_may_name_the_only_checkpoint_that_may_score_it() -> None:
    shelf, frames = Shelf(SHORT, LONG, after=1, has_encoder=False), video(125, 2)
    with RewardClient("", transports=[shelf]) as client:
        episode = client.episode(TASK, env=3, weights_digest="weights-of-v1")
        assert episode.add(frames[0]).step == 0
        for _ in range(2):
            episode.reset()
            got = r"rfm_frames \(weights weights-of-v2\)"
            with pytest.raises(InferenceFailedError, match=rf"^envs\[3\]: expected .* weights-of-v1, got {got}"):
                episode.add(frames[1])


def test_a_named_checkpoint_is_that_of_the_server_that_answers() -> None:
    other = replace(V2, version=V1.version)
    shelves, paid = [Shelf(has_encoder=False), Shelf(other, has_encoder=False, url="grpc://other:1")], []
    with RewardClient("", transports=shelves) as client:
        episode = client.episode(TASK, weights_digest="weights-of-v1")
        for frame in video(126, 4):
            with suppress(InferenceFailedError):
                paid.append(episode.add(frame).progress)
    assert [shelf.count for shelf in shelves] == [2, 2]
    assert paid == [pytest.approx(V1.score)] * 2


def test_a_server_that_no_longer_describes_its_checkpoint_may_not_score_for_a_named_one(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("rfm_client.transport.servers.LULL_S", 0.0)
    frames, shelf = video(127, 3), Shelf(has_encoder=False)
    with RewardClient("", transports=[shelf]) as client:
        named, free = client.episode(TASK, weights_digest="weights-of-v1"), client.episode(TASK)
        assert named.add(frames[0]).step == 0
        monkeypatch.setattr(shelf, "model_info", AsyncMock(side_effect=DeadlineExceededError("no answer in time")))
        with pytest.raises(InferenceFailedError, match="expected a checkpoint with weights weights-of-v1, got an unk"):
            named.add(frames[1])
        assert free.add(frames[1]).step == 0
        assert caplog.text.count("cannot tell whether the checkpoint is the same as before: no answer in time") == 2
        monkeypatch.undo()
        assert named.add(frames[2]).step == 1


@pytest.mark.parametrize(
    "describe",
    [lambda client: client.model_info(frames=True, refresh=True), RewardClient.model_infos],
    ids=["model_info", "model_infos"],
)
def test_a_change_that_a_caller_s_own_question_shows_ends_the_episode(
    describe: Callable[[RewardClient], object],
) -> None:
    frames, shelf = video(128, 2), Shelf(other=replace(V2, version=V1.version), has_encoder=False)
    with RewardClient("", transports=[shelf]) as client:
        episode = client.episode(TASK)
        episode.add(frames[0])
        shelf.after = 0
        describe(client)
        with pytest.raises(InferenceFailedError, match="reset the episode"):
            episode.add(frames[1])


def test_frames_are_resized_as_the_served_checkpoint_reads_them_by_now() -> None:
    """Kept frames have the size of the episode's first."""
    small = replace(SHORT, frame_size=FrameSize("exact", (8, 8)))
    large = replace(LONG, frame_size=FrameSize("exact", (16, 16)))
    frames, shelf = video(124, 2), Shelf(small, large, after=1, has_encoder=False)
    with RewardClient("", transports=[shelf]) as client, client.episode(TASK, resize=True) as episode:
        episode.add(frames[0])
        with pytest.raises(InferenceFailedError, match="reset the episode"):
            episode.add(frames[1])
        with pytest.raises(InvalidSampleError, match=r"as the episode's first, or a reset, got uint8 \[16, 16, 3\]"):
            episode.add(frames[0])
        assert {shape[2:4] for shape in shelf.shapes} == {(8, 8)}
        episode.reset()
        episode.add(frames[0])
        assert shelf.shapes[-1] == (1, 8, 16, 16, 3)


def test_large_frames_go_in_several_requests(transport: Recording, client: RewardClient) -> None:
    large = video(116, 5, (700, 700))  # 1.5 MB each
    scores = added(client, [client.episode(TASK, frames=2) for _ in range(5)], large)
    assert sorted(len(inputs["num_frames"]) for inputs in transport.requests) == [1, 2, 2]
    expected = [offline(client, large[[index]], Sampling("rint_pad", 2)).progress[0] for index in range(5)]
    np.testing.assert_allclose([score.progress for score in scores], expected, atol=TOLERANCE)
    assert transport.most_bytes < 4 * 2**20


def test_a_request_of_very_many_frames_is_refused_before_memory_is_taken(transport: Recording) -> None:
    inputs = {
        "frames": np.zeros((1, 1, 1, 1, 3), np.uint8),
        "frame_digests": np.zeros((1, 140_000, 32), np.uint8),
        "num_frames": np.array([[140_000, 0]], np.int32),
        "task": np.array([[TASK.encode()]], np.object_),
    }

    async def ask() -> None:
        try:
            await transport.infer(f"{MODEL}_encoder", inputs, ["video_embeddings"], 30)
        finally:
            await transport.close()

    with pytest.raises(InvalidSampleError, match="num_frames: expected at most 131072 frames in a request"):
        asyncio.run(ask())


FRAME = video(0, 1)[0]
REFUSED: dict[str, tuple[dict[str, Any], Any, str]] = {
    "not UTF-8": ({"task": "\ud800"}, FRAME, "task: expected text that UTF-8 can encode"),
    "a camera": ({"cameras": "front"}, FRAME, "^cameras: expected a sequence of names, got 'front'$"),
    "a camera's frame": ({}, {"a": FRAME}, r"frame: .* of one camera .*, got frames of \['a'\]"),
    "orient": (
        {"cameras": ["front"], "orient": {"wrist": "rotate180"}},
        FRAME,
        r"^orient: expected some of the cameras \['front'\], got 'wrist'$",
    ),
    "no frame": ({}, None, r"^envs\[3\]\.frame: expected one to score, got none yet$"),
    "no task": ({"task": " "}, FRAME, r"^envs\[3\]\.task: expected a task sentence"),
    "env": ({"env": "3"}, FRAME, "^env: expected a whole number, got '3'$"),
}


@pytest.mark.parametrize(("given", "frame", "message"), REFUSED.values(), ids=REFUSED)
def test_invalid_episodes_and_frames_are_refused_with_their_environment(
    given: dict[str, Any], frame: Any, message: str
) -> None:
    with RewardClient("", transports=[Shelf(has_encoder=False)]) as client, pytest.raises(ValueError, match=message):
        episode = client.episode(**{"task": TASK, "env": 3, "frames": 4, **given})
        if frame is not None:
            episode.keep(frame)
        client.score_episodes([episode])


def test_an_episode_goes_on_when_the_server_has_forgotten_its_frames(engines: EngineServer) -> None:
    """As after a restart, or behind a load balancer."""
    frames = video(118, 9)
    for model, tolerance in ((MODEL, TOLERANCE), (IMAGES, BATCHED_VLM_TOLERANCE)):
        with engines.client(model) as client, client.episode(TASK, frames=4) as episode:
            scores = []
            for t, frame in enumerate(frames):
                if t in (4, 7):
                    engines.forget_features()
                scores.append(episode.add(frame))
            expected = offline(client, frames)
        assert_same(of_steps(scores), expected, tolerance)
