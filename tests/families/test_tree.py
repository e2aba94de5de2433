# SPDX-License-Identifier: MIT
"""Prefixes of an episode as a tree: scores as in separate passes, fewer tokens, bounded masks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from reward_models import ROOT
from rfm import published
from rfm.engine import Engine, Execution
from rfm.qwen import leaves, tree
from rfm.qwen.batch import VlmRow
from rfm.qwen.tree import Conversation, trees
from rfm_client import InvalidSampleError, ProgressResult, ProgressSample, Trajectory
from rfm_client.contract import wire
from tolerances import TOLERANCE
from vlm import load

CHECKPOINT = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied"
TASK = "put the red block in the bowl"


def sample(num_frames: int, height: int = 64, width: int = 64, frame_steps: int = 0) -> ProgressSample:
    frames = np.random.default_rng(num_frames).integers(0, 256, (num_frames, height, width, 3), np.uint8)
    return ProgressSample(Trajectory(frames=frames, task=TASK), frame_steps=frame_steps)


def topreward(settings: str = "", **options: Any) -> Engine:
    return Engine.of(published.load(str(CHECKPOINT), reward_model=f"topreward{settings}"), **options)


def robometer(name: str = "q3_tok_disc10", **options: Any) -> Engine:
    return Engine.of(load(name), **options)


def values(outcomes: Any) -> list[Any]:
    """Return progress, or log-probabilities, of each sample."""
    assert all(isinstance(outcome, ProgressResult) for outcome in outcomes), outcomes
    return [outcome.progress if outcome.log_prob is None else outcome.log_prob for outcome in outcomes]


def assert_as_separate(engine: Engine, samples: list[ProgressSample], monkeypatch: pytest.MonkeyPatch) -> None:
    """A tree gives the scores of separate prefixes with fewer tokens."""
    of_trees, separate = Execution(), Execution()
    found = values(engine.evaluate(samples, of_trees))
    with monkeypatch.context() as changed:
        changed.setattr(tree, "WORTH", np.inf)
        expected = values(engine.evaluate(samples, separate))
    assert of_trees.num_tokens < separate.num_tokens
    for each, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(each, wanted, rtol=0, atol=TOLERANCE)


def planned(rows: list[VlmRow], collator: Any) -> list[VlmRow]:
    return trees(rows, collator.visual_pad, are_images=collator.config.multi_image)


COUNTED = {
    "16 frames": ("topreward", 16, (224, 224), 4984, 1800),
    "64 frames": ("topreward", 64, (224, 224), 64218, 7500),
    "15 prefixes of 64 frames": ("topreward,num_prefixes=15", 64, (224, 224), 14967, 3000),
}


@pytest.mark.parametrize("name, num_frames, size_px, separate, most", COUNTED.values(), ids=COUNTED)
def test_a_tree_has_few_tokens(name: str, num_frames: int, size_px: tuple[int, int], separate: int, most: int) -> None:
    collator: Any = published.load(CHECKPOINT, reward_model=name).collator  # type: ignore[attr-defined]
    rows = collator.rows(sample(num_frames, *size_px))
    assert sum(row.num_tokens for row in rows) == separate
    assert sum(row.cost for row in planned(rows, collator)) <= most


def test_conversations_share_the_tokens_before_the_first_that_is_read_or_stands_elsewhere() -> None:
    collator: Any = published.load(CHECKPOINT, reward_model="topreward").collator  # type: ignore[attr-defined]
    whole = Conversation.of(collator.rows(sample(4))[-1], collator.visual_pad, are_images=False)
    assert whole.shared(whole) == whole.reads[0] < whole.row.num_tokens
    position_ids = whole.row.position_ids.copy()
    position_ids[0, 5] += 1
    assert whole.shared(replace(whole, row=replace(whole.row, position_ids=position_ids))) == 5


def test_budget_and_metrics_count_the_tokens_of_a_tree() -> None:
    engine, execution = topreward(), Execution()
    asked = sample(64, 224, 224)
    prepared = engine.prepare(asked)
    engine.score([prepared], execution)
    assert execution.num_tokens == prepared.num_tokens <= 7500
    assert execution.num_slots == execution.num_tokens
    assert execution.num_encoded == 128  # 32 pairs, and 32 frames that make up a pair alone


MIXED = [sample(1), sample(16), sample(20, 48, 80), sample(24, 96, 64)]


@pytest.mark.parametrize("settings", ["", ",chat_template=true", ",num_prefixes=5"])
def test_a_batch_of_trees_gives_the_scores_of_separate_prefixes(settings: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_as_separate(topreward(settings), [*MIXED, sample(40)], monkeypatch)


@pytest.mark.parametrize("frame_steps", [0, 4], ids=["TOPReward", "dense mode"])
def test_a_tree_does_not_depend_on_its_batch(frame_steps: int) -> None:
    engine = robometer() if frame_steps else topreward()
    samples = [replace(each, frame_steps=frame_steps) for each in MIXED]
    for each, together in zip(samples, values(engine.evaluate(samples)), strict=True):
        np.testing.assert_allclose(together, values(engine.evaluate([each]))[0], rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(
    "bounds",
    [
        {"leaves.MOST_PACK_TOKENS": 200},
        {"leaves.MOST_MASK_BYTES": 60_000},
        {"tree.MOST_LEAF_TOKENS": 300},
    ],
    ids=lambda bounds: next(iter(bounds)),
)
def test_bounds_of_memory_change_no_score(bounds: dict[str, int], monkeypatch: pytest.MonkeyPatch) -> None:
    masks: list[int] = []
    mask = leaves.Packs.mask
    monkeypatch.setattr(leaves.Packs, "mask", lambda packs: masks.append(mask(packs).numel()) or mask(packs))
    samples = [sample(24), *MIXED]
    engine = topreward()
    of_all = max(1, sum(len(row.packs) for each in samples for row in engine.predictor.rows(each)))
    for name, value in bounds.items():
        monkeypatch.setattr(f"rfm.qwen.{name}", value)
    assert_as_separate(engine, samples, monkeypatch)
    assert sum(len(row.packs) for each in samples for row in engine.predictor.rows(each)) > of_all
    assert max(masks) <= leaves.MOST_MASK_BYTES


def test_a_server_bounds_the_longest_prefix_and_not_the_tree() -> None:
    engine = topreward()
    asked = sample(16)
    (row,) = engine.predictor.rows(asked)
    engine.max_sample_tokens = row.num_tokens
    assert row.cost > 2 * row.num_tokens
    (served,) = engine.evaluate([asked])
    assert isinstance(served, ProgressResult)
    engine.max_sample_tokens -= 1
    (refused,) = engine.evaluate([asked])
    assert isinstance(refused, InvalidSampleError)
    assert f"expected at most {row.num_tokens - 1} tokens (max_sample_tokens of this server)" in str(refused)


@pytest.mark.parametrize("frame_steps", [0, 4], ids=["TOPReward", "dense mode"])
def test_cached_features_and_frame_references_change_no_score(
    frame_steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    cached = (robometer if frame_steps else topreward)(feature_cache_mib=16)
    asked = sample(16, frame_steps=frame_steps)
    assert_as_separate(cached, [asked], monkeypatch)
    expected, again = values(cached.evaluate([asked])), Execution()
    frames = asked.trajectory.frames
    assert frames is not None
    tensors = wire.encode_refs([[*map(wire.frame_digest, frames)]], [TASK], [])
    tensors[wire.FRAME_STEPS][:] = frame_steps
    assert cached.cache is not None
    (named,) = wire.decode_samples(tensors, cached.cache.found)
    found = values(cached.score([cached.prepare(named)], again))
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=TOLERANCE)
    assert (again.num_encoded, again.num_found > 0) == (0, True)


DENSE = ["q3_tok_disc10", "q25_peft_adapter_disc10", "q25_boundary_disc10"]


@pytest.mark.parametrize("name", DENSE)
def test_dense_mode_in_trees_gives_the_scores_of_separate_prefixes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = [sample(9, 56, 84, 4), sample(16, 84, 56, 8), sample(3), sample(2, frame_steps=2)]
    assert_as_separate(robometer(name), samples, monkeypatch)


@pytest.mark.parametrize("engine, frame_steps", [(topreward, 0), (robometer, 4)], ids=["TOPReward", "dense Robometer"])
def test_a_tree_that_does_not_fit_in_memory_is_scored_prefix_by_prefix(
    engine: Any, frame_steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_tree, small = engine(), engine()
    episodes = [sample(8, frame_steps=frame_steps), sample(6, frame_steps=frame_steps)]
    expected = values(of_tree.evaluate(episodes))
    rows = [row for episode in episodes for row in small.predictor.rows(episode)]
    longest = max(each.num_tokens for row in rows for each in small.predictor.sequences(row))
    score, execution = small.predictor.score, Execution()

    def limited(rows: Any, batch: Any, execution: Execution) -> Any:
        if batch.num_slots > longest:
            raise torch.OutOfMemoryError("no room")
        return score(rows, batch, execution)

    monkeypatch.setattr(small.predictor, "score", limited)
    found = values(small.evaluate(episodes, execution))
    assert execution.out_of_memory_count > 0
    for each, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(each, wanted, rtol=0, atol=TOLERANCE)
