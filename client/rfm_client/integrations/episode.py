# SPDX-License-Identifier: MIT
"""An episode as a reward model sees it: its frames, known scores and requests. ``gym.py`` states the rules."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, cast

import numpy as np

from rfm_client.client import RewardClient
from rfm_client.contract.errors import InvalidSampleError, RewardError
from rfm_client.contract.numbers import checked_count, checked_finite
from rfm_client.contract.results import ProgressResult, Result
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.camera_fusion import FUSES, Fuse, check_fuse, checked_cameras
from rfm_client.data.orientation import Orientation, turned
from rfm_client.data.resize import resize_frames
from rfm_client.data.sampling import Prefix, Rule, Sampling, of_frames
from rfm_client.episodes.frames import checked_frame, orientations_of
from rfm_client.episodes.live import LiveView
from rfm_client.episodes.options import SuccessRule
from rfm_client.episodes.windows import NamedFrame, Window
from rfm_client.integrations.watching import Watching

Info: TypeAlias = dict[str, Any]
Fit: TypeAlias = Callable[[UInt8Array], UInt8Array]
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
    fuse: how the scores of several cameras become one
    orient: how frames, rendered ones too, are turned so that they are upright: an Orientation, or such by camera; a
        camera that is not named: not at all
    sampling: which frames of the episode so far are sent: a rule of ``rfm_client.data.sampling``; None: that of the
        checkpoint's training
    resize: frames are made as small as the checkpoint reads them before they are kept and sent (needs Pillow); ReWiND's
        scores differ slightly from those of the frames as they are
    max_frames: the rule's number of frames; None: the checkpoint's ``ModelInfo.max_frames``. If it has none, a rule
        that needs a number raises ValueError at the first reset
    blocking: a step waits for its score
    max_pending: most steps of one environment whose questions are open when not blocking
    await_last: the last step of an episode is waited for even when not blocking; otherwise what is open is dropped
    live: where each scored step is reported to, of several cameras the first one's frame; it delays nothing
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
        if self.mode not in ("absolute", "delta"):
            raise ValueError(f"mode: expected 'absolute' or 'delta', got {self.mode!r}")
        checked_finite("scale", self.scale)
        checked_count("every", self.every)
        checked_count("max_pending", self.max_pending)
        if self.max_frames is not None:
            checked_count("max_frames", self.max_frames)
        object.__setattr__(self, "cameras", checked_cameras(self.cameras))
        check_fuse(self.fuse)
        orientations_of(self.orient, self.cameras)
        Sampling.of(self.sampling, self.max_frames, trained_frames=1)  # whether rule and number go together

    @property
    def renders(self) -> bool:
        """Whether frames come from ``render()``."""
        return self.frames_from is None and not self.cameras

    def frames_of(self, observation: Any) -> Any:
        """The frame in one environment's observation; with cameras a tuple of theirs. Raises InvalidSampleError."""
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
        return tuple(found[camera] for camera in self.cameras)


class Scorer:
    """Sends episodes to the reward model. Connects at the first request."""

    def __init__(self, client: ClientSource, options: RewardOptions) -> None:
        if not (isinstance(client, RewardClient) or callable(client)):
            raise TypeError(f"client: expected a RewardClient or what makes one, got {type(client).__name__}")
        self._source = client
        self._options = options
        self._made: RewardClient | None = None

    def score(self, episodes: Mapping[Episode, bool]) -> None:
        """Collects the answers that have come, and sends requests about the newest frames where they are due.

        episodes: with whether their newest frame is their last
        """
        try:
            self._score(episodes)
        finally:
            for episode in (episode for episode, ends in episodes.items() if ends or episode.succeeded):
                episode.end()

    def _score(self, episodes: Mapping[Episode, bool]) -> None:
        awaited = []
        for episode, ends in episodes.items():
            episode.collect()
            ends = ends or episode.succeeded
            due = ends or not episode.is_known or episode.step % self._options.every == 0
            waits = self._options.blocking or not episode.is_known or (ends and self._options.await_last)
            if ends:
                episode.cancel()
            if due and waits:
                awaited.append(episode)
            elif due and not ends:
                self._submit(episode)
        if awaited:
            self._await(awaited)

    def close(self) -> None:
        """Closes the client if it was made here."""
        if self._made is not None:
            self._made.close()

    def _submit(self, episode: Episode) -> None:
        if episode.num_pending >= self._options.max_pending:
            episode.num_skipped += 1
        else:
            sampling = self._sampling()
            windows = episode.windows(sampling)
            episode.expect([self._client.submit_window(window) for window in windows], sampling)

    def _await(self, episodes: Sequence[Episode]) -> None:
        asked_s, sampling = time.perf_counter(), self._sampling()
        windows = [episode.windows(sampling) for episode in episodes]
        outcomes = iter(self._client.score_windows([window for of_episode in windows for window in of_episode]))
        results = [
            episode.fused([episode.checked(next(outcomes)) for _ in of_episode])
            for episode, of_episode in zip(episodes, windows, strict=True)
        ]
        for episode, result in zip(episodes, results, strict=True):
            episode.learn(episode.step, result, sampling.prefix(episode.step), asked_s)

    @property
    def _client(self) -> RewardClient:
        if isinstance(self._source, RewardClient):
            return self._source
        if self._made is None:
            self._made = self._source()
        return self._made

    def fit(self) -> Fit | None:
        """What makes a frame [H, W, 3] as small as it is sent; None: it stays as it is. Raises RewardError."""
        size = self._client.model_info(frames=True).frame_size if self._options.resize else None
        return None if size is None else lambda frame: resize_frames(frame[np.newaxis], size)[0]

    def _sampling(self) -> Sampling:
        """The rule with its number of frames; where the options do not say, those of the checkpoint that is served."""
        rule, frames = self._options.sampling, self._options.max_frames
        if rule is not None and frames is not None:
            return Sampling(rule, frames)
        info = self._client.model_info(frames=True)
        return Sampling.of(rule, frames, info.max_frames, trained_padding=info.trained_padding)


class Episode:
    """The frames of one episode, what is known of it, and the requests that have no answer yet.

    env: number of its environment; None: there is only one
    """

    def __init__(self, options: RewardOptions, task: str, env: int | None = None) -> None:
        self._options = options
        self._task = task
        self._orientations = orientations_of(options.orient, options.cameras)
        self._where = "" if env is None else f"envs[{env}]"
        self._watching = Watching(options.live, task, options.terminate_on_success, env or 0)
        self._frames: list[tuple[NamedFrame, ...]] = []  # of each camera
        self._sizes: list[tuple[int, ...]] | None = None  # of the cameras' frames as they came
        self._fit: Fit | None = None
        self._pending: dict[int, tuple[Prefix, Sequence[Future[ProgressResult]], float]] = {}  # by step, since when
        self._known_step = -1
        self._progress = self._success = self._paid_progress = np.nan
        self.num_skipped = 0
        self.succeeded = False

    @property
    def step(self) -> int:
        """Number of steps since the reset."""
        return len(self._frames) - 1

    @property
    def is_known(self) -> bool:
        """Whether there is an answer."""
        return self._known_step >= 0

    @property
    def num_pending(self) -> int:
        """Number of requests that have no answer yet."""
        return len(self._pending)

    def add(self, frame: Any, find_fit: Callable[[], Fit | None] = lambda: None) -> Sequence[UInt8Array]:
        """Adds a copy of the frame: an environment may draw into the same array again. Of each camera, as it came.

        frame: with cameras a tuple of theirs
        find_fit: gives what makes the episode's frames smaller; asked at its first
        """
        frames = frame if self._options.cameras else (frame,)
        names = [f"frame[{camera!r}]" for camera in self._options.cameras] or ["frame"]
        try:
            kept = [
                turned(checked_frame(each, name), orientation)
                for each, name, orientation in zip(frames, names, self._orientations, strict=True)
            ]
            self._check_sizes(kept, names)
        except InvalidSampleError as error:
            raise self._located(error) from None
        if self._sizes is None:
            self._fit = find_fit()
        self._sizes = [each.shape for each in kept]
        self._frames.append(tuple(NamedFrame(each if self._fit is None else self._fit(each)) for each in kept))
        return kept

    def windows(self, sampling: Sampling) -> list[Window]:
        """The question about the newest frame of each camera."""
        shown = [self._frames[index] for index in sampling.prefix(self.step).indices]
        return [Window(of_camera, self._task) for of_camera in zip(*shown, strict=True)]

    def expect(self, answers: Sequence[Future[ProgressResult]], sampling: Sampling) -> None:
        """Records that an answer about each camera's newest frame, sampled so, is to come."""
        self._pending[self.step] = sampling.prefix(self.step), answers, time.perf_counter()

    def collect(self) -> None:
        """Takes over the answers that have come. Raises the RewardError of one that failed."""
        for step in [step for step, (_, answers, _) in self._pending.items() if all(each.done() for each in answers)]:
            prefix, answers, asked_s = self._pending.pop(step)
            errors = [error for error in (answer.exception() for answer in answers) if isinstance(error, RewardError)]
            if errors:
                raise self._located(errors[0])
            self.learn(step, self.fused([answer.result() for answer in answers]), prefix, asked_s)

    def cancel(self) -> None:
        """Cancels the requests that have no answer yet."""
        for answer in (answer for _, answers, _ in self._pending.values() for answer in answers):
            answer.cancel()
        self._pending.clear()

    def end(self) -> None:
        """Cancels the requests that have no answer yet, and tells who watches that the episode is over."""
        self.cancel()
        self._watching.end()

    def fused(self, results: Sequence[ProgressResult]) -> ProgressResult:
        """One result of those of all cameras."""
        if len(results) == 1:
            return results[0]
        fuse = FUSES[self._options.fuse]
        progress, success = ([getattr(each, field) for each in results] for field in ("progress", "success"))
        versions = {each.model_version for each in results}
        return replace(
            results[0],
            progress=fuse(progress, axis=0),
            success=fuse(success, axis=0),
            progress_logits=None,
            model_version=versions.pop() if len(versions) == 1 else None,
        )

    def checked(self, outcome: Result | RewardError) -> ProgressResult:
        """The answer; raises what came in its place."""
        if isinstance(outcome, RewardError):
            raise self._located(outcome)
        return cast(ProgressResult, outcome)

    def learn(self, step: int, result: ProgressResult, prefix: Prefix, asked_s: float) -> None:
        """Takes over an answer about what ``prefix`` shows, asked at ``asked_s``, unless a newer one is known."""
        if step <= self._known_step:
            return
        frames = of_frames(result, prefix)
        progress = frames.last_progress
        if not self.is_known:
            self._paid_progress = progress
        self._known_step = step
        self._progress, self._success = progress, float(frames.success[-1])
        rule = self._options.terminate_on_success
        if rule is not None and np.isnan(frames.success).any():
            expected = "None with a checkpoint that does not predict success"
            raise ValueError(f"terminate_on_success: expected {expected}, got {rule}")
        if rule is not None and step > 0:
            self.succeeded |= frames.succeeded(last=rule.last, threshold=rule.threshold)
        self._watching.add(step, self._frames[step][0].pixels, frames, asked_s)

    def reward(self, env_reward: float) -> float:
        """The reward of the step."""
        change, self._paid_progress = self._progress - self._paid_progress, self._progress
        reward = self._options.scale * (self._progress if self._options.mode == "absolute" else change)
        return reward + env_reward if self._options.add_to_env_reward else reward

    def info(self) -> Info:
        """The newest known scores, and by how many steps they lag."""
        known = {"progress": self._progress, "success": self._success, "step": self._known_step}
        known |= {"lag": self.step - self._known_step, "skipped": self.num_skipped}
        return known if self._options.terminate_on_success is None else known | {"succeeded": self.succeeded}

    def _check_sizes(self, frames: Sequence[UInt8Array], names: Sequence[str]) -> None:
        for frame, size, name in zip(frames, self._sizes or [frame.shape for frame in frames], names, strict=True):
            if frame.shape != size:
                first = f"uint8 {list(size)}, as the episode's first"
                raise InvalidSampleError.at(name, first, f"{frame.dtype} {list(frame.shape)}")

    def _located(self, error: RewardError) -> RewardError:
        return error.inside(self._where) if self._where and isinstance(error, InvalidSampleError) else error
