# SPDX-License-Identifier: MIT
"""Convert a request's samples for the client, score them, and write the evaluation server's answer."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from fastapi.exceptions import RequestValidationError

from rfm_client import (
    AsyncRewardClient,
    DeadlineExceededError,
    Float32Array,
    InvalidSampleError,
    ModelInfo,
    ModelNotFoundError,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    RewardError,
    Sample,
    ServerUnavailableError,
    SimilarityResult,
    SimilaritySample,
    Trajectory,
    UInt8Array,
    as_array,
    float_frames_to_uint8,
)
from rfm_client.frames import BlankFrames, what_is_shown
from rfm_client.options import first_names
from rfm_client.serving import MIN_BYTES, Deadline, off_loop
from rfm_gateway import schema
from rfm_gateway.body import Batch, Decoded, invalid
from rfm_gateway.folder import RequestFiles

FRAME_STEPS = 4  # frames to which the evaluation server samples each prefix
PREFERRED = 0.5
CHOSEN_IS_FIRST = 1.0  # the evaluation server's label: the chosen trajectory is first, and better
RGB_CHANNELS, RGBA_CHANNELS = 3, 4

_TEXT_FRAME_PX = 32  # of the blank frame that is sent with a task to get only the task's embedding
_SIDES = {  # the gateway's fields, by the client's names
    "first": "chosen_trajectory",
    "second": "rejected_trajectory",
    "reference": "ref_trajectory",
    "other": "sim_trajectory",
}
logger = logging.getLogger("rfm_gateway")

Texts: TypeAlias = Mapping[
    str, Float32Array | InvalidSampleError
]  # by task: its embedding, or the error of the encoder


class Evaluator:
    """Scores batches with the server behind ``client``.

    folder: folder of files that samples may name, with links resolved; None: no files
    max_decoded_bytes: limit of the decoded files of one request
    """

    def __init__(
        self, client: AsyncRewardClient, timeout_s: float, folder: Path | None = None, max_decoded_bytes: int = 0
    ) -> None:
        self._client = client
        self._timeout_s = timeout_s
        self._folder = folder
        self._max_decoded_bytes = max_decoded_bytes

    async def evaluate(self, batch: Batch, request_id: str) -> schema.EvaluateBatchAnswer:
        """Return the answer to a whole batch. A missing sample would shift later scores, or be read as a reward of 0.

        Raises RequestValidationError that lists all invalid samples, HTTPException for files that are too large, and
        ServerError.
        """
        deadline = Deadline(self._timeout_s)
        try:
            return await self._evaluate(batch, deadline, request_id)
        except DeadlineExceededError as error:  # its message has the time limit of one call, not of all
            raise deadline.exceeded("Triton") from error

    async def _evaluate(self, batch: Batch, deadline: Deadline, request_id: str) -> schema.EvaluateBatchAnswer:
        served = await self._served(batch.samples, deadline)
        texts = await self._texts(batch.samples, served, deadline, request_id)
        files = RequestFiles(self._folder, Decoded(self._max_decoded_bytes))
        by_prefix = batch.use_frame_steps and served.shows_whole_prefixes
        conversion = _Conversion(served, texts, files, FRAME_STEPS if batch.use_frame_steps and not by_prefix else 0)
        num_bytes = batch.num_bytes if self._folder is None else MIN_BYTES  # files may be large
        samples = await off_loop(num_bytes, conversion.samples, batch.samples)
        await off_loop(num_bytes, _log_blank_samples, samples)
        asked = [_prefixes(sample) if by_prefix else [sample] for sample in samples]
        flat = await self._client.evaluate(
            [each for of_sample in asked for each in of_sample],
            return_errors=True,
            timeout_s=deadline.remaining_s(),
            request_id=request_id,
        )
        answers = iter(flat)
        outcomes = [_joined([next(answers) for _ in of_sample]) for of_sample in asked]
        failed = {index: outcome for index, outcome in enumerate(outcomes) if isinstance(outcome, RewardError)}
        unfit = {index: error for index, error in failed.items() if isinstance(error, InvalidSampleError)}
        if unfit:
            raise _refused(unfit)
        for error in failed.values():
            raise error
        results = [
            outcome for outcome in outcomes if not isinstance(outcome, RewardError)
        ]  # no outcome is an error here
        group = 1 if served.frames is None or batch.use_frame_steps else await self._frames_per_value(results, deadline)
        return _answer(batch.samples, results, group)

    async def _frames_per_value(self, results: Sequence[Result], deadline: Deadline) -> int:
        """Return how many frames share a value. Raises ServerUnavailableError while another version is loaded."""
        info = await self._client.model_info(frames=True, timeout_s=deadline.remaining_s())
        unknown = {str(result.model_version) for result in results} - set(info.versions)
        if info.versions and unknown:
            got = ", ".join(sorted(unknown))
            expected = f"model_version: expected one of {', '.join(info.versions)}"
            raise ServerUnavailableError(f"{expected}, got {got}: the checkpoint is being replaced, try again")
        return info.frames_per_value

    async def _served(self, samples: Sequence[schema.Sample], deadline: Deadline) -> _Served:
        """Return the models that can score the samples.

        Asks about the model for frames only if a sample may need it, because the client does not cache that a model is
        missing and would send a request each time.
        """
        trajectories = [t for sample in samples for t in sample.named_trajectories.values()]
        needs_embeddings = any(map(_has_embeddings, trajectories))
        embeddings = await self._model_info(deadline, frames=False) if needs_embeddings else None
        has_frames = any(trajectory.frames is not None for trajectory in trajectories)
        needs_frames = has_frames and not (embeddings is not None and all(map(_has_embeddings, trajectories)))
        frames = await self._model_info(deadline, frames=True) if needs_frames else None
        if embeddings is None and frames is None:  # raises ModelNotFoundError if the other model is missing, too
            await self._client.model_info(frames=not needs_frames, timeout_s=deadline.remaining_s())
        return _Served(embeddings, frames)

    async def _model_info(self, deadline: Deadline, *, frames: bool) -> ModelInfo | None:
        try:
            return await self._client.model_info(frames=frames, timeout_s=deadline.remaining_s())
        except ModelNotFoundError:
            return None

    async def _texts(
        self, samples: Sequence[schema.Sample], served: _Served, deadline: Deadline, request_id: str
    ) -> Texts:
        """Return embeddings by task, for tasks without an embedding; empty without an encoder."""
        tasks = {
            first.task
            for first, *_ in (tuple(sample.named_trajectories.values()) for sample in samples)
            if _has_embeddings(first) and first.text_embedding is None and first.task and first.task.strip()
        }
        if not tasks or served.embeddings is None:
            return {}
        try:
            texts = await asyncio.gather(*(self._text(task, deadline, request_id) for task in tasks))
            return dict(zip(tasks, texts, strict=True))
        except ModelNotFoundError:
            return {}

    async def _text(self, task: str, deadline: Deadline, request_id: str) -> Float32Array | InvalidSampleError:
        blank = np.zeros((1, _TEXT_FRAME_PX, _TEXT_FRAME_PX, 3), np.uint8)
        try:
            encoded = await self._client.encode(
                Trajectory(frames=blank, task=task), timeout_s=deadline.remaining_s(), request_id=request_id
            )
        except InvalidSampleError as error:  # of this task alone
            return error
        assert encoded.text_embedding is not None
        return encoded.text_embedding


@dataclass(frozen=True)
class _Served:
    """The checkpoint's models for embeddings and for raw frames; None: not served."""

    embeddings: ModelInfo | None
    frames: ModelInfo | None

    @property
    def shows_whole_prefixes(self) -> bool:
        """True for RoboReward, to which the evaluation server shows all frames of a prefix."""
        return self.frames is not None and (self.frames.kind or "").startswith("RoboReward")


@dataclass(frozen=True)
class _Conversion:
    """Conversion of one request's samples.

    texts: embeddings of tasks
    files: the files that samples name
    frame_steps: frames to which each prefix of a progress sample is sampled; 0: no dense mode
    """

    served: _Served
    texts: Texts
    files: RequestFiles
    frame_steps: int

    def samples(self, samples: Sequence[schema.Sample]) -> list[Sample]:
        """Return the client's samples.

        Raises RequestValidationError that lists all invalid samples, and HTTPException as ``RequestFiles`` does.
        """
        converted: list[Sample] = []
        errors: dict[int, InvalidSampleError] = {}
        for index, sample in enumerate(samples):
            try:
                converted.append(self._sample(sample))
            except InvalidSampleError as error:
                errors[index] = error
        if errors:
            raise _refused(errors)
        return converted

    def _sample(self, sample: schema.Sample) -> Sample:
        given = sample.named_trajectories
        by_embeddings = self.served.embeddings is not None and all(map(_has_embeddings, given.values()))
        trajectories: list[Trajectory] = []
        for name, trajectory in given.items():
            try:
                if by_embeddings:
                    trajectories.append(self._of_embeddings(trajectory, needs_text=not trajectories))
                else:
                    trajectories.append(self._of_frames(trajectory))
            except InvalidSampleError as error:
                raise error.inside(name) from None
        if isinstance(sample, schema.ProgressInput):
            return ProgressSample(trajectories[0], frame_steps=self.frame_steps)
        if isinstance(sample, schema.PreferenceInput):
            return PreferenceSample(*trajectories)
        return SimilaritySample(*trajectories)

    def _of_embeddings(self, given: schema.TrajectoryInput, *, needs_text: bool) -> Trajectory:
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

    def _of_frames(self, given: schema.TrajectoryInput) -> Trajectory:
        if given.frames is None:
            what = "video_embeddings" if _has_embeddings(given) else "neither frames nor video_embeddings"
            if _has_embeddings(given) and self.served.embeddings is not None:
                raise InvalidSampleError.at("video_embeddings", "them in both trajectories or neither", "one of two")
            raise InvalidSampleError.at("frames", "frames", what)
        if self.served.frames is None:
            raise InvalidSampleError.at(
                "video_embeddings", "embeddings, since no model for raw frames is served", "frames"
            )
        if isinstance(given.frames, list):
            return Trajectory(frames=self.files.frames(given.frames), task=given.task or "")
        return Trajectory(frames=_uint8(given.frames), task=given.task or "")


def _log_blank_samples(samples: Sequence[Sample]) -> None:
    """Log a line about the samples with frames that show nothing."""
    blank: dict[int, int] = {}
    for index, sample in enumerate(samples):
        for frames in (trajectory.frames for trajectory in sample.trajectories):
            highest = None if frames is None else BlankFrames(frames).highest
            if highest is not None:
                blank[index] = max(highest, blank.get(index, 0))
    if blank:
        names, told = first_names(blank, 12), what_is_shown(max(blank.values()))
        logger.warning("samples %s: %s: their scores mean nothing", names, told)


def _prefixes(sample: Sample) -> list[Sample]:
    """Return a sample of raw frames for each prefix of a progress sample; another sample alone."""
    if not isinstance(sample, ProgressSample):
        return [sample]
    frames, task = sample.trajectory.positions, sample.trajectory.task
    return [ProgressSample(Trajectory(frames=frames[:end], task=task)) for end in range(1, len(frames) + 1)]


def _joined(outcomes: Sequence[Result | RewardError]) -> Result | RewardError:
    """Return the last score of each prefix, or the first error; a single outcome as it is."""
    if len(outcomes) == 1:
        return outcomes[0]
    results = [outcome for outcome in outcomes if isinstance(outcome, ProgressResult)]
    if len(results) < len(outcomes):
        return next(outcome for outcome in outcomes if isinstance(outcome, RewardError))
    progress, success = (np.array([getattr(each, name)[-1] for each in results]) for name in ("progress", "success"))
    return ProgressResult(progress=progress, success=success, model_version=results[-1].model_version)


def _has_embeddings(trajectory: schema.TrajectoryInput) -> bool:
    """True if the trajectory has embeddings, or a file of embeddings and no frames."""
    in_file = trajectory.embeddings_path is not None and trajectory.frames is None
    return trajectory.video_embeddings is not None or in_file


def _uint8(frames: Any) -> UInt8Array:
    """Return frames as uint8 [T, H, W, C], converted as the evaluation server does.

    Floats are clipped and truncated. A single frame becomes a video of one frame. RGBA loses its alpha channel.
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
    return array  # Trajectory refuses all other types and shapes


def _check_width(where: str, array: Float32Array, width: int | None) -> None:
    if width is not None and array.shape[-1] != width:
        axes = "[T, " if array.ndim > 1 else "["
        raise InvalidSampleError.at(where, f"{axes}{width}]", str(list(array.shape)))


def _refused(errors: Mapping[int, InvalidSampleError]) -> RequestValidationError:
    """Return an error that lists all invalid samples, under the caller's field names."""
    details: list[Any] = []
    for index, error in errors.items():
        words = error.where.split(".")
        path = [int(word) if word.isdecimal() else _SIDES.get(word, word) for word in words]
        details += invalid(("samples", index, *path), error.problem).errors()
    return RequestValidationError(details)


def _answer(samples: Sequence[schema.Sample], results: Sequence[Result], group: int) -> schema.EvaluateBatchAnswer:
    """Return the evaluation server's answer for these results.

    group: number of frames that share a value; the answer has each value once
    """
    progress = [result for result in results if isinstance(result, ProgressResult)]
    preferences = [result.preference for result in results if isinstance(result, PreferenceResult)]
    similar = [(s, r) for s, r in zip(samples, results, strict=True) if isinstance(r, SimilarityResult)]
    success = [result.success[::group] for result in progress]
    answer = schema.EvaluateBatchAnswer()
    if progress:
        answer.outputs_progress = schema.ProgressOutputs.model_construct(
            progress_pred=[result.progress[::group].tolist() for result in progress]
        )
    if progress and all(np.isfinite(values).all() for values in success):
        answer.outputs_success = schema.SuccessOutputs.model_construct(
            success_probs=[values.tolist() for values in success]
        )
    if preferences:
        answer.outputs_preference = schema.PreferenceOutputs.model_construct(
            predictions=[int(preference > PREFERRED) for preference in preferences],
            prediction_probs=preferences,
            preference_labels=[CHOSEN_IS_FIRST] * len(preferences),
        )
    if similar:
        references = [sample.ref_trajectory for sample, _ in similar if isinstance(sample, schema.SimilarityInput)]
        answer.outputs_similarity = schema.SimilarityOutputs.model_construct(
            sim_score_ref_sim=[result.similarity for _, result in similar],
            task=[reference.task for reference in references],
            data_source=[reference.data_source for reference in references],
            data_gen_strategy=[getattr(sample, "data_gen_strategy", None) for sample, _ in similar],
            metadata=[{} if reference.metadata is None else reference.metadata for reference in references],
        )
    return answer
