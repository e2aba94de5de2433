# SPDX-License-Identifier: MIT
"""Convert samples to tensors and back: requests to reward models and encoders, and encoders' answers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from rfm_client.contract.errors import InferenceFailedError, InvalidSampleError
from rfm_client.contract.samples import (
    EncoderSample,
    NamedFrame,
    PreferenceSample,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
    UInt8Array,
    stackable,
)
from rfm_client.contract.wire.specs import (
    DIGEST_BYTES,
    FRAME_DIGESTS,
    FRAME_STEPS,
    FRAMES,
    GOAL,
    NUM_FRAMES,
    SAMPLE_TYPE,
    SECOND_FRAMES,
    TASK,
    TEXT_EMBEDDING,
    UNKNOWN_FRAMES,
    VIDEO_EMBEDDINGS,
    VIEWS,
    SampleType,
    Tensors,
    frame_digest,
    pad_stack,
)

Decoded = TypeVar("Decoded")
Row: TypeAlias = dict[str, npt.NDArray[Any]]  # tensors of one sample
Known: TypeAlias = Mapping[Any, npt.NDArray[Any]]  # pixels or embeddings by frame digest
Kept: TypeAlias = Callable[[Iterable[bytes]], Known]  # returns what a server keeps of these frames

_SAMPLE_TYPES = {
    ProgressSample: SampleType.PROGRESS,
    PreferenceSample: SampleType.PREFERENCE,
    SimilaritySample: SampleType.SIMILARITY,
}


def encode_samples(samples: Sequence[Sample]) -> Tensors:
    """Return one request. Apart from time, all first trajectories must share one shape, and so must all second ones.

    The samples must agree on which views and goal they have, and on the shapes.
    """
    tensors: Tensors = {
        SAMPLE_TYPE: np.array([[_SAMPLE_TYPES[type(sample)]] for sample in samples], np.uint8),
        NUM_FRAMES: np.array([_lengths(sample) for sample in samples], np.int32),
        FRAME_STEPS: np.array([[getattr(sample, "frame_steps", 0)] for sample in samples], np.int32),
    }
    texts = [sample.trajectories[0] for sample in samples]
    has_frames = texts[0].frames is not None
    arrays = zip(*(stackable(sample.trajectories) for sample in samples), strict=True)
    for name, rows in zip((FRAMES, SECOND_FRAMES) if has_frames else (VIDEO_EMBEDDINGS,), arrays, strict=False):
        tensors[name] = pad_stack([[trajectory.positions for trajectory in row] for row in rows])
    views = zip(*(text.views for text in texts), strict=True)
    tensors |= {name: pad_stack([[view] for view in rows]) for name, rows in zip(VIEWS, views, strict=False)}
    if texts[0].goal is not None:
        tensors[GOAL] = np.stack([text.goal for text in texts if text.goal is not None])
    if has_frames:
        tensors[TASK] = np.array([[text.task.encode()] for text in texts], np.object_)
    else:
        embeddings = [text.text_embedding for text in texts if text.text_embedding is not None]
        tensors[TEXT_EMBEDDING] = embeddings[0][np.newaxis] if len(embeddings) == 1 else np.stack(embeddings)
    return tensors


def decode_samples(tensors: Mapping[str, npt.NDArray[Any]], kept: Kept | None = None) -> list[Sample]:
    """Return the samples in one request. Raises InvalidSampleError, which names the sample and the field.

    kept: finds frame pixels that the model keeps; None: it keeps none
    """
    return _decode_rows(tensors, kept, _decode_sample)


def encode_frames(trajectory: Trajectory) -> Tensors:
    """Return an encoder request for one trajectory of raw frames. The encoder refuses what it does not read."""
    tensors = encode_samples([ProgressSample(trajectory)])
    return {name: tensor for name, tensor in tensors.items() if name not in (SAMPLE_TYPE, FRAME_STEPS)}


def decode_embeddings(tensors: Mapping[str, npt.NDArray[Any]], trajectory: Trajectory) -> Trajectory:
    """Return the trajectory with the encoder's embeddings. Raises InferenceFailedError if the answer is invalid."""
    count, video, text = trajectory.num_frames, tensors[VIDEO_EMBEDDINGS], tensors[TEXT_EMBEDDING]
    if video.ndim != 3 or text.ndim != 2 or video.shape[:2] != (1, count) or len(text) != 1:
        raise InferenceFailedError(f"embeddings: expected [1, {count}, D] and [1, Dt], got {video.shape}, {text.shape}")
    try:
        return Trajectory(video_embeddings=video[0], text_embedding=text[0], task=trajectory.task)
    except InvalidSampleError as error:
        raise InferenceFailedError(f"embeddings: {error}") from error


def decode_trajectories(tensors: Mapping[str, npt.NDArray[Any]], kept: Kept | None = None) -> list[EncoderSample]:
    """Return the trajectories in each sample, without padding, for the encoder. Raises InvalidSampleError.

    kept: finds frame embeddings that the model keeps; None: it keeps none
    """
    return _decode_rows(tensors, kept, _decode_encoder_sample)


def encode_refs(videos: Sequence[Sequence[bytes]], tasks: Sequence[str], sent: Sequence[UInt8Array]) -> Tensors:
    """Return one progress request for videos whose frames are named by their digests.

    videos, tasks: frame digests and a task for each video
    sent: frames that the model may lack, uint8 [H, W, 3] of one size; empty: it has all frames
    """
    count = len(videos)
    num_rows = -(-len(sent) // count)
    shape = sent[0].shape if sent else (1, 1, 3)  # an input is never empty
    frames = np.zeros((count, max(num_rows, 1), *shape), np.uint8)
    for index, frame in enumerate(sent):
        frames[index % count, index // count] = frame
    digests = [[np.frombuffer(b"".join(video), np.uint8).reshape(-1, DIGEST_BYTES)] for video in videos]
    return {
        SAMPLE_TYPE: np.full((count, 1), SampleType.PROGRESS, np.uint8),
        NUM_FRAMES: np.array([[len(video), 0] for video in videos], np.int32),
        FRAME_STEPS: np.zeros((count, 1), np.int32),
        FRAMES: frames,
        FRAME_DIGESTS: pad_stack(digests),
        TASK: np.array([[task.encode()] for task in tasks], np.object_),
    }


def encode_trajectories(encoded: Sequence[EncoderSample], num_positions: int, outputs: Collection[str]) -> Tensors:
    """Return the encoder's requested outputs, float32 [B, P, D] (zero padding) and [B, Dt]; P = ``num_positions``."""
    rows = [[trajectory.positions for trajectory in encoder_sample.trajectories] for encoder_sample in encoded]
    texts = [encoder_sample.trajectories[0].text_embedding for encoder_sample in encoded]
    embeddings = {
        VIDEO_EMBEDDINGS: pad_stack(rows, num_positions),
        TEXT_EMBEDDING: np.stack([text for text in texts if text is not None]),
    }
    return {name: embeddings[name] for name in outputs}


def _lengths(sample: Sample) -> tuple[int, int]:
    first, *second = (trajectory.num_frames for trajectory in sample.trajectories)
    return first, sum(second)


def _decode_rows(
    tensors: Mapping[str, npt.NDArray[Any]], kept: Kept | None, decode: Callable[[Row, Known], Decoded]
) -> list[Decoded]:
    """Decode all samples. The digests for the request's pixels are computed here, whatever the caller calls them."""
    known: Known = {}
    if FRAME_DIGESTS in tensors:
        if SECOND_FRAMES in tensors:
            raise InvalidSampleError.at(FRAME_DIGESTS, f"none with {SECOND_FRAMES}", "both")
        known = {frame_digest(frame): frame for frames in tensors[FRAMES] for frame in frames}
        if kept is not None:
            asked = {bytes(digest) for digests in tensors[FRAME_DIGESTS] for digest in digests}
            known = {**kept(asked), **known}
    count = len(tensors[NUM_FRAMES])
    decoded = []
    for index in range(count):
        try:
            decoded.append(decode({name: array[index] for name, array in tensors.items()}, known))
        except InvalidSampleError as error:
            if count == 1:
                raise
            raise error.inside(f"samples[{index}]") from None
    return decoded


def _decode_sample(row: Row, known: Known) -> Sample:
    sample_type, frame_steps = int(row[SAMPLE_TYPE][0]), int(row[FRAME_STEPS][0])
    lengths = row[NUM_FRAMES].tolist()
    if sample_type not in list(SampleType):
        types = ", ".join(f"{t.value} ({t.name.lower()})" for t in SampleType)
        raise InvalidSampleError.at(SAMPLE_TYPE, f"one of {types}", str(sample_type))
    if sample_type == SampleType.PROGRESS:
        if lengths[0] < 1 or lengths[1] != 0:
            raise InvalidSampleError.at(NUM_FRAMES, "[at least 1, 0] for progress", str(lengths))
        positions, _ = _positions(row, lengths)
        views = tuple(_unpadded(row, name, lengths[0]) for name in VIEWS if name in row)
        trajectory = _trajectory(row, positions, known)
        if views or GOAL in row:
            trajectory = replace(trajectory, views=views, goal=row.get(GOAL))
        return ProgressSample(trajectory, frame_steps)
    if given := [name for name in (*VIEWS, GOAL, FRAME_DIGESTS) if name in row]:
        raise InvalidSampleError.at(SAMPLE_TYPE, f"progress with {given[0]}", SampleType(sample_type).name.lower())
    if min(lengths) < 1:
        raise InvalidSampleError.at(NUM_FRAMES, "at least one frame of each of the two trajectories", str(lengths))
    if frame_steps != 0:
        raise InvalidSampleError.at(FRAME_STEPS, "0 unless the sample is of type progress", str(frame_steps))
    first, second = (_trajectory(row, array, known) for array in _positions(row, lengths))
    return (PreferenceSample if sample_type == SampleType.PREFERENCE else SimilaritySample)(first, second)


def _decode_encoder_sample(row: Row, known: Known) -> EncoderSample:
    lengths = row[NUM_FRAMES].tolist()
    if lengths[0] < 1 or lengths[1] < 0:
        raise InvalidSampleError.at(NUM_FRAMES, "[at least 1, at least 0]", str(lengths))
    return EncoderSample(tuple(_trajectory(row, array, known) for array in _positions(row, lengths) if len(array)))


def _trajectory(row: Row, positions: npt.NDArray[Any], known: Known) -> Trajectory:
    if FRAMES in row:
        shown: dict[str, Any] = {"frames": positions}
        if FRAME_DIGESTS in row:
            shown = {"named": _named([bytes(digest) for digest in positions], known)}
        return Trajectory(**shown, task=_task(row))
    return Trajectory(video_embeddings=positions, text_embedding=row[TEXT_EMBEDDING])


def _named(digests: Sequence[bytes], known: Known) -> tuple[NamedFrame, ...]:
    """Return what is known about each frame. Raises InvalidSampleError for unknown frames or unequal sizes."""
    unknown = sum(digest not in known for digest in digests)
    if unknown:
        raise InvalidSampleError.at(FRAME_DIGESTS, UNKNOWN_FRAMES, f"{unknown} others")
    sizes = sorted({known[digest].shape[:2] for digest in digests if known[digest].dtype == np.uint8})
    if len(sizes) > 1:
        raise InvalidSampleError.at(FRAME_DIGESTS, "digests of frames of one size", f"sizes {sizes}")
    return tuple((digest, known[digest]) for digest in digests)


def _positions(row: Row, lengths: Sequence[int]) -> list[npt.NDArray[Any]]:
    """Return one sample's frame positions for the first and the second trajectory, without padding.

    Both lie in one array, unless there are second frames.
    """
    if SECOND_FRAMES in row:
        return [_unpadded(row, name, length) for name, length in zip((FRAMES, SECOND_FRAMES), lengths, strict=True)]
    name = next(name for name in (FRAME_DIGESTS, FRAMES, VIDEO_EMBEDDINGS) if name in row)
    both = _unpadded(row, name, sum(lengths))
    return [both[: lengths[0]], both[lengths[0] :]]


def _unpadded(row: Row, name: str, total: int) -> npt.NDArray[Any]:
    """Return positions up to ``total``. The rest must be zero padding, or num_frames is wrong."""
    positions = row[name]
    if total > len(positions):
        raise InvalidSampleError.at(NUM_FRAMES, f"at most the {len(positions)} frames in {name}", str(total))
    if positions[total:].any():
        raise InvalidSampleError.at(name, f"zeros behind the {total} frames that num_frames states", "other values")
    return positions[:total]


def _task(row: Row) -> str:
    raw = row[TASK][0]
    try:
        return raw.decode() if isinstance(raw, bytes) else str(raw)
    except UnicodeDecodeError:
        raise InvalidSampleError.at(TASK, "UTF-8 text", "other bytes") from None
