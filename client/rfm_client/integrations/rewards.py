# SPDX-License-Identifier: MIT
"""How the scores of an episode become the rewards of a Gymnasium environment. ``gym.py`` states the rules."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np

from rfm_client.client import RewardClient
from rfm_client.contract.checks import require
from rfm_client.contract.errors import InvalidSampleError, RewardError
from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.numbers import checked_count, checked_finite
from rfm_client.contract.results import ProgressResult
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.camera_fusion import Fuse
from rfm_client.data.orientation import Orientation
from rfm_client.data.sampling import Rule
from rfm_client.episodes.live import LiveView
from rfm_client.episodes.steps import EpisodeFrames, EpisodeOptions, StepRequest, StepScore, SuccessRule

Info: TypeAlias = dict[str, Any]
ClientSource: TypeAlias = RewardClient | Callable[[], RewardClient]


@dataclass(frozen=True, kw_only=True)
class RewardOptions:
    """How an episode is scored, and how progress becomes reward. Raises ValueError for contradictory options.

    mode: a step is paid the newest known progress (absolute), or how far that has come since the step before (delta):
        then an episode's rewards add up to its last known progress less its first, however late answers come
    scale: factor of what is paid
    add_to_env_reward: the environment's own reward is added; otherwise it is replaced
    every: steps from one scoring to the next; in between, absolute holds its value and delta is 0
    terminate_on_success: terminates the episode when an answer says success, except one about the frame of the reset.
        The reset raises ValueError if the checkpoint does not predict success
    frames_from: where frames, uint8 [H, W, 3], come from. None: ``render()``; or a key of the observation; or what
        takes one environment's observation and gives its frame
    cameras: each is scored, and the scores fused: keys, of the observation or of what ``frames_from`` says, that hold a
        frame of each; none: there is one camera, without a name
    sampling, fuse, orient, resize, live: as of ``rfm_client.episodes.EpisodeOptions``; rendered frames are turned, too
    max_frames: the rule's number of frames, EpisodeOptions' ``frames``
    blocking: a step waits for its score
    max_pending: most steps of one environment whose questions are open when not blocking
    await_last: the last step of an episode is waited for even when not blocking; otherwise what is open is dropped
    """

    mode: Literal["absolute", "delta"] = "absolute"
    scale: float = 1.0
    add_to_env_reward: bool = False
    every: int = 1
    terminate_on_success: SuccessRule | None = None
    frames_from: str | Callable[[Any], UInt8Array | Mapping[str, UInt8Array]] | None = None
    cameras: Sequence[str] = ()
    fuse: Fuse = "mean"
    orient: Orientation | Mapping[str, Orientation] = "none"
    sampling: Rule | None = None
    resize: bool = False
    max_frames: int | None = None
    blocking: bool = True
    max_pending: int = 4
    await_last: bool = True
    live: LiveView | None = None

    def __post_init__(self) -> None:
        require("mode", self.mode in ("absolute", "delta"), "'absolute' or 'delta'", repr(self.mode))
        checked_finite("scale", self.scale)
        for name in ("every", "max_pending", "max_frames"):
            if getattr(self, name) is not None:
                checked_count(name, getattr(self, name))
        object.__setattr__(self, "cameras", self.scoring.cameras)

    @cached_property
    def scoring(self) -> EpisodeOptions:
        """How the episode's steps are scored. Raises ValueError."""
        return EpisodeOptions(
            sampling=self.sampling,
            frames=self.max_frames,
            cameras=self.cameras,
            fuse=self.fuse,
            orient=self.orient,
            resize=self.resize,
            success=self.terminate_on_success or SuccessRule(),
            live=self.live,
        )

    @property
    def renders(self) -> bool:
        """Whether frames come from ``render()``."""
        return self.frames_from is None and not self.cameras

    def frames_of(self, observation: Any) -> Any:
        """The frame in one environment's observation; with cameras, such by name. Raises InvalidSampleError."""
        source = self.frames_from
        if source is None:
            found = observation
        elif callable(source):
            found = source(observation)
        else:
            found = observation[source]
        if not self.cameras:
            return found
        if not isinstance(found, Mapping) or not found.keys() >= set(self.cameras):
            got = list(found) if isinstance(found, Mapping) else type(found).__name__
            raise InvalidSampleError.at("frames", f"a frame of each of the cameras {list(self.cameras)}", str(got))
        return {camera: found[camera] for camera in self.cameras}


class RewardedEpisode:
    """One episode: its frames, what is known of it, and the questions that have no answer yet.

    index: number of its environment; None: there is only one
    size: what the checkpoint reads: frames are made as small; None: they stay as they are
    pending: questions, and the answers to come about each of their windows
    known: the newest score that has come
    """

    def __init__(self, options: RewardOptions, task: str, index: int | None, size: FrameSize | None) -> None:
        where = "" if index is None else f"envs[{index}]"
        self.frames = EpisodeFrames(task, options.scoring, index or 0, where)
        self._options, self._size = options, size
        self.pending: list[tuple[StepRequest, list[Future[ProgressResult]]]] = []
        self.known: StepScore | None = None
        self._paid_progress = np.nan
        self.num_skipped = 0
        self.succeeded = False

    def add(self, frame: Any) -> None:
        """Adds a copy of the frame: an environment may draw into the same array again. With cameras, such by name.

        Raises InvalidSampleError.
        """
        self.frames.append(self.frames.checked(frame, self._size))

    def collect(self) -> None:
        """Takes over the answers that have come. Raises the RewardError of one that failed."""
        for each in [each for each in self.pending if all(answer.done() for answer in each[1])]:
            self.pending.remove(each)
            question, answers = each
            outcomes = []
            for answer in answers:
                error = answer.exception()
                outcomes.append(error if isinstance(error, RewardError) else answer.result())
            self.learn(*question.scores(outcomes))

    def cancel(self) -> None:
        """Cancels the questions that have no answer yet."""
        for _, answers in self.pending:
            for answer in answers:
                answer.cancel()
        self.pending.clear()

    def end(self) -> None:
        """Cancels the questions that have no answer yet, and tells who watches that the episode is over."""
        self.cancel()
        self.frames.end()

    def learn(self, score: StepScore) -> None:
        """Takes over the score of a step, unless a newer one is known."""
        if self.known is not None and score.step <= self.known.step:
            return
        rule = self._options.terminate_on_success
        if rule is not None and np.isnan(score.success):
            expected = "None with a checkpoint that does not predict success"
            raise ValueError(f"terminate_on_success: expected {expected}, got {rule}")
        if self.known is None:
            self._paid_progress = score.progress
        score = replace(score, succeeded=score.succeeded and score.step > 0)  # a reset is no success
        self.known = score
        self.succeeded |= rule is not None and score.succeeded
        self.frames.report(score)

    def reward(self, env_reward: float) -> float:
        """The reward of the step."""
        progress = np.nan if self.known is None else self.known.progress
        change, self._paid_progress = progress - self._paid_progress, progress
        reward = self._options.scale * (progress if self._options.mode == "absolute" else change)
        return reward + env_reward if self._options.add_to_env_reward else reward

    def info(self) -> Info:
        """The newest known scores, and by how many steps they lag."""
        known = self.known or StepScore(np.nan, np.nan, False, -1, np.nan)
        told = {"progress": known.progress, "success": known.success, "step": known.step}
        told |= {"lag": self.frames.step - known.step, "skipped": self.num_skipped}
        return told if self._options.terminate_on_success is None else told | {"succeeded": self.succeeded}


class EpisodeRewarder:
    """Asks about the episodes of environments, by one client. Connects at the first question."""

    def __init__(self, client: ClientSource, options: RewardOptions) -> None:
        if not (isinstance(client, RewardClient) or callable(client)):
            raise TypeError(f"client: expected a RewardClient or what makes one, got {type(client).__name__}")
        self._source = client
        self._options = options
        self._made: RewardClient | None = None

    def begin(self, task: str, frame: Any, index: int | None = None) -> RewardedEpisode:
        """A new episode, whose first frame this is. Raises RewardError. index: number of its environment"""
        size = self._client.model_info(frames=True).frame_size if self._options.resize else None
        episode = RewardedEpisode(self._options, task, index, size)
        episode.add(frame)
        return episode

    def score(self, episodes: Mapping[RewardedEpisode, bool]) -> None:
        """Collects the answers that have come, and asks about the newest frames where that is due. Raises RewardError.

        episodes: with whether their newest frame is their last
        """
        try:
            self._score(episodes)
        finally:
            for episode in (episode for episode, ends in episodes.items() if ends or episode.succeeded):
                episode.end()

    def close(self) -> None:
        """Closes the client if it was made here."""
        if self._made is not None:
            self._made.close()

    def _score(self, episodes: Mapping[RewardedEpisode, bool]) -> None:
        awaited = []
        for episode, ends in episodes.items():
            episode.collect()
            ends = ends or episode.succeeded
            is_first = episode.known is None
            due = ends or is_first or episode.frames.step % self._options.every == 0
            waits = self._options.blocking or is_first or (ends and self._options.await_last)
            if ends:
                episode.cancel()
            if due and waits:
                awaited.append(episode)
            elif due and not ends and len(episode.pending) >= self._options.max_pending:
                episode.num_skipped += 1
            elif due and not ends:
                question = self._question([episode])
                answers = [self._client.submit_window(window) for window in question.windows]
                episode.pending.append((question, answers))
        if awaited:
            question = self._question(awaited)
            scores = question.scores(self._client.score_windows(question.windows))
            for episode, score in zip(awaited, scores, strict=True):
                episode.learn(score)

    def _question(self, episodes: Sequence[RewardedEpisode]) -> StepRequest:
        """About their newest frames, sampled as the options say and as suits the checkpoint that is served now."""
        asked_s = time.perf_counter()
        scoring = self._options.scoring
        info: ModelInfo | None = self._client.model_info(frames=True) if scoring.needs_model_info else None
        return StepRequest([episode.frames for episode in episodes], scoring.sampling_for(info), asked_s)

    @property
    def _client(self) -> RewardClient:
        if isinstance(self._source, RewardClient):
            return self._source
        if self._made is None:
            self._made = self._source()
        return self._made
