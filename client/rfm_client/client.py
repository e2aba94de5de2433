# SPDX-License-Identifier: MIT
"""RewardClient: blocking client for served reward models, usable from any number of threads."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal, overload

from rfm_client.async_client import AsyncRewardClient, ClientOptions
from rfm_client.contract.checks import checked_count
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import RewardError
from rfm_client.contract.results import PreferenceResult, ProgressResult, Result, SimilarityResult
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory
from rfm_client.contract.wire import Part
from rfm_client.episodes.episodes import Episode
from rfm_client.episodes.options import EpisodeOptions, StepKeywords, StepScore
from rfm_client.episodes.scorer import Asked
from rfm_client.episodes.steps import Steps
from rfm_client.frames.fit_to_checkpoint import snapshot
from rfm_client.frames.sampling import Sampling
from rfm_client.scoring.samples import CallOptions
from rfm_client.transport.limits import Deadline
from rfm_client.transport.threads import Closing, LoopThread, OneProcess

if TYPE_CHECKING:
    from typing_extensions import Unpack


class RewardClient(ClientOptions, Closing, OneProcess):
    """Blocking, thread-safe client: an AsyncRewardClient whose event loop runs in a separate thread.

    ``help(RewardClient.__init__)`` describes the options. Errors are the same as AsyncRewardClient's. The client closes
    as a context manager and at interpreter exit. It does not survive a fork: create one client per process.
    """

    def __post_init__(self) -> None:
        self._client = AsyncRewardClient(**{each.name: getattr(self, each.name) for each in fields(ClientOptions)})
        self._loop = LoopThread("rfm-client")
        self._finalizer = weakref.finalize(self, _close, self._client, self._loop)

    def progress(
        self, trajectory: Trajectory, *, frame_steps: int = 0, **options: Unpack[CallOptions]
    ) -> ProgressResult:
        """Return progress and success at each frame; ``frame_steps`` as in ProgressSample. Raises RewardError."""
        return self._loop.wait(self._client.progress(trajectory, frame_steps=frame_steps, **options))

    def preference(
        self, first: Trajectory, second: Trajectory, *, both_orders: bool = False, **options: Unpack[CallOptions]
    ) -> PreferenceResult:
        """Return the probability that ``first`` does the task better. Raises RewardError.

        both_orders: True: also ask in the other order, since answers may depend on the order; ``preference`` is the
            mean, and if the orders disagree, ``verdict`` is None. Recommended for labels
        """
        return self._loop.wait(self._client.preference(first, second, both_orders=both_orders, **options))

    def curve(
        self,
        trajectory: Trajectory,
        sampling: Sampling | None = None,
        *,
        go_on: Callable[[], None] | None = None,
        **options: Unpack[CallOptions],
    ) -> ProgressResult:
        """Score every frame as if it were the newest: from that frame and the frames before it.

        Each frame travels once if the server caches features (``ModelInfo.by_digest``).

        sampling: which frames the model sees from a prefix; None: as in the checkpoint's training
        go_on: called before each underlying call, in the client's thread; may raise to end this one
        options: apply to each underlying call; several are needed because the prefixes of a long trajectory exceed
            memory

        Raises RewardError; ValueError if neither ``sampling`` nor the checkpoint gives a frame count, and for
        ``subsample``.
        """
        return self._loop.wait(self._client.curve(trajectory, sampling, go_on=go_on, **options))

    def similarity(self, reference: Trajectory, other: Trajectory, **options: Unpack[CallOptions]) -> SimilarityResult:
        """Return a raw score for how similar ``other`` is to ``reference``. Raises RewardError."""
        return self._loop.wait(self._client.similarity(reference, other, **options))

    @overload
    def evaluate(
        self, samples: Iterable[Sample], *, return_errors: Literal[False] = False, **options: Unpack[CallOptions]
    ) -> list[Result]: ...
    @overload
    def evaluate(
        self, samples: Iterable[Sample], *, return_errors: bool, **options: Unpack[CallOptions]
    ) -> list[Result | RewardError]: ...
    def evaluate(
        self, samples: Iterable[Sample], *, return_errors: bool = False, **options: Unpack[CallOptions]
    ) -> list[Result] | list[Result | RewardError]:
        """Score samples in any number and mix; return results in order.

        return_errors: True: return a failed sample's error in place of a result; False: raise the first error,
            as ``samples[3].num_frames: expected X, got Y``
        """
        samples = list(samples)  # in this thread: an iterator may be slow, or call this client
        return self._loop.wait(self._client.evaluate(samples, return_errors=return_errors, **options))

    @overload
    def submit(self, sample: ProgressSample, **options: Unpack[CallOptions]) -> Future[ProgressResult]: ...
    @overload
    def submit(self, sample: PreferenceSample, **options: Unpack[CallOptions]) -> Future[PreferenceResult]: ...
    @overload
    def submit(self, sample: SimilaritySample, **options: Unpack[CallOptions]) -> Future[SimilarityResult]: ...
    def submit(self, sample: Sample, **options: Unpack[CallOptions]) -> Future[Any]:
        """Send the sample and return a future for the result at once.

        The future raises RewardError; cancelling it cancels the request. Arrays are copied, so the caller may change
        them. Beyond ``max_in_flight`` open requests, copies wait in memory.
        """
        future = self._loop.start(self._client.score(snapshot(sample), **options))
        future.add_done_callback(lambda _done: self)  # keeps the client alive until then
        return future

    def episode(self, task: str, *, env: int | None = None, **options: Unpack[StepKeywords]) -> Episode:
        """Return an episode to score step by step. A step sends only the new frame if the server caches features.

        env: environment index, shown in errors as ``envs[3]``; None: the only one
        options: EpisodeOptions fields. Raises ValueError for contradictory options
        """
        where = "" if env is None else f"envs[{checked_count('env', env, least=0)}]"
        return Episode(Steps(task, EpisodeOptions(**options), where), self._begin, self._score_steps, self.model_info)

    def score_episodes(self, episodes: Sequence[Episode]) -> list[StepScore]:
        """Score all episodes at their newest frames, with as few requests as possible. Raises RewardError.

        Frames come from ``Episode.keep``, and stay in the episodes after a failure.
        """
        return self._score_steps([each.asked for each in episodes], Deadline(self.timeout_s))

    def submit_episodes(self, episodes: Sequence[Episode]) -> Future[list[StepScore]]:
        """Start ``score_episodes`` and return a future at once. Frames kept later do not change the scores."""
        asked = [each.asked for each in episodes]
        future = self._loop.start(self._client._score_steps(asked, Deadline(self.timeout_s)))
        future.add_done_callback(lambda _done: self)
        return future

    def encode(
        self, trajectory: Trajectory, *, timeout_s: float | None = None, request_id: str | None = None
    ) -> Trajectory:
        """Return the trajectory with embeddings instead of frames, for repeated scoring. Raises RewardError.

        The checkpoint must be served with encoders.
        """
        return self._loop.wait(self._client.encode(trajectory, timeout_s=timeout_s, request_id=request_id))

    def is_ready(self, *, timeout_s: float | None = None) -> bool:
        """True if a server answers and has the model ready, for embeddings or for raw frames."""
        return self._loop.wait(self._client.is_ready(timeout_s=timeout_s))

    def wait_ready(self, timeout_s: float) -> None:
        """Wait until ``is_ready``. Raises DeadlineExceededError."""
        self._loop.wait(self._client.wait_ready(timeout_s))

    def model_info(self, *, frames: bool = False, refresh: bool = False, timeout_s: float | None = None) -> ModelInfo:
        """Describe the model for embeddings or, with ``frames``, for raw frames.

        refresh: True: ask the server again; False: reuse the description until another model version answers

        Raises ModelNotFoundError if the model is not served.
        """
        return self._loop.wait(self._client.model_info(frames=frames, refresh=refresh, timeout_s=timeout_s))

    def model_infos(self, *, timeout_s: float | None = None) -> dict[Part, list[ModelInfo]]:
        """Describe the checkpoint's served parts, as reported by every reachable server.

        Raises RewardError if no server answers.
        """
        return self._loop.wait(self._client.model_infos(timeout_s=timeout_s))

    def close(self) -> None:
        """End running calls, which raise ClientClosedError, close the connections and release shared memory."""
        self._finalizer()

    def _begin(self, timeout_s: float | None) -> Deadline:
        self._loop.check_caller()
        return Deadline(self.timeout_s if timeout_s is None else timeout_s)

    def _score_steps(self, asked: Sequence[Asked], deadline: Deadline) -> list[StepScore]:
        return self._loop.wait(self._client._score_steps(asked, deadline))


def _close(client: AsyncRewardClient, loop: LoopThread) -> None:
    client.stop_retrying()  # first: to a cancelled call the connection may seem to end
    loop.stop(client.close)
