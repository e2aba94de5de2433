# SPDX-License-Identifier: MIT
"""Samples of a request -> the client's samples -> results -> the evaluation server's answer."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import numpy as np

from rfm_client.async_client import AsyncRewardClient
from rfm_client.contract.errors import DeadlineExceededError, InvalidSampleError, ModelNotFoundError, RewardError
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.results import PreferenceResult, ProgressResult, Result, SimilarityResult
from rfm_client.contract.samples import Float32Array, Sample, Trajectory
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.off_loop import off_loop
from rfm_gateway import schema
from rfm_gateway.body import Batch
from rfm_gateway.conversion import Conversion, Served, Texts, converted_bytes, has_embeddings, num_bytes, refused
from rfm_gateway.folder import AllowedFolder, NamedFiles
from rfm_gateway.memory import Share
from rfm_gateway.versions import check_one, of_one_version

FRAME_STEPS = 4  # frames to which the evaluation server samples each prefix
PREFERRED = 0.5
CHOSEN_IS_FIRST = 1.0  # the evaluation server's label: the first trajectory, which is the chosen one, is better

_TEXT_FRAME_PX = 32  # of the blank frame that goes with a task, where only the task's embedding is wanted


class Scorer:
    """Scores batches with the server behind ``client``."""

    def __init__(self, client: AsyncRewardClient, folder: AllowedFolder, timeout_s: float) -> None:
        self._client = client
        self._folder = folder
        self._timeout_s = timeout_s
        self._frames_per_value: dict[str, int] = {}  # of each version that was served alone

    async def evaluate(self, batch: Batch, share: Share, request_id: str) -> schema.EvaluateBatchAnswer:
        """The answer to a batch, whole: one that lacked a sample would shift the others', or be read as a reward of 0.

        Raises RequestValidationError for samples that cannot be scored, all of them listed, HTTPException as ``share``
        does, and ServerError.
        """
        deadline = Deadline(self._timeout_s)
        try:
            return await self._evaluate(batch, share, deadline, request_id)
        except DeadlineExceededError as error:  # its message names the time of one of several calls
            raise deadline.exceeded("Triton") from error

    async def _evaluate(
        self, batch: Batch, share: Share, deadline: Deadline, request_id: str
    ) -> schema.EvaluateBatchAnswer:
        served = await self._served(batch.samples, deadline)
        texts = await self._texts(batch.samples, served, deadline, request_id)
        steps = FRAME_STEPS if batch.use_frame_steps else 0
        share.take(sum(map(converted_bytes, batch.samples)))
        conversion = Conversion(served, texts, NamedFiles(self._folder, share), steps)
        samples = await off_loop(sum(map(num_bytes, batch.samples)), conversion.samples, batch.samples)
        scored = await self._results(samples, deadline, request_id, may_repeat=not texts)
        group = 1
        if served.frames is not None and not steps:
            group = await self._group(served.frames, str(scored[0].model_version), deadline)
        return _answer(batch.samples, scored, group)

    async def _results(
        self, samples: Sequence[Sample], deadline: Deadline, request_id: str, *, may_repeat: bool
    ) -> list[Result]:
        """The results of all samples, of one version.

        may_repeat: they can be sent as they are to another version: none has embeddings that the server made
        """
        outcomes = await of_one_version(
            lambda: self._client.evaluate(
                samples, return_errors=True, timeout_s=deadline.remaining_s(), request_id=request_id
            ),
            may_repeat=may_repeat,
        )
        failed = {index: outcome for index, outcome in enumerate(outcomes) if isinstance(outcome, RewardError)}
        unfit = {i: error for i, error in failed.items() if isinstance(error, InvalidSampleError)}
        if unfit:
            raise refused(unfit)
        for error in failed.values():
            raise error
        return [outcome for outcome in outcomes if not isinstance(outcome, RewardError)]  # all of them

    async def _group(self, info: ModelInfo, version: str, deadline: Deadline) -> int:
        """How many frames share a value of the version that answered.

        ``info`` may be of another one. While a checkpoint is replaced, one configuration names both versions; what an
        earlier one said of a version alone holds.
        """
        known = self._frames_per_value
        if info.versions not in ((), (version,)) and version not in known:
            info = await self._client.model_info(frames=True, refresh=True, timeout_s=deadline.remaining_s())
        if len(info.versions) == 1:
            known[info.versions[0]] = info.frames_per_value
        if version not in known and info.versions and version not in info.versions:
            check_one({version, *info.versions})
        return known.get(version, info.frames_per_value)

    async def _served(self, samples: Sequence[schema.Sample], deadline: Deadline) -> Served:
        """The models that may score the samples.

        It reads the model for frames only if a sample may need it: the client does not remember that a model is not
        served, and would send a request every time.
        """
        trajectories = [t for sample in samples for t in sample.named_trajectories.values()]
        needs_embeddings = any(has_embeddings(trajectory) for trajectory in trajectories)
        embeddings = await self._model_info(deadline, frames=False) if needs_embeddings else None
        has_frames = any(trajectory.frames is not None for trajectory in trajectories)
        needs_frames = has_frames and not (embeddings is not None and all(map(has_embeddings, trajectories)))
        frames = await self._model_info(deadline, frames=True) if needs_frames else None
        if embeddings is None and frames is None:  # is the other one served, or none at all?
            await self._client.model_info(frames=not needs_frames, timeout_s=deadline.remaining_s())
        return Served(embeddings, frames)

    async def _model_info(self, deadline: Deadline, *, frames: bool) -> ModelInfo | None:
        try:
            return await self._client.model_info(frames=frames, timeout_s=deadline.remaining_s())
        except ModelNotFoundError:
            return None

    async def _texts(
        self, samples: Sequence[schema.Sample], served: Served, deadline: Deadline, request_id: str
    ) -> Texts:
        """Embeddings of the tasks that come without one, by task; empty if there is no encoder."""
        tasks = {
            first.task
            for first, *_ in (tuple(sample.named_trajectories.values()) for sample in samples)
            if has_embeddings(first) and first.text_embedding is None and first.task and first.task.strip()
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
        except InvalidSampleError as error:  # of one task; the others' samples have errors of their own
            return error
        assert encoded.text_embedding is not None
        return encoded.text_embedding


def _answer(samples: Sequence[schema.Sample], results: Sequence[Result], group: int) -> schema.EvaluateBatchAnswer:
    """The evaluation server's answer for these results.

    group: number of frames that share a value; the evaluation server gave one value a group
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
        references = [sample.ref_trajectory for sample, _ in similar if isinstance(sample, schema.SimilaritySample)]
        answer.outputs_similarity = schema.SimilarityOutputs.model_construct(
            sim_score_ref_sim=[result.similarity for _, result in similar],
            task=[reference.task for reference in references],
            data_source=[reference.data_source for reference in references],
            data_gen_strategy=[getattr(sample, "data_gen_strategy", None) for sample, _ in similar],
            metadata=[{} if reference.metadata is None else reference.metadata for reference in references],
        )
    return answer
