# SPDX-License-Identifier: MIT
"""RewardClient: rewards from served reward models, for any number of threads."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from rfm_client.async_client import DEFAULT_IN_FLIGHT, DEFAULT_TIMEOUT_S, AsyncRewardClient
from rfm_client.contract.errors import RewardError
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.names import DEFAULT_MODEL, Part
from rfm_client.contract.results import PreferenceResult, ProgressResult, Result, SimilarityResult
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory
from rfm_client.data.fit_to_checkpoint import snapshot
from rfm_client.episodes.episodes import Episode, Episodes
from rfm_client.episodes.steps import EpisodeSettings
from rfm_client.episodes.windows import Window
from rfm_client.scoring.call import CallOptions
from rfm_client.transport.calls import Transport
from rfm_client.transport.lifetime import Closing, OneProcess
from rfm_client.transport.loop_thread import LoopThread

if TYPE_CHECKING:
    from typing_extensions import Unpack


class RewardClient(Closing, OneProcess):
    """AsyncRewardClient without ``await``, thread-safe: its event loop runs in a thread of its own.

    Arguments and errors are AsyncRewardClient's. Closes itself as a context manager and at the interpreter's end.
    It does not survive a fork: make one in each process.
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
        self._client = AsyncRewardClient(
            urls,
            model=model,
            timeout_s=timeout_s,
            retry=retry,
            max_in_flight=max_in_flight,
            shared_memory=shared_memory,
            ca_file=ca_file,
            client_certificate=client_certificate,
            client_key=client_key,
            headers=headers,
            api_key=api_key,
            transports=transports,
        )
        self._loop = LoopThread("rfm-client")
        self._finalizer = weakref.finalize(self, _close, self._client, self._loop)

    def progress(
        self, trajectory: Trajectory, *, frame_steps: int = 0, **options: Unpack[CallOptions]
    ) -> ProgressResult:
        """Progress and success at each frame; ``frame_steps`` as in ProgressSample. Raises RewardError."""
        return self._loop.wait(self._client.progress(trajectory, frame_steps=frame_steps, **options))

    def preference(
        self, first: Trajectory, second: Trajectory, *, both_orders: bool = False, **options: Unpack[CallOptions]
    ) -> PreferenceResult:
        """Probability that ``first`` does its task better than ``second``; ``both_orders`` as in AsyncRewardClient.

        Raises RewardError.
        """
        return self._loop.wait(self._client.preference(first, second, both_orders=both_orders, **options))

    def similarity(self, reference: Trajectory, other: Trajectory, **options: Unpack[CallOptions]) -> SimilarityResult:
        """Raw similarity score of ``other`` to ``reference``. Raises RewardError."""
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
        """The results of any number and mix of samples, in order.

        return_errors: a sample that fails gives its error in its place and the others their results; otherwise the
            first error is raised
        """
        samples = list(samples)  # here, since whatever makes them may take its time, or ask this client
        return self._loop.wait(self._client.evaluate(samples, return_errors=return_errors, **options))

    @overload
    def submit(self, sample: ProgressSample, **options: Unpack[CallOptions]) -> Future[ProgressResult]: ...
    @overload
    def submit(self, sample: PreferenceSample, **options: Unpack[CallOptions]) -> Future[PreferenceResult]: ...
    @overload
    def submit(self, sample: SimilaritySample, **options: Unpack[CallOptions]) -> Future[SimilarityResult]: ...
    def submit(self, sample: Sample, **options: Unpack[CallOptions]) -> Future[Any]:
        """The result to come; returns at once. The future raises RewardError; cancelling it cancels the request.

        The sample's arrays are copied, so they may be written over. Of many futures ``max_in_flight`` requests are
        sent at a time; the copies of the others stay in memory.
        """
        future = self._loop.start(self._client.score(snapshot(sample), **options))
        future.add_done_callback(lambda _done: self)  # until then the client lives, even without another reference
        return future

    def episode(self, task: str, *, timeout_s: float | None = None, **options: Unpack[EpisodeSettings]) -> Episode:
        """An episode that is scored step by step: each step sends its new frame alone, if the server keeps features.

        options: as of EpisodeOptions; ValueError for contradictory ones
        timeout_s: the longest that a step may take; None: the client's
        """
        return Episode(self._client.episode(task, timeout_s=timeout_s, **options), self._loop, self)

    def episodes(
        self, num: int, task: str | Sequence[str], *, timeout_s: float | None = None, **options: Unpack[EpisodeSettings]
    ) -> Episodes:
        """Episodes side by side, as those of vectorised environments: as few requests a step as fit.

        task: of all, or of each
        others: as of ``episode``
        """
        return Episodes(self._client.episodes(num, task, timeout_s=timeout_s, **options), self._loop, self)

    def score_windows(self, windows: Sequence[Window], *, timeout_s: float | None = None) -> list[Result | RewardError]:
        """The result or error of each window, a progress question about frames that the server may know."""
        return self._loop.wait(self._client.score_windows(windows, timeout_s=timeout_s))

    def submit_window(self, window: Window) -> Future[ProgressResult]:
        """The result of a window to come, as of ``submit``."""
        future = self._loop.start(self._client.score_window(window))
        future.add_done_callback(lambda _done: self)
        return future

    def encode(
        self, trajectory: Trajectory, *, timeout_s: float | None = None, request_id: str | None = None
    ) -> Trajectory:
        """The trajectory with embeddings of its frames and its task in place of the frames, for a checkpoint that is
        served with encoders. A trajectory that is scored often is then encoded once. Raises RewardError.
        """
        return self._loop.wait(self._client.encode(trajectory, timeout_s=timeout_s, request_id=request_id))

    def is_ready(self, *, timeout_s: float | None = None) -> bool:
        """Whether a server answers and has the model ready, for embeddings or for raw frames."""
        return self._loop.wait(self._client.is_ready(timeout_s=timeout_s))

    def wait_ready(self, timeout_s: float) -> None:
        """Returns as soon as ``is_ready``. Raises DeadlineExceededError."""
        self._loop.wait(self._client.wait_ready(timeout_s))

    def model_info(self, *, frames: bool = False, refresh: bool = False, timeout_s: float | None = None) -> ModelInfo:
        """What the server says of its model for embeddings or, with ``frames``, for raw frames.

        refresh: request it even if it is known. It is forgotten when another version of the model answers.

        Raises ModelNotFoundError if it is not served.
        """
        return self._loop.wait(self._client.model_info(frames=frames, refresh=refresh, timeout_s=timeout_s))

    def model_infos(self, *, timeout_s: float | None = None) -> dict[Part, list[ModelInfo]]:
        """What every server that answers says now of the checkpoint's models, as far as it serves them: the one for
        embeddings, the encoder, the one for raw frames. Raises RewardError if no server answers.
        """
        return self._loop.wait(self._client.model_infos(timeout_s=timeout_s))

    def close(self) -> None:
        """Cancels what is under way, closes the connections and gives shared memory back."""
        self._finalizer()


def _close(client: AsyncRewardClient, loop: LoopThread) -> None:
    client.stop_retrying()  # before calls are cancelled, for a connection may seem to end under them
    loop.stop(client.close)
