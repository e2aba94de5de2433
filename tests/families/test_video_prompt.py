# SPDX-License-Identifier: MIT
"""The two forms of a Qwen3-VL video prompt: token ids as transformers' processor gives them, and the choice."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import numpy as np
import pytest
import transformers
from transformers import BatchFeature, ProcessorMixin
from transformers.models.qwen2_5_vl.processing_qwen2_5_vl import Qwen2_5_VLProcessor
from transformers.models.qwen3_vl.processing_qwen3_vl import Qwen3VLProcessor

import goldens
from paths import GOLDEN
from reward_models import BASE, ROOT
from rfm import published
from rfm.engine import Engine
from rfm.files import CheckpointError
from rfm.published.qwen import WRAPPED_SINCE, decided
from rfm_client import PreferenceSample, ProgressSample, Trajectory

ROBOMETER = ROOT / "lerobot_robometer" / "video_avg_disc10" / "checkpoint"
TOP = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied"
ROBO = ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint"
QWEN_2_5 = goldens.config("q25_video_avg_disc10")
# Ids by the processors of transformers 4.57.6 (bare) and 5.24.0 (wrapped). RFM_WRITE_IDS=1 writes the installed one's.
STORED = GOLDEN / "video_prompts" / "ids.json"
INSTALLED = tuple(map(int, transformers.__version__.split(".")[:2]))
FORM = "wrapped" if INSTALLED >= WRAPPED_SINCE else "bare"
PADDED = re.compile(r"(<\|vision_start\|>)(<\|video_pad\|>)+(<\|vision_end\|>)")
GROUPS = re.compile(r"(<[\d.]+ seconds><\|vision_start\|><\|video_pad\|><\|vision_end\|>)+")
VIDEO = "<|vision_start|><|video_pad|><|vision_end|>"


def trajectory(num_frames: int, seed: int = 3) -> Trajectory:
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, 48, 64, 3), np.uint8)
    return Trajectory(frames=frames, task="put the cup on the plate")


PROGRESS, PAIR = ProgressSample(trajectory(5)), PreferenceSample(trajectory(3), trajectory(4, seed=4))


@dataclass(frozen=True)
class Case:
    """A model, a sample, and the frame numbers and rate of each video for the processor."""

    source: Path
    shown: tuple[list[int], ...]
    fps: float
    options: dict[str, Any]
    sample: Any = PROGRESS

    def engine(self, form: Any = None) -> Engine:
        return Engine.of(published.load(self.source, **self.options, video_prompt=form))

    def ids(self, form: Any) -> list[int]:
        return list(map(int, self.engine(form).predictor.rows(self.sample)[-1].input_ids))


OF_BASE = {"base_model": str(BASE)}
CASES = {
    "robometer": Case(ROBOMETER, ([*range(6)],), 1, OF_BASE),
    "robometer, two videos": Case(ROBOMETER, ([*range(4)], [*range(4)]), 1, OF_BASE, PAIR),
    "topreward": Case(TOP, ([*range(5)],), 2, {"reward_model": "topreward"}),
    "topreward-robometer": Case(TOP, ([0, 2, 3, 5],), 24, {"reward_model": "topreward-robometer"}),
    "roboreward": Case(ROBO, ([*range(6)],), 1, {"reward_model": "roboreward"}),
    "roboreward-expected": Case(ROBO, ([*range(6)],), 1, {"reward_model": "roboreward-expected"}),
}


@dataclass
class Metadata:
    fps: float
    frames_indices: list[int]

    @property
    def sampled_fps(self) -> float:
        return self.fps


@dataclass(frozen=True)
class Videos:
    """Return grid and times of each video in place of the processor, which needs torchvision."""

    grids: Sequence[tuple[int, int, int]]
    metadata: Sequence[Metadata]
    merge_size: ClassVar[int] = 2
    temporal_patch_size: ClassVar[int] = 2

    def __call__(self, *_: Any, **__: Any) -> BatchFeature:
        return BatchFeature({"video_grid_thw": np.array(self.grids), "video_metadata": list(self.metadata)})

    def fetch_videos(self, videos: Any, *_: Any, **__: Any) -> Any:
        return videos


def by_processor(case: Case, kind: Any = Qwen3VLProcessor) -> list[int]:
    """The ids by the installed processor, from the chat template's text with one pad a video."""
    predictor = case.engine().predictor
    row, tokenizer = predictor.rows(case.sample)[-1], predictor.collator.tokenizer
    grids = [predictor.collator.grid(video) for video in row.videos]
    text = tokenizer.decode(row.input_ids, clean_up_tokenization_spaces=False)
    text = GROUPS.sub(VIDEO, PADDED.sub(r"\1<|video_pad|>\3", text))
    assert text.count(VIDEO) == text.count("<|video_pad|>") == len(grids)
    videos = Videos(
        [(grid.groups, grid.rows, grid.columns) for grid in grids],
        [Metadata(case.fps, list(shown)) for shown in case.shown],
    )
    with patch.object(ProcessorMixin, "check_argument_for_proper_class", lambda *_, **__: None):
        processor = kind(image_processor=object(), tokenizer=tokenizer, video_processor=videos)
    frames = [np.zeros((2, 3, 32, 32), np.uint8) for _ in grids]
    return list(map(int, np.asarray(processor(text=[text], videos=frames)["input_ids"][0])))


@pytest.mark.parametrize("name", CASES)
def test_ids_are_those_of_the_installed_processor(name: str) -> None:
    expected = by_processor(CASES[name])
    if os.environ.get("RFM_WRITE_IDS"):
        stored = json.loads(STORED.read_text()) if STORED.exists() else {}
        stored.setdefault(FORM, {})[name] = expected
        STORED.write_text(json.dumps(stored) + "\n")
    assert CASES[name].ids(FORM) == expected


@pytest.mark.parametrize("form", ["bare", "wrapped"])
@pytest.mark.parametrize("name", CASES)
def test_ids_are_those_of_older_and_of_newer_processors(name: str, form: str) -> None:
    assert CASES[name].ids(form) == json.loads(STORED.read_text())[form][name]


def test_a_qwen_2_5_vl_s_video_is_the_same_in_all_versions() -> None:
    case = Case(QWEN_2_5.checkpoint, ([*range(6)],), 1, {"base_model": str(QWEN_2_5.base_model)})
    assert case.ids(None) == by_processor(case, Qwen2_5_VLProcessor)


VERSIONS: dict[str, tuple[str | None, str, str, bool]] = {  # form and end of the source by version; True: assumed
    "4.57": ("4.57.6", "bare", "transformers_version 4.57.6", False),
    "the last before": ("5.9.0", "bare", "transformers_version 5.9.0", False),
    "the first": ("5.10.1", "wrapped", "transformers_version 5.10.1", False),
    "in development": ("5.24.0.dev0", "wrapped", "transformers_version 5.24.0.dev0", False),
    "none": (None, "bare", "; --video-prompt names the form", True),
}


def with_version(source: Path, folder: Path, version: str | None) -> Path:
    shutil.copytree(source, folder, copy_function=shutil.copyfile)
    content = json.loads((folder / "config.json").read_text())
    part = content.get("vlm_config", content)
    part.pop("transformers_version")
    part.update({} if version is None else {"transformers_version": version})
    (folder / "config.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("source", [ROBOMETER, TOP], ids=["robometer", "topreward"])
@pytest.mark.parametrize(("version", "form", "ending", "is_assumed"), VERSIONS.values(), ids=VERSIONS)
def test_the_version_of_transformers_decides_the_form(
    tmp_path: Path, source: Path, version: str | None, form: str, ending: str, is_assumed: bool
) -> None:
    options: dict[str, Any] = OF_BASE if source == ROBOMETER else {"reward_model": "topreward"}
    loaded: Any = published.read(with_version(source, tmp_path / "checkpoint", version), **options)
    assert loaded.checkpoint.config.video_prompt == form
    assumed = [each for each in loaded.assumptions if each.name == "video_prompt"]
    # A later transformers may only have saved an ordinary model.
    assert [each.value for each in assumed] == [form] * (is_assumed or (source == TOP and form == "wrapped"))
    assert all(each.source.endswith(ending) for each in assumed)
    asked = published.read(tmp_path / "checkpoint", **options, video_prompt="wrapped")
    assert asked.checkpoint.config.video_prompt == "wrapped"
    assert "video_prompt" not in [each.name for each in asked.assumptions]


def test_an_adapter_s_base_model_does_not_tell_the_version_of_its_run() -> None:
    (assumed,) = decided(None, {}, "config.json")[1]
    assert assumed.value == "bare"
    assert decided("wrapped", {}, "config.json") == ("wrapped", ())


@pytest.mark.parametrize("name", ["robometer", "topreward", "roboreward"])
def test_an_export_keeps_its_form(tmp_path: Path, name: str) -> None:
    case = CASES[name]
    for form in ("bare", "wrapped"):
        published.load(case.source, **case.options, video_prompt=form).save(tmp_path / form)
        saved = Engine.of(published.load(tmp_path / form))
        assert list(saved.predictor.rows(case.sample)[-1].input_ids) == case.ids(form)
        assert published.load(tmp_path / form).config.video_prompt == form
    settings = json.loads((tmp_path / "bare" / "config.json").read_text())["rfm"]
    assert "video_prompt" not in settings  # as in exports before the setting, which keep the digest
    with pytest.raises(CheckpointError, match="leave it out, or export the checkpoint again"):
        published.load(tmp_path / "bare", video_prompt="wrapped")
