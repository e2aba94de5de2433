# SPDX-License-Identifier: MIT
"""LeRobot's own Robometer and TOPReward, as its newest release has them, beside ours."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_environment import IS_THERE, run
from paths import ROOT
from reward_models import BASE
from rfm import published
from rfm.engine import Engine
from rfm_client import ProgressResult, ProgressSample, Trajectory

pytestmark = [pytest.mark.nightly, IS_THERE]

PROGRAM = ROOT / "tests" / "support" / "lerobot_scores.py"
TASK = "put the red block in the bowl"
IMAGES = {"use_per_frame_progress_token": False}
VIDEO = IMAGES | {"use_multi_image": False}
ROBOMETER: dict[str, dict[str, Any]] = {
    "tokens": {},
    "tokens_7_bins": {"progress_discrete_bins": 7},
    "images_mean": IMAGES,
    "images_boundary": IMAGES | {"frame_pooling": "boundary"},
    "images_attention": IMAGES | {"frame_pooling": "attention", "frame_pooling_attn_temperature": 0.7},
    "images_l2": IMAGES | {"progress_loss_type": "l2"},
    "video_mean": VIDEO,
    "video_last": VIDEO | {"average_temporal_patches": False},
}
OWN_WORDS = {
    "prompt_prefix": "A robot moves. ",
    "prompt_suffix_template": "Has it done this: {instruction}? The answer is: Yes",
}
TOPREWARD: dict[str, dict[str, Any]] = {
    f"{template}_{fps}_fps{own}": {"add_chat_template": template == "chat", "fps": fps} | words
    for template, fps, (own, words) in product(("plain", "chat"), (2.0, 4.0), {"": {}, "_own_words": OWN_WORDS}.items())
}
FLOAT32, BFLOAT16 = "float32", "bfloat16"
SETTINGS = {
    f"{model}_{name}_{dtype}": {"model": model, "torch_dtype": dtype} | settings
    for model, by_name in {"robometer": ROBOMETER, "topreward": TOPREWARD}.items()
    for name, settings in by_name.items()
    for dtype in (FLOAT32, BFLOAT16)
}
TOLERANCES = {  # seen in float32: 1.2e-7 and 1.9e-6, in bfloat16: 2.2e-3 and 0.022
    "robometer": {FLOAT32: 2e-6, BFLOAT16: 5e-3},
    "topreward": {FLOAT32: 2e-5, BFLOAT16: 0.05},
}


@pytest.fixture(scope="module")
def frames() -> Any:
    noise = np.random.default_rng(0).integers(0, 256, (5, 64, 96, 3), np.uint8)
    return noise // np.arange(1, 6, dtype=np.uint8)[:, None, None, None]  # darker and darker


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, frames: Any) -> Path:
    """A folder with LeRobot's checkpoints and their scores."""
    made = tmp_path_factory.mktemp("lerobot")
    (made / "settings.json").write_text(json.dumps(SETTINGS))
    np.save(made / "frames.npy", frames)
    run([PROGRAM, made, BASE], made)
    return made


@pytest.mark.parametrize("name", SETTINGS)
def test_scores_are_those_of_lerobot_s_newest_release(folder: Path, frames: Any, name: str) -> None:
    settings, expected = SETTINGS[name], json.loads((folder / "scores.json").read_text())[name]
    dtype = settings["torch_dtype"]
    tolerance = TOLERANCES[settings["model"]][dtype]
    base_model = str(folder / name / "vlm" if settings["model"] == "topreward" else BASE)
    engine = Engine.of(published.load(folder / name, base_model=base_model), dtype=getattr(torch, dtype))
    (result,) = engine.evaluate([ProgressSample(Trajectory(frames=frames, task=TASK))])
    assert isinstance(result, ProgressResult), result
    for kind, values in expected.items():
        got = getattr(result, kind)
        got = got if len(values) == len(got) else got[::2]  # one value for each pair of a video
        np.testing.assert_allclose(got, values, rtol=0, atol=tolerance)
        assert np.ptp(values) > 2 * tolerance
