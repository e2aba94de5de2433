# SPDX-License-Identifier: MIT
"""AsyncRewardClient: asyncio client for served reward models (RewardClient runs it in a thread); options for both."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast, overload

from rfm_client.contract.checks import require
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import (
    ClientClosedError,
    DeadlineExceededError,
    ModelNotFoundError,
    RewardError,
    ServerUnavailableError,
)
from rfm_client.contract.results import PreferenceResult, ProgressResult, Result, SimilarityResult
from rfm_client.contract.samples import (
    PreferenceSample,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
    blank_trajectory,
    with_pictures,
)
from rfm_client.contract.wire import DEFAULT_MODEL, PROBE_PREFIX, Part, encoder_name, frames_name
from rfm_client.episodes.options import StepScore
from rfm_client.episodes.scorer import Asked, StepScorer
from rfm_client.frames.fit_to_checkpoint import resize_frames
from rfm_client.frames.sampling import Sampling
from rfm_client.scoring.samples import Call, CallOptions, SampleScorer, results_of
from rfm_client.transport.calls import Transport, TritonTransport
from rfm_client.transport.connection import Credentials
from rfm_client.transport.limits import ConcurrencyLimiter, Deadline, check_timeout
from rfm_client.transport.servers import PROBE_TIMEOUT_S, Servers
from rfm_client.transport.threads import AsyncClosing, OneProcess

if TYPE_CHECKING:
    from typing_extensions import Unpack

DEFAULT_TIMEOUT_S = 60.0
DEFAULT_IN_FLIGHT = 128  # twice the usual batch: the next batch fills up while one is scored


@dataclass(eq=False, repr=False)
class ClientOptions:
    """Options for RewardClient and AsyncRewardClient, fixed once the client exists.

    urls: one or several ``grpc://host:8001`` or ``http://host:8000``, with TLS ``grpcs://`` or ``https://``. The least
        busy server gets the next request; an episode stays on one server, which caches frame features. A failed server
        gets no requests until it is ready again
    model: name used at export; raw frames go to ``<model>_frames``
    timeout_s: time limit for a call with all retries; at most 1e9
    retry: True: within the time limit, retry requests while a server is down, restarting or full
    max_in_flight: how many requests may be open at once, with at most 256 MiB together; further requests wait
    shared_memory: True: send large inputs through shared memory if client and server run on one host
    ca_file: certificate authorities (PEM) to trust; None: the system's, or over gRPC its built-in list
    client_certificate, client_key: files (PEM) to identify this client (mutual TLS); both or neither
    headers: sent with every request, over gRPC as metadata
    api_key: sent with every request as ``Authorization: Bearer KEY``
    transports: replace connections to ``urls``, for tests and unusual networks

    Raises ValueError.
    """

    urls: str | Iterable[str]
    _: KW_ONLY
    model: str = DEFAULT_MODEL
    timeout_s: float = DEFAULT_TIMEOUT_S
    retry: bool = True
    max_in_flight: int = DEFAULT_IN_FLIGHT
    shared_memory: bool = False
    ca_file: str | Path | None = None
    client_certificate: str | Path | None = None
    client_key: str | Path | None = None
    headers: Mapping[str, str] | None = None
    api_key: str | None = None
    transports: Sequence[Transport] | None = None

    def __post_init__(self) -> None:
        """Build the client from these options."""
        raise NotImplementedError


ClientOptions.__init__.__doc__ = ClientOptions.__doc__  # so that help() on the clients shows it


READY_POLL_S = 0.2


class AsyncRewardClient(ClientOptions, AsyncClosing, OneProcess):
    """Client for one or several servers with the same checkpoint, in one event loop.

    ``help(RewardClient)`` describes the calls, ``help(AsyncRewardClient.__init__)`` the options. Do not change a
    sample's arrays while you await the call: a queued request reads them late.
    """

    def __post_init__(self) -> None:
        check_timeout(self.timeout_s)
        keys = self.ca_file, self.client_certificate, self.client_key
        credentials = Credentials(*keys, self.headers or {}, self.api_key)
        transports = self.transports
        if not transports:
            urls = [self.urls] if isinstance(self.urls, str) else self.urls
            transports = [TritonTransport(url, credentials, shared_memory=self.shared_memory) for url in urls]
        self._servers = Servers(transports, retry=self.retry)
        self._scorer = SampleScorer(self.model, self._servers, ConcurrencyLimiter(self.max_in_flight))
        self._steps = StepScorer(self.model, self._scorer, len(self._servers))
        self._is_closed = False
        self._loop: asyncio.AbstractEventLoop | None = None  # set by the first call

    async def progress(
        self, trajectory: Trajectory, *, frame_steps: int = 0, **options: Unpack[CallOptions]
    ) -> ProgressResult:
        """Return progress and success at each frame, as ``RewardClient.progress`` does."""
        return cast(ProgressResult, await self.score(ProgressSample(trajectory, frame_steps=frame_steps), **options))

    async def preference(
        self, first: Trajectory, second: Trajectory, *, both_orders: bool = False, **options: Unpack[CallOptions]
    ) -> PreferenceResult:
        """Return the probability that ``first`` does the task better, as ``RewardClient.preference`` does."""
        sample = PreferenceSample(first, second)
        if not both_orders:
            return cast(PreferenceResult, await self.score(sample, **options))
        results = results_of(await self.evaluate([sample, sample.swapped], return_errors=True, **options))
        asked, swapped = cast("list[PreferenceResult]", results)
        return PreferenceResult.of_both_orders(asked, swapped)

    async def similarity(
        self, reference: Trajectory, other: Trajectory, **options: Unpack[CallOptions]
    ) -> SimilarityResult:
        """Return how similar ``other`` is to ``reference``, as ``RewardClient.similarity`` does."""
        return cast(SimilarityResult, await self.score(SimilaritySample(reference, other), **options))

    async def curve(
        self,
        trajectory: Trajectory,
        sampling: Sampling | None = None,
        *,
        go_on: Callable[[], None] | None = None,
        **options: Unpack[CallOptions],
    ) -> ProgressResult:
        """Score every frame as if it were the newest, as ``RewardClient.curve`` does."""
        require("subsample", not options.get("subsample"), "False: the sampling rule chooses the frames", True)
        info = await self.model_info(frames=trajectory.frames is not None, timeout_s=options.get("timeout_s"))
        info.check_scores_prefixes()
        rule = sampling or Sampling.of(None, None, info.max_frames, trained_padding=info.trained_padding)
        if trajectory.frames is not None:
            self._scorer.tell_of_blank(trajectory.frames)
        if options.pop("resize", False) and info.frame_size is not None:  # once, because prefixes share frames
            shrink = partial(resize_frames, size=info.frame_size)
            trajectory = await asyncio.to_thread(with_pictures, trajectory, shrink)
        request_ids = self._call(options).request_ids  # counted through all requests

        def begin() -> Call:
            call = self._call(options)
            call.request_ids = request_ids
            call.checks_blank = False  # a prefix may repeat the first frame
            return call

        go_on = go_on or (lambda: None)
        if info.by_digest and not trajectory.has_views:
            results = await self._steps.in_turn(trajectory, rule, info, begin, go_on)
            return rule.joined(cast("list[ProgressResult]", results))
        parts, results = rule.parts(trajectory), []
        # in a thread, because copying many frames would block the event loop
        while part := await asyncio.to_thread(next, parts, None):
            go_on()
            results += results_of(await self._scorer.outcomes(part, begin()), "samples[{}]")
        return rule.joined(cast("list[ProgressResult]", results))

    async def score(self, sample: Sample, **options: Unpack[CallOptions]) -> Result:
        """Return the result of one sample of any type. Raises RewardError."""
        (result,) = results_of(await self._scorer.outcomes([sample], self._call(options)))
        return result

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
        """Return results for samples in any number and mix, as ``RewardClient.evaluate`` does."""
        samples = list(samples)
        outcomes = await self._scorer.outcomes(samples, self._call(options))
        return outcomes if return_errors else results_of(outcomes, "samples[{}]" if len(samples) > 1 else "")

    async def _score_steps(self, asked: Sequence[Asked], deadline: Deadline) -> list[StepScore]:
        """Score episodes at the steps asked for, with as few requests as possible. Raises RewardError."""
        call = self._call({})
        call.deadline = deadline
        return await self._steps.scores(asked, call)

    async def encode(
        self, trajectory: Trajectory, *, timeout_s: float | None = None, request_id: str | None = None
    ) -> Trajectory:
        """Return the trajectory with embeddings instead of frames, as ``RewardClient.encode`` does."""
        return await self._scorer.embeddings(trajectory, self._call({"timeout_s": timeout_s, "request_id": request_id}))

    async def probe(self, model: ModelInfo, *, timeout_s: float | None = None) -> None:
        """Score a blank sample, which the server's metrics ignore. Raises RewardError on failure."""
        call = self._call({"timeout_s": timeout_s, "request_id": PROBE_PREFIX})
        call.checks_blank = False
        results_of(await self._scorer.outcomes([ProgressSample(blank_trajectory(model.widths))], call))

    async def is_ready(self, *, timeout_s: float | None = None) -> bool:
        """True if a server has the model ready, as in ``RewardClient.is_ready``."""
        left_s = self._deadline(timeout_s).remaining_s()
        return await self._servers.is_ready((self.model, frames_name(self.model)), left_s)

    async def wait_ready(self, timeout_s: float) -> None:
        """Wait until a server has the model ready, as ``RewardClient.wait_ready`` does."""
        deadline = self._deadline(timeout_s)
        while deadline.ends_within(0) or not await self.is_ready(
            timeout_s=min(PROBE_TIMEOUT_S, deadline.remaining_s())
        ):
            if deadline.ends_within(READY_POLL_S):
                names = f"{self.model} and {frames_name(self.model)}"
                why = await self._why_unready()
                raise DeadlineExceededError(f"{self._servers}: {names}: not ready within {timeout_s:g} s{why}")
            await asyncio.sleep(READY_POLL_S)

    @property
    def model_names(self) -> dict[Part, str]:
        """Model names that belong to the checkpoint, whether served or not."""
        name = self.model
        return {"embeddings": name, "encoder": encoder_name(name), "frames": frames_name(name)}

    async def model_info(
        self, *, frames: bool = False, refresh: bool = False, timeout_s: float | None = None
    ) -> ModelInfo:
        """Describe the model, as ``RewardClient.model_info`` does."""
        name = frames_name(self.model) if frames else self.model
        return await self._scorer.model_info(name, self._deadline(timeout_s), refresh=refresh)

    async def model_infos(self, *, timeout_s: float | None = None) -> dict[Part, list[ModelInfo]]:
        """Describe the checkpoint's served parts, as ``RewardClient.model_infos`` does."""
        deadline = self._deadline(timeout_s)
        infos: dict[Part, list[ModelInfo]] = {}
        for part, name in self.model_names.items():
            with suppress(ModelNotFoundError):
                infos[part] = await self._scorer.model_infos(name, deadline)
        return infos

    def stop_retrying(self) -> None:
        """Let later failures end their calls at once. ``close`` does this first."""
        self._servers.stop_retrying()

    async def close(self) -> None:
        """Close the connections and release shared memory. Running calls raise ClientClosedError."""
        self._is_closed = True
        await self._servers.close()

    async def _why_unready(self) -> str:
        try:
            await self._servers.first.model_info(frames_name(self.model), PROBE_TIMEOUT_S)  # without retries
        except (ServerUnavailableError, ModelNotFoundError) as error:  # waiting is the remedy
            return f": {error.fault or error}"
        except RewardError as error:
            return f": {error}"
        return ""

    def _call(self, options: CallOptions) -> Call:
        """Return a call that begins now. Raises TypeError for an unknown option."""
        return Call(self._deadline(options.get("timeout_s")), options)

    def _deadline(self, timeout_s: float | None) -> Deadline:
        """Return the deadline for a call that begins now. timeout_s: None: the client's."""
        if self._is_closed:
            raise ClientClosedError("this AsyncRewardClient is closed")
        loop = asyncio.get_running_loop()
        self._loop = self._loop or loop
        if self._loop is not loop:
            expected = "the event loop that it was first used in"
            raise RuntimeError(f"this AsyncRewardClient: expected {expected}, got another: make one in each loop")
        return Deadline(self.timeout_s if timeout_s is None else timeout_s)
