# SPDX-License-Identifier: MIT
"""Reference cases of the original code: requests and answers."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from paths import GOLDEN
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

# RFM_GOLDENS names a folder with more cases of the same layout; without it the tests need nothing but this repository.
ROOT = Path(os.environ.get("RFM_GOLDENS") or GOLDEN)

FRAME_STEPS = 4  # of the original's dense mode

# Largest differences from the original for raw scores (logits, similarity) and probabilities. The references come
# from another machine, so each limit is three times the largest difference with SSE4.1, AVX2 or AVX-512: small enough
# to see an epsilon of 1e-6 in place of 1e-5 in a LayerNorm.
REWIND_TOLERANCES = (2e-5, 5e-6)  # seen: 7.6e-6, 1.7e-6
VLM_TOLERANCES = (4e-5, 1e-5)  # seen: 1.2e-5, 3.1e-6
LORA_TOLERANCES = (1.5e-4, 1.5e-5)  # seen: 4.9e-5, 5.0e-6; merged weights sum in another order
# float32 scores beside a reference in bfloat16. Seen: 0.22, 0.018
ROUNDED_TOLERANCES = (0.3, 0.05)
# bfloat16 scores beside the original's. With AVX-512 and without AMX, as the references were computed, all bits of all
# logits are the same, and a probability differs by its own rounding, at most 2 ** -9. On other CPUs any sum may be
# rounded elsewhere (seen with AVX2 or AMX: 0.19, 0.022; with AMX turned off in oneDNN: 0.12, 0.012).
AS_REFERENCES = (
    torch.backends.cpu.get_cpu_capability() == "AVX512" and "amx_tile" not in Path("/proc/cpuinfo").read_text()
)
BFLOAT16_TOLERANCES = (0.02, 2e-3) if AS_REFERENCES else (0.3, 0.05)

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
        files = (file for file in self.folder.rglob("*model.safetensors") if "encoders" not in file.parts)
        return next(files).parent

    @property
    def summary(self) -> dict[str, Any]:
        return dict(json.loads((self.folder / "config_summary.json").read_text()))

    @property
    def is_vlm(self) -> bool:
        return "base" in self.summary

    @property
    def image_encoder(self) -> Path | None:
        return self._encoder("image_encoder")

    @property
    def text_encoder(self) -> Path | None:
        return self._encoder("text_encoder")

    @property
    def base_model(self) -> Path | None:
        return self.folder / self.summary["base"] if self.is_vlm else None

    @property
    def sources(self) -> dict[str, str]:
        """Arguments for loading the checkpoint: the base model or the encoders, if any."""
        names = ("base_model", "image_encoder", "text_encoder")
        return {name: str(source) for name in names if (source := getattr(self, name)) is not None}

    @property
    def is_discrete(self) -> bool:
        return bool(self.summary["progress_head_outputs"] > 1)

    @property
    def is_bfloat16(self) -> bool:
        return self.summary.get("torch_dtype") == "bfloat16"

    @property
    def frames_per_value(self) -> int:
        """In video mode two frames share a value."""
        return 2 if self.is_vlm and not self.summary["use_multi_image"] else 1

    @property
    def tolerances(self) -> tuple[float, float]:
        """Tolerances of raw scores and probabilities in float32."""
        if not self.is_vlm:
            return REWIND_TOLERANCES
        return LORA_TOLERANCES if self.summary["lora"] else VLM_TOLERANCES

    def _encoder(self, name: str) -> Path | None:
        folder = self.folder / "encoders" / name
        return folder if folder.is_dir() else None

    def cases(self) -> list[Case]:
        return [Case(self, file) for file in sorted((self.folder / "cases").glob("*.json"))]


@dataclass(frozen=True, eq=False)
class Expected:
    """Scores of one sample: per trajectory progress [T], logits [T, K] and success [T]; the answer about a pair."""

    progress: list[Array]
    progress_logits: list[Array] | None
    success: list[Array]
    query: float | None


@dataclass(frozen=True)
class Case:
    """A request and the answer."""

    config: Config
    file: Path

    def __str__(self) -> str:
        return f"{self.config.name}/{self.file.stem}"

    @property
    def content(self) -> dict[str, Any]:
        return dict(json.loads(self.file.read_text()))

    @property
    def arrays(self) -> dict[str, Array]:
        """The raw arrays that the original computed."""
        return dict(np.load(self.file.with_suffix("").with_suffix(".expected.npz")))

    @property
    def tolerances(self) -> tuple[float, float]:
        """Tolerances of raw scores and probabilities; wide for references in bfloat16 alone."""
        rounded = self.config.is_bfloat16 and not self.has_float32
        return ROUNDED_TOLERANCES if rounded else self.config.tolerances

    @property
    def has_float32(self) -> bool:
        """True if a case of a bfloat16 checkpoint also has float32 references."""
        return any(key.startswith("fp32.") for key in self.content["expected_arrays"])

    @property
    def is_refused(self) -> bool:
        """True if the request has to be refused."""
        return "expectation" in self.content

    def samples(self) -> list[Sample]:
        inputs = self.file.parent / self.content["inputs"]
        request = json.loads(inputs.with_suffix(".json").read_text())
        arrays = np.load(inputs.with_suffix(".npz"))
        frame_steps = FRAME_STEPS if request["use_frame_steps"] else 0
        samples = [_sample(sample, arrays, frame_steps) for sample in request["samples"]]
        # The original drew the order of a similarity sample's trajectories; ours is always reference first.
        orders = iter(self.content.get("reference_first") or [])
        return [
            SimilaritySample(sample.other, sample.reference)
            if isinstance(sample, SimilaritySample) and not next(orders, True)
            else sample
            for sample in samples
        ]

    def expected(self, *, bfloat16: bool = False) -> list[Expected]:
        """Read the raw arrays, which the original's answer does not contain in full.

        bfloat16: True: scores in bfloat16 if the checkpoint has that type; False: in float32
        """
        arrays = self.arrays
        if not bfloat16 and self.has_float32:
            arrays = {key.removeprefix("fp32."): array for key, array in arrays.items() if key.startswith("fp32.")}
        read = _Reader(arrays, self.config)
        if self.content["kind"] in ("ragg", "ragp", "ragged"):  # evaluated one by one, each with separate arrays
            return [read.expected(sample, 0, f"sample_{index}.") for index, sample in enumerate(self.samples())]
        rows = {"progress": 0, "preference": 0, "similarity": 0}
        expected = []
        for sample in self.samples():
            kind = sample_type(sample)
            expected.append(read.expected(sample, rows[kind], ""))
            dense = isinstance(sample, ProgressSample) and sample.frame_steps
            rows[kind] += sample.trajectories[0].num_frames if dense else 1
        return expected

    def check_response(self, results: Sequence[Result]) -> None:
        """Compare with the body that the original server sends, or should have sent."""
        body = self.content.get("response_fixed") or self.content["response"]
        raw_tolerance, tolerance = ROUNDED_TOLERANCES if self.config.is_bfloat16 else self.config.tolerances
        by_kind: dict[str, list[Any]] = {"progress": [], "success": [], "preference": [], "similarity": []}
        for sample, result in zip(self.samples(), results, strict=True):
            if isinstance(result, ProgressResult):
                dense = isinstance(sample, ProgressSample) and sample.frame_steps
                each = slice(None, None, 1 if dense else self.config.frames_per_value)
                by_kind["progress"].append(result.progress[each])
                by_kind["success"].append(result.success[each])
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
            for got, wanted in zip(by_kind[kind], part[name] if part else [], strict=True):
                atol = raw_tolerance if kind == "similarity" else tolerance
                np.testing.assert_allclose(got, wanted, rtol=0, atol=atol)


def configs(family: str) -> list[Config]:
    """Return a family's reference checkpoints, without those on SmolVLM, which no published checkpoint uses."""
    folders = sorted(path for path in (ROOT / family).iterdir() if (path / "cases").is_dir())
    return [Config(folder) for folder in folders if not folder.name.startswith("smol_")]


REWIND = configs("rewind")
WITH_ENCODERS = configs("rewind_encoders")
VLM = configs("vlm")
CASES = [case for config in (*REWIND, *WITH_ENCODERS) for case in config.cases()]
VLM_CASES = [case for config in VLM for case in config.cases()]
ANSWERED = [case for case in (*CASES, *VLM_CASES) if not case.is_refused]


def config(name: str) -> Config:
    return next(config for config in (*REWIND, *WITH_ENCODERS, *VLM) if config.name == name)


# What the shared server serves: ReWiND, ReWiND with encoders; and on demand Qwen3-VL on images, Qwen2.5-VL on video. Each
# reference case runs on the engine; through Triton one case of each model.
SERVED = [config(name) for name in ("c1_t1_disc10", "enc_c1_t1_disc10")]
ON_DEMAND = [config(name) for name in ("q3_tok_disc10", "q25_video_avg_disc10")]
SERVED_CASES = [
    next(case for case in each.cases() if case.file.stem.startswith("mixed")) for each in (*SERVED, *ON_DEMAND)
]


def sample_type(sample: Sample) -> str:
    return {ProgressSample: "progress", PreferenceSample: "preference", SimilaritySample: "similarity"}[type(sample)]


def differences(result: Result, expected: Expected) -> tuple[float, float]:
    """Return the largest differences of raw scores and probabilities from the reference."""
    frames = frame_scores(result)
    raw, probabilities = [0.0], [0.0]
    for got, progress, success in zip(frames, expected.progress, expected.success, strict=True):
        assert got.progress.shape == progress.shape
        assert got.success.shape == success.shape
        probabilities += [np.abs(got.progress - progress).max(), np.abs(got.success - success).max()]
    for got, logits in zip(frames, expected.progress_logits or [], strict=bool(expected.progress_logits)):
        if got.progress_logits is not None:
            raw.append(np.abs(got.progress_logits - logits).max())
    if isinstance(result, PreferenceResult):
        assert expected.query is not None
        probabilities.append(abs(result.preference - sigmoid(expected.query)))
    if isinstance(result, SimilarityResult):
        assert expected.query is not None
        raw.append(abs(result.similarity - expected.query))
    return float(max(raw)), float(max(probabilities))


def check(result: Result, expected: Expected, tolerances: tuple[float, float]) -> None:
    """Every number of a result against the reference."""
    raw, probability = differences(result, expected)
    assert raw <= tolerances[0]
    assert probability <= tolerances[1]


def assert_close(left: object, right: object, tolerance: float) -> None:
    """Progress, success, preference and similarity of two results are equal within a tolerance."""
    assert not isinstance(left, Exception), left
    assert not isinstance(right, Exception), right
    for a, b in zip(frame_scores(left), frame_scores(right), strict=True):  # type: ignore[arg-type]
        np.testing.assert_allclose(a.progress, b.progress, rtol=0, atol=tolerance)
        np.testing.assert_allclose(a.success, b.success, rtol=0, atol=tolerance)
    for name in ("preference", "similarity"):
        if hasattr(left, name):
            assert abs(getattr(left, name) - getattr(right, name)) <= tolerance


def frame_scores(result: Result) -> list[FrameScores]:
    """Return the scores of each trajectory of a sample."""
    if isinstance(result, ProgressResult):
        return [result]
    return [scores for scores in vars(result).values() if isinstance(scores, FrameScores)]


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


@dataclass(frozen=True)
class _Reader:
    """Return a case's raw arrays."""

    arrays: dict[str, Array]
    config: Config

    def expected(self, sample: Sample, row: int, prefix: str) -> Expected:
        kind = sample_type(sample)
        lengths = [trajectory.num_frames for trajectory in sample.trajectories]
        if isinstance(sample, ProgressSample) and sample.frame_steps:  # one row per prefix; the last frame counts
            rows = range(row, row + lengths[0])
            progress, success = (
                [np.stack([self._raw(f"{prefix}{kind}.{name}_logits_A", r)[-1] for r in rows])]
                for name in ("progress", "success")
            )
        else:
            progress, success = (
                self._of_trajectories(f"{prefix}{kind}.{name}_logits", row, lengths) for name in ("progress", "success")
            )
        query = {"preference": "pref_logits", "similarity": "sim_logits"}.get(kind)
        answer = float(self.arrays[f"{prefix}{kind}.{query}"][row, 0]) if query else None
        success = [sigmoid(part) for part in success]
        if not self.config.is_discrete:  # stored behind the sigmoid
            return Expected(progress, None, success, answer)
        return Expected([_mean_bin(part) for part in progress], progress, success, answer)

    def _of_trajectories(self, name: str, row: int, lengths: Sequence[int]) -> list[Array]:
        """Split the values by trajectory. The original splits pairs in the middle, whatever the lengths."""
        values = np.concatenate([self._raw(f"{name}_{side}", row) for side, _ in zip("AB", lengths, strict=False)])
        each = self.config.frames_per_value
        counts = [-(-length // each) for length in lengths]
        parts = np.split(values, np.cumsum(counts)[:-1])
        return [part[np.arange(length) // each] for part, length in zip(parts, lengths, strict=True)]

    def _raw(self, name: str, row: int) -> Array:
        """[T] or [T, K]; for a single frame the original may omit the time axis."""
        discrete = self.config.is_discrete and "progress" in name.rpartition(".")[2]
        return (
            self.arrays[name][row]
            .reshape(-1, self.config.summary["progress_head_outputs"] if discrete else 1)
            .squeeze(() if discrete else 1)
        )


def _mean_bin(logits: Array) -> Array:
    weights = np.exp(logits.astype(np.float64) - logits.max(axis=-1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True) @ np.linspace(0, 1, logits.shape[-1]))
