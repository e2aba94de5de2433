# SPDX-License-Identifier: MIT
"""AsyncRewardClient: rewards from served reward models, for asyncio. RewardClient runs this one in a thread."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, overload

from rfm_client.contract.errors import DeadlineExceededError, InvalidSampleError, ModelNotFoundError, RewardError
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
DEFAULT_IN_FLIGHT = 128  # twice the usual batch: while one is scored, the next one gathers
READY_POLL_S = 0.2


class AsyncRewardClient(AsyncClosing, OneProcess):
    """A connection to one or several servers of the same checkpoint, for one event loop.

    Arrays of samples must not change while a call is awaited: they are sent as they are when it is their turn.

    urls: ``grpc://host:8001`` or ``http://host:8000``, with TLS ``grpcs://`` or ``https://``, one or several. The
        server with the fewest requests under way gets the next one. A server that fails is left out until it is
        ready again.
    model: name under which the checkpoint was exported; raw frames go to ``<model>_frames``
    timeout_s: the longest that a call may take, retries included, at most 1e9; there is no endless wait
    retry: send again what failed because a server was down, restarting or full, until the time is up
    max_in_flight: requests under way at a time; more wait their turn
    shared_memory: large inputs go through memory that client and server map, if both are on one host
    ca_file, client_certificate, client_key, headers, api_key: as Credentials has them
    transports: instead of connections to ``urls``, for tests and unusual networks
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
        self._windows = WindowScorer(model, self._scorer)
        self._is_closed = False
        self._loop: asyncio.AbstractEventLoop | None = None  # that it was first used in

    async def progress(
        self, trajectory: Trajectory, *, frame_steps: int = 0, **options: Unpack[CallOptions]
    ) -> ProgressResult:
        """Progress and success at each frame; ``frame_steps`` as in ProgressSample. Raises RewardError."""
        return cast(ProgressResult, await self.score(ProgressSample(trajectory, frame_steps=frame_steps), **options))

    async def preference(
        self, first: Trajectory, second: Trajectory, *, both_orders: bool = False, **options: Unpack[CallOptions]
    ) -> PreferenceResult:
        """Probability that ``first`` does its task better than ``second``. Raises RewardError.

        both_orders: the other order is asked, too, since a model's answer may depend on it; the ``preference`` is the
            mean, and where the orders disagree there is no ``verdict``. For labels, ask so.
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
        """Raw similarity score of ``other`` to ``reference``. Raises RewardError."""
        return cast(SimilarityResult, await self.score(SimilaritySample(reference, other), **options))

    async def score(self, sample: Sample, **options: Unpack[CallOptions]) -> Result:
        """The result of one sample of any type. Raises RewardError."""
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
        """The results of any number and mix of samples, in order.

        return_errors: a sample that fails gives its error in its place and the others their results; otherwise the
            first error is raised, as ``samples[3].num_frames: expected X, got Y``
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
        """An episode that is scored step by step: each step sends its new frame alone, if the server keeps features.

        options: as of EpisodeOptions; ValueError for contradictory ones
        timeout_s: the longest that a step may take; None: the client's
        """
        return AsyncEpisode(self, task, EpisodeOptions(**options), timeout_s)

    def episodes(
        self, num: int, task: str | Sequence[str], *, timeout_s: float | None = None, **options: Unpack[EpisodeSettings]
    ) -> AsyncEpisodes:
        """Episodes side by side, as those of vectorised environments: as few requests a step as fit.

        task: of all, or of each
        others: as of ``episode``
        """
        tasks = [task] * num if isinstance(task, str) else list(task)
        if len(tasks) != num:
            raise ValueError(f"task: expected one for each of {num} episodes, got {len(tasks)}")
        return AsyncEpisodes(self, tasks, EpisodeOptions(**options), timeout_s)

    async def score_windows(
        self, windows: Sequence[Window], *, timeout_s: float | None = None
    ) -> list[Result | RewardError]:
        """The result or error of each window, a progress question about frames that the server may know."""
        return await self._windows.outcomes(windows, self._call({"timeout_s": timeout_s}))

    async def score_window(self, window: Window) -> ProgressResult:
        """The result of a window. Raises RewardError."""
        (outcome,) = await self.score_windows([window])
        if isinstance(outcome, RewardError):
            raise outcome
        return cast(ProgressResult, outcome)

    async def encode(
        self, trajectory: Trajectory, *, timeout_s: float | None = None, request_id: str | None = None
    ) -> Trajectory:
        """The trajectory with embeddings of its frames and its task in place of the frames, for a checkpoint that is
        served with encoders. A trajectory that is scored often is then encoded once. Raises RewardError.
        """
        return await self._scorer.embeddings(trajectory, self._call({"timeout_s": timeout_s, "request_id": request_id}))

    async def is_ready(self, *, timeout_s: float | None = None) -> bool:
        """Whether a server answers and has the model ready, for embeddings or for raw frames."""
        left_s = self._deadline(timeout_s).remaining_s()
        return await self._servers.is_ready((self._model, frames_name(self._model)), left_s)

    async def wait_ready(self, timeout_s: float) -> None:
        """Returns as soon as ``is_ready``. Raises DeadlineExceededError."""
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
        """What the server says of its model for embeddings or, with ``frames``, for raw frames.

        refresh: request it even if it is known. It is forgotten when another version of the model answers.

        Raises ModelNotFoundError if it is not served.
        """
        name = frames_name(self._model) if frames else self._model
        return await self._scorer.model_info(name, self._deadline(timeout_s), refresh=refresh)

    async def model_infos(self, *, timeout_s: float | None = None) -> dict[Part, list[ModelInfo]]:
        """What every server that answers says now of the checkpoint's models, as far as it serves them: the one for
        embeddings, the encoder, the one for raw frames. Raises RewardError if no server answers.
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
        """Has calls that fail from now on fail at once, as ``close`` does first."""
        self._servers.stop_retrying()

    async def close(self) -> None:
        """Closes the connections and gives shared memory back."""
        self._is_closed = True
        await self._servers.close()

    async def _why_unready(self) -> str:
        try:
            await self._servers.model_info(frames_name(self._model), Deadline(PROBE_TIMEOUT_S))
        except ModelNotFoundError as error:
            return f": {error}"
        except RewardError:
            pass
        return ""

    def _call(self, options: CallOptions) -> Call:
        """The call that begins now, with these options. Raises TypeError for an unknown one."""
        others: dict[str, Any] = {**options}
        return Call(self._deadline(others.pop("timeout_s", None)), **others)

    def _deadline(self, timeout_s: float | None) -> Deadline:
        """Deadline of a call which begins now; timeout_s: None: the client's."""
        if self._is_closed:
            raise RuntimeError("this AsyncRewardClient is closed")
        loop = asyncio.get_running_loop()
        self._loop = self._loop or loop
        if self._loop is not loop:
            expected = "the event loop that it was first used in"
            raise RuntimeError(f"this AsyncRewardClient: expected {expected}, got another: make one in each loop")
        return Deadline(self._timeout_s if timeout_s is None else timeout_s)
