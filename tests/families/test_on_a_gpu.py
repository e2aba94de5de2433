# SPDX-License-Identifier: MIT
"""A GPU gives the CPU's numbers for every family. These tests need only the packages of a bare GPU machine."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import goldens
import rfm_export
import robodopamine
from engines import load_engine, serve_config
from reward_models import ROOT, references
from rfm import published
from rfm.engine import Engine, Execution
from rfm_client import (
    PreferenceSample,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
    as_trajectory,
)
from trajectories import random_trajectory
from vlm import BFLOAT16, PLAIN, assert_close, video

CAMERA = "observation.images.top"
FRAMES = np.random.default_rng(0).integers(0, 256, (4, 6, 8, 3), np.uint8)
TOPREWARD = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied"
ROBOREWARD = references("roboreward")[0].config / "checkpoint"
LONG = [ProgressSample(video(seed, *size)) for seed, size in enumerate([(1, 64, 96), (16, 64, 64), (24, 96, 64)])]
SHORT: list[Sample] = [
    *(ProgressSample(video(seed, 5, 84, 112)) for seed in range(3)),
    PreferenceSample(video(4, 2, 64, 96), video(5, 3, 64, 64)),
    ProgressSample(video(6, 4, 60, 60), 3),
]
EMBEDDED: list[Sample] = [
    ProgressSample(random_trajectory(0, 5), 3),
    PreferenceSample(random_trajectory(1, 3), random_trajectory(2, 6)),
    SimilaritySample(random_trajectory(3, 1), random_trajectory(4, 4)),
]


def reference(name: str, **options: Any) -> Callable[[], Any]:
    config = goldens.config(name)
    return lambda: published.read(config.checkpoint, **config.sources, **options)


def asked(folder: Path, reward_model: str) -> Callable[[], Any]:
    return lambda: published.read(folder, reward_model=reward_model)


MODELS: dict[str, tuple[Callable[[], Any], list[Any], float]] = {
    "ReWiND": (reference("c1_t1_disc10"), EMBEDDED, 1e-4),
    "ReWiND with encoders": (reference("enc_c1_t1_disc10"), [ProgressSample(video(0, 5, 50, 70))], 1e-4),
    "images": (reference(PLAIN), SHORT, 1e-5),
    "videos": (reference("q25_video_last_l2"), SHORT, 1e-5),
    "a tree of dense mode": (reference(PLAIN), [replace(each, frame_steps=4) for each in LONG], 1e-4),
    "int8": (reference(PLAIN, weights="int8"), SHORT, 1e-4),
    "nf4": (reference(PLAIN, weights="nf4"), SHORT, 1e-4),
    "topreward": (asked(TOPREWARD, "topreward"), LONG, 1e-4),
    "topreward-robometer": (asked(TOPREWARD, "topreward-robometer"), LONG, 1e-4),
    "robodopamine": (
        asked(robodopamine.CHECKPOINT, "robodopamine,mode=forward,interval=1"),
        [robodopamine.case_named("forward_T5").sample],
        0,
    ),
}


def check(results: list[Any], expected: list[Any], tolerance: float) -> None:
    for result, other in zip(results, expected, strict=True):
        assert_close(result, other, tolerance)
        for name in ("log_prob", "similarity"):
            if getattr(other, name, None) is not None:
                np.testing.assert_allclose(getattr(result, name), getattr(other, name), rtol=0, atol=tolerance)


@pytest.mark.gpu
@pytest.mark.parametrize(("load", "samples", "tolerance"), MODELS.values(), ids=MODELS)
def test_a_gpu_gives_the_cpu_s_numbers(load: Callable[[], Any], samples: list[Any], tolerance: float) -> None:
    on_cpu, on_gpu = (
        Engine.of(loaded.checkpoint, device=device, dtype=torch.float32, encoders=loaded.encoders()).evaluate(samples)
        for device, loaded in (("cpu", load()), ("cuda", load()))
    )
    check(on_gpu, on_cpu, tolerance)


@pytest.mark.gpu
def test_bfloat16_on_a_gpu_is_near_float32_on_the_cpu() -> None:
    """The original's own scores in bfloat16 differ from those in float32 by up to 0.018 (``goldens``)."""
    samples = [sample for case in goldens.config(BFLOAT16).cases() for sample in case.samples()]
    engine = Engine.of(reference(BFLOAT16)(), device="cuda")
    together = engine.evaluate(samples)
    check(together, load_engine(BFLOAT16).evaluate(samples), 0.02)
    check([engine.evaluate([sample])[0] for sample in samples], together, 0.02)


@pytest.mark.gpu
def test_a_gpu_writes_the_original_s_answers_in_bfloat16() -> None:
    engine = Engine.of(asked(ROBOREWARD, "roboreward")(), device="cuda")
    cases = [case for case in references("roboreward") if case.config / "checkpoint" == ROBOREWARD]
    cases = [case for case in cases if not case.content["use_frame_steps"]]
    expected = [each["parsed_score"] for case in cases for each in case.content["generations"]]
    for result, score in zip(engine.evaluate([s for case in cases for s in case.samples()]), expected, strict=True):
        assert isinstance(result, RewardError) if score is None else result.last_progress == score / 4 - 0.25  # type: ignore[union-attr]


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_graphs_on_a_gpu_give_the_scores_of_plain_passes(dtype: torch.dtype) -> None:
    plain, engine = (
        Engine.of(reference(BFLOAT16)(), device="cuda", dtype=dtype, cuda_graphs=graphs) for graphs in (False, True)
    )
    samples = [sample for sample in SHORT if not getattr(sample, "frame_steps", 0)]
    for _ in range(4):
        for sample in samples:  # lengths are padded, so kernels differ
            check(engine.evaluate([sample]), plain.evaluate([sample]), 1e-5 if dtype is torch.float32 else 0.02)
    assert engine.graphs is not None
    assert not engine.graphs.has_failed
    assert engine.graphs.num_replayed > len(samples)


@pytest.mark.gpu
def test_the_host_waits_for_a_gpu_once_a_batch() -> None:
    """PyTorch reports each wait of the host. Only reading the scores may wait."""
    engine = Engine.of(reference(BFLOAT16)(), device="cuda")
    engine.evaluate(SHORT[:3])
    prepared = [engine.prepare(sample) for sample in SHORT[:3]]
    for each in prepared:
        engine.work_ahead(each)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        engine.score(prepared, Execution())
        torch.cuda.set_sync_debug_mode("default")
    assert len([each for each in caught if "synchronizing CUDA operation" in str(each.message)]) == 1


@pytest.mark.gpu
def test_tensors_are_fetched_from_the_gpu() -> None:
    frames = Trajectory(frames=torch.from_numpy(FRAMES).cuda()).frames  # type: ignore[arg-type]
    np.testing.assert_array_equal(frames, FRAMES)
    channels_first = torch.from_numpy(FRAMES).permute(0, 3, 1, 2) / 255
    filmed = as_trajectory({CAMERA: channels_first.cuda().requires_grad_()})
    np.testing.assert_array_equal(filmed.positions, FRAMES)


@pytest.mark.gpu
def test_a_gpu_compares_an_export_with_the_checkpoint(tmp_path: Path) -> None:
    said: list[str] = []
    large = next(iter(goldens.VLM))
    settings = replace(serve_config(large), num_gpus=1, dtype="float32")
    assert rfm_export.export(large.checkpoint, tmp_path, settings, say=said.append) == 1
    assert "on cuda:0" in said[-1]
