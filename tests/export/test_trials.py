# SPDX-License-Identifier: MIT
"""What `rfm tune` serves is what an export of each setting would be, and shows it no frame twice."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import goldens
import rfm_export
from engines import serve_config
from rfm_client import ProgressSample
from rfm_client.contract.made_up import random_trajectory
from rfm_client.contract.named_frames import frame_digest
from rfm_commands import tune
from rfm_commands.tune import Setting, Sweep

EMBEDDINGS = goldens.config("c1_t1_disc10")
FRAMES = goldens.WITH_ENCODERS[0]
VLM = goldens.config("q3_tok_disc10")
SEVERAL, ONE = Setting(3, 2, 8), Setting(1, 4, 32)

REPOSITORIES: dict[str, tuple[goldens.Config, dict[str, Any]]] = {
    "embeddings": (EMBEDDINGS, {}),
    "embeddings, of several instances": (EMBEDDINGS, {"instances": 2}),
    "encoders with a cache": (FRAMES, {}),
    "encoders with a cache, of several instances": (FRAMES, {"instances": 2, "queue_timeout_ms": 500}),
    "encoders without a cache": (FRAMES, {"feature_cache_mb": 0}),
    "encoders without a cache, of several instances": (FRAMES, {"feature_cache_mb": 0, "instances": 2}),
    "a vision-language model with a cache": (VLM, {}),
    "a vision-language model without a cache": (VLM, {"feature_cache_mb": 0}),
}


@pytest.mark.parametrize(("config", "options"), REPOSITORIES.values(), ids=REPOSITORIES)
def test_a_trial_is_laid_out_as_an_export_of_its_setting(
    config: goldens.Config, options: dict[str, Any], tmp_path: Path
) -> None:
    settings = replace(serve_config(config), **options)
    rfm_export.export(config.checkpoint, tmp_path / "exported", settings)
    for setting in (SEVERAL, ONE):
        trial = shutil.copytree(tmp_path / "exported", tmp_path / f"{setting.instances}")
        tune._apply(setting, trial)
        assert rfm_export.check(trial, replace(settings, **asdict(setting))) == []


def test_no_frame_is_measured_twice_and_embeddings_stay_as_they_are() -> None:
    random = np.random.default_rng(0)
    filmed = [ProgressSample(random_trajectory(random, 4, None, task="stack")) for _ in range(3)]
    sent = list(itertools.islice(tune._unseen(filmed), 10))
    frames = [frame for sample in sent for frame in sample.trajectories[0].positions]
    assert len(set(map(frame_digest, frames))) == 40
    for sample, original in zip(sent, itertools.cycle(filmed), strict=False):
        differences = sample.trajectories[0].positions != original.trajectory.positions
        assert differences.sum() <= 4 * tune.NUMBER_BYTES
    embedded = [ProgressSample(random_trajectory(random, 4, (12, 6), task="")) for _ in range(3)]
    assert list(itertools.islice(tune._unseen(embedded), 6)) == [*embedded, *embedded]


@pytest.mark.triton
@pytest.mark.slow
def test_frames_are_measured_with_several_instances(tmp_path: Path) -> None:
    rfm_export.export(FRAMES.checkpoint, tmp_path / "exported", serve_config(FRAMES))
    sweep = Sweep(tmp_path / "exported", "rfm", callers=4, seconds=1.0, use_frames=True)
    samples_per_s, p50_ms = sweep._measured(Setting(2, 1, 8))
    assert samples_per_s > 0
    assert p50_ms > 0
