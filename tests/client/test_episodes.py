# SPDX-License-Identifier: MIT
"""An episode scored step by step has the scores of the same frames asked as a whole, whatever the server knows."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

import goldens
import rfm_export
from engines import serve_config
from one_model import BriefServer
from reference_server import Served
from repositories import configure
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints
from rfm_client import (
    AsyncRewardClient,
    InvalidSampleError,
    ModelNotFoundError,
    ProcessEndedError,
    ProgressResult,
    RewardClient,
    ServerUnavailableError,
    Trajectory,
)
from rfm_client.contract import wire
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.sampling import RULES, Rule, Sampling, of_prefixes, prefix_samples
from rfm_client.episodes import Episode, SuccessRule
from rfm_client.transport.access import Access
from rfm_client.transport.calls import Answer, GrpcTransport
from rfm_serve import serving

pytestmark = pytest.mark.triton

MODEL = "enc_c1_t1_disc10"
IMAGES, VIDEO = "q3_tok_disc10", "q25_video_avg_disc10"
TASK = "stack the cups"
TOLERANCE, VLM_TOLERANCE = 1e-5, 1e-4
TOLD_S = 1.0  # in which the model tells Triton what it has counted


def film(seed: int, count: int, size: tuple[int, int] = (40, 56)) -> UInt8Array:
    return np.random.default_rng(seed).integers(0, 256, (count, *size, 3), np.uint8)


def offline(client: RewardClient, frames: UInt8Array, sampling: Sampling, task: str = TASK) -> ProgressResult:
    """Each frame's score from the prefix that ends with it, all pixels sent."""
    results = client.evaluate(list(prefix_samples(Trajectory(frames=frames, task=task), sampling)))
    return of_prefixes([result for result in results if isinstance(result, ProgressResult)], sampling)


def online(episode: Episode, frames: UInt8Array) -> tuple[list[float], list[float]]:
    scores = [episode.add(frame) for frame in frames]
    assert [score.step for score in scores] == list(range(len(frames)))
    return [score.progress for score in scores], [score.success for score in scores]


def assert_same(
    scores: tuple[Sequence[float], Sequence[float]], expected: ProgressResult, tolerance: float = TOLERANCE
) -> None:
    np.testing.assert_allclose(scores[0], expected.progress, rtol=0, atol=tolerance)
    np.testing.assert_allclose(scores[1], expected.success, rtol=0, atol=tolerance)


def counted(endpoints: Endpoints, name: str, model: str = f"{MODEL}_encoder") -> float:
    """What the metrics of the model that encodes frames say."""
    time.sleep(TOLD_S)
    with urllib.request.urlopen(endpoints.metrics_url, timeout=10) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    found = [
        sample.value
        for family in families
        for sample in family.samples
        if sample.name == f"rfm_{name}" and sample.labels["model"] == model
    ]
    return sum(found)


class Recording(GrpcTransport):
    """To the real server; notes the inputs of each request."""

    def __init__(self, url: str) -> None:
        super().__init__(url, Access(), shared_memory=False)
        self.requests: list[wire.Tensors] = []

    async def infer(self, model: str, inputs: wire.Tensors, outputs: object, timeout_s: float, **more: str) -> Answer:
        self.requests.append(inputs)
        return await super().infer(model, inputs, outputs, timeout_s, **more)  # type: ignore[arg-type]

    @property
    def num_bytes(self) -> list[int]:
        return [sum(array.nbytes for array in inputs.values()) for inputs in self.requests]


@pytest.fixture
def recorded(served: Served) -> Iterator[tuple[Recording, RewardClient]]:
    transport = Recording(served.url("grpc"))
    with RewardClient([], transports=[transport], model=MODEL) as client:
        yield transport, client


def of_rule(rule: Rule, frames: int = 5) -> Sampling:
    """The rule with few frames; ``all`` takes no number, and the first ReWiND code's rules have their own."""
    return Sampling(rule, None if rule == "all" or rule.startswith("rewind") else frames)


@pytest.mark.parametrize("rule", RULES)
def test_steps_have_the_scores_of_the_whole(served: Served, protocol: str, rule: Rule) -> None:
    count = 16 if rule == "all" else 40  # the checkpoint takes 16 frames
    sampling, frames = of_rule(rule, 7), film(RULES.index(rule), count)
    given = None if rule == "all" else sampling.frames
    with served.client(protocol, MODEL) as client, client.episode(TASK, sampling=rule, frames=given) as episode:
        assert_same(online(episode, frames), offline(client, frames, sampling))


@pytest.mark.parametrize("rule", ["rint_pad", "linspace_trunc"])
@pytest.mark.parametrize("model", [IMAGES, VIDEO])
def test_steps_of_a_vision_language_checkpoint_have_the_scores_of_the_whole(
    served: Served, protocol: str, model: str, rule: Rule
) -> None:
    sampling, frames = of_rule(rule, 4), film(3, 40, (56, 84))
    with served.client(protocol, model) as client, client.episode(TASK, sampling=rule, frames=4) as episode:
        assert client.model_info(frames=True).by_digest
        assert_same(online(episode, frames), offline(client, frames, sampling), VLM_TOLERANCE)


@pytest.mark.parametrize("model", [IMAGES, VIDEO])
def test_a_step_of_a_vision_language_checkpoint_sends_its_new_frame_alone(served: Served, model: str) -> None:
    transport, frames = Recording(served.url("grpc")), film(4, 12, (56, 84))
    before = counted(served.endpoints, "frames_encoded_total", f"{model}_frames")
    with RewardClient([], transports=[transport], model=model) as client, client.episode(TASK, frames=4) as episode:
        for frame in frames:
            episode.add(frame)
    assert [len(inputs[wire.FRAMES][0]) for inputs in transport.requests] == [1] * len(frames)
    encoded = counted(served.endpoints, "frames_encoded_total", f"{model}_frames") - before
    shown = [Sampling("rint_pad", 4).prefix(t).indices for t in range(len(frames))]
    pairs = {tuple(pair) for indices in shown for pair in indices.reshape(-1, 2).tolist()}
    assert encoded == (len(frames) if model == IMAGES else 2 * len(pairs))


def test_a_step_sends_and_encodes_its_new_frame_alone(served: Served, recorded: tuple[Recording, RewardClient]) -> None:
    transport, client = recorded
    frames = film(100, 24, (64, 96))
    before = counted(served.endpoints, "frames_encoded_total")
    with client.episode(TASK, frames=8) as episode:
        for frame in frames:
            episode.add(frame)
    assert counted(served.endpoints, "frames_encoded_total") - before == len(frames)
    assert [len(inputs[wire.FRAMES][0]) for inputs in transport.requests] == [1] * len(frames)
    assert max(transport.num_bytes) < frames[0].nbytes + 512
    assert counted(served.endpoints, "feature_cache_hits_total") >= 7 * 16


def test_equal_frames_of_another_episode_are_not_encoded_again(
    served: Served, recorded: tuple[Recording, RewardClient]
) -> None:
    transport, client = recorded
    frames = film(101, 5)
    with client.episode(TASK, frames=4) as episode:
        first = online(episode, frames)
    before = counted(served.endpoints, "frames_encoded_total")
    with served.client("http", MODEL) as other, other.episode(TASK, frames=4) as episode:
        np.testing.assert_allclose(online(episode, frames), first, atol=TOLERANCE)  # sent again: another client
    with client.episode(TASK, frames=4) as episode:
        np.testing.assert_allclose(online(episode, frames), first, atol=TOLERANCE)  # not even sent
    assert counted(served.endpoints, "frames_encoded_total") == before
    assert [inputs[wire.FRAMES].shape for inputs in transport.requests[-5:]] == [(1, 1, 1, 1, 3)] * 5


def test_callers_of_plain_tensors_notice_nothing_and_fill_the_cache_too(served: Served) -> None:
    frames = film(102, 6)
    with served.client("grpc", MODEL) as client:
        client.progress(Trajectory(frames=frames, task=TASK))
        before = counted(served.endpoints, "frames_encoded_total")
        client.progress(Trajectory(frames=frames[::-1], task=TASK))
        assert counted(served.endpoints, "frames_encoded_total") == before


def test_episodes_side_by_side_are_one_request_and_score_alike(
    served: Served, recorded: tuple[Recording, RewardClient]
) -> None:
    transport, client = recorded
    films = np.stack([film(seed, 7) for seed in (200, 201, 202)], axis=1)  # [T, N, H, W, 3]
    tasks = ["stack the cups", "open the drawer", "stack the cups"]
    episodes = client.episodes(3, tasks, frames=4)
    added = [episodes.add(frames) for frames in films]
    assert len(transport.requests) == len(films)
    for index, task in enumerate(tasks):
        scores = [float(step.progress[index]) for step in added], [float(step.success[index]) for step in added]
        assert_same(scores, offline(client, films[:, index], Sampling("rint_pad", 4), task))
    assert added[-1].step.tolist() == [6, 6, 6]


def test_a_mask_leaves_episodes_out_and_a_reset_begins_some_anew(served: Served) -> None:
    frames = film(103, 4)
    with served.client("grpc", MODEL) as client:
        episodes = client.episodes(2, TASK, frames=4)
        episodes.add(frames[[0, 1]])
        scores = episodes.add([None, frames[2]], mask=[False, True])
        assert np.isnan([scores.progress[0], scores.success[0]]).all()
        assert not scores.succeeded[0]
        assert scores.step.tolist() == [0, 1]
        expected = offline(client, frames[[1, 2]], Sampling("rint_pad", 4))
        np.testing.assert_allclose(scores.progress[1], expected.progress[-1], atol=TOLERANCE)
        episodes.reset([False, True], task="open the drawer")
        scores = episodes.add(frames[[3, 3]])
        assert scores.step.tolist() == [1, 0]
        expected = offline(client, frames[[3]], Sampling("rint_pad", 4), "open the drawer")
        np.testing.assert_allclose(scores.progress[1], expected.progress[-1], atol=TOLERANCE)
        with pytest.raises(ValueError, match=r"mask: expected bool \[2\], got int64 \[2\]"):
            episodes.add(frames[[0, 1]], mask=[0, 1])


def test_cameras_are_scored_apart_and_fused(served: Served) -> None:
    front, wrist = film(104, 5), film(105, 5, (48, 48))  # of two sizes
    with served.client("grpc", MODEL) as client:
        apart = [offline(client, frames, Sampling("rint_pad", 4)).progress[-1] for frames in (front, wrist)]
        for fuse, expected in {"mean": np.mean(apart), "min": min(apart), "max": max(apart)}.items():
            episode = client.episode(TASK, frames=4, cameras=("front", "wrist"), fuse=fuse)  # type: ignore[arg-type]
            scores = [episode.add({"front": a, "wrist": b}) for a, b in zip(front, wrist, strict=True)]
            np.testing.assert_allclose(scores[-1].progress, expected, atol=TOLERANCE)
        wanted = r"frames: expected frames of the cameras \['front', 'wrist'\], got \['front'\]"
        with pytest.raises(InvalidSampleError, match=wanted):
            episode.add({"front": front[0]})


@pytest.mark.parametrize(
    ("orient", "front_as", "wrist_as"),
    [
        ("rotate180", lambda frame: frame[::-1, ::-1], lambda frame: frame[::-1, ::-1]),
        ({"front": "rotate90"}, lambda frame: np.rot90(frame, -1), lambda frame: frame),
        ({"front": "flip-vertical", "wrist": "flip-horizontal"}, np.flipud, np.fliplr),
    ],
    ids=["all cameras", "one of them", "each its own"],
)
def test_frames_are_scored_as_they_are_turned(served: Served, orient: Any, front_as: Any, wrist_as: Any) -> None:
    front, wrist = film(104, 3), film(105, 3, (48, 48))
    with served.client("grpc", MODEL) as client:
        upright = client.episodes(1, TASK, sampling="all", cameras=("front", "wrist"))
        turned = client.episode(TASK, sampling="all", cameras=("front", "wrist"), orient=orient)
        for a, b in zip(front, wrist, strict=True):
            expected = upright.add({"front": [front_as(a)], "wrist": [wrist_as(b)]})
            assert turned.add({"front": a, "wrist": b}).progress == pytest.approx(expected.progress[0], abs=TOLERANCE)
        one, another = (client.episode(TASK, sampling="all", orient=each) for each in ("rotate270", "none"))
        for frame in front:
            expected_one = another.add(np.rot90(frame))
            assert one.add(frame).progress == pytest.approx(expected_one.progress, abs=TOLERANCE)


def test_the_success_rule_decides(served: Served) -> None:
    frames = film(106, 3)
    with served.client("grpc", MODEL) as client:
        result = client.progress(Trajectory(frames=frames, task=TASK))
        for threshold in (0.0, 1.0):
            episode = client.episode(TASK, sampling="all", success=SuccessRule(threshold, last=2))
            score = [episode.add(frame) for frame in frames][-1]
            assert score.succeeded == result.succeeded(last=2, threshold=threshold)


def test_a_frame_that_is_wrong_leaves_the_episode_as_it_was(served: Served) -> None:
    frames = film(107, 3)
    with served.client("grpc", MODEL) as client, client.episode(TASK, frames=4) as episode:
        episode.add(frames[0])
        with pytest.raises(InvalidSampleError, match=r"^frame: expected uint8 \[H, W, 3\], got float64 \[2, 2, 3\]"):
            episode.add(np.zeros((2, 2, 3)))
        with pytest.raises(InvalidSampleError, match=r"expected uint8 \[40, 56, 3\], as the episode's first, got"):
            episode.add(film(0, 1, (8, 8))[0])
        assert_same(online_from(episode, frames[1:], 1), later(offline(client, frames, Sampling("rint_pad", 4)), 1))
        episodes = client.episodes(2, TASK, frames=4)
        with pytest.raises(InvalidSampleError, match=r"^episodes\[1\]\.frame: expected uint8 \[H, W, 3\]"):
            episodes.add([frames[0], np.zeros((2, 2, 3))])
        assert episodes.add(frames[:2]).step.tolist() == [0, 0]


def online_from(episode: Episode, frames: UInt8Array, step: int) -> tuple[list[float], list[float]]:
    scores = [episode.add(frame) for frame in frames]
    assert scores[0].step == step
    return [score.progress for score in scores], [score.success for score in scores]


def later(result: ProgressResult, start: int) -> ProgressResult:
    return ProgressResult(progress=result.progress[start:], success=result.success[start:])


def test_the_newest_frame_takes_the_place_of_one_that_waits(served: Served) -> None:
    frames = film(108, 30)
    with served.client("grpc", MODEL) as client, client.episode(TASK, frames=4) as episode:
        answers = [episode.add_nowait(frame) for frame in frames]
        score = answers[-1].result()
        taken = [index for index, answer in enumerate(answers) if not answer.cancelled()]
        assert score.step == len(taken) - 1
        assert (taken[0], taken[-1]) == (0, len(frames) - 1)
        assert 1 < len(taken) < len(frames)
        expected = offline(client, frames[taken], Sampling("rint_pad", 4))
        np.testing.assert_allclose(score.progress, expected.progress[-1], atol=TOLERANCE)
        with pytest.raises(InvalidSampleError, match="frame: expected uint8"):
            episode.add_nowait(np.zeros((2, 2, 3))).result()
        episode.reset("open the drawer")
        assert episode.add(frames[0]).step == 0


def test_an_episode_for_asyncio_scores_alike(served: Served) -> None:
    frames = film(109, 4)

    async def play() -> list[float]:
        async with (
            AsyncRewardClient(served.url("grpc"), model=MODEL) as client,
            client.episode(TASK, frames=4) as episode,
        ):
            scores = [await episode.add(frame) for frame in frames[:3]]
            scores.append(await episode.add_nowait(frames[3]))
            return [score.progress for score in scores]

    with served.client("grpc", MODEL) as client:
        expected = offline(client, frames, Sampling("rint_pad", 4))
    np.testing.assert_allclose(asyncio.run(play()), expected.progress, rtol=0, atol=TOLERANCE)


def test_frames_stay_in_the_order_in_which_they_were_added(served: Served) -> None:
    """Whether they are waited for or not, and with a reset between them."""
    frames = film(113, 4)

    async def play() -> tuple[list[float], list[int]]:
        async with AsyncRewardClient(served.url("grpc"), model=MODEL) as client:
            episode = client.episode(TASK, frames=4)
            open_, waiting = episode.add_nowait(frames[0]), episode.add_nowait(frames[3])
            second = await episode.add(frames[1])
            assert open_.done()
            assert waiting.cancelled()
            buffer = frames[2].copy()
            third = episode.add_nowait(buffer)
            buffer[:] = 0  # drawn over before it was sent
            await episode.reset()
            first = await episode.add(frames[0])
            scores = [open_.result(), second, third.result(), first]
            return [score.progress for score in scores], [score.step for score in scores]

    with served.client("grpc", MODEL) as client:
        expected = offline(client, frames[:3], Sampling("rint_pad", 4)).progress
    progress, steps = asyncio.run(play())
    assert steps == [0, 1, 2, 0]
    np.testing.assert_allclose(progress, [*expected, expected[0]], rtol=0, atol=TOLERANCE)


def test_who_stops_to_wait_for_a_reset_loses_no_answer(served: Served) -> None:
    frames = film(114, 2)

    async def play() -> float:
        async with AsyncRewardClient(served.url("grpc"), model=MODEL) as client:
            episode = client.episode(TASK, frames=4)
            answer = episode.add_nowait(frames[0])
            reset = asyncio.create_task(episode.reset())
            await asyncio.sleep(0)
            reset.cancel()
            first = await answer
            assert (await episode.add(frames[1])).step == 1
            return first.progress

    with served.client("grpc", MODEL) as client:
        expected = offline(client, frames[:1], Sampling("rint_pad", 4))
    np.testing.assert_allclose(asyncio.run(play()), expected.progress[0], atol=TOLERANCE)


def test_an_episode_keeps_its_client(served: Served) -> None:
    episode = RewardClient(served.url("grpc"), model=MODEL).episode(TASK, frames=4)
    gc.collect()
    assert [episode.add(frame).step for frame in film(115, 2)] == [0, 1]


def test_large_frames_go_in_several_requests(recorded: tuple[Recording, RewardClient]) -> None:
    transport, client = recorded
    large = film(116, 5, (700, 700))  # 1.5 MB each
    episodes = client.episodes(5, TASK, frames=2)
    scores = episodes.add(large)
    assert sorted(len(inputs[wire.NUM_FRAMES]) for inputs in transport.requests) == [1, 2, 2]
    expected = [offline(client, large[[index]], Sampling("rint_pad", 2)).progress[0] for index in range(5)]
    np.testing.assert_allclose(scores.progress, expected, atol=TOLERANCE)
    alike = client.episodes(5, TASK, frames=2)
    alike.add(np.repeat(film(117, 1, (700, 700)), 5, axis=0))  # each row of a request is as long as its longest
    assert max(transport.num_bytes) < 4 * 2**20


def test_a_request_of_very_many_frames_is_refused_before_memory_is_taken(served: Served) -> None:
    frames = np.zeros((1, 140_000, 1, 1, 3), np.uint8)
    named = {wire.FRAME_DIGESTS: np.zeros((1, 140_000, 32), np.uint8)}
    inputs = {
        wire.NUM_FRAMES: np.array([[140_000, 0]], np.int32),
        wire.TASK: np.array([[TASK.encode()]], np.object_),
    }

    async def ask(**more: np.ndarray) -> None:
        transport = GrpcTransport(served.url("grpc"), Access(), shared_memory=False)
        try:
            await transport.infer(f"{MODEL}_encoder", {**inputs, **more}, [wire.VIDEO_EMBEDDINGS], 30)
        finally:
            await transport.close()

    for more in ({wire.FRAMES: frames}, {wire.FRAMES: frames[:, :1], **named}):
        with pytest.raises(InvalidSampleError, match=r"num_frames: expected at most 131072 frames in a request"):
            asyncio.run(ask(**more))


def test_a_task_or_model_that_is_not_there_is_told(served: Served) -> None:
    frames = film(110, 1)
    with served.client("grpc", MODEL) as client, pytest.raises(InvalidSampleError, match=r"task: expected a task"):
        client.episode(" ", frames=4).add(frames[0])
    with served.client("grpc", "nobody") as client, pytest.raises(ModelNotFoundError):
        client.episode(TASK, frames=4).add(frames[0])
    with served.client("grpc", MODEL) as client, pytest.raises(ValueError, match="expected one for each of 3 episodes"):
        client.episodes(3, ["a", "b"])
    with pytest.raises(ValueError, match=r"cameras: expected a sequence of names, got 'front'"):
        client.episode(TASK, cameras="front")
    with pytest.raises(ValueError, match=r"^orient: expected some of the cameras \['front'\], got 'wrist'$"):
        client.episode(TASK, cameras=["front"], orient={"wrist": "rotate180"})
    with served.client("grpc", MODEL) as client:
        with pytest.raises(
            InvalidSampleError, match=r"frames: expected frames of one camera .*, got frames of \['a'\]"
        ):
            client.episode(TASK, frames=4).add({"a": frames[0]})
        with pytest.raises(InvalidSampleError, match="task: expected text that UTF-8 can encode"):
            client.episode("\ud800", frames=4).add(frames[0])


def repository_of(folder: Path, checkpoint: str = MODEL, **changes: Any) -> Path:
    config = goldens.config(checkpoint)
    repository = folder / "model_repository"
    rfm_export.export(config.checkpoint, repository, replace(serve_config(config, MODEL), **changes))
    return repository


@pytest.mark.slow
def test_an_episode_goes_on_when_its_server_was_restarted(tmp_path: Path, protocol: str) -> None:
    repository, endpoints = repository_of(tmp_path), Endpoints.free()
    frames = film(111, 9)
    url = endpoints.grpc_url if protocol == "grpc" else endpoints.http_url
    with RewardClient(url, model=MODEL) as client, client.episode(TASK, frames=4) as episode:
        with BriefServer(repository, endpoints, find_installation()):
            before = [episode.add(frame) for frame in frames[:4]]
        with BriefServer(repository, endpoints, find_installation()):
            after = [episode.add(frame) for frame in frames[4:]]
            scores = [*before, *after]
            expected = offline(client, frames, Sampling("rint_pad", 4))
    assert_same(([score.progress for score in scores], [score.success for score in scores]), expected)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("checkpoint", "killed", "tolerance"),
    [(MODEL, f"{MODEL}_encoder", TOLERANCE), (IMAGES, f"{MODEL}_frames", VLM_TOLERANCE)],
)
def test_an_episode_goes_on_when_the_process_that_knew_its_frames_was_killed(
    tmp_path: Path, checkpoint: str, killed: str, tolerance: float
) -> None:
    frames = film(118, 9)
    with serving(repository_of(tmp_path, checkpoint)) as served, served.client(model=MODEL) as client:
        served.wait_ready()
        with client.episode(TASK, frames=4) as episode:
            scores = [episode.add(frame) for frame in frames[:5]]
            (process,) = served.model_processes(killed)
            os.kill(process, signal.SIGKILL)
            while len(scores) < len(frames):
                with suppress(ServerUnavailableError, ProcessEndedError):  # then the episode has not grown
                    scores.append(episode.add(frames[len(scores)]))
        expected = offline(client, frames, Sampling("rint_pad", 4))
    assert [score.step for score in scores] == list(range(len(frames)))
    assert_same(([score.progress for score in scores], [score.success for score in scores]), expected, tolerance)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("checkpoint", "encoder", "tolerance"),
    [(MODEL, f"{MODEL}_encoder", TOLERANCE), (IMAGES, f"{MODEL}_frames", VLM_TOLERANCE)],
)
def test_an_episode_goes_on_between_two_instances_that_know_different_frames(
    tmp_path: Path, checkpoint: str, encoder: str, tolerance: float
) -> None:
    """As on two GPUs."""
    repository, endpoints, frames = repository_of(tmp_path, checkpoint), Endpoints.free(), film(119, 12)
    configure(repository / encoder, instances=2)
    with (
        BriefServer(repository, endpoints, find_installation()),
        RewardClient(endpoints.grpc_url, model=MODEL) as client,
    ):
        for _ in range(3):
            with client.episode(TASK, frames=4) as episode:
                assert_same(online(episode, frames), offline(client, frames, Sampling("rint_pad", 4)), tolerance)


@pytest.mark.slow
def test_two_servers_that_know_different_frames_and_one_without_a_cache_score_alike(tmp_path: Path) -> None:
    frames = film(112, 12)
    caching = repository_of(tmp_path / "caching")
    plain = repository_of(tmp_path / "plain", feature_cache_mb=0)
    first, second, third = Endpoints.free(), Endpoints.free(), Endpoints.free()
    with (
        BriefServer(caching, first, find_installation()),
        BriefServer(caching, second, find_installation()),
        BriefServer(plain, third, find_installation()),
        RewardClient([each.grpc_url for each in (first, second, third)], model=MODEL) as client,
    ):
        expected = offline(client, frames, Sampling("rint_pad", 4))
        for _ in range(3):
            with client.episode(TASK, frames=4) as episode:
                assert_same(online(episode, frames), expected)
