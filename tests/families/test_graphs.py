# SPDX-License-Identifier: MIT
"""CUDA graphs give the scores of plain passes. Without a GPU, a replay calls the captured function again."""

from __future__ import annotations

import logging
import random
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

import goldens
from captures import CalledAgain
from engines import load_engine
from pretended import CUDA, pretended
from reward_models import references
from rfm import published
from rfm.engine import Engine, Execution
from rfm.engine.feature_cache import FeatureCache
from rfm.engine.graphs import IDLE_CALLS, STEP_TOKENS, Captured, Function, Graphs
from rfm_client import ProgressSample
from vlm import PLAIN, assert_close, video

ROBOREWARD = references("roboreward")[0].config / "checkpoint"
CPU = torch.device("cpu")


def engine_with(graphs: Graphs, config: goldens.Config, feature_cache_mib: int = 0) -> Engine:
    """The engine of a reference checkpoint with these graphs, on the CPU."""
    checkpoint = published.load(config.checkpoint, **config.sources)
    cache = FeatureCache[Any](feature_cache_mib << 20) if feature_cache_mib else None
    return Engine(checkpoint.predictor(CPU, None, cache), graphs=graphs)


@pytest.mark.parametrize(
    ("config", "feature_cache_mib"),
    [
        (goldens.config(name), mib)
        for name, mib in ((PLAIN, 0), (PLAIN, 4), ("q25_attention_disc10", 4), ("q25_video_last_l2", 0))
    ],
    ids=str,
)
def test_replays_give_the_reference_answers(config: goldens.Config, feature_cache_mib: int) -> None:
    cases = [case for case in config.cases() if not case.is_refused][:3]
    asked = [(case, *pair) for case in cases for pair in zip(case.samples(), case.expected(), strict=True)] * 4
    random.Random(0).shuffle(asked)
    graphs = Graphs(CalledAgain())
    engine = engine_with(graphs, config, feature_cache_mib)
    for case, sample, expected in asked:
        (result,) = engine.evaluate([sample])
        assert not isinstance(result, Exception), result
        goldens.check(result, expected, case.tolerances)
    assert graphs.num_captured > 1
    assert graphs.num_replayed > graphs.num_captured


def test_an_expected_score_is_replayed_and_a_written_answer_is_not() -> None:
    names = "roboreward-expected", "roboreward"
    expected, written = (published.load(ROBOREWARD, reward_model=name) for name in names)
    assert (expected.description.uses_graphs, written.description.uses_graphs) == (True, False)
    plain, graphs = Engine.of(expected), Graphs(CalledAgain())
    engine = Engine(expected.predictor(CPU), graphs=graphs)
    samples = [ProgressSample(video(seed, 4, 64, 64)) for seed in range(2)]
    for _ in range(3):
        for sample in samples:
            assert_same(engine.evaluate([sample]), plain.evaluate([sample]))
    assert graphs.num_replayed


def assert_same(results: Sequence[Any], expected: Sequence[Any]) -> None:
    for result, of_plain in zip(results, expected, strict=True):
        assert not isinstance(result, Exception), result
        for left, right in zip(goldens.frame_scores(result), goldens.frame_scores(of_plain), strict=True):
            torch.testing.assert_close(left.progress, right.progress, rtol=0, atol=1e-5)


def doubled(tensor: Tensor) -> Tensor:
    return tensor * 2


def call(graphs: Graphs, length: int, value: float = 1.0) -> float:
    return float(graphs(doubled, [torch.full((length,), float(value))], "doubled", length).max())


def test_a_graph_that_rests_makes_room() -> None:
    graphs = Graphs(CalledAgain(), max_graphs=2)
    for _ in range(3):
        call(graphs, 1), call(graphs, 2)
    assert graphs.num_captured == 2
    for number in range(IDLE_CALLS):
        assert call(graphs, 1, number) == 2 * number
    for number in range(3):
        assert call(graphs, 3, number) == 2 * number  # in the place of 2
    assert graphs.num_captured == 3
    replayed = graphs.num_replayed
    assert [call(graphs, length, 5) for length in (1, 3, 2)] == [10, 10, 10]
    assert graphs.num_replayed == replayed + 2


def test_results_stay_when_another_graph_is_replayed() -> None:
    graphs = Graphs(CalledAgain())
    for _ in range(3):
        kept = [graphs(doubled, [torch.ones(length)], "doubled", length) for length in (1, 2)]
    call(graphs, 1, 7.0)
    assert graphs.num_captured == 2
    assert [each.tolist() for each in kept] == [[2], [2, 2]]


def test_the_constants_tell_functions_apart() -> None:
    graphs = Graphs(CalledAgain())
    for _ in range(4):
        for factor in (2, 3):
            assert graphs(lambda tensor, by=factor: tensor * by, [torch.ones(1)], factor, 1) == factor


def test_lengths_share_a_graph_but_large_batches_are_not_padded() -> None:
    graphs = Graphs(CalledAgain())
    engine = engine_with(graphs, goldens.config(PLAIN))
    tasks = ["lift the red cup", "lift the red cup and put it on the table", "lift it", "put the cup down"]
    slots, lengths = set(), set()
    for task in tasks:
        sample, execution = ProgressSample(video(0, 2, 64, 64, task)), Execution()
        (result,) = engine.evaluate([sample], execution)
        assert_close(result, load_engine(PLAIN).evaluate([sample])[0], 1e-5)
        slots.add(execution.num_slots)
        lengths.add(execution.num_tokens)
    assert len(lengths) > len(slots) == 1
    assert slots.pop() % STEP_TOKENS == 0
    assert graphs.num_captured == 2  # the tower and the language model
    execution = Execution()
    engine.evaluate([ProgressSample(video(seed, 3, 64, 64)) for seed in range(40)], execution)
    assert execution.num_slots == execution.num_tokens


class Failing:
    """Fails to capture, as PyTorch does: the error at the capture's end hides the cause."""

    def __call__(self, function: Function, tensors: Sequence[Tensor], beside: Captured | None) -> Captured:
        try:
            raise RuntimeError("CUDA error: operation not permitted when stream is capturing\nmore")
        except RuntimeError:
            raise RuntimeError("CUDA error: operation failed due to a previous error during capture")  # noqa: B904


def test_after_a_failed_capture_all_passes_are_plain(caplog: pytest.LogCaptureFixture) -> None:
    graphs = Graphs(Failing())
    engine, sample = engine_with(graphs, goldens.config(PLAIN)), ProgressSample(video(0, 3, 64, 64))
    (expected,) = load_engine(PLAIN).evaluate([sample])
    with caplog.at_level(logging.WARNING):
        for _ in range(6):
            assert_close(engine.evaluate([sample])[0], expected, 1e-5)
    assert [record.getMessage() for record in caplog.records] == [
        "CUDA graphs are off in this process, because a capture failed: "
        "CUDA error: operation not permitted when stream is capturing"
    ]
    assert (graphs.has_failed, graphs.num_captured) == (True, 0)


def test_a_lack_of_memory_drops_graphs_and_kept_features_and_halves_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    graphs, execution, freed, kept = Graphs(CalledAgain()), Execution(), list[None](), list[int]()
    engine: Any = engine_with(graphs, goldens.config(PLAIN), 4)
    network, cache = engine.predictor.network, engine.predictor.cache
    *first, last, other = (ProgressSample(video(seed, 3, 64, 64)) for seed in range(5))
    for sample in first:
        engine.evaluate([sample])
    assert graphs.num_captured == 2
    forward, replayed = network.forward, graphs.num_replayed

    def refusing(batch: Any) -> Any:
        kept.append(len(cache))
        if len(kept) == 1:
            raise torch.OutOfMemoryError("made up")
        return forward(batch)

    monkeypatch.setattr(network, "forward", refusing)
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: freed.append(None))
    expected = load_engine(PLAIN).evaluate([last, other])
    for result, alone in zip(engine.evaluate([last, other], execution), expected, strict=True):
        assert_close(result, alone, 1e-5)
    assert graphs.num_replayed == replayed
    assert kept[0] > kept[1] == 0
    assert (execution.out_of_memory_count, len(freed)) == (1, 1)


def test_an_engine_has_graphs_where_they_can_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = published.load(goldens.config(PLAIN).checkpoint, **goldens.config(PLAIN).sources)
    assert Engine.of(checkpoint, cuda_graphs=True).graphs is None  # the CPU
    with pretended(monkeypatch), torch.inference_mode():
        assert Engine.of(checkpoint, device=CUDA).graphs is None
        assert Engine.of(checkpoint, device=CUDA, cuda_graphs=True).graphs is not None
        embedded = published.load(goldens.REWIND[0].checkpoint)
        assert Engine.of(embedded, device=CUDA, cuda_graphs=True).graphs is None
