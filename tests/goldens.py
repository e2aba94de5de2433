# SPDX-License-Identifier: MIT
"""Reference cases computed by the original code: a request, and what it must be answered."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client import (
    FrameScores,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    Sample,
    SimilarityResult,
    SimilaritySample,
    Trajectory,
    float_frames_to_uint8,
)

_OWN = Path(__file__).parent / "golden"
_SHARED = Path(__file__).parents[2] / "shared" / "golden"  # all cases, where they are at hand
ROOT = _SHARED if _SHARED.is_dir() else _OWN

FRAME_STEPS = 4  # of the original's dense mode
PROBABILITY_TOLERANCE = 1e-5
SIMILARITY_TOLERANCE = 1e-4
LOGIT_TOLERANCE = 1e-4

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Config:
    """One reference checkpoint."""

    folder: Path

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def checkpoint(self) -> Path:
        found = (file.parent for file in self.folder.rglob("model.safetensors") if "encoders" not in file.parts)
        return next(found)

    @property
    def image_encoder(self) -> Path | None:
        folder = self.folder / "encoders" / "image_encoder"
        return folder if folder.is_dir() else None

    @property
    def text_encoder(self) -> Path | None:
        folder = self.folder / "encoders" / "text_encoder"
        return folder if folder.is_dir() else None

    def cases(self) -> list[Case]:
        return [Case(self, file) for file in sorted((self.folder / "cases").glob("*.json"))]


@dataclass(frozen=True, eq=False)
class Expected:
    """Scores of one sample: per trajectory progress [T], its logits [T, K] and success [T]; the answer about a pair."""

    progress: list[Array]
    progress_logits: list[Array] | None
    success: list[Array]
    query: float | None


@dataclass(frozen=True)
class Case:
    """One request and its answer."""

    config: Config
    file: Path

    def __str__(self) -> str:
        return f"{self.config.name}/{self.file.stem}"

    @property
    def content(self) -> dict[str, Any]:
        return dict(json.loads(self.file.read_text()))

    @property
    def is_refused(self) -> bool:
        """Whether the request has to be refused."""
        return "expectation" in self.content

    def samples(self) -> list[Sample]:
        inputs = self.file.parent / self.content["inputs"]
        request = json.loads(inputs.with_suffix(".json").read_text())
        arrays = np.load(inputs.with_suffix(".npz"))
        frame_steps = FRAME_STEPS if request["use_frame_steps"] else 0
        return [_sample(sample, arrays, frame_steps) for sample in request["samples"]]

    def expected(self) -> list[Expected]:
        """From the raw arrays, which also tell what the original's answer leaves out."""
        arrays = dict(np.load(self.file.with_suffix("").with_suffix(".expected.npz")))
        if self.content["kind"] in ("ragg", "ragp", "ragged"):  # evaluated one by one, each with arrays of its own
            return [
                _expected(
                    sample, {k.partition(".")[2]: v for k, v in arrays.items() if k.startswith(f"sample_{i}.")}, 0
                )
                for i, sample in enumerate(self.samples())
            ]
        rows = {"progress": 0, "preference": 0, "similarity": 0}
        expected = []
        for sample in self.samples():
            kind = sample_type(sample)
            expected.append(_expected(sample, arrays, rows[kind]))
            dense = isinstance(sample, ProgressSample) and sample.frame_steps
            rows[kind] += sample.trajectories[0].num_frames if dense else 1
        return expected

    def check_response(self, results: list[Result]) -> None:
        """Compares with the body that the original server sends, or should have sent."""
        body = self.content.get("response_fixed") or self.content["response"]
        by_kind: dict[str, list[Any]] = {"progress": [], "success": [], "preference": [], "similarity": []}
        for result in results:
            if isinstance(result, ProgressResult):
                by_kind["progress"].append(result.progress)
                by_kind["success"].append(result.success)
            elif isinstance(result, PreferenceResult):
                by_kind["preference"].append(result.preference)
            else:
                by_kind["similarity"].append(result.similarity)
        names = {
            "progress": "progress_pred",
            "success": "success_probs",
            "preference": "prediction_probs",
            "similarity": "sim_score_ref_sim",
        }
        for kind, name in names.items():
            part = body.get(f"outputs_{kind}")
            assert (part is None) == (not by_kind[kind])
            tolerance = SIMILARITY_TOLERANCE if kind == "similarity" else PROBABILITY_TOLERANCE
            for got, wanted in zip(by_kind[kind], part[name] if part else [], strict=True):
                np.testing.assert_allclose(got, wanted, rtol=0, atol=tolerance)


def configs(family: str) -> list[Config]:
    folders = sorted(path for path in (ROOT / family).iterdir() if (path / "cases").is_dir())
    return [Config(folder) for folder in folders]


REWIND = configs("rewind")
WITH_ENCODERS = configs("rewind_encoders")
CASES = [case for config in (*REWIND, *WITH_ENCODERS) for case in config.cases()]
ANSWERED = [case for case in CASES if not case.is_refused]
REFUSED = [case for case in CASES if case.is_refused]


def config(name: str) -> Config:
    return next(config for config in (*REWIND, *WITH_ENCODERS) if config.name == name)


def sample_type(sample: Sample) -> str:
    return {ProgressSample: "progress", PreferenceSample: "preference", SimilaritySample: "similarity"}[type(sample)]


def check(result: Result, expected: Expected) -> None:
    """Every number of a result against the reference."""
    frames = frame_scores(result)
    for got, progress, success in zip(frames, expected.progress, expected.success, strict=True):
        np.testing.assert_allclose(got.progress, progress, rtol=0, atol=PROBABILITY_TOLERANCE)
        np.testing.assert_allclose(got.success, success, rtol=0, atol=PROBABILITY_TOLERANCE)
    if expected.progress_logits is not None:
        for got, logits in zip(frames, expected.progress_logits, strict=True):
            assert got.progress_logits is not None
            np.testing.assert_allclose(got.progress_logits, logits, rtol=0, atol=LOGIT_TOLERANCE)
    if isinstance(result, PreferenceResult):
        assert expected.query is not None
        assert abs(result.preference - sigmoid(expected.query)) <= PROBABILITY_TOLERANCE
    if isinstance(result, SimilarityResult):
        assert expected.query is not None
        assert abs(result.similarity - expected.query) <= SIMILARITY_TOLERANCE


def frame_scores(result: Result) -> list[FrameScores]:
    if isinstance(result, ProgressResult):
        return [result]
    return [result.first, result.second] if isinstance(result, PreferenceResult) else [result.reference, result.other]


def sigmoid(logits: Any) -> Any:
    return 1 / (1 + np.exp(-np.asarray(logits, np.float64)))


def _sample(sample: dict[str, Any], arrays: Any, frame_steps: int) -> Sample:
    kind = sample["sample_type"]
    if kind == "progress":
        return ProgressSample(_trajectory(sample["trajectory"], arrays), frame_steps=frame_steps)
    keys = {"preference": ("chosen", "rejected"), "similarity": ("ref", "sim")}[kind]
    first, second = (_trajectory(sample[f"{key}_trajectory"], arrays) for key in keys)
    return PreferenceSample(first, second) if kind == "preference" else SimilaritySample(first, second)


def _trajectory(trajectory: dict[str, Any], arrays: Any) -> Trajectory:
    fields = {name: arrays[value["__numpy_file__"]] for name, value in trajectory.items() if isinstance(value, dict)}
    if "frames" in fields and fields["frames"].dtype != np.uint8:
        fields["frames"] = float_frames_to_uint8(fields["frames"])
    return Trajectory(task=trajectory["task"], **fields)


def _expected(sample: Sample, arrays: dict[str, Array], row: int) -> Expected:
    kind = sample_type(sample)
    sides = "A" if kind == "progress" else "AB"
    progress, logits, success = [], [], []
    for side, trajectory in zip(sides, sample.trajectories, strict=True):
        raw, raw_success = (arrays[f"{kind}.{name}_logits_{side}"] for name in ("progress", "success"))
        if isinstance(sample, ProgressSample) and sample.frame_steps:  # one row a prefix, of which the last counts
            raw, raw_success = (part[row : row + trajectory.num_frames, -1] for part in (raw, raw_success))
        else:
            raw, raw_success = raw[row], raw_success[row]
        success.append(sigmoid(raw_success))
        if raw.ndim == 2:  # discrete; continuous progress is stored behind its sigmoid
            logits.append(raw)
            weights = np.exp(raw.astype(np.float64) - raw.max(axis=-1, keepdims=True))
            weights /= weights.sum(axis=-1, keepdims=True)
            progress.append(weights @ np.linspace(0, 1, raw.shape[-1]))
        else:
            progress.append(raw)
    query = {"preference": "pref_logits", "similarity": "sim_logits"}.get(kind)
    answer = float(arrays[f"{kind}.{query}"][row, 0]) if query else None
    return Expected(progress, logits or None, success, answer)
