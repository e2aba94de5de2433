# SPDX-License-Identifier: MIT
"""AsyncRewardClient: asyncio client of served reward models, which RewardClient runs in a thread."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, overload

from rfm_client.contract.errors import (
    ClientClosedError,
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    InvalidValueError,
    ModelNotFoundError,
    RewardError,
)
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.names import DEFAULT_MODEL, Part, encoder_name, frames_name
from rfm_client.contract.results import PreferenceResult, ProgressResult, Result, SimilarityResult
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory
from rfm_client.episodes.episodes import AsyncEpisode, AsyncEpisodes
from rfm_client.episodes.steps import EpisodeOptions, EpisodeSettings
from rfm_client.episodes.windows import Window, WindowScorer
from rfm_client.scoring.call import Call, CallOptions
from rfm_client.scoring.samples import SampleScorer
from rfm_client.transport.calls import Transport, connect
from rfm_client.transport.concurrency import ConcurrencyLimiter
from rfm_client.transport.credentials import Credentials
from rfm_client.transport.deadline import Deadline, check_timeout
from rfm_client.transport.lifetime import AsyncClosing, OneProcess
from rfm_client.transport.servers import PROBE_TIMEOUT_S, Servers

if TYPE_CHECKING:
    from typing_extensions import Unpack

DEFAULT_TIMEOUT_S = 60.0
DEFAULT_IN_FLIGHT = 128  # twice the usual batch: the next gathers while a batch is scored
READY_POLL_S = 0.2


class AsyncRewardClient(AsyncClosing, OneProcess):
    """Client of one or several servers of the same checkpoint, for one event loop.

    The arrays of a sample must not change while its call is awaited: they are read when it is the request's turn.

    urls: one or several ``grpc://host:8001`` or ``http://host:8000``, with TLS ``grpcs://`` or ``https://``. The server
        with the fewest open requests gets the next; an episode stays on its server, which keeps features of its frames.
        A server that fails is left out until it is ready again
    model: name of the exported checkpoint; raw frames go to ``<model>_frames``
    timeout_s: longest time of a call, retries included; at most 1e9
    retry: True: until the time is up, retry requests that fail because a server is down, restarting or full
    max_in_flight: most open requests; further requests wait
    shared_memory: True: large inputs go through memory that client and server, on one host, both map
    ca_file, client_certificate, client_key, headers, api_key: as in Credentials
    transports: used in place of connections to ``urls``, for tests and unusual networks
    """

    def __init__(
        self,
        urls: str | Iterable[str],
        *,
        model: str = DEFAULT_MODEL,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        retry: bool = True,
        max_in_flight: int = DEFAULT_IN_FLIGHT,
        shared_memory: bool = False,
        ca_file: str | Path | None = None,
        client_certificate: str | Path | None = None,
        client_key: str | Path | None = None,
        headers: Mapping[str, str] | None = None,
        api_key: str | None = None,
        transports: Sequence[Transport] | None = None,
    ) -> None:
        check_timeout(timeout_s)
        credentials = Credentials(ca_file, client_certificate, client_key, headers or {}, api_key)
        if not transports:
            urls = [urls] if isinstance(urls, str) else urls
            transports = [connect(url, shared_memory=shared_memory, credentials=credentials) for url in urls]
        self._model = model
        self._timeout_s = timeout_s
        self._servers = Servers(transports, retry=retry)
        self._scorer = SampleScorer(model, self._servers, ConcurrencyLimiter(max_in_flight))
        self._windows = WindowScorer(model, self._scorer, len(self._servers))
        self._is_closed = False
        self._loop: asyncio.AbstractEventLoop | None = None  # of the first call

    async def progress(
        self, trajectory: Trajectory, *, frame_steps: int = 0, **options: Unpack[CallOptions]
    ) -> ProgressResult:
        """Return progress and success at each frame; ``frame_steps`` as in ProgressSample. Raises RewardError."""
        return cast(ProgressResult, await self.score(ProgressSample(trajectory, frame_steps=frame_steps), **options))

    async def preference(
        self, first: Trajectory, second: Trajectory, *, both_orders: bool = False, **options: Unpack[CallOptions]
    ) -> PreferenceResult:
        """Return the probability that ``first`` does its task better than ``second``. Raises RewardError.

        both_orders: True: ask the other order, too, since answers may depend on the order; ``preference`` is the mean,
            and if the orders disagree, ``verdict`` is None. Recommended for labels
        """
        sample = PreferenceSample(first, second)
        if not both_orders:
            return cast(PreferenceResult, await self.score(sample, **options))
        outcomes = await self.evaluate([sample, sample.swapped], return_errors=True, **options)
        for outcome in outcomes:
            if isinstance(outcome, RewardError):
                raise outcome
        asked, swapped = cast("list[PreferenceResult]", outcomes)
        return PreferenceResult.of_both_orders(asked, swapped)

    async def similarity(
        self, reference: Trajectory, other: Trajectory, **options: Unpack[CallOptions]
    ) -> SimilarityResult:
        """Return the raw similarity score of ``other`` to ``reference``. Raises RewardError."""
        return cast(SimilarityResult, await self.score(SimilaritySample(reference, other), **options))

    async def score(self, sample: Sample, **options: Unpack[CallOptions]) -> Result:
        """Return the result of one sample of any type. Raises RewardError."""
        return await self._scorer.result(sample, self._call(options))

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
        """Return the results of any number and mix of samples, in order.

        return_errors: True: the error of a failed sample stands in its result's place; False: raise the first error,
            as ``samples[3].num_frames: expected X, got Y``
        """
        samples = list(samples)
        outcomes = await self._scorer.outcomes(samples, self._call(options))
        if return_errors:
            return outcomes
        for index, outcome in enumerate(outcomes):
            if isinstance(outcome, InvalidSampleError) and len(samples) > 1:
                raise outcome.inside(f"samples[{index}]") from outcome
            if isinstance(outcome, RewardError):
                raise outcome
        return cast("list[Result]", outcomes)

    def episode(self, task: str, *, timeout_s: float | None = None, **options: Unpack[EpisodeSettings]) -> AsyncEpisode:
        """Return an episode to score step by step. A step sends only its new frame, if the server keeps features.

        timeout_s: longest time of a step; None: the client's
        options: fields of EpisodeOptions. Raises ValueError for contradictory options
        """
        return AsyncEpisode(self, task, EpisodeOptions(**options), timeout_s)

    def episodes(
        self, num: int, task: str | Sequence[str], *, timeout_s: float | None = None, **options: Unpack[EpisodeSettings]
    ) -> AsyncEpisodes:
        """Return ``num`` parallel episodes, as in vectorised environments. A step takes as few requests as possible.

        task: a sentence for all episodes, or a sentence for each
        timeout_s, options: as in ``episode``
        """
        tasks = [task] * num if isinstance(task, str) else list(task)
        if len(tasks) != num:
            raise InvalidValueError.at("task", f"one for each of {num} episodes", len(tasks))
        return AsyncEpisodes(self, tasks, EpisodeOptions(**options), timeout_s)

    async def score_windows(
        self, windows: Sequence[Window], *, timeout_s: float | None = None
    ) -> list[Result | RewardError]:
        """Return the progress result or error of each window. Only frames that the server lacks are sent."""
        return await self._windows.outcomes(windows, self._call({"timeout_s": timeout_s}))

    async def score_window(self, window: Window) -> ProgressResult:
        """Return the result of a window. Raises RewardError."""
        (outcome,) = await self.score_windows([window])
        if isinstance(outcome, RewardError):
            raise outcome
        return cast(ProgressResult, outcome)

    async def encode(
        self, trajectory: Trajectory, *, timeout_s: float | None = None, request_id: str | None = None
    ) -> Trajectory:
        """Return the trajectory with embeddings in place of frames, for repeated scoring. Raises RewardError.

        The checkpoint must be served with encoders.
        """
        return await self._scorer.embeddings(trajectory, self._call({"timeout_s": timeout_s, "request_id": request_id}))

    async def is_ready(self, *, timeout_s: float | None = None) -> bool:
        """True if a server answers and has the model ready, for embeddings or for raw frames."""
        left_s = self._deadline(timeout_s).remaining_s()
        return await self._servers.is_ready((self._model, frames_name(self._model)), left_s)

    async def wait_ready(self, timeout_s: float) -> None:
        """Return as soon as ``is_ready``. Raises DeadlineExceededError, or ServerUnavailableError for wrong ports."""
        deadline = self._deadline(timeout_s)
        await self._servers.check_ports()
        while not await self.is_ready(timeout_s=min(PROBE_TIMEOUT_S, deadline.remaining_s())):
            if deadline.ends_within(READY_POLL_S):
                names = f"{self._model} and {frames_name(self._model)}"
                why = await self._why_unready()
                raise DeadlineExceededError(f"{self._servers}: {names}: not ready within {timeout_s:g} s{why}")
            await asyncio.sleep(READY_POLL_S)

    async def model_info(
        self, *, frames: bool = False, refresh: bool = False, timeout_s: float | None = None
    ) -> ModelInfo:
        """Return the server's description of its model for embeddings or, with ``frames``, for raw frames.

        refresh: True: request it again; False: use the known description, until another version of the model answers

        Raises ModelNotFoundError if the model is not served.
        """
        name = frames_name(self._model) if frames else self._model
        return await self._scorer.model_info(name, self._deadline(timeout_s), refresh=refresh)

    async def model_infos(self, *, timeout_s: float | None = None) -> dict[Part, list[ModelInfo]]:
        """Return the descriptions of each served part of the checkpoint, by all servers that answer.

        Raises RewardError if no server answers.
        """
        deadline = self._deadline(timeout_s)
        names: dict[Part, str] = {
            "embeddings": self._model,
            "encoder": encoder_name(self._model),
            "frames": frames_name(self._model),
        }
        told: dict[Part, list[ModelInfo]] = {}
        for part, name in names.items():
            with suppress(ModelNotFoundError):
                told[part] = await self._servers.model_infos(name, deadline)
        return told

    def stop_retrying(self) -> None:
        """Make later failures end their calls at once, as ``close`` does first."""
        self._servers.stop_retrying()

    async def close(self) -> None:
        """Close the connections and release shared memory. Running calls raise ClientClosedError."""
        self._is_closed = True
        await self._servers.close()

    async def _why_unready(self) -> str:
        try:
            await self._servers.model_info(frames_name(self._model), Deadline(PROBE_TIMEOUT_S))
        except (ModelNotFoundError, InferenceFailedError) as error:
            return f": {error}"
        except RewardError:
            pass
        return ""

    def _call(self, options: CallOptions) -> Call:
        """A call that begins now. Raises TypeError for an unknown option."""
        others: dict[str, Any] = {**options}
        return Call(self._deadline(others.pop("timeout_s", None)), **others)

    def _deadline(self, timeout_s: float | None) -> Deadline:
        """Deadline of a call that begins now; timeout_s: None: the client's."""
        if self._is_closed:
            raise ClientClosedError("this AsyncRewardClient is closed")
        loop = asyncio.get_running_loop()
        self._loop = self._loop or loop
        if self._loop is not loop:
            expected = "the event loop that it was first used in"
            raise RuntimeError(f"this AsyncRewardClient: expected {expected}, got another: make one in each loop")
        return Deadline(self._timeout_s if timeout_s is None else timeout_s)
