# SPDX-License-Identifier: MIT
"""Convert a request's samples for the client, score them, and write the evaluation server's response."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, replace
from itertools import chain, islice
from traceback import clear_frames
from typing import TypeAlias, cast

import numpy as np

from rfm_client import (
    AsyncRewardClient,
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
)
from rfm_client.frames import BlankFrames
from rfm_client.options import first_names
from rfm_client.serving import off_loop
from rfm_gateway import schema
from rfm_gateway.body import Batch
from rfm_gateway.field_errors import refused
from rfm_gateway.observe import within

FRAME_STEPS = 4  # the evaluation server samples each prefix to this many frames
FRAME_STEPS_FOR_SECONDS = 8  # the same, for a model that predicts remaining seconds
PREFERRED = 0.5
CHOSEN_IS_FIRST = 1.0  # the evaluation server's label: the chosen trajectory is first, and better
WARNING_HEADER = "X-RFM-Warning"  # on responses whose scores mean nothing
PADDING = "frames of zeros at the end (send the real frames alone, without padding)"
MOST_NAMES = 12  # samples that a warning names
_BLANK = np.zeros((1, 32, 32, 3), np.uint8)  # sent with a task to get only the task embedding

Text: TypeAlias = Float32Array | InvalidSampleError  # a task's embedding, or the encoder's error


@dataclass(frozen=True)
class Evaluator:
    """Scores batches with the server behind ``client``.

    use_frame_steps: for requests that do not say
    refuse_blank: True: black and single-colour frames are invalid
    """

    client: AsyncRewardClient
    timeout_s: float
    _: KW_ONLY
    use_frame_steps: bool
    refuse_blank: bool

    async def evaluate(self, batch: Batch, request_id: str) -> tuple[schema.EvaluateBatchAnswer, str]:
        """Return the response for a whole batch, and a warning about samples that show nothing; empty: none do.

        No sample may be left out: that would shift later scores, or be read as a reward of 0.

        Raises RequestValidationError that lists all invalid samples, and ServerError.
        """
        try:
            return await within(self.timeout_s, self._evaluate(batch, request_id))
        except Exception as error:
            clear_frames(error.__traceback__)  # otherwise the traceback's variables keep the arrays in memory
            raise

    async def _evaluate(self, batch: Batch, request_id: str) -> tuple[schema.EvaluateBatchAnswer, str]:
        embeddings, frames = await self._served(batch.samples)
        texts = await self._texts(batch.samples, request_id) if embeddings is not None else {}
        use_frame_steps = self.use_frame_steps if batch.use_frame_steps is None else batch.use_frame_steps
        by_prefix = use_frame_steps and frames is not None and frames.scores_whole_prefixes
        steps = FRAME_STEPS if frames is None or frames.has_progress else FRAME_STEPS_FOR_SECONDS
        frame_steps = steps if use_frame_steps and not by_prefix else 0
        conversion = _Conversion(embeddings, frames, texts, frame_steps, self.refuse_blank)
        samples, warning = await off_loop(batch.num_bytes, conversion.samples, batch)
        asked = [_prefixes(sample) if by_prefix else [sample] for sample in samples]
        flat = chain.from_iterable(asked)
        outcomes = iter(await self.client.evaluate(flat, return_errors=True, request_id=request_id))
        results = _results([list(islice(outcomes, len(of_sample))) for of_sample in asked], batch)
        group = 1 if frames is None or use_frame_steps else await self._frames_per_value(frames, results)
        return _answer(batch.samples, results, group), warning

    async def _frames_per_value(self, before: ModelInfo, results: Sequence[Result]) -> int:
        """Return how many frames share a value, in the version that is served now or was served ``before``.

        Raises ServerUnavailableError if neither answered.
        """
        now = await self.client.model_info(frames=True)
        answered = {str(result.model_version) for result in results}
        for info in (now, before):
            if answered <= {*info.versions}:
                return info.frames_per_value
        fault = f"model_version: expected one of {', '.join(now.versions)}, got {', '.join(sorted(answered))}"
        raise ServerUnavailableError(f"{fault}: the checkpoint is being replaced, try again")

    async def _served(self, samples: Sequence[schema.Sample]) -> tuple[ModelInfo | None, ModelInfo | None]:
        """Return the models for embeddings and for raw frames that can score the samples; None: not served, or unused.

        Asks about the frame model only if a sample may need it: the client does not cache that a model is missing, and
        would send a request each time.
        """
        given = [trajectory for sample in samples for trajectory in sample.named_trajectories.values()]
        embedded = [trajectory.video_embeddings is not None for trajectory in given]
        embeddings = await self._model_info(frames=False) if any(embedded) else None
        has_frames = any(trajectory.frames is not None for trajectory in given)
        needs_frames = has_frames and not (embeddings is not None and all(embedded))
        frames = await self._model_info(frames=True) if needs_frames else None
        if embeddings is None and frames is None:  # raises ModelNotFoundError if the other model is missing, too
            await self.client.model_info(frames=not needs_frames)
        return embeddings, frames

    async def _model_info(self, *, frames: bool) -> ModelInfo | None:
        try:
            return await self.client.model_info(frames=frames)
        except ModelNotFoundError:
            return None

    async def _texts(self, samples: Sequence[schema.Sample], request_id: str) -> Mapping[str, Text]:
        """Return embeddings by task, for tasks without an embedding; empty without an encoder."""
        firsts = [next(iter(sample.named_trajectories.values())) for sample in samples]
        unread = [each.task for each in firsts if each.video_embeddings is not None and each.text_embedding is None]
        tasks = {task for task in unread if task and task.strip()}
        texts: dict[str, Text] = {}
        if tasks:
            with suppress(ModelNotFoundError):
                found = await asyncio.gather(*(self._text(task, request_id) for task in tasks))
                texts = dict(zip(tasks, found, strict=True))
        return texts

    async def _text(self, task: str, request_id: str) -> Text:
        try:
            encoded = await self.client.encode(Trajectory(frames=_BLANK, task=task), request_id=request_id)
        except InvalidSampleError as error:  # for this task alone
            return error
        assert encoded.text_embedding is not None
        return encoded.text_embedding


@dataclass(frozen=True)
class _Conversion:
    """Converts one request's samples.

    embedding_model, frame_model: models that score them; None: not served, or unused
    texts: embeddings by task
    frame_steps: frames to which each prefix of a progress sample is sampled; 0: no dense mode
    refuse_blank: True: black and single-colour frames are invalid
    """

    embedding_model: ModelInfo | None
    frame_model: ModelInfo | None
    texts: Mapping[str, Text]
    frame_steps: int
    refuse_blank: bool

    def samples(self, batch: Batch) -> tuple[list[Sample], str]:
        """Return the client's samples, and a warning about those that show nothing.

        Raises RequestValidationError that lists all invalid samples.
        """
        converted: list[Sample] = []
        errors: dict[int, InvalidSampleError] = {}
        for index, sample in enumerate(batch.samples):
            try:
                converted.append(self._sample(sample))
            except InvalidSampleError as error:
                errors[index] = error
        if errors:
            raise refused(errors, batch.samples, batch.paths)
        return converted, warning_of(converted)

    def _sample(self, sample: schema.Sample) -> Sample:
        given = sample.named_trajectories
        are_embedded = all(each.video_embeddings is not None for each in given.values())
        by_embeddings = self.embedding_model is not None and are_embedded
        trajectories: list[Trajectory] = []
        for name, each in given.items():
            try:
                is_first = not trajectories
                trajectories.append(self._of_embeddings(each, is_first) if by_embeddings else self._of_frames(each))
            except InvalidSampleError as error:
                raise error.inside(name) from None
        if isinstance(sample, schema.ProgressInput):
            return ProgressSample(trajectories[0], frame_steps=self.frame_steps)
        kind = PreferenceSample if isinstance(sample, schema.PreferenceInput) else SimilaritySample
        return kind(*trajectories)

    def _of_embeddings(self, given: schema.TrajectoryInput, needs_text: bool) -> Trajectory:
        text = given.text_embedding
        if text is None and given.task is not None:
            text = self.texts.get(given.task)
            if isinstance(text, InvalidSampleError):
                raise text
        trajectory = Trajectory(video_embeddings=given.video_embeddings, text_embedding=text, task=given.task or "")
        assert self.embedding_model is not None
        widths = {"video_embeddings": self.embedding_model.video_dim, "text_embedding": self.embedding_model.text_dim}
        for where, width in widths.items():
            array: Float32Array | None = getattr(trajectory, where)
            if array is not None and width not in (None, array.shape[-1]):
                raise InvalidSampleError.at(where, f"[{'T, ' * (array.ndim - 1)}{width}]", str(list(array.shape)))
        if trajectory.text_embedding is None and needs_text:
            got = "a task, and no encoder is served" if given.task and given.task.strip() else "neither"
            raise InvalidSampleError.at("text_embedding", "an embedding, or a task to encode", got)
        return trajectory

    def _of_frames(self, given: schema.TrajectoryInput) -> Trajectory:
        if given.frames is None and given.video_embeddings is None:
            if given.embeddings_path is not None:
                expected = "video_embeddings as an array, since the gateway reads no files"
                raise InvalidSampleError.at("embeddings_path", expected, "the name of a file")
            raise InvalidSampleError.at("frames", "frames", "neither frames nor video_embeddings")
        if given.frames is None and self.embedding_model is not None:
            raise InvalidSampleError.at("video_embeddings", "them in both trajectories or neither", "one of two")
        if given.frames is None:
            expected = "frames, since no model for embeddings is served"
            raise InvalidSampleError.at("video_embeddings", expected, "embeddings")
        if self.frame_model is None:
            expected = "embeddings, since no model for raw frames is served"
            raise InvalidSampleError.at("frames", expected, "frames")
        trajectory = Trajectory(frames=given.uint8_frames, task=given.task or "")
        if self.refuse_blank:
            refuse_blank_frames(trajectory)
        return trajectory


def _prefixes(sample: Sample) -> list[Sample]:
    """Return a raw-frame sample for each prefix of a progress sample; any other sample alone."""
    if not isinstance(sample, ProgressSample):
        return [sample]
    trajectory, frames = sample.trajectory, sample.trajectory.positions
    return [ProgressSample(replace(trajectory, frames=frames[:end])) for end in range(1, len(frames) + 1)]


def _results(outcomes: Sequence[Sequence[Result | RewardError]], batch: Batch) -> list[Result]:
    """Return each sample's result, from the outcomes of its prefixes or from its only outcome.

    Raises RequestValidationError that lists all invalid samples, else the first error.
    """
    outcome_of = ((index, each) for index, of_sample in enumerate(outcomes) for each in reversed(of_sample))
    failed = {index: error for index, error in outcome_of if isinstance(error, RewardError)}  # each sample's first
    unfit = {index: error for index, error in failed.items() if isinstance(error, InvalidSampleError)}
    if unfit:
        raise refused(unfit, batch.samples, batch.paths)
    for error in failed.values():
        raise error
    return [_joined(cast("list[Result]", of_sample)) for of_sample in outcomes]


def _joined(results: Sequence[Result]) -> Result:
    """Return each prefix's last scores; a single result as it is. Raises InferenceFailedError."""
    if len(results) == 1:
        return results[0]
    newest = slice(-1, None)
    return ProgressResult.of_parts([each.at(newest) for each in results if isinstance(each, ProgressResult)])


def _progress(result: ProgressResult) -> Float32Array:
    """Return progress; for a model of seconds, minus the seconds, as in the evaluation server's default mode."""
    return result.progress if result.remaining_s is None else -result.remaining_s


def _answer(samples: Sequence[schema.Sample], results: Sequence[Result], group: int) -> schema.EvaluateBatchAnswer:
    """Return the evaluation server's response for these results.

    group: frames that share a value; the response has each value once
    """
    progress = [result for result in results if isinstance(result, ProgressResult)]
    preferences = [result.preference for result in results if isinstance(result, PreferenceResult)]
    similarities = [result.similarity for result in results if isinstance(result, SimilarityResult)]
    similar = [sample for sample in samples if isinstance(sample, schema.SimilarityInput)]
    answer = schema.EvaluateBatchAnswer()
    if progress:
        values = [_progress(result)[::group].tolist() for result in progress]
        answer.outputs_progress = schema.ProgressOutputs.model_construct(progress_pred=values)
    if progress and all(np.isfinite(result.success[::group]).all() for result in progress):
        values = [result.success[::group].tolist() for result in progress]
        answer.outputs_success = schema.SuccessOutputs.model_construct(success_probs=values)
    if preferences:
        answer.outputs_preference = schema.PreferenceOutputs.model_construct(
            predictions=[int(preference > PREFERRED) for preference in preferences],
            prediction_probs=preferences,
            preference_labels=[CHOSEN_IS_FIRST] * len(preferences),
        )
    if similar:
        references = [sample.ref_trajectory for sample in similar]
        answer.outputs_similarity = schema.SimilarityOutputs.model_construct(
            sim_score_ref_sim=similarities,
            task=[reference.task for reference in references],
            data_source=[reference.data_source for reference in references],
            data_gen_strategy=[sample.data_gen_strategy for sample in similar],
            metadata=[{} if reference.metadata is None else reference.metadata for reference in references],
        )
    return answer


def warning_of(samples: Sequence[Sample]) -> str:
    """Return a warning that names samples with blank frames, or with zeros at the end; empty if there are none."""
    shown = [(index, t.frames) for index, sample in enumerate(samples) for t in sample.trajectories if t is not None]
    clips = [(index, frames, BlankFrames(frames)) for index, frames in shown if frames is not None]
    blank = {index: found for index, _, found in clips if found.told}
    padded = dict.fromkeys(index for index, frames, found in clips if not found.told and _is_padded(frames))
    warnings = []
    if blank:
        described = max(blank.values(), key=lambda found: found.highest or 0).told
        warnings.append(f"samples {first_names(blank, MOST_NAMES)}: {described}: their scores mean nothing")
    if padded:
        warnings.append(f"samples {first_names(padded, MOST_NAMES)}: {PADDING}: they are scored as pictures")
    return "; ".join(warnings)


def refuse_blank_frames(trajectory: Trajectory) -> None:
    """Raise InvalidSampleError for blank frames, and for zero frames at the end."""
    if trajectory.frames is None:
        return
    fault = BlankFrames(trajectory.frames).told or PADDING * _is_padded(trajectory.frames)
    if fault:
        raise InvalidSampleError.at("frames", "pictures that show something", fault)


def _is_padded(frames: UInt8Array) -> bool:
    """True if zeros follow a picture, up to the last frame."""
    return not frames[-1].any() and bool(frames.any())
