# SPDX-License-Identifier: MIT
"""Names of models, requests and the admin key's variable; tensor names, types and dimensions; frame digests.

Letters as in the package.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import FRAME_SCORES
from rfm_client.contract.samples import UInt8Array

Part: TypeAlias = Literal["embeddings", "encoder", "frames"]  # models in a served checkpoint

DEFAULT_MODEL = "rfm"  # scores embeddings; the other models derive their names from it

PROBE_PREFIX = "rfm-probe"  # begins probes' request ids, which a model's metrics ignore

ADMIN_KEY_VARIABLE = "RFM_ADMIN_KEY"


def encoder_name(model: str) -> str:
    """Return the name of the encoder whose embeddings ``model`` scores."""
    return f"{model}_encoder"


def frames_name(model: str) -> str:
    """Return the name of the model that scores raw frames, beside ``model`` for embeddings."""
    return f"{model}_frames"


Tensors: TypeAlias = dict[str, npt.NDArray[Any]]

SAMPLE_TYPE = "sample_type"
NUM_FRAMES = "num_frames"
FRAME_STEPS = "frame_steps"
VIDEO_EMBEDDINGS = "video_embeddings"
TEXT_EMBEDDING = "text_embedding"
FRAMES = "frames"
SECOND_FRAMES = "second_frames"
LEFT_FRAMES, RIGHT_FRAMES, GOAL = "left_frames", "right_frames", "goal"
VIEWS = (LEFT_FRAMES, RIGHT_FRAMES)
FRAME_DIGESTS = "frame_digests"
TASK = "task"

PROGRESS = "progress"
SUCCESS = "success"
PREFERENCE = "preference"
SIMILARITY = "similarity"
PROGRESS_LOGITS = "progress_logits"
TIMING_MS = "timing_ms"

REQUEST_ID = re.compile(r"[\w.:/+=@-]{1,64}", re.ASCII)  # valid request ids

UNKNOWN_FRAMES = "digests of frames that this model knows or has been sent"  # expected by the error for unknown digests

DIGEST_BYTES = 32  # SHA-256: nobody can make two frames with one digest

VARIABLE = -1  # a dimension that differs between requests


class SampleType(IntEnum):
    """Values of the ``sample_type`` input."""

    PROGRESS = 0
    PREFERENCE = 1
    SIMILARITY = 2


@dataclass(frozen=True)
class TensorSpec:
    """Name, element type and dimensions (without the batch axis) of one input or output.

    ragged: True if requests with different variable dimensions may share a batch
    optional: True if a request may omit it; requests with and without it share no batch
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
_VIEWS_SPECS = (
    *(TensorSpec(view, "UINT8", (VARIABLE, VARIABLE, VARIABLE, 3), ragged=True, optional=True) for view in VIEWS),
    TensorSpec(GOAL, "UINT8", (VARIABLE, VARIABLE, 3), ragged=True, optional=True),
)
_DIGESTS_SPEC = TensorSpec(FRAME_DIGESTS, "UINT8", (VARIABLE, DIGEST_BYTES), ragged=True, optional=True)


def frame_digest(frame: UInt8Array) -> bytes:
    """Return the SHA-256 of a frame, uint8 [H, W, 3]: of H and W (4 bytes each, little-endian), then of the pixels."""
    digest = hashlib.sha256(np.array(frame.shape[:2], "<u4").tobytes())
    digest.update(np.ascontiguousarray(frame).data)
    return digest.digest()


def embedding_inputs(video_dim: int, text_dim: int) -> tuple[TensorSpec, ...]:
    """Return the inputs of a model that scores embeddings of widths D = video_dim and Dt = text_dim."""
    video = TensorSpec(VIDEO_EMBEDDINGS, "FP32", (VARIABLE, video_dim), ragged=True)
    return (*_QUESTION_SPECS, video, TensorSpec(TEXT_EMBEDDING, "FP32", (text_dim,)))


def frame_inputs(*, by_digest: bool = False, with_views: bool = False) -> tuple[TensorSpec, ...]:
    """Return the inputs of a model that scores raw frames.

    by_digest: with frame digests
    with_views: with further cameras' frames, and a goal
    """
    return (*_QUESTION_SPECS, *_FRAMES_SPECS, *_VIEWS_SPECS * with_views, *[_DIGESTS_SPEC] * by_digest)


def encoder_inputs(*, by_digest: bool = False) -> tuple[TensorSpec, ...]:
    """Return the encoder's inputs; num_frames excludes padding. ``by_digest`` as in ``frame_inputs``."""
    return (_NUM_FRAMES_SPEC, *_FRAMES_SPECS, *([_DIGESTS_SPEC] if by_digest else []))


def encoder_outputs(video_dim: int, text_dim: int) -> tuple[TensorSpec, ...]:
    """Return the encoder's outputs: the embeddings among ``embedding_inputs``."""
    return tuple(
        TensorSpec(spec.name, spec.datatype, spec.dims)
        for spec in embedding_inputs(video_dim, text_dim)
        if spec.name in (VIDEO_EMBEDDINGS, TEXT_EMBEDDING)
    )


def score_outputs(progress_bins: int | None, more: Collection[str] = ()) -> tuple[TensorSpec, ...]:
    """Return a reward model's outputs.

    progress_bins: K of a discrete checkpoint; None: continuous
    more: frame scores beyond those that every model gives and those for progress bins
    """
    of_every_model = [name for name, score in FRAME_SCORES.items() if score.is_always_asked]
    of_bins = [name for name, score in FRAME_SCORES.items() if score.is_per_bin and progress_bins is not None]
    return (
        *(TensorSpec(name, "FP32", (VARIABLE,)) for name in of_every_model),
        TensorSpec(PREFERENCE, "FP32", (1,)),
        TensorSpec(SIMILARITY, "FP32", (1,)),
        TensorSpec(TIMING_MS, "FP32", (2,)),
        *(TensorSpec(name, "FP32", (VARIABLE, progress_bins or 1)) for name in of_bins),
        *(TensorSpec(name, "FP32", (VARIABLE,)) for name in FRAME_SCORES if name in more),
    )


def num_positions(inputs: Mapping[str, npt.NDArray[Any]]) -> int:
    """Return P, the number of frame positions in one request, over all its arrays."""
    if FRAME_DIGESTS in inputs:
        return int(inputs[FRAME_DIGESTS].shape[1])
    return sum(int(inputs[name].shape[1]) for name in (FRAMES, SECOND_FRAMES, VIDEO_EMBEDDINGS) if name in inputs)


def pad_stack(
    rows: Sequence[Sequence[npt.NDArray[Any]]], length: int | None = None, *, fill: float = 0
) -> npt.NDArray[Any]:
    """Return [B, length, ...] from B rows; a row joins arrays [N, ...] of one dtype and is padded with ``fill``.

    length: None: the longest row's length
    """
    if length is None:
        length = max(sum(map(len, parts)) for parts in rows)
    first = rows[0][0]
    if len(rows) == 1 and sum(map(len, rows[0])) == length:  # a single sample needs no padding; a single array, no copy
        return (first if len(rows[0]) == 1 else np.concatenate(rows[0]))[np.newaxis]
    shape = len(rows), length, *first.shape[1:]
    padded = np.full(shape, fill, first.dtype) if fill else np.zeros(shape, first.dtype)
    for row, parts in zip(padded, rows, strict=True):
        start = 0
        for part in parts:
            row[start : start + len(part)] = part
            start += len(part)
    return padded
