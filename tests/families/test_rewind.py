# SPDX-License-Identifier: MIT
"""The network against torch's own transformer, in every variant; the collator; the engine's batches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import goldens
from rfm import published
from rfm.config import DEFAULT_TOKEN_BUDGET
from rfm.engine import Engine, Outcome
from rfm.engine.layers import progress_from_logits
from rfm.families.rewind.checkpoint import RewindCollator, RewindPredictor
from rfm.families.rewind.network import Packing, RewindConfig, RewindTransformer, rounded_up
from rfm_client import (
    InvalidSampleError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
)
from small_network import SMALL
from trajectories import random_trajectory

TOLERANCE = 1e-6  # seen: 2.1e-7
VARIANTS = {
    f"causal={causal} tokens={tokens} bins={bins}": replace(
        SMALL, causal_mask=causal, use_per_frame_progress_token=tokens, progress_bins=bins
    )
    for causal, tokens, bins in product((True, False), (True, False), (1, 5))
} | {
    "one wide layer": replace(SMALL, num_layers=1, hidden_dim=64, num_attention_heads=8),
    "many narrow layers": replace(SMALL, num_layers=5, hidden_dim=4, num_attention_heads=1),
    "no similarity": replace(SMALL, has_similarity=False),
    "no preference": replace(SMALL, has_preference=False),
    "no success": replace(SMALL, has_success=False),
    "progress alone": replace(SMALL, has_similarity=False, has_preference=False, has_success=False),
}


def build(config: RewindConfig, seed: int = 0) -> RewindTransformer:
    torch.manual_seed(seed)
    network = RewindTransformer(config).eval()
    for parameter in network.parameters():  # no layer is left at zeros or ones
        nn.init.normal_(parameter, std=0.3)
    return network.requires_grad_(False)


def engine_of(network: RewindTransformer, *, device: str = "cpu", token_budget: int = DEFAULT_TOKEN_BUDGET) -> Engine:
    return Engine(RewindPredictor(network, torch.device(device)), token_budget=token_budget)


def trajectory(seed: int, num_frames: int) -> Trajectory:
    return random_trajectory(seed, num_frames, SMALL.video_feature_dim, SMALL.text_feature_dim)


def sequence_of(network: RewindTransformer, sample: Sample) -> tuple[Tensor, list[list[int]]]:
    """Written from the format's description, one token at a time: the row's tokens, and where scores are read."""
    weights, config = network.state_dict(), network.config
    text = torch.as_tensor(sample.trajectories[0].text_embedding)
    token = weights["text_proj.weight"] @ text + weights["text_proj.bias"]
    if config.use_per_frame_progress_token:
        token = token + weights["text_position_embedding"][0, 0]
    tokens, read = [token], []
    for side, part in zip("AB", sample.trajectories, strict=False):
        positions = []
        for index, frame in enumerate(torch.as_tensor(part.video_embeddings)):
            token = weights["video_proj.weight"] @ frame + weights["video_proj.bias"]
            tokens.append(token + weights[f"first_embedding_{side}"][0, 0] if index == 0 else token)
            if config.use_per_frame_progress_token:
                tokens.append(weights[f"prog_token_{side}"][0, index])
            positions.append(len(tokens) - 1)
        read.append(positions)
    if len(sample.trajectories) == 2:
        name = "similarity_token" if isinstance(sample, SimilaritySample) else "preference_token"
        tokens.append(weights[name][0, 0])
    return torch.stack(tokens), read


def reference_scores(network: RewindTransformer, sample: Sample) -> list[Tensor]:
    """The sample's scores by torch's own transformer: per trajectory progress and success, then the query."""
    config = network.config
    layer = nn.TransformerEncoderLayer(
        config.hidden_dim, config.num_attention_heads, 4 * config.hidden_dim, batch_first=True, dropout=0.0
    )
    transformer = nn.TransformerEncoder(layer, config.num_layers, enable_nested_tensor=False)
    transformer.load_state_dict(network.transformer.state_dict())
    tokens, read = sequence_of(network, sample)
    length = len(tokens)
    mask = torch.ones(length, length, dtype=torch.bool).triu(1) if config.causal_mask else None
    hidden = transformer(tokens[None], mask=mask)[0]  # in training mode, without dropout: the plain path
    scores = []
    for positions in read:
        logits = network.progress_head(hidden[positions])
        if config.progress_bins == 1:
            scores.append(logits.squeeze(-1).sigmoid())
        else:
            scores.append(logits.softmax(-1) @ torch.linspace(0, 1, config.progress_bins))
        if config.has_success:
            scores.append(network.success_head(hidden[positions]).squeeze(-1).sigmoid())
        else:
            scores.append(torch.full([len(positions)], torch.nan))
    if isinstance(sample, PreferenceSample):
        scores.append(network.preference_head(hidden[-1]).sigmoid())
    elif isinstance(sample, SimilaritySample):
        scores.append(network.similarity_head(hidden[-1]))
    return scores


def numbers(outcome: Outcome) -> np.ndarray:
    assert not isinstance(outcome, RewardError), outcome
    parts = [part for scores in goldens.frame_scores(outcome) for part in (scores.progress, scores.success)]
    query = [[getattr(outcome, name)] for name in ("preference", "similarity") if hasattr(outcome, name)]
    return np.concatenate([*parts, *query])


def samples_for(config: RewindConfig) -> list[Sample]:
    samples: list[Sample] = [ProgressSample(trajectory(t, t)) for t in (1, 2, 5, 8)]
    if config.has_preference:
        samples += [PreferenceSample(trajectory(a, a), trajectory(b + 50, b)) for a, b in ((1, 1), (3, 6), (8, 2))]
    if config.has_similarity:
        samples += [SimilaritySample(trajectory(a, a), trajectory(b + 70, b)) for a, b in ((1, 4), (6, 6))]
    return samples


@pytest.mark.parametrize("config", VARIANTS.values(), ids=VARIANTS)
def test_every_variant_scores_as_torchs_own_transformer(config: RewindConfig) -> None:
    network = build(config)
    samples = samples_for(config)
    for sample, outcome in zip(samples, engine_of(network).evaluate(samples), strict=True):
        expected = torch.cat([score.detach().flatten() for score in reference_scores(network, sample)])
        np.testing.assert_allclose(numbers(outcome), expected.numpy(), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(
    ("config", "token_budget"),
    [*((each, 64) for each in VARIANTS.values()), (SMALL, 16_384)],
    ids=[*VARIANTS, "one batch"],
)
def test_no_mix_of_lengths_and_types_changes_a_result(config: RewindConfig, token_budget: int) -> None:
    random = np.random.default_rng(token_budget)
    samples = samples_for(config)
    samples += [ProgressSample(trajectory(t, t), frame_steps=3) for t in (2, 5)]
    network = build(config)
    alone = [numbers(engine_of(network).evaluate([sample])[0]) for sample in samples]
    engine = engine_of(network, token_budget=token_budget)
    for size in (2, 3, 4, 5, 7, 11, 18, 29, 47):
        chosen = random.integers(0, len(samples), size)
        for index, outcome in zip(chosen, engine.evaluate([samples[i] for i in chosen]), strict=True):
            np.testing.assert_allclose(numbers(outcome), alone[index], rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("lengths", [(32, 33), (33, 32), (32, 32, 32)], ids=str)
def test_rows_of_as_many_tokens_as_a_batch_has_room_for_are_scored_as_alone(lengths: tuple[int, ...]) -> None:
    """33 and 34 tokens lie in a batch of 68 tokens, like two padded rows."""
    engine = engine_of(build(replace(SMALL, use_per_frame_progress_token=False, max_len=40)))
    samples = [ProgressSample(trajectory(seed, length)) for seed, length in enumerate(lengths)]
    for sample, outcome in zip(samples, engine.evaluate(samples), strict=True):
        (alone,) = engine.evaluate([sample])
        np.testing.assert_allclose(numbers(outcome), numbers(alone), rtol=0, atol=TOLERANCE)


def test_the_token_budget_bounds_every_forward() -> None:
    network = build(SMALL)
    sizes: list[int] = []
    network.transformer.register_forward_hook(
        lambda _m, inputs, _o: sizes.append(inputs[1].num_rows * inputs[1].longest)
    )
    engine_of(network, token_budget=100).evaluate(samples_for(SMALL) * 5)
    assert max(sizes) <= 100
    assert len(sizes) < 30
    sizes.clear()
    engine_of(network).evaluate([ProgressSample(trajectory(t, t), frame_steps=4) for t in (3, 9, 20)])
    assert len(sizes) == 1


def test_a_row_over_the_token_budget_runs_alone() -> None:
    network = build(SMALL)
    samples = [ProgressSample(trajectory(seed, 8)) for seed in range(3)] + [ProgressSample(trajectory(3, 2))] * 2
    expected = [numbers(outcome) for outcome in engine_of(network).evaluate(samples)]
    rows: list[int] = []
    network.transformer.register_forward_hook(lambda _m, inputs, _o: rows.append(inputs[1].num_rows))
    outcomes = engine_of(network, token_budget=10).evaluate(samples)  # a row of eight frames has 17 tokens
    for outcome, other in zip(outcomes, expected, strict=True):
        np.testing.assert_allclose(numbers(outcome), other, rtol=0, atol=TOLERANCE)
    assert rows == [2, 1, 1, 1]


def test_frames_that_many_rows_show_are_in_a_batch_once() -> None:
    same, collator = trajectory(1, 3), RewindCollator(SMALL)
    samples = (ProgressSample(trajectory(0, 5), frame_steps=4), PreferenceSample(same, same))
    batch = collator.collate([row for sample in samples for row in collator.rows(sample)])
    assert len(batch.video) == rounded_up(5 + 3)


def test_rows_of_one_length_need_no_mask() -> None:
    assert Packing.of(np.array([4, 4])).mask is None


def test_counts_are_rounded_up_to_one_of_few() -> None:
    counts = range(1, 5000)
    assert all(count <= rounded_up(count) <= count * 17 / 16 for count in counts)
    assert [rounded_up(count) for count in (1, 31, 32, 33, 65, 1056, 1089)] == [1, 31, 32, 34, 68, 1088, 1152]
    assert len({rounded_up(count) for count in counts}) < 160


def test_discrete_progress_is_read_in_float32() -> None:
    logits = torch.randn(3, 4, 10, generator=torch.manual_seed(0)).bfloat16()
    expected = logits.double().softmax(-1) @ torch.linspace(0, 1, 10, dtype=torch.float64)
    torch.testing.assert_close(progress_from_logits(logits).double(), expected, rtol=0, atol=1e-6)


@pytest.mark.reference
@pytest.mark.parametrize("case", goldens.CASES, ids=str)
def test_the_engine_gives_every_reference_answer(case: goldens.Case, engine: Callable[[str], Engine]) -> None:
    outcomes = engine(case.config.name).evaluate(case.samples())
    if case.is_refused:
        assert all(isinstance(outcome, InvalidSampleError) and "max_len" in str(outcome) for outcome in outcomes)
        return
    results = [outcome for outcome in outcomes if not isinstance(outcome, RewardError)]
    for result, expected in zip(results, case.expected(), strict=True):
        goldens.check(result, expected, case.tolerances)
    case.check_response(results)


def test_half_precision_scores_are_near_those_of_float32() -> None:
    """ReWiND in bfloat16, on request."""
    checkpoint = goldens.config("c1_t1_disc10").checkpoint
    in_float32, in_bfloat16 = (Engine.of(published.load(checkpoint), dtype=dtype) for dtype in (None, torch.bfloat16))
    samples = [ProgressSample(random_trajectory(seed, 1 + seed)) for seed in range(8)]
    for exact, near in zip(in_float32.evaluate(samples), in_bfloat16.evaluate(samples), strict=True):
        assert isinstance(exact, ProgressResult) and isinstance(near, ProgressResult)
        assert near.progress.dtype == np.float32
        assert 0 < np.abs(near.progress - exact.progress).max() < 0.02


@pytest.mark.parametrize("name", ["c1_t1_disc10", "legacy_keys_l2"])
def test_only_discrete_progress_has_logits_and_they_are_those_of_the_progress(
    engine: Callable[[str], Engine], name: str
) -> None:
    (result,) = engine(name).evaluate([ProgressSample(random_trajectory(0, 3))])
    assert isinstance(result, ProgressResult)
    if name.endswith("l2"):
        assert result.progress_logits is None
    else:
        assert result.progress_logits is not None
        assert result.progress_logits.shape == (3, 10)
        expected = progress_from_logits(torch.from_numpy(result.progress_logits))
        np.testing.assert_allclose(result.progress, expected.numpy(), rtol=0, atol=TOLERANCE)
