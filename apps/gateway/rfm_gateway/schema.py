# SPDX-License-Identifier: MIT
"""Requests and responses of the evaluation server.

Field names come from ``dataset_types.py`` in reward_fm and robometer. Other fields are ignored, as upstream does.
T frames, H x W pixels, D frame embedding width, Dt text embedding width.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import (
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    TypeAdapter,
    ValidationInfo,
    WithJsonSchema,
)

from rfm_client import InvalidSampleError, UInt8Array, float_frames_to_uint8

UPLOAD_KEY = "__numpy_file__"
MAX_AXES = 4  # in frames, [T, H, W, 3]
RGB_CHANNELS, RGBA_CHANNELS = 3, 4

_UPLOADED = {
    "type": "object",
    "description": "Multipart requests only: the name of the part that is this array as a .npy file.",
    "properties": {UPLOAD_KEY: {"type": "string"}},
    "required": [UPLOAD_KEY],
}
_NUMBERS = {"type": "array", "items": {"type": "number"}, "minItems": 1}


def _nested(depth: int) -> dict[str, Any]:
    return _NUMBERS if depth == 1 else {"type": "array", "items": _nested(depth - 1), "minItems": 1}


def _array_schema(description: str, depth: int) -> WithJsonSchema:
    return WithJsonSchema({"description": description, "anyOf": [_nested(depth), _UPLOADED, {"type": "null"}]})


def _array(value: Any, info: ValidationInfo) -> Any:
    """Return an array from nested lists, or from the named upload."""
    if value is None or isinstance(value, np.ndarray):
        return value
    if isinstance(value, Mapping):
        return _uploaded(value, info.context or {})
    if not isinstance(value, list):
        raise ValueError(f"expected an array, got {type(value).__name__}")
    shape, numbers = _flattened(value)
    try:
        array = np.asarray(numbers)
    except OverflowError:
        raise ValueError("expected numbers, got something else") from None
    if array.dtype.kind not in "biuf":
        raise ValueError("expected numbers, got something else")
    return array.reshape(shape)


def _flattened(array: list[Any]) -> tuple[tuple[int, ...], list[Any]]:
    """Return the shape and the numbers of nested lists. Raises ValueError.

    Numpy reads a flat list faster than a nested one. It never reads text, which would make every element as wide as
    the longest.
    """
    shape = [len(array)]
    for _ in range(MAX_AXES):
        kinds = set(map(type, array))
        if kinds <= {bool, int, float}:
            return tuple(shape), array
        if not kinds <= {bool, int, float, list}:
            raise ValueError("expected numbers, got something else")
        lengths = set(map(len, array)) if kinds == {list} else set[int]()
        if len(lengths) != 1:
            raise ValueError("expected rows of equal length, got unequal ones")
        shape += lengths
        array = [*itertools.chain.from_iterable(array)]
    raise ValueError(f"expected at most {MAX_AXES} axes, got more")


def _frames(value: Any, info: ValidationInfo) -> Any:
    """Return an array of frames, or a list of file names, which beside embeddings is ignored."""
    if isinstance(value, list) and value and all(isinstance(name, str) for name in value):
        return value
    return _array(value, info)


def _uploaded(value: Mapping[str, Any], uploads: Mapping[str, Callable[[], Any]]) -> Any:
    name = value.get(UPLOAD_KEY)
    if not isinstance(name, str):
        raise ValueError(f'expected an array or {{"{UPLOAD_KEY}": name}}, got an object without it')
    if name not in uploads:
        raise ValueError(f"expected a .npy part named {name!r}, got none")
    return uploads[name]()


class TrajectoryInput(BaseModel):
    """Frames or embeddings of an episode, and its task."""

    model_config = ConfigDict(extra="ignore")

    task: str | None = Field(None, description="The task as a sentence.")
    frames: Annotated[
        Any,
        BeforeValidator(_frames),
        _array_schema("[T, H, W, 3], RGB, 0..255", 4),
    ] = None
    video_embeddings: Annotated[Any, BeforeValidator(_array), _array_schema("[T, D]", 2)] = None
    text_embedding: Annotated[
        Any,
        BeforeValidator(_array),
        _array_schema("[Dt], the embedding of the task; if it is missing, a served encoder encodes the task", 1),
    ] = None
    embeddings_path: Any = None  # alone it is refused, since the gateway reads no files
    data_source: Any = None
    metadata: Any = None

    @property
    def uint8_frames(self) -> UInt8Array:
        """The frames as an uint8 array [T, H, W, C], converted as the evaluation server does.

        Floats are clipped and truncated. A single frame becomes a one-frame video. RGBA loses its alpha channel.
        Raises InvalidSampleError for integers outside 0..255, for other types and shapes, and for file names.
        """
        if isinstance(self.frames, list):
            raise InvalidSampleError.at("frames", "an array, since the gateway reads no files", "names of files")
        _check_axes(self.frames)
        array: np.ndarray[Any, Any] = self.frames if self.frames.ndim != 3 else self.frames[np.newaxis]
        if array.ndim == 4 and array.shape[-1] == RGBA_CHANNELS:
            array = array[..., :RGB_CHANNELS]
        if array.dtype.kind == "f":
            return float_frames_to_uint8(array)
        if array.dtype != np.uint8 and array.dtype.kind in "iu" and array.size:
            if array.min() < 0 or array.max() > 255:
                raise InvalidSampleError.at("frames", "values in 0..255", f"{array.min()}..{array.max()}")
            return array.astype(np.uint8)
        return array


def _check_axes(frames: np.ndarray[Any, Any]) -> None:
    """Raise InvalidSampleError unless the frames are numbers [T, H, W, 3 or 4], or one frame [H, W, 3 or 4]."""
    shape, channels = frames.shape, (RGB_CHANNELS, RGBA_CHANNELS)
    if frames.dtype.kind != "b" and frames.ndim in (3, MAX_AXES) and shape[-1] in channels and 0 not in shape:
        return
    raise InvalidSampleError.at("frames", "uint8 [T, H, W, 3]", f"{frames.dtype} {list(shape)}")


class _Sample(BaseModel):
    model_config = ConfigDict(extra="ignore")

    @property
    def named_trajectories(self) -> dict[str, TrajectoryInput]:
        """The trajectories by field name, in scoring order."""
        return {name: value for name, value in self if isinstance(value, TrajectoryInput)}


class ProgressInput(_Sample):
    """Score the progress of a trajectory at each frame."""

    sample_type: Literal["progress"]
    trajectory: TrajectoryInput


class PreferenceInput(_Sample):
    """Score which trajectory does the task of the chosen trajectory better."""

    sample_type: Literal["preference"]
    chosen_trajectory: TrajectoryInput
    rejected_trajectory: TrajectoryInput


class SimilarityInput(_Sample):
    """Score the similarity of ``sim_trajectory`` to ``ref_trajectory``. ``diff_trajectory`` is ignored."""

    sample_type: Literal["similarity"]
    ref_trajectory: TrajectoryInput = Field(validation_alias=AliasChoices("ref_trajectory", "reference_trajectory"))
    sim_trajectory: TrajectoryInput = Field(validation_alias=AliasChoices("sim_trajectory", "traj_sim_trajectory"))
    data_gen_strategy: Any = None


Sample: TypeAlias = ProgressInput | PreferenceInput | SimilarityInput
_ByType: TypeAlias = Annotated[Sample, Discriminator("sample_type")]
SAMPLES: TypeAdapter[list[Sample]] = TypeAdapter(list[_ByType])


class EvaluateBatchRequest(BaseModel):
    """At least one sample. A bare list, a single sample, or an object whose only value is the list is also read."""

    samples: list[_ByType] = Field(min_length=1)
    use_frame_steps: bool | None = Field(
        None,
        description="Score each frame of progress samples on its prefix alone, sampled to 4 frames. Without this field "
        "the gateway's --use-frame-steps decides.",
    )


class PreferenceOutputs(BaseModel):
    """An entry for each preference sample, in order."""

    predictions: list[int] = Field(description="1: the chosen trajectory is preferred; 0: the rejected trajectory is.")
    prediction_probs: list[float] | None = Field(description="Probability that the chosen trajectory is preferred.")
    preference_labels: list[float] = Field(description="The truth: 1, the chosen trajectory.")


class ProgressOutputs(BaseModel):
    """An entry for each progress sample, in order."""

    progress_pred: list[list[float | None]] = Field(
        description="0..1, for each frame; null: the model (Robo-Dopamine) did not compare the frame."
    )


class SuccessOutputs(BaseModel):
    """An entry for each progress sample, in order."""

    success_probs: list[list[float]] = Field(description="0..1, for each frame.")


class SimilarityOutputs(BaseModel):
    """An entry for each similarity sample, in order."""

    sim_score_ref_sim: list[float] = Field(description="Raw score of sim_trajectory against ref_trajectory.")
    task: list[str | None]
    data_source: list[Any]
    data_gen_strategy: list[Any]
    metadata: list[Any]


class EvaluateBatchAnswer(BaseModel):
    """Scores by type; null without samples of the type. ``outputs_success`` is left out without scores."""

    outputs_preference: PreferenceOutputs | None = None
    outputs_progress: ProgressOutputs | None = None
    outputs_success: SuccessOutputs | None = None
    outputs_similarity: SimilarityOutputs | None = None


class FieldError(BaseModel):
    """The error at a field of a request."""

    type: str
    loc: list[str | int] = Field(description="Path of the field.")
    msg: str = Field(description="expected X, got Y")


class InvalidRequest(BaseModel):
    """Body of an answer with status 422."""

    detail: list[FieldError]


class Failure(BaseModel):
    """Body of every other error."""

    detail: str


class GpuStats(BaseModel):
    """A device that models run on; a server without GPUs has its CPU alone."""

    device: str = Field(description="UUID of the GPU, or CPU.")
    status: Literal["ready", "processing"] = Field(description="processing: requests wait for their turn.")
    total_requests: int = Field(description="Requests that Triton has answered there, each counted once.")
    total_processing_time: float = Field(description="Seconds that models computed there.")
    last_used: float | None = Field(description="Unix time of the last request to any device; null: none yet.")
    utilization: float | None = Field(description="0..1, now; null where Triton does not report it.")
    memory_used_bytes: float | None
    memory_total_bytes: float | None


class GpuStatus(BaseModel):
    """Fields of the evaluation server, from Triton's metrics and statistics."""

    total_gpus: int = Field(description="Devices that models run on.")
    available_gpus: int = Field(description="0 while requests wait for their turn, else as total_gpus.")
    max_workers: int = Field(description="As total_gpus.")
    pool_size: int = Field(description="As total_gpus.")
    gpu_stats: dict[str, GpuStats] = Field(description='By number, from "0".')


class Health(BaseModel):
    """The state of a server whose models all answer a probe or are busy."""

    status: Literal["healthy"]
    available_gpus: int | None = Field(description="0 while requests wait for their turn, else as total_gpus.")
    total_gpus: int | None = Field(description="Devices that models run on; null: Triton's metrics cannot be read.")


class ModelInformation(BaseModel):
    """Facts about the served checkpoint."""

    model_path: str | None = Field(description="Hub id or folder name of the exported checkpoint.")
    model_version: str | None = Field(description="Version in the model repository.")
    num_gpus: int | None
    experiment_config: dict[str, Any] = Field(
        description="config.yaml of the training run, without secrets; else the network's configuration."
    )
    model_architecture: dict[str, Any] = Field(description="Class and numbers of parameters.")
