# SPDX-License-Identifier: MIT
"""The wire contract: samples and results as named tensors. The only place where tensor names stand.

Letters: B samples of one request (the batch axis), P frame positions: the first trajectory's frames, then
the second's, then zero padding; D, Dt, K, H, W as in ``rfm_client.contract.samples``.

Whatever changes the answer is an input, and every input but two is always present: that is what lets Triton put
requests of different callers, lengths and sample types into one batch. One is ``second_frames``, for pairs whose
trajectories differ in frame size: ``frames`` then holds the first trajectories alone, and it the second ones. It is
optional, so that requests without it stay what they were before it existed. Triton batches requests that have it among
themselves. P is then the positions of both arrays.

The other is ``frame_digests``, of a model that keeps what it made of frames: the name of each of the P frames
(``named_frames``). ``frames`` then holds, in any order and in any sample's row, the pixels of those that the model may
not know; zeros may lie between them. A request with a digest that the model does not know is refused, and its caller
asks again with all pixels.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client.contract.errors import InferenceFailedError, InvalidSampleError
from rfm_client.contract.named_frames import (
    DIGEST_BYTES,
    NamedFootage,
    NamedProgressSample,
    NamedTrajectory,
    frame_digest,
)
from rfm_client.contract.results import (
    BatchTiming,
    FrameScores,
    PreferenceResult,
    ProgressResult,
    Result,
    SimilarityResult,
)
from rfm_client.contract.samples import (
    Float32Array,
    Footage,
    PreferenceSample,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
    UInt8Array,
    stackable,
)

Tensors: TypeAlias = dict[str, npt.NDArray[Any]]

SAMPLE_TYPE = "sample_type"
NUM_FRAMES = "num_frames"
FRAME_STEPS = "frame_steps"
VIDEO_EMBEDDINGS = "video_embeddings"
TEXT_EMBEDDING = "text_embedding"
FRAMES = "frames"
SECOND_FRAMES = "second_frames"
FRAME_DIGESTS = "frame_digests"
TASK = "task"

PROGRESS = "progress"
SUCCESS = "success"
PREFERENCE = "preference"
SIMILARITY = "similarity"
PROGRESS_LOGITS = "progress_logits"
TIMING_MS = "timing_ms"

REQUEST_ID = re.compile(r"[\w.:/+=@-]{1,64}", re.ASCII)  # what a request's id may be

UNKNOWN_FRAMES = "digests of frames that this model knows or has been sent"  # what is told of others

VARIABLE = -1  # a dimension that differs from request to request


class SampleType(IntEnum):
    """Values of the ``sample_type`` input."""

    PROGRESS = 0
    PREFERENCE = 1
    SIMILARITY = 2


_VALUES = frozenset(SampleType)
_SAMPLE_TYPES = {
    ProgressSample: SampleType.PROGRESS,
    PreferenceSample: SampleType.PREFERENCE,
    SimilaritySample: SampleType.SIMILARITY,
}
_ASKED_BY: dict[str, frozenset[type]] = {
    PROGRESS: frozenset(_SAMPLE_TYPES),
    SUCCESS: frozenset(_SAMPLE_TYPES),
    PREFERENCE: frozenset({PreferenceSample}),
    SIMILARITY: frozenset({SimilaritySample}),
}


@dataclass(frozen=True)
class TensorSpec:
    """Name, element type and dimensions (without the batch axis) of one input or output.

    ragged: requests in which the variable dimensions differ may still share a batch.
    optional: a request may leave it out; those with it and those without share no batch.
    """

    name: str
    datatype: Literal["UINT8", "INT32", "FP32", "BYTES"]
    dims: tuple[int, ...]
    ragged: bool = False
    optional: bool = False


_NUM_FRAMES_SPEC = TensorSpec(NUM_FRAMES, "INT32", (2,))
_QUESTION_SPECS = (TensorSpec(SAMPLE_TYPE, "UINT8", (1,)), _NUM_FRAMES_SPEC, TensorSpec(FRAME_STEPS, "INT32", (1,)))
_FRAMES_SPECS = (
    TensorSpec(FRAMES, "UINT8", (VARIABLE, VARIABLE, VARIABLE, 3), ragged=True),
    TensorSpec(SECOND_FRAMES, "UINT8", (VARIABLE, VARIABLE, VARIABLE, 3), ragged=True, optional=True),
    TensorSpec(TASK, "BYTES", (1,)),
)
_DIGESTS_SPEC = TensorSpec(FRAME_DIGESTS, "UINT8", (VARIABLE, DIGEST_BYTES), ragged=True, optional=True)


def embedding_inputs(video_dim: int, text_dim: int) -> tuple[TensorSpec, ...]:
    """Inputs of a model that scores embeddings of widths D = video_dim and Dt = text_dim."""
    video = TensorSpec(VIDEO_EMBEDDINGS, "FP32", (VARIABLE, video_dim), ragged=True)
    return (*_QUESTION_SPECS, video, TensorSpec(TEXT_EMBEDDING, "FP32", (text_dim,)))


def frame_inputs(*, by_digest: bool = False) -> tuple[TensorSpec, ...]:
    """Inputs of a model that scores raw frames. ``by_digest``: of one that takes the digests of those it knows."""
    return (*_QUESTION_SPECS, *_FRAMES_SPECS, *([_DIGESTS_SPEC] if by_digest else []))


def encoder_inputs(*, by_digest: bool = False) -> tuple[TensorSpec, ...]:
    """Inputs of the encoder; num_frames keeps it from encoding padding. ``by_digest``: as of ``frame_inputs``."""
    return (_NUM_FRAMES_SPEC, *_FRAMES_SPECS, *([_DIGESTS_SPEC] if by_digest else []))


def encoder_outputs(video_dim: int, text_dim: int) -> tuple[TensorSpec, ...]:
    """Outputs of the encoder: what ``embedding_inputs`` takes in place of frames and task."""
    return tuple(
        TensorSpec(spec.name, spec.datatype, spec.dims)
        for spec in embedding_inputs(video_dim, text_dim)
        if spec.name in (VIDEO_EMBEDDINGS, TEXT_EMBEDDING)
    )


def score_outputs(progress_bins: int | None) -> tuple[TensorSpec, ...]:
    """Outputs of every reward model; progress_bins is K of a discrete checkpoint, None of a continuous one."""
    scores = (
        TensorSpec(PROGRESS, "FP32", (VARIABLE,)),
        TensorSpec(SUCCESS, "FP32", (VARIABLE,)),
        TensorSpec(PREFERENCE, "FP32", (1,)),
        TensorSpec(SIMILARITY, "FP32", (1,)),
        TensorSpec(TIMING_MS, "FP32", (2,)),
    )
    if progress_bins is None:
        return scores
    return (*scores, TensorSpec(PROGRESS_LOGITS, "FP32", (VARIABLE, progress_bins)))


def outputs_for(samples: Sequence[Sample]) -> tuple[str, ...]:
    """The scores that these samples ask for. The others would be NaN, and cost their way from the server."""
    kinds = set(map(type, samples))
    return tuple(name for name, asked_by in _ASKED_BY.items() if not asked_by.isdisjoint(kinds))


def encode_samples(samples: Sequence[Sample]) -> Tensors:
    """One request for samples whose positions have the same shape beyond the time axis, trajectory by trajectory."""
    tensors: Tensors = {
        SAMPLE_TYPE: np.array([[_SAMPLE_TYPES[type(sample)]] for sample in samples], np.uint8),
        NUM_FRAMES: np.array([_num_frames(sample) for sample in samples], np.int32),
        FRAME_STEPS: np.array([[getattr(sample, "frame_steps", 0)] for sample in samples], np.int32),
    }
    texts = [sample.trajectories[0] for sample in samples]
    has_frames = texts[0].frames is not None
    arrays = zip(*(stackable(sample.trajectories) for sample in samples), strict=True)
    for name, rows in zip((FRAMES, SECOND_FRAMES) if has_frames else (VIDEO_EMBEDDINGS,), arrays, strict=False):
        tensors[name] = pad_stack([[trajectory.positions for trajectory in row] for row in rows])
    if has_frames:
        tensors[TASK] = np.array([[text.task.encode()] for text in texts], np.object_)
    else:
        embeddings = [text.text_embedding for text in texts if text.text_embedding is not None]
        tensors[TEXT_EMBEDDING] = embeddings[0][np.newaxis] if len(embeddings) == 1 else np.stack(embeddings)
    return tensors


def decode_samples(tensors: Mapping[str, npt.NDArray[Any]]) -> list[Sample | NamedProgressSample]:
    """The samples of one request. Raises InvalidSampleError that names the sample and the field."""
    decode = partial(_decode_sample, _pixels(tensors))
    return [_located(decode, tensors, row) for row in range(len(tensors[SAMPLE_TYPE]))]


def encode_frames(trajectory: Trajectory) -> Tensors:
    """One request to the encoder, for one trajectory of raw frames."""
    tensors = encode_samples([ProgressSample(trajectory)])
    return {spec.name: tensors[spec.name] for spec in encoder_inputs() if spec.name in tensors}


def decode_embeddings(tensors: Mapping[str, npt.NDArray[Any]], trajectory: Trajectory) -> Trajectory:
    """The encoder's answer for one trajectory. Raises InferenceFailedError if it lacks an embedding."""
    count, video, text = trajectory.num_frames, tensors[VIDEO_EMBEDDINGS], tensors[TEXT_EMBEDDING]
    if video.ndim != 3 or text.ndim != 2 or video.shape[:2] != (1, count) or len(text) != 1:
        raise InferenceFailedError(f"embeddings: expected [1, {count}, D] and [1, Dt], got {video.shape}, {text.shape}")
    try:
        return Trajectory(video_embeddings=video[0], text_embedding=text[0], task=trajectory.task)
    except InvalidSampleError as error:
        raise InferenceFailedError(f"embeddings: {error}") from error


def decode_trajectories(tensors: Mapping[str, npt.NDArray[Any]]) -> list[Footage | NamedFootage]:
    """What the encoder is to encode: of each sample the frames of its trajectories, without padding, and its task."""
    pixels = _pixels(tensors)

    def decode(tensors: Mapping[str, npt.NDArray[Any]], row: int) -> Footage | NamedFootage:
        lengths = tensors[NUM_FRAMES][row].tolist()
        if lengths[0] < 1 or lengths[1] < 0:
            raise InvalidSampleError.at(NUM_FRAMES, "[at least 1, at least 0]", str(lengths))
        arrays = [array for array in _positions(tensors, row, lengths) if len(array)]
        if pixels is not None:
            return NamedFootage(tuple(_named(pixels, tensors, row, array) for array in arrays))
        return Footage(tuple(_trajectory(tensors, row, array) for array in arrays))

    return [_located(decode, tensors, row) for row in range(len(tensors[NUM_FRAMES]))]


def encode_named(trajectories: Sequence[NamedTrajectory], sent: Sequence[UInt8Array]) -> Tensors:
    """One request for the progress of each trajectory, whose frames have the digests.

    sent: uint8 [H, W, 3] of one size, the frames that the model may not know; none: it knows all
    """
    count = len(trajectories)
    num_rows = -(-len(sent) // count)
    shape = sent[0].shape if sent else (1, 1, 3)  # an input is never empty
    frames = np.zeros((count, max(num_rows, 1), *shape), np.uint8)
    for index, frame in enumerate(sent):
        frames[index % count, index // count] = frame
    digests = [[np.frombuffer(b"".join(named.digests), np.uint8).reshape(-1, DIGEST_BYTES)] for named in trajectories]
    return {
        SAMPLE_TYPE: np.full((count, 1), SampleType.PROGRESS, np.uint8),
        NUM_FRAMES: np.array([[named.num_frames, 0] for named in trajectories], np.int32),
        FRAME_STEPS: np.zeros((count, 1), np.int32),
        FRAMES: frames,
        FRAME_DIGESTS: pad_stack(digests),
        TASK: np.array([[named.task.encode()] for named in trajectories], np.object_),
    }


def _pixels(tensors: Mapping[str, npt.NDArray[Any]]) -> dict[bytes, UInt8Array] | None:
    """The frames of a request that names frames, by their digests; None: it names none."""
    if FRAME_DIGESTS not in tensors:
        return None
    if SECOND_FRAMES in tensors:
        raise InvalidSampleError.at(FRAME_DIGESTS, f"none with {SECOND_FRAMES}", "both")
    return {frame_digest(frame): frame for row in tensors[FRAMES] for frame in row}


def encode_trajectories(encoded: Sequence[Footage], num_positions: int, outputs: Collection[str]) -> Tensors:
    """The requested outputs of the encoder for one request of ``num_positions`` = P, padded with zeros."""
    rows = [[trajectory.positions for trajectory in footage.trajectories] for footage in encoded]
    texts = [footage.trajectories[0].text_embedding for footage in encoded]
    embeddings = {
        VIDEO_EMBEDDINGS: pad_stack(rows, num_positions),
        TEXT_EMBEDDING: np.stack([text for text in texts if text is not None]),
    }
    return {name: embeddings[name] for name in outputs}


def num_positions(inputs: Mapping[str, npt.NDArray[Any]]) -> int:
    """P, the frame positions of one request: its widths of the time axis, added up."""
    if FRAME_DIGESTS in inputs:
        return int(inputs[FRAME_DIGESTS].shape[1])
    return sum(int(inputs[name].shape[1]) for name in (FRAMES, SECOND_FRAMES, VIDEO_EMBEDDINGS) if name in inputs)


def encode_results(results: Sequence[Result], num_positions: int, outputs: Collection[str]) -> Tensors:
    """The requested outputs of one request of ``num_positions`` = P; what a result lacks is NaN, never 0."""
    return {name: _ENCODERS[name](results, num_positions) for name in outputs}


def decode_results(
    tensors: Mapping[str, npt.NDArray[Any]], samples: Sequence[Sample], model_version: str | None = None
) -> list[Result]:
    """The results of the samples of one request, which ``model_version`` answered.

    Raises InferenceFailedError for an answer that lacks a score: a missing reward is no reward of 0 or NaN. Success
    alone may be NaN, at all frames: then the checkpoint does not predict it.
    """
    return [_decode_result(tensors, row, sample, model_version) for row, sample in enumerate(samples)]


def pad_stack(
    rows: Sequence[Sequence[npt.NDArray[Any]]], length: int | None = None, *, fill: float = 0
) -> npt.NDArray[Any]:
    """[B, length, ...] from B rows of arrays [P, ...] of one dtype, which lie one after the other.

    length: the longest row's unless given
    """
    if length is None:
        length = max(sum(map(len, parts)) for parts in rows)
    first = rows[0][0]
    if len(rows) == 1 and sum(map(len, rows[0])) == length:  # a single sample: no padding, and of one array no copy
        return (first if len(rows[0]) == 1 else np.concatenate(rows[0]))[np.newaxis]
    shape = len(rows), length, *first.shape[1:]
    padded = np.full(shape, fill, first.dtype) if fill else np.zeros(shape, first.dtype)
    for row, parts in zip(padded, rows, strict=True):
        start = 0
        for part in parts:
            row[start : start + len(part)] = part
            start += len(part)
    return padded


def _num_frames(sample: Sample) -> tuple[int, int]:
    lengths = [trajectory.num_frames for trajectory in sample.trajectories]
    return lengths[0], lengths[1] if len(lengths) > 1 else 0


def _encode_frames(field: str) -> Callable[[Sequence[Result], int], Float32Array]:
    """An encoder of one score a frame: it gives [B, P, ...]."""

    def encode(results: Sequence[Result], num_positions: int) -> Float32Array:
        rows = [[getattr(scores, field) for scores in _frame_scores(result)] for result in results]
        return pad_stack(rows, num_positions, fill=np.nan)

    return encode


def _encode_question(field: str) -> Callable[[Sequence[Result], int], Float32Array]:
    """An encoder of one score a sample of one type: it gives [B, 1]."""

    def encode(results: Sequence[Result], _num_positions: int) -> Float32Array:
        return np.array([[getattr(result, field, np.nan)] for result in results], np.float32)

    return encode


def _encode_timing(results: Sequence[Result], _num_positions: int) -> Float32Array:
    timings = [result.timing or BatchTiming(np.nan, np.nan) for result in results]
    return np.array([[timing.collate_ms, timing.forward_ms] for timing in timings], np.float32)


_ENCODERS = {
    PROGRESS: _encode_frames("progress"),
    SUCCESS: _encode_frames("success"),
    PROGRESS_LOGITS: _encode_frames("progress_logits"),
    PREFERENCE: _encode_question("preference"),
    SIMILARITY: _encode_question("similarity"),
    TIMING_MS: _encode_timing,
}


def _located(decode: Any, tensors: Mapping[str, npt.NDArray[Any]], row: int) -> Any:
    try:
        return decode(tensors, row)
    except InvalidSampleError as error:
        if len(tensors[NUM_FRAMES]) == 1:
            raise
        raise error.inside(f"samples[{row}]") from None


def _decode_sample(
    pixels: Mapping[bytes, UInt8Array] | None, tensors: Mapping[str, npt.NDArray[Any]], row: int
) -> Sample | NamedProgressSample:
    sample_type = int(tensors[SAMPLE_TYPE][row, 0])
    lengths = tensors[NUM_FRAMES][row].tolist()
    frame_steps = int(tensors[FRAME_STEPS][row, 0])
    if sample_type not in _VALUES:
        known = ", ".join(f"{t.value} ({t.name.lower()})" for t in SampleType)
        raise InvalidSampleError.at(SAMPLE_TYPE, f"one of {known}", str(sample_type))
    if sample_type == SampleType.PROGRESS:
        if lengths[0] < 1 or lengths[1] != 0:
            raise InvalidSampleError.at(NUM_FRAMES, "[at least 1, 0] for progress", str(lengths))
        positions, _ = _positions(tensors, row, lengths)
        if pixels is not None:
            return NamedProgressSample(_named(pixels, tensors, row, positions), frame_steps)
        return ProgressSample(_trajectory(tensors, row, positions), frame_steps)
    if pixels is not None:
        raise InvalidSampleError.at(SAMPLE_TYPE, f"progress with {FRAME_DIGESTS}", SampleType(sample_type).name.lower())
    if min(lengths) < 1:
        raise InvalidSampleError.at(NUM_FRAMES, "at least one frame of each of the two trajectories", str(lengths))
    if frame_steps != 0:
        raise InvalidSampleError.at(FRAME_STEPS, "0 unless the sample is of type progress", str(frame_steps))
    first, second = (_trajectory(tensors, row, array) for array in _positions(tensors, row, lengths))
    return (PreferenceSample if sample_type == SampleType.PREFERENCE else SimilaritySample)(first, second)


def _trajectory(tensors: Mapping[str, npt.NDArray[Any]], row: int, positions: npt.NDArray[Any]) -> Trajectory:
    if FRAMES in tensors:
        return Trajectory(frames=positions, task=_task(tensors, row))
    return Trajectory(video_embeddings=positions, text_embedding=tensors[TEXT_EMBEDDING][row])


def _named(
    pixels: Mapping[bytes, UInt8Array], tensors: Mapping[str, npt.NDArray[Any]], row: int, digests: npt.NDArray[Any]
) -> NamedTrajectory:
    return NamedTrajectory(tuple(map(bytes, digests)), pixels, _task(tensors, row))


def _positions(tensors: Mapping[str, npt.NDArray[Any]], row: int, lengths: Sequence[int]) -> list[npt.NDArray[Any]]:
    """The frame positions of the first and the second trajectory of one sample, without padding.

    Both are in one array or, if there are second frames, each is in its own.
    """
    if SECOND_FRAMES in tensors:
        arrays = zip((FRAMES, SECOND_FRAMES), lengths, strict=True)
        return [_unpadded(tensors, name, row, length) for name, length in arrays]
    name = next(name for name in (FRAME_DIGESTS, FRAMES, VIDEO_EMBEDDINGS) if name in tensors)
    both = _unpadded(tensors, name, row, sum(lengths))
    return [both[: lengths[0]], both[lengths[0] :]]


def _unpadded(tensors: Mapping[str, npt.NDArray[Any]], name: str, row: int, total: int) -> npt.NDArray[Any]:
    """Positions up to ``total``; what lies behind must be padding, or num_frames is wrong."""
    positions: npt.NDArray[Any] = tensors[name][row]
    if total > len(positions):
        raise InvalidSampleError.at(NUM_FRAMES, f"at most the {len(positions)} frames in {name}", str(total))
    if total < len(positions) and positions[total:].any():
        raise InvalidSampleError.at(name, f"zeros behind the {total} frames that num_frames tells", "other values")
    return positions[:total]


def _task(tensors: Mapping[str, npt.NDArray[Any]], row: int) -> str:
    raw = tensors[TASK][row, 0]
    try:
        return raw.decode() if isinstance(raw, bytes) else str(raw)
    except UnicodeDecodeError:
        raise InvalidSampleError.at(TASK, "UTF-8 text", "other bytes") from None


def _frame_scores(result: Result) -> tuple[FrameScores, ...]:
    if isinstance(result, ProgressResult):
        return (result,)
    if isinstance(result, PreferenceResult):
        return (result.first, result.second)
    return (result.reference, result.other)


def decode_progress(
    tensors: Mapping[str, npt.NDArray[Any]], row: int, num_frames: int, model_version: str | None = None
) -> ProgressResult:
    """The result of one sample of type progress, whose trajectory has ``num_frames``. Raises InferenceFailedError."""
    scores = _scores_between(tensors, row, slice(0, num_frames))
    return ProgressResult(
        progress=scores.progress,
        success=scores.success,
        progress_logits=scores.progress_logits,
        timing=_timing(tensors, row),
        model_version=model_version,
    )


def _timing(tensors: Mapping[str, npt.NDArray[Any]], row: int) -> BatchTiming | None:
    return BatchTiming(*tensors[TIMING_MS][row].tolist()) if TIMING_MS in tensors else None


def _decode_result(
    tensors: Mapping[str, npt.NDArray[Any]], row: int, sample: Sample, model_version: str | None
) -> Result:
    num_first, num_second = _num_frames(sample)
    if isinstance(sample, ProgressSample):
        return decode_progress(tensors, row, num_first, model_version)
    first = _scores_between(tensors, row, slice(0, num_first))
    of_request: dict[str, Any] = {"timing": _timing(tensors, row), "model_version": model_version}
    second = _scores_between(tensors, row, slice(num_first, num_first + num_second))
    if isinstance(sample, PreferenceSample):
        preference = float(_present(tensors, PREFERENCE, row, slice(0, 1))[0])
        return PreferenceResult(preference=preference, first=first, second=second, **of_request)
    similarity = float(_present(tensors, SIMILARITY, row, slice(0, 1))[0])
    return SimilarityResult(similarity=similarity, reference=first, other=second, **of_request)


def _scores_between(tensors: Mapping[str, npt.NDArray[Any]], row: int, positions: slice) -> FrameScores:
    logits = _present(tensors, PROGRESS_LOGITS, row, positions) if PROGRESS_LOGITS in tensors else None
    return FrameScores(
        progress=_present(tensors, PROGRESS, row, positions),
        success=_present(tensors, SUCCESS, row, positions, may_lack=True),
        progress_logits=logits,
    )


def _present(
    tensors: Mapping[str, npt.NDArray[Any]], name: str, row: int, positions: slice, *, may_lack: bool = False
) -> Float32Array:
    """One row's scores at some positions. Raises InferenceFailedError unless all are there and finite.

    may_lack: they may also be NaN throughout, of a checkpoint that does not predict them
    """
    scores, count = tensors[name], positions.stop - positions.start
    if scores.ndim < 2 or row >= len(scores):
        raise InferenceFailedError(f"{name}: expected scores of sample {row}, got an array {list(scores.shape)}")
    part: Float32Array = scores[row, positions]
    is_good = np.isfinite(part).all() or (may_lack and np.isnan(part).all())
    if len(part) != count or not is_good:
        raise InferenceFailedError(f"{name}: expected {count} finite scores, got {part.tolist()}")
    return part
