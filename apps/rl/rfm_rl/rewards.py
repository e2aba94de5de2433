# SPDX-License-Identifier: MIT
"""Turn an episode's scores into Gymnasium rewards. ``gym.py`` states the rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NoReturn, TypeAlias, get_args

import numpy as np

from rfm_client import InvalidSampleError, UInt8Array
from rfm_client.episodes import Episode, EpisodeOptions, FrameOptions, StepScore, SuccessRule
from rfm_client.options import InvalidValueError, checked_count, checked_finite, require

Mode: TypeAlias = Literal["absolute", "delta", "shaping", "final"]
Info: TypeAlias = dict[str, Any]

RELABELS = "compute_reward"  # an environment's method that rewards a step for another goal
RETURNS = "episode_returns"  # attribute in Monitor and RecordEpisodeStatistics
_STATISTICS = "episode"  # key in info, from Monitor and RecordEpisodeStatistics

_PAID: dict[Mode, Callable[[float, float, float, bool], float]] = {  # takes progress now and before, gamma, the end
    "absolute": lambda now, before, gamma, is_end: now,
    "delta": lambda now, before, gamma, is_end: now - before,
    "shaping": lambda now, before, gamma, is_end: gamma * now - before,
    "final": lambda now, before, gamma, is_end: now if is_end else 0.0,
}


@dataclass(frozen=True, kw_only=True)
class RewardOptions(FrameOptions):
    """How to score an episode, and to turn progress into rewards. Raises ValueError for contradictory options.

    mode: ``absolute``: the newest known progress. ``delta``: its change since the step before; an episode's rewards
        add up to its last known progress minus its first, however late scores come. ``shaping``: ``gamma`` times the
        newest known progress minus the progress at the step before (potential-based shaping; where it is added to
        another reward, the progress in a terminal state counts as 0). ``final``: 0, and at an episode's last step
        its progress; without a success rule, only the reset and the last step are scored
    gamma: the discount used to train the policy, above 0 and at most 1, only for ``shaping``
    scale: factor for this reward
    success_bonus: added once per episode, at the first step that is known to succeed by ``success``, or by
        ``terminate_on_success``; never at the reset. The reset raises ValueError if the checkpoint does not predict
        success
    success: the bonus rule; None: ``terminate_on_success``, else the default rule
    add_to_env_reward: True: add the environment's own reward; False: replace it
    every: steps from one score to the next; until a new score comes, ``absolute`` repeats its value
        and ``delta`` is 0
    terminate_on_success: rule that ends the episode at a success, except at the reset's frame. The reset raises
        ValueError if the checkpoint does not predict success
    frames_from: where frames come from, uint8 [H, W, 3]: an observation key, or a function from an environment's
        observation to its frame; None: ``render()``
    cameras: keys of the frames to score and fuse, in the observation or the result from ``frames_from``; empty: a
        single camera without a name
    score: what rewards are made from: ``progress``, or ``remaining_s``: minus the remaining seconds, in place of
        progress in each mode, so that a step pays the seconds that it gains
    sampling, fuse, orient, channels, resize, weights_digest: as in ``rfm_client.episodes.FrameOptions``; rendered
        frames are changed alike
    max_frames: ``frames`` in EpisodeOptions: the rule's frame count
    blocking: True: a step waits for its score; False: only the reset and an episode's last step wait
    max_pending: how many of an environment's steps may have open requests when not blocking
    """

    mode: Mode = "absolute"
    gamma: float | None = None
    scale: float = 1.0
    success_bonus: float = 0.0
    success: SuccessRule | None = None
    add_to_env_reward: bool = False
    every: int = 1
    terminate_on_success: SuccessRule | None = None
    frames_from: str | Callable[[Any], UInt8Array | Mapping[str, UInt8Array]] | None = None
    max_frames: int | None = None
    blocking: bool = True
    max_pending: int = 4

    def __post_init__(self) -> None:
        require("mode", self.mode in get_args(Mode), f"one of {', '.join(get_args(Mode))}", repr(self.mode))
        checked_finite("scale", self.scale)
        checked_finite("success_bonus", self.success_bonus)
        if self.mode == "shaping":
            is_discount = self.gamma is not None and 0 < checked_finite("gamma", self.gamma) <= 1
            require(
                "gamma", is_discount, "the policy's discount, above 0 and at most 1, with mode 'shaping'", self.gamma
            )
        else:
            require("gamma", self.gamma is None, f"None with mode {self.mode!r}", self.gamma)
        is_used = self.success is None or self.success_bonus != 0
        require("success", is_used, "None without success_bonus (terminate_on_success has a rule)", self.success)
        is_one = None in (self.success, self.terminate_on_success) or self.success == self.terminate_on_success
        require(
            "success", is_one, f"None or the rule of terminate_on_success, {self.terminate_on_success}", self.success
        )
        for name in ("every", "max_pending", "max_frames"):
            if getattr(self, name) is not None:
                checked_count(name, getattr(self, name))
        super().__post_init__()
        EpisodeOptions(**self.scoring)  # raises ValueError

    @property
    def scoring(self) -> dict[str, Any]:
        """The arguments that ``client.episode`` gets."""
        of_frames = {each.name: getattr(self, each.name) for each in fields(FrameOptions)}
        return {**of_frames, "frames": self.max_frames, "success": self.success_rule or SuccessRule()}

    @property
    def success_rule(self) -> SuccessRule | None:
        """The rule that ends episodes or decides the bonus; None: success decides nothing."""
        return self.terminate_on_success or self.success or (SuccessRule() if self.success_bonus else None)

    @property
    def shapes_another(self) -> bool:
        """True if ``shaping`` is added to another reward, and must keep that reward's best policies.

        This needs a potential of 0 in terminal states (Ng, Harada and Russell 1999; Grzes 2017). Without another
        reward, such shaping would add up to the same return for every policy, so there the last progress counts.
        """
        return self.mode == "shaping" and (self.add_to_env_reward or self.success_bonus != 0)

    def is_due(self, step: int) -> bool:
        """True if a step between an episode's first and last is scored."""
        return (self.mode != "final" or self.success_rule is not None) and step % self.every == 0

    @property
    def renders(self) -> bool:
        """True if frames come from ``render()``."""
        return self.frames_from is None and not self.cameras

    def frames_of(self, observation: Any) -> Any:
        """Return the frame in an environment's observation; with cameras, a dict. Raises InvalidSampleError."""
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
    """One episode's rewards: the newest known score, and open requests.

    index: the environment's number; None: the only environment
    pending: scores from open requests
    known: the newest known score
    total_reward: sum of the rewards so far
    """

    def __init__(self, options: RewardOptions, episode: Episode, index: int | None) -> None:
        self.index = index
        self.steps = episode
        self._options = options
        self.pending: list[Future[list[StepScore]]] = []
        self.known: StepScore | None = None
        self._paid_progress = np.nan
        self._paid = {"reward": np.nan, "env_reward": np.nan}
        self.total_reward = 0.0
        self.num_skipped = 0
        self.succeeded = False  # ends the episode
        self._has_succeeded = self._has_bonus = self._has_ended = False

    @property
    def is_unpaid(self) -> bool:
        """True if the episode goes on, and one of its steps is not yet paid."""
        paid = 0 if self.known is None or self._options.mode == "final" else self.known.step
        return not self._has_ended and self.steps.step > paid

    def collect(self) -> None:
        """Take over scores from completed requests. Raises the RewardError of a failed request."""
        for answer in [answer for answer in self.pending if answer.done()]:
            self.pending.remove(answer)
            self.learn(*answer.result())

    def cancel(self) -> None:
        """Cancel the requests that are still open."""
        for answer in self.pending:
            answer.cancel()
        self.pending.clear()

    def end(self) -> None:
        """Cancel open requests, and end the episode."""
        self.cancel()
        self.steps.close()
        self._has_ended = True

    def learn(self, score: StepScore) -> None:
        """Take over a score, unless a newer score is known.

        Raises ValueError if ``terminate_on_success`` or ``success_bonus`` is set, but success is not predicted.
        """
        if self.known is not None and score.step <= self.known.step:
            return
        rule, ending = self._options.success_rule, self._options.terminate_on_success
        if rule is not None and np.isnan(score.success):
            name, none = ("success_bonus", "0") if ending is None else ("terminate_on_success", "None")
            expected = f"{none} with a checkpoint that does not predict success"
            raise InvalidValueError.at(name, expected, getattr(self._options, name))
        if self.known is None:
            self._paid_progress = score.value(self._options.score)
        score = replace(score, succeeded=score.succeeded and score.step > 0)  # a reset is no success
        self.known = score
        self._has_succeeded |= rule is not None and score.succeeded
        self.succeeded |= ending is not None and score.succeeded

    def reward(self, env_reward: float, terminated: bool) -> float:
        """Return the newest step's reward. A step that is due must be scored before.

        terminated: True if the environment has reached a terminal state; False at a time limit
        """
        options = self._options
        progress = np.nan if self.known is None else self.known.value(options.score)
        if options.shapes_another and (terminated or self.succeeded):
            progress = 0.0
        before, self._paid_progress = self._paid_progress, progress
        reward = options.scale * _PAID[options.mode](progress, before, options.gamma or 1.0, self._has_ended)
        if self._has_succeeded and not self._has_bonus:
            self._has_bonus = True
            reward += options.success_bonus
        reward += env_reward if options.add_to_env_reward else 0.0
        self.total_reward += reward
        self._paid = {"reward": reward, "env_reward": env_reward}
        return reward

    def info(self) -> Info:
        """Return the newest reward and the newest known scores, under the same keys at a reset and at a step."""
        known = self.known or StepScore(np.nan, np.nan, False, -1, np.nan)
        scores: Info = {**self._paid, "progress": known.progress, "success": known.success, "step": known.step}
        scores |= {"lag": self.steps.step - known.step, "skipped": self.num_skipped, **known.more_scores}
        return scores if self._options.success_rule is None else scores | {"succeeded": self._has_succeeded}


def refuse_relabelling(*_args: object, **_kwargs: object) -> NoReturn:
    """Raise NotImplementedError: a reward for another goal would be the environment's own."""
    expected = "no rewards for other goals, since the reward model scores frames and a task sentence"
    remedy = "turn off hindsight relabelling (HerReplayBuffer); other replay buffers keep the model's rewards"
    raise NotImplementedError(f"{RELABELS}: expected {expected}, got a call; {remedy}")


def with_statistics(info: Info, episode: RewardedEpisode, *, has_statistics: bool = False) -> Info:
    """Return a step's info. Statistics from a Monitor inside the wrapper show the model's rewards.

    has_statistics: True: a Monitor inside reports ends, but does not see one by ``terminate_on_success``
    """
    statistics = info.get(_STATISTICS)
    if isinstance(statistics, dict) and "r" in statistics:
        return {**info, _STATISTICS: {**statistics, **_statistics(episode)}}
    return {**info, _STATISTICS: _statistics(episode)} if has_statistics and episode.succeeded else info


def correct_statistics(infos: Info, index: int, episode: RewardedEpisode) -> None:
    """Put the model's rewards into the statistics in a Gymnasium vector's infos."""
    for info in (infos, infos.get("final_info")):
        if isinstance(info, dict) and f"_{_STATISTICS}" in info and info[f"_{_STATISTICS}"][index]:
            for key, value in _statistics(episode).items():
                if key in info[_STATISTICS]:
                    info[_STATISTICS][key][index] = value


def _statistics(episode: RewardedEpisode) -> dict[str, float]:
    return {"r": episode.total_reward, "l": episode.steps.step}
