# SPDX-License-Identifier: MIT
"""Samples of a request, as the evaluation server's callers write them -> the client's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from fastapi.exceptions import RequestValidationError

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.samples import (
    Float32Array,
    PreferenceSample,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
    UInt8Array,
    as_array,
    float_frames_to_uint8,
)
from rfm_client.transport.off_loop import MIN_BYTES
from rfm_gateway import schema
from rfm_gateway.body import invalid
from rfm_gateway.folder import NamedFiles

_SIDES = {  # what the client calls them
    "first": "chosen_trajectory",
    "second": "rejected_trajectory",
    "reference": "ref_trajectory",
    "other": "sim_trajectory",
}
RGB_CHANNELS, RGBA_CHANNELS = 3, 4
Texts: TypeAlias = Mapping[str, Float32Array | InvalidSampleError]  # by task; why one cannot be encoded


@dataclass(frozen=True)
class Served:
    """What is served of the checkpoint: for embeddings, and for raw frames; None: it is not."""

    embeddings: ModelInfo | None
    frames: ModelInfo | None


@dataclass(frozen=True)
class Conversion:
    """Converts the samples of one request.

    texts: embeddings of tasks; files: those that the samples name; frame_steps: of progress samples
    """

    served: Served
    texts: Texts
    files: NamedFiles
    frame_steps: int

    def samples(self, samples: Sequence[schema.Sample]) -> list[Sample]:
        """The samples as the client takes them.

        Raises RequestValidationError that lists all that cannot be scored, and HTTPException as NamedFiles does.
        """
        converted: list[Sample] = []
        errors: dict[int, InvalidSampleError] = {}
        for index, sample in enumerate(samples):
            try:
                converted.append(self._sample(sample))
            except InvalidSampleError as error:
                errors[index] = error
        if errors:
            raise refused(errors)
        return converted

    def _sample(self, sample: schema.Sample) -> Sample:
        given = sample.named_trajectories
        by_embeddings = self.served.embeddings is not None and all(map(has_embeddings, given.values()))
        trajectories: list[Trajectory] = []
        for name, trajectory in given.items():
            try:
                if by_embeddings:
                    trajectories.append(self._of_embeddings(trajectory, needs_text=not trajectories))
                else:
                    trajectories.append(self._of_frames(trajectory))
            except InvalidSampleError as error:
                raise error.inside(name) from None
        if isinstance(sample, schema.ProgressSample):
            return ProgressSample(trajectories[0], frame_steps=self.frame_steps)
        if isinstance(sample, schema.PreferenceSample):
            return PreferenceSample(*trajectories)
        return SimilaritySample(*trajectories)

    def _of_embeddings(self, given: schema.Trajectory, *, needs_text: bool) -> Trajectory:
        video, text = given.video_embeddings, given.text_embedding
        if video is None:
            in_file = self.files.embeddings(given.embeddings_path or "")
            video, text = in_file.video_embeddings, in_file.text_embedding if text is None else text
        if text is None and given.task is not None:
            text = self.texts.get(given.task)
            if isinstance(text, InvalidSampleError):
                raise text
        trajectory = Trajectory(video_embeddings=video, text_embedding=text, task=given.task or "")
        info = self.served.embeddings
        assert info is not None and trajectory.video_embeddings is not None
        _check_width("video_embeddings", trajectory.video_embeddings, info.video_dim)
        if trajectory.text_embedding is not None:
            _check_width("text_embedding", trajectory.text_embedding, info.text_dim)
        elif needs_text:
            got = "neither" if not (given.task and given.task.strip()) else "a task, and no encoder is served"
            raise InvalidSampleError.at("text_embedding", "an embedding, or a task to encode", got)
        return trajectory

    def _of_frames(self, given: schema.Trajectory) -> Trajectory:
        if given.frames is None:
            what = "video_embeddings" if has_embeddings(given) else "neither frames nor video_embeddings"
            if has_embeddings(given) and self.served.embeddings is not None:
                raise InvalidSampleError.at("video_embeddings", "them in both trajectories or neither", "one of two")
            raise InvalidSampleError.at("frames", "frames", what)
        if self.served.frames is None:
            raise InvalidSampleError.at(
                "video_embeddings", "embeddings, since no model for raw frames is served", "frames"
            )
        if isinstance(given.frames, list):
            return Trajectory(frames=self.files.frames(given.frames), task=given.task or "")
        return Trajectory(frames=_uint8(given.frames), task=given.task or "")


def has_embeddings(trajectory: schema.Trajectory) -> bool:
    """Whether the trajectory has embeddings: its own, or those of a file where it has no frames."""
    in_file = trajectory.embeddings_path is not None and trajectory.frames is None
    return trajectory.video_embeddings is not None or in_file


def num_bytes(sample: schema.Sample) -> int:
    """Bytes of the sample's arrays; MIN_BYTES if it names files, whose size is not known yet."""
    trajectories = sample.named_trajectories.values()
    if any(isinstance(t.frames, list) or t.embeddings_path is not None for t in trajectories):
        return MIN_BYTES
    arrays = (array for t in trajectories for array in (t.frames, t.video_embeddings))
    return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))


def converted_bytes(sample: schema.Sample) -> int:
    """Bytes of the copies that are made of the sample's arrays whose types are not those that are scored."""
    copies = 0
    for trajectory in sample.named_trajectories.values():
        floats = ((array, np.float32) for array in (trajectory.video_embeddings, trajectory.text_embedding))
        for array, dtype in ((trajectory.frames, np.uint8), *floats):
            if isinstance(array, np.ndarray) and array.dtype != dtype:
                copies += array.size * np.dtype(dtype).itemsize
    return copies


def _uint8(frames: Any) -> UInt8Array:
    """uint8 [T, H, W, C], as the evaluation server made images.

    Whole numbers stay as they are, floats are clipped and truncated. One frame is a film of one. Of RGBA the colours
    count.
    """
    array = as_array(frames)
    if array.ndim == 3:
        array = array[np.newaxis]
    if array.ndim == 4 and array.shape[-1] == RGBA_CHANNELS:
        array = array[..., :RGB_CHANNELS]
    if array.dtype.kind == "f":
        return float_frames_to_uint8(array)
    if array.dtype != np.uint8 and array.dtype.kind in "iu" and array.size:
        if array.min() < 0 or array.max() > 255:
            raise InvalidSampleError.at("frames", "values in 0..255", f"{array.min()}..{array.max()}")
        return array.astype(np.uint8)
    return array  # Trajectory checks the rest


def _check_width(where: str, array: Float32Array, width: int | None) -> None:
    if width is not None and array.shape[-1] != width:
        axes = "[T, " if array.ndim > 1 else "["
        raise InvalidSampleError.at(where, f"{axes}{width}]", str(list(array.shape)))


def refused(errors: Mapping[int, InvalidSampleError]) -> RequestValidationError:
    """One error that lists all samples that cannot be scored, each at its field as the caller named it."""
    details: list[Any] = []
    for index, error in errors.items():
        where, _, message = error.message.partition(": ")
        path: list[str | int] = [int(word) if word.isdecimal() else _SIDES.get(word, word) for word in where.split(".")]
        details += invalid(("samples", index, *path), message).errors()
    return RequestValidationError(details)
