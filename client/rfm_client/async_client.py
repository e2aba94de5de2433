# SPDX-License-Identifier: MIT
"""AsyncRewardClient: rewards from served reward models, for asyncio. RewardClient runs this one in a thread."""

from __future__ import annotations

import asyncio
import itertools
import secrets
from collections.abc import Coroutine, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Literal, TypedDict, cast, overload

from rfm_client.batching import groups, model_of, padded_bytes, parts
from rfm_client.contract import wire
from rfm_client.contract.errors import (
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    RewardError,
)
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.names import DEFAULT_MODEL, encoder_name, frames_name
from rfm_client.contract.results import PreferenceResult, ProgressResult, Result, SimilarityResult
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory
from rfm_client.data.fitting import FittedSample, fitted, whole, with_frame_indices
from rfm_client.transport.access import Access, AccessOptions
from rfm_client.transport.calls import Answer, Transport, connect
from rfm_client.transport.deadline import Deadline, check_timeout
from rfm_client.transport.host_names import of_urls
from rfm_client.transport.in_flight import InFlight
from rfm_client.transport.off_loop import off_loop
from rfm_client.transport.server import PROBE_TIMEOUT_S
from rfm_client.transport.servers import Servers

if TYPE_CHECKING:
    from typing_extensions import Unpack

DEFAULT_TIMEOUT_S = 60.0
DEFAULT_IN_FLIGHT = 128  # twice the usual batch: while one is scored, the next one gathers
READY_POLL_S = 0.2
_ID_BYTES = 8  # of chance in the ids of a call's requests

_SCORES = (wire.PROGRESS, wire.SUCCESS, wire.PREFERENCE, wire.SIMILARITY)


class ClientOptions(AccessOptions, total=False):
    """How a client works.

    model: name under which the checkpoint was exported (``rfm``); raw frames go to ``<model>_frames``
    timeout_s: the longest that a call may take, retries included, at most 1e9; there is no endless wait (60)
    retry: send again what failed because a server was down, restarting or full, until the time is up (True)
    max_in_flight: requests under way at a time (128); more wait their turn
    shared_memory: large inputs go through memory that client and server map, if both are on one host (False)
    ca_file, client_certificate, client_key, headers, api_key: as Access has them
    """

    model: str
    timeout_s: float
    retry: bool
    max_in_flight: int
    shared_memory: bool


class CallOptions(TypedDict, total=False):
    """How one call is made.

    timeout_s: the longest that it may take, instead of the client's
    logits: with the raw scores of the progress bins, which only discrete checkpoints have
    timing: with the server's time for the batch
    subsample: of a trajectory longer than the checkpoint was trained on (``ModelInfo.max_frames``) so many frames are
        scored, evenly from the first to the last; the result's ``frame_indices`` names them (None: all)
    resize: frames are made as small as the checkpoint reads them before they are sent (needs Pillow); ReWiND's scores
        differ slightly from those of the frames as they are
    request_id: with which the ids of the call's requests begin, in errors and in the server's log (None: a random one)
    """

    timeout_s: float | None
    logits: bool
    timing: bool
    subsample: bool
    resize: bool
    request_id: str | None


@dataclass(frozen=True)
class _Call:
    """What the requests of one call share. request_ids: one for each"""

    deadline: Deadline
    outputs: Sequence[str]
    request_ids: Iterator[str]


class AsyncRewardClient:
    """A connection to one or several servers of the same checkpoint, for one event loop.

    Arrays of samples must not change while a call is awaited: they are sent as they are when it is their turn.

    urls: ``grpc://host:8001`` or ``http://host:8000``, with TLS ``grpcs://`` or ``https://``, one or several. The
        server with the fewest requests under way gets the next one. A server that fails is left out until it is
        ready again.
    transports: instead of connections to ``urls``, for tests and unusual networks
    """

    def __init__(
        self,
        urls: str | Iterable[str],
        *,
        transports: Sequence[Transport] | None = None,
        **options: Unpack[ClientOptions],
    ) -> None:
        _check_known(options, ClientOptions)
        urls = [urls] if isinstance(urls, str) else urls
        shared_memory = options.get("shared_memory", False)
        access = Access.of(options)
        fixed, names = of_urls([] if transports else urls, partial(connect, shared_memory=shared_memory, access=access))
        self._model = options.get("model", DEFAULT_MODEL)
        self._timeout_s = options.get("timeout_s", DEFAULT_TIMEOUT_S)
        check_timeout(self._timeout_s)
        self._servers = Servers(transports or fixed, retry=options.get("retry", True), names=names)
        self._in_flight = InFlight(options.get("max_in_flight", DEFAULT_IN_FLIGHT))
        self._model_infos: dict[str, ModelInfo] = {}
        self._is_closed = False

    async def progress(
        self, trajectory: Trajectory, *, frame_steps: int = 0, **options: Unpack[CallOptions]
    ) -> ProgressResult:
        """Progress and success at each frame; ``frame_steps`` as in ProgressSample. Raises RewardError."""
        return cast(ProgressResult, await self.score(ProgressSample(trajectory, frame_steps=frame_steps), **options))

    async def preference(
        self, first: Trajectory, second: Trajectory, **options: Unpack[CallOptions]
    ) -> PreferenceResult:
        """Probability that ``first`` does its task better than ``second``. Raises RewardError."""
        return cast(PreferenceResult, await self.score(PreferenceSample(first, second), **options))

    async def similarity(
        self, reference: Trajectory, other: Trajectory, **options: Unpack[CallOptions]
    ) -> SimilarityResult:
        """Raw similarity score of ``other`` to ``reference``. Raises RewardError."""
        return cast(SimilarityResult, await self.score(SimilaritySample(reference, other), **options))

    async def score(self, sample: Sample, **options: Unpack[CallOptions]) -> Result:
        """The result of one sample of any type. Raises RewardError."""
        return (await self.evaluate([sample], **options))[0]

    @overload
    async def evaluate(
        self, samples: Iterable[Sample], *, return_errors: Literal[False] = False, **options: Unpack[CallOptions]
    ) -> list[Result]: ...
    @overload
    async def evaluate(
        self, samples: Iterable[Sample], *, return_errors: bool, **options: Unpack[CallOptions]
    ) -> list[Result | RewardError]: ...
    async def evaluate(
        self, samples: Iterable[Sample], *, return_errors: bool = False, **options: Unpack[CallOptions]
    ) -> list[Result] | list[Result | RewardError]:
        """The results of any number and mix of samples, in order.

        return_errors: a sample that fails gives its error in its place and the others their results; otherwise the
            first error is raised, as ``samples[3].num_frames: expected X, got Y``
        """
        samples = list(samples)
        outcomes = await self._outcomes(samples, options)
        if return_errors:
            return outcomes
        for index, outcome in enumerate(outcomes):
            if isinstance(outcome, InvalidSampleError) and len(samples) > 1:
                raise outcome.inside(f"samples[{index}]") from outcome
            if isinstance(outcome, RewardError):
                raise outcome
        return cast("list[Result]", outcomes)

    async def encode(
        self, trajectory: Trajectory, *, timeout_s: float | None = None, request_id: str | None = None
    ) -> Trajectory:
        """The trajectory with embeddings of its frames and its task in place of the frames, for a checkpoint that is
        served with encoders. A trajectory that is scored often is then encoded once. Raises RewardError.
        """
        if trajectory.frames is None:
            raise InvalidSampleError.at("trajectory", "frames", "video_embeddings")
        tensors = await off_loop(trajectory.frames.nbytes, wire.encode_frames, trajectory)
        outputs = (wire.VIDEO_EMBEDDINGS, wire.TEXT_EMBEDDING)
        deadline, name = self._deadline(timeout_s), next(_request_ids(request_id))
        async with self._in_flight.room(trajectory.frames.nbytes, deadline):
            answer = await self._servers.infer(encoder_name(self._model), tensors, outputs, deadline, request_id=name)
        return wire.decode_embeddings(answer.tensors, trajectory)

    async def is_ready(self, *, timeout_s: float | None = None) -> bool:
        """Whether a server answers and has the model ready, for embeddings or for raw frames."""
        left_s = self._deadline(timeout_s).remaining_s()
        return await self._servers.is_ready((self._model, frames_name(self._model)), left_s)

    async def wait_ready(self, timeout_s: float) -> None:
        """Returns as soon as ``is_ready``. Raises DeadlineExceededError."""
        deadline = self._deadline(timeout_s)
        while not await self.is_ready(timeout_s=min(PROBE_TIMEOUT_S, deadline.remaining_s())):
            if deadline.ends_within(READY_POLL_S):
                names = f"{self._model} and {frames_name(self._model)}"
                raise DeadlineExceededError(f"{self._servers}: {names}: not ready within {timeout_s:g} s")
            await asyncio.sleep(READY_POLL_S)

    async def model_info(
        self, *, frames: bool = False, refresh: bool = False, timeout_s: float | None = None
    ) -> ModelInfo:
        """What the server says of its model for embeddings or, with ``frames``, for raw frames.

        refresh: request it even if it is known. It is forgotten when another version of the model answers.

        Raises ModelNotFoundError if it is not served.
        """
        name = frames_name(self._model) if frames else self._model
        return await self._model_info(name, self._deadline(timeout_s), refresh=refresh)

    async def close(self) -> None:
        """Closes the connections and gives shared memory back."""
        self._is_closed = True
        await self._servers.close()

    async def __aenter__(self) -> AsyncRewardClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    async def _outcomes(self, samples: Sequence[Sample], options: CallOptions) -> list[Result | RewardError]:
        _check_known(options, CallOptions)
        call = _Call(
            self._deadline(options.get("timeout_s")), _outputs(options), _request_ids(options.get("request_id"))
        )
        deadline = call.deadline
        fits, outcomes = await self._fitted(samples, options, deadline)
        sent = {index: fit.sample for index, fit in fits.items()}

        async def request_group(model: str, group: Sequence[int]) -> None:
            try:
                limit = (await self._model_info(model, deadline)).max_batch_size if len(group) > 1 else 1
            except RewardError as error:
                outcomes.update(zip(group, _for_each(error, len(group)), strict=True))
                return
            await _together([request_part(model, part) for part in parts(sent, group, limit)])

        async def request_part(model: str, part: Sequence[int]) -> None:
            answers = await self._request(model, [sent[index] for index in part], call)
            for index, answer in zip(part, answers, strict=True):
                outcomes[index] = (
                    answer if isinstance(answer, RewardError) else with_frame_indices(answer, fits[index].frame_indices)
                )

        await _together([request_group(model, group) for model, group in groups(sent, self._model)])
        return [outcomes[index] for index in range(len(samples))]

    async def _fitted(
        self, samples: Sequence[Sample], options: CallOptions, deadline: Deadline
    ) -> tuple[dict[int, FittedSample], dict[int, Result | RewardError]]:
        """The samples as they are sent, and the errors of those that cannot be sent, by index."""
        subsample, resize = options.get("subsample", False), options.get("resize", False)
        fits: dict[int, FittedSample] = {}
        failed: dict[int, Result | RewardError] = {}
        for index, sample in enumerate(samples):
            try:
                fits[index] = whole(sample)
                if subsample or resize:
                    deadline.remaining_s()
                    info = await self._model_info(model_of(sample, self._model), deadline)
                    # in a thread: resizing takes a while, and other calls wait for this event loop
                    fits[index] = await asyncio.to_thread(fitted, sample, info, subsample=subsample, resize=resize)
            except RewardError as error:
                fits.pop(index, None)
                failed[index] = error
        return fits, failed

    async def _request(self, model: str, samples: Sequence[Sample], call: _Call) -> Sequence[Result | RewardError]:
        """One request. It fails whole if one sample cannot be scored; then each sample is sent alone.

        A request that is refused because it has ended its process is not taken apart: all its samples fail.
        """
        request_id = next(call.request_ids)
        try:
            answer = await self._infer(model, samples, call, request_id)
            return wire.decode_results(answer.tensors, samples, answer.model_version)
        except (InvalidSampleError, InferenceFailedError) as error:
            error.request_id = request_id
            if len(samples) == 1:
                return [error]
            if isinstance(error, InvalidSampleError) and error.is_deadly:
                return _for_each(error, len(samples))  # alone, the one that is would end two more processes
        except RewardError as error:
            return _for_each(error, len(samples))
        alone = await asyncio.gather(*(self._request(model, [sample], call) for sample in samples))
        return [outcome for (outcome,) in alone]

    async def _infer(self, model: str, samples: Sequence[Sample], call: _Call, request_id: str) -> Answer:
        num_bytes = padded_bytes(samples)
        async with self._in_flight.room(
            num_bytes, call.deadline
        ):  # arrays are made in turn, so that they do not pile up
            tensors = await off_loop(num_bytes, wire.encode_samples, samples)
            answer = await self._servers.infer(model, tensors, call.outputs, call.deadline, request_id=request_id)
        known = self._model_infos.get(model)
        if known is not None and known.versions and answer.model_version not in known.versions:
            del self._model_infos[model]
        return answer

    def _deadline(self, timeout_s: float | None) -> Deadline:
        """Deadline of a call which begins now; timeout_s: None: the client's."""
        if self._is_closed:
            raise RuntimeError("this AsyncRewardClient is closed")
        return Deadline(self._timeout_s if timeout_s is None else timeout_s)

    async def _model_info(self, model: str, deadline: Deadline, *, refresh: bool = False) -> ModelInfo:
        if refresh or model not in self._model_infos:
            try:
                self._model_infos[model] = await self._servers.model_info(model, deadline)
            except ModelNotFoundError:
                self._model_infos.pop(model, None)
                raise
        return self._model_infos[model]


async def _together(calls: Sequence[Coroutine[None, None, None]]) -> None:
    """Awaits all coroutines. A single one, as in most calls, needs no task of its own."""
    if len(calls) == 1:
        await calls[0]
    else:
        await asyncio.gather(*calls)


def _for_each(error: RewardError, count: int) -> list[Result | RewardError]:
    """One error of its own for each sample that shares the failure; they may be raised apart."""
    copies: list[Result | RewardError] = []
    for _ in range(count):
        one = copy(error)
        one.__cause__ = error
        copies.append(one)
    return copies


def _check_known(options: Mapping[str, object], known: type[ClientOptions] | type[CallOptions]) -> None:
    """Raises TypeError for an unknown option, which would otherwise be ignored in silence."""
    unknown = sorted(options.keys() - known.__annotations__)
    if unknown:
        raise TypeError(f"options: expected some of {', '.join(known.__annotations__)}, got {', '.join(unknown)}")


def _request_ids(prefix: str | None) -> Iterator[str]:
    """Request ids of one call, which begin alike. Raises ValueError for a prefix that is not allowed."""
    if prefix is not None and not wire.REQUEST_ID.fullmatch(prefix):
        raise ValueError(f"request_id: expected 1 to 64 letters, digits or any of ._:/+=@-, got {prefix!r}")
    prefix = prefix or secrets.token_hex(_ID_BYTES)
    return (f"{prefix}-{number}" for number in itertools.count(1))


def _outputs(options: CallOptions) -> tuple[str, ...]:
    optional = {wire.PROGRESS_LOGITS: options.get("logits", False), wire.TIMING_MS: options.get("timing", False)}
    return (*_SCORES, *(name for name, wanted in optional.items() if wanted))
