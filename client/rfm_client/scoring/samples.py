# SPDX-License-Identifier: MIT
"""Score samples: call options and deadline, requests, and an outcome for every sample."""

from __future__ import annotations

import asyncio
import itertools
import logging
import secrets
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from copy import copy
from functools import partial
from typing import TypeAlias, TypedDict, cast

from rfm_client.contract import wire
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import (
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    InvalidValueError,
    ModelNotFoundError,
    RewardError,
    ServerUnavailableError,
)
from rfm_client.contract.results import Result
from rfm_client.contract.samples import ProgressSample, Sample, Trajectory, UInt8Array
from rfm_client.contract.wire import encoder_name
from rfm_client.frames.blank_frames import BlankFrames, is_blank
from rfm_client.frames.fit_to_checkpoint import FittedSample, fitted, whole, with_frame_indices
from rfm_client.scoring.batching import groups, model_of, padded_bytes, parts
from rfm_client.transport.calls import Answer
from rfm_client.transport.limits import ConcurrencyLimiter, Deadline
from rfm_client.transport.servers import KnownServer, Servers
from rfm_client.transport.threads import off_loop

_ID_BYTES = 8  # random bytes in a call's request ids


class CallOptions(TypedDict, total=False):
    """Options for every call.

    timeout_s: time limit; None: the client's
    logits: True: add the raw scores for the progress bins (checkpoints with bins only)
    timing: True: add the server's time for the batch
    subsample: True: score at most ``ModelInfo.max_frames`` frames, evenly spaced from first to last, as in training;
        ``frame_indices`` in the result lists them
    resize: True: shrink frames to the checkpoint's size before sending (needs Pillow); ReWiND's scores then differ
        slightly
    request_id: prefix for request ids in errors and in the server's log; None: random
    """

    timeout_s: float | None
    logits: bool
    timing: bool
    subsample: bool
    resize: bool
    request_id: str | None


class Call:
    """Values shared by all requests in one call.

    Raises ValueError for an invalid request id, TypeError for an unknown option.

    outputs: names of outputs to request
    request_ids: yields an id for each request
    server: index of the server to ask first; None: the least busy
    checks_blank: True: warn about videos that show nothing
    answered_by: for each answer, the description of the checkpoint that gave it; None: unknown
    """

    server: int | None = None
    checks_blank = True

    def __init__(self, deadline: Deadline, options: CallOptions) -> None:
        if unknown := options.keys() - CallOptions.__annotations__.keys():
            raise TypeError(
                f"expected options among {', '.join(CallOptions.__annotations__)}, got {', '.join(unknown)}"
            )
        request_id = options.get("request_id")
        if request_id is not None and not wire.REQUEST_ID.fullmatch(request_id):
            raise InvalidValueError.at("request_id", "1 to 64 letters, digits or any of ._:/+=@-", repr(request_id))
        prefix = request_id or secrets.token_hex(_ID_BYTES)
        self.deadline = deadline
        self.request_ids = (f"{prefix}-{number}" for number in itertools.count(1))
        outputs = {wire.PROGRESS_LOGITS: "logits", wire.TIMING_MS: "timing"}
        self.answered_by: list[ModelInfo | None] = []
        self.outputs = tuple(output for output, option in outputs.items() if options.get(option))
        self.subsample, self.resize = options.get("subsample", False), options.get("resize", False)

    def at(self, server: int) -> Call:
        """Return a copy of the call that asks this server first."""
        call = copy(self)
        call.server = server
        return call


Outcome: TypeAlias = Result | RewardError

logger = logging.getLogger("rfm_client")

_PROBED_FRAMES = 8
_EMBEDDINGS = (wire.VIDEO_EMBEDDINGS, wire.TEXT_EMBEDDING)


class SampleScorer:
    """Scores samples on a client's servers, in one event loop.

    model: name of the model for embeddings
    """

    def __init__(self, model: str, servers: Servers, concurrency: ConcurrencyLimiter) -> None:
        self._model = model
        self._servers = servers
        self._concurrency = concurrency
        self._infos: dict[str, ModelInfo] = {}  # the newest of any server
        self.changes: list[str] = []  # what each change of the checkpoint was; empty with several servers
        self._undescribed: set[str] = set()  # not asked about embeddings again, which they score without a description
        self._checks_lengths = True  # until a trajectory was too long
        self._checks_blank = True  # until a video was blank

    async def outcomes(self, samples: Sequence[Sample], call: Call) -> list[Outcome]:
        """Return a result or error for each sample. Errors carry no traceback, which would keep arrays alive."""
        fits: dict[int, FittedSample] = {}
        outcomes: dict[int, Outcome] = {}
        for index, sample in enumerate(samples):
            try:
                fits[index] = await self._fitted(sample, call)
            except RewardError as error:
                outcomes[index] = error.with_traceback(None)
        sent = {index: fit.sample for index, fit in fits.items()}
        calls = [self._scored(*group, sent, call) for group in groups(sent, self._model)]
        scored = [await calls[0]] if len(calls) == 1 else await asyncio.gather(*calls)  # one needs no task
        for index, outcome in itertools.chain(*scored):
            indices = fits[index].frame_indices
            outcomes[index] = outcome if isinstance(outcome, RewardError) else with_frame_indices(outcome, indices)
        answered = [sample for index, sample in sent.items() if not isinstance(outcomes[index], RewardError)]
        self._check_lengths(answered)
        return [outcomes[index] for index in range(len(samples))]

    async def embeddings(self, trajectory: Trajectory, call: Call) -> Trajectory:
        """Return the trajectory with embeddings instead of frames. Raises RewardError."""
        if trajectory.frames is None:
            raise InvalidSampleError.at("trajectory", "frames", "video_embeddings")
        tensors, model = partial(wire.encode_frames, trajectory), encoder_name(self._model)
        size, request_id = trajectory.frames.nbytes, next(call.request_ids)
        answer = await self.infer(model, size, tensors, _EMBEDDINGS, call, request_id)
        return wire.decode_embeddings(answer.tensors, trajectory)

    async def model_info(self, model: str, deadline: Deadline, *, refresh: bool = False) -> ModelInfo:
        """Return the server's description of ``model``, from memory unless ``refresh``. Raises RewardError."""
        if refresh or model not in self._infos:
            try:
                self._remember(model, *await self._servers.model_info(model, deadline))
            except ModelNotFoundError:
                self._infos.pop(model, None)
                raise
        return self._infos[model]

    async def model_infos(self, model: str, deadline: Deadline) -> list[ModelInfo]:
        """Return each server's description of ``model``, and remember the first. Raises RewardError."""
        try:
            infos = await self._servers.model_infos(model, deadline)
        except ModelNotFoundError:
            self._infos.pop(model, None)
            raise
        for info, server in reversed(infos):
            self._remember(model, info, server)
        return [info for info, _ in infos]

    def tell_of_length(self, num_frames: int, info: ModelInfo) -> None:
        """Log the first trajectory that has more frames than in training. Its scores are unreliable."""
        limit = info.max_frames
        if not self._checks_lengths or limit is None or num_frames <= limit or info.needs_whole_episode:
            return
        self._checks_lengths = False
        remedy = f"score {limit} of them (subsample), or each frame on at most {limit} (frame_steps or sampling)"
        expected = "trajectory: expected at most %d frames, as in the training of %s, got %d: %s (logged once)"
        logger.warning(expected, limit, info.source or info.name, num_frames, remedy)

    def tell_of_blank(self, frames: Sequence[UInt8Array] | UInt8Array) -> None:
        """Log the first video that shows nothing. Its scores mean nothing."""
        few = frames[:: max(len(frames) // _PROBED_FRAMES, 1)]  # if only the start is black, not all frames are read
        if self._checks_blank and len(frames) > 1 and all(map(is_blank, few)) and all(map(is_blank, frames)):
            self._checks_blank = False
            expected = "frames: expected pictures that show something, got %d frames: %s (logged once)"
            logger.warning(expected, len(frames), BlankFrames(frames).told)

    def _check_lengths(self, samples: Iterable[Sample]) -> None:
        """Log the first sample that is too long, if its model is described."""
        for sample in samples if self._checks_lengths else ():
            info = self._infos.get(model_of(sample, self._model))
            if info is not None:
                self.tell_of_length(_longest(sample), info)

    async def _fitted(self, sample: Sample, call: Call) -> FittedSample:
        """Return the sample as the call sends it. Raises RewardError."""
        fit = whole(sample)
        for trajectory in fit.sample.trajectories if self._checks_blank and call.checks_blank else ():
            if trajectory.frames is not None:
                self.tell_of_blank(trajectory.frames)
        if not (call.subsample or call.resize):
            return fit
        call.deadline.remaining_s()
        info = await self.model_info(model_of(sample, self._model), call.deadline)
        max_frames, frame_size = info.max_frames if call.subsample else None, info.frame_size if call.resize else None
        # in a thread, because resizing would block the event loop
        return await asyncio.to_thread(fitted, sample, max_frames, frame_size)

    async def _scored(
        self, model: str, group: Sequence[int], samples: Mapping[int, Sample], call: Call
    ) -> Iterable[tuple[int, Outcome]]:
        """Return indices and outcomes for samples that share arrays."""
        if len(group) == 1:
            return zip(group, await self._request(model, [samples[group[0]]], call), strict=True)
        try:
            limit = (await self.model_info(model, call.deadline)).max_batch_size
        except RewardError as error:
            return zip(group, for_each(error, len(group)), strict=True)
        requests = [[samples[index] for index in part] for part in parts(samples, group, limit)]
        answered = await asyncio.gather(*(self._request(model, request, call) for request in requests))
        return zip(group, itertools.chain(*answered), strict=True)

    async def _request(
        self, model: str, samples: Sequence[Sample], call: Call, *, asks_given: bool = True
    ) -> Sequence[Outcome]:
        """Send one request. If an invalid sample makes it fail, send every sample alone.

        asks_given: True: request the scores that only some models give, according to the model's description
        """
        request_id = next(call.request_ids)
        size, tensors = padded_bytes(samples), partial(wire.encode_samples, samples)
        asked: tuple[str, ...] = (*wire.outputs_for(samples), *call.outputs)
        more: list[str] = []
        try:
            given = await self._given(model, samples, call) if asks_given else ()
            more = [name for name in wire.outputs_for(samples, given) if name not in asked]
            answer = await self.infer(model, size, tensors, (*asked, *more), call, request_id)
            return wire.decode_results(answer.tensors, samples, answer.model_version)
        except (InvalidSampleError, InferenceFailedError) as error:
            error.request_id = request_id
            if isinstance(error, InvalidSampleError) and error.where in more:  # the server now has an older export
                self._infos.pop(model, None)
                return await self._request(model, samples, call, asks_given=False)
            if len(samples) == 1:
                return [error.with_traceback(None)]
        except RewardError as error:
            return for_each(error, len(samples))
        alone = await asyncio.gather(*(self._request(model, [sample], call) for sample in samples))
        return [outcome for (outcome,) in alone]

    async def _given(self, model: str, samples: Sequence[Sample], call: Call) -> tuple[str, ...]:
        """Return the names of all scores in the model's description. Raises RewardError."""
        is_needed = samples[0].trajectories[0].frames is not None
        if not is_needed and model in self._undescribed:
            return ()
        try:
            return (await self.model_info(model, call.deadline)).scores
        except RewardError as error:
            if is_needed and not isinstance(error, (ModelNotFoundError, InferenceFailedError)):
                raise
            if not isinstance(error, (DeadlineExceededError, ServerUnavailableError)):
                self._undescribed.add(model)
            return ()  # the request itself decides

    async def infer(
        self,
        model: str,
        num_bytes: int,
        tensors: Callable[[], wire.Tensors],
        outputs: Collection[str],
        call: Call,
        request_id: str,
    ) -> Answer:
        """Return the model's ``outputs``. Raises RewardError.

        tensors: makes the inputs, ``num_bytes`` large, when it is the request's turn
        """
        # Make tensors only in turn, so that they do not pile up.
        try:
            async with self._concurrency.room(num_bytes, call.deadline):
                inputs = await off_loop(num_bytes, tensors)
                answer, server = await self._servers.infer(
                    model, inputs, outputs, call.deadline, request_id=request_id, first=call.server
                )
        except RewardError as error:
            error.request_id = request_id
            raise
        if self._may_differ(model, answer, server) or server.describing.locked():
            async with server.describing:  # first tell of the change, then return the new checkpoint's answers
                if self._may_differ(model, answer, server):
                    await self._compare(model, server, call.deadline)
        call.answered_by.append(None if self._may_differ(model, answer, server) else server.infos.get(model))
        return answer

    def _may_differ(self, model: str, answer: Answer, server: KnownServer) -> bool:
        """True if the checkpoint that answered may be another than the described one."""
        known = server.infos.get(model)
        if known is None:
            return model in self._infos
        is_new = bool(known.versions) and answer.model_version not in known.versions
        return is_new or model not in server.described

    async def _compare(self, model: str, server: KnownServer, deadline: Deadline) -> None:
        """Have the server that answered describe the model. If it does not, its next answer asks again."""
        described = server.described
        try:
            info, _ = await self._servers.model_info(model, deadline, server)
        except RewardError as error:
            logger.warning("%s: cannot tell whether the checkpoint is the same as before: %s", model, error)
            return
        self._remember(model, info, server, described)

    def _remember(self, model: str, info: ModelInfo, server: KnownServer, described: set[str] | None = None) -> None:
        """Remember a server's description. If its checkpoint changed, log it and forget the other models'.

        described: the server's set at the time of the question; None: its set by now
        """
        before = server.infos.get(model) or self._infos.get(model) or info
        server.infos[model] = self._infos[model] = info
        (server.described if described is None else described).add(model)
        if info.weights_digest != before.weights_digest:
            server.infos, self._infos = {model: info}, {model: info}
            told = [f"{each.source or each.name} (weights {each.weights_digest})" for each in (info, before)]
            change = "another checkpoint, {} instead of {}".format(*told)
            logger.warning("%s: served by %s: scores do not mix", model, change)
            if len(self._servers) == 1:
                self.changes.append(change)


def _longest(sample: Sample) -> int:
    """Return the longest trajectory's frame count; 0 in dense mode, where the model sees only sampled prefixes."""
    if isinstance(sample, ProgressSample) and sample.frame_steps:
        return 0
    return max(trajectory.num_frames for trajectory in sample.trajectories)


def results_of(outcomes: list[Outcome], where: str = "") -> list[Result]:
    """Return the outcomes if all are results. Otherwise remove the first error from the list and raise it.

    where: name for a sample, such as ``samples[{}]``, used in the error for an invalid one; empty: there is only one
    """
    for index, outcome in enumerate(outcomes):
        if isinstance(outcome, RewardError):
            try:
                if where and isinstance(outcome, InvalidSampleError):
                    raise outcome.inside(where.format(index)) from outcome
                raise outcome
            finally:
                del outcomes[index], outcome  # an error held by its own traceback would stay in memory
    return cast("list[Result]", outcomes)


def for_each(error: RewardError, count: int) -> list[Outcome]:
    """Return ``count`` copies of the error, because callers may raise them separately."""
    copies: list[Outcome] = []
    error = error.with_traceback(None)
    for _ in range(count):
        one = copy(error)
        one.__cause__ = error
        copies.append(one)
    return copies
