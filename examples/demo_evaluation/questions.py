# SPDX-License-Identifier: MIT
"""Held-out clips, and the questions about them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfm_client import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory
from toy_world import FAILURES, NUM_FRAMES, TASKS, VERBS, Clip, make_clip
from toy_world.render import SIZE_PX

_SEEDS_PER_TASK = 10  # room between the seeds of one case and the next
_NOISE_PAIRS = 40
_NOISE_SEED = 0


@dataclass(frozen=True, eq=False)
class Case:
    """A task and one clip of every sort. Every clip has a scene of its own.

    other: a success at another task; wrong_sentence: the video of ``success`` under the sentence of that other task
    """

    verb: str
    success: Clip
    second_success: Clip
    failure: Clip
    rewound: Clip
    other: Clip
    wrong_sentence: Clip

    @property
    def clips(self) -> tuple[Clip, ...]:
        """In the order of the questions about progress."""
        return self.success, self.second_success, self.failure, self.rewound, self.wrong_sentence

    def trajectory(self, clip: Clip) -> Trajectory:
        """The clip as a client sends it."""
        return Trajectory(frames=clip.frames, task=clip.task.sentence(self.verb))

    def samples(self) -> list[Sample]:
        """Progress of ``clips``; preferences, either way round; similarity to the second success and to ``other``."""
        success, second, failure = map(self.trajectory, (self.success, self.second_success, self.failure))
        wrong = Trajectory(frames=self.other.frames, task=success.task)
        return [
            *(ProgressSample(self.trajectory(clip)) for clip in self.clips),
            PreferenceSample(success, failure),
            PreferenceSample(failure, success),
            PreferenceSample(success, wrong),
            PreferenceSample(wrong, success),
            SimilaritySample(success, second),
            SimilaritySample(success, wrong),
        ]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """All cases: tasks, verbs and sorts of failure take turns."""

    cases: list[Case]

    @classmethod
    def of(cls, num_cases: int, seed: int) -> HeldOut:
        """The same cases for the same seed; training draws its clips from other generators."""
        return cls([_case(index, seed + index * _SEEDS_PER_TASK) for index in range(num_cases)])

    @property
    def num_clips(self) -> int:
        """Different videos; a wrong sentence over one of them adds none."""
        return 5 * len(self.cases)

    def samples(self) -> list[Sample]:
        """The questions, case by case."""
        return [sample for case in self.cases for sample in case.samples()]


def noise_samples() -> list[Sample]:
    """Preferences between clips of random pixels, each pair either way round."""
    random = np.random.default_rng(_NOISE_SEED)
    samples: list[Sample] = []
    for index in range(_NOISE_PAIRS):
        task = TASKS[index % len(TASKS)].sentence(VERBS[index % len(VERBS)])
        first, second = random.integers(0, 256, (2, NUM_FRAMES, SIZE_PX, SIZE_PX, 3), np.uint8)
        pair = PreferenceSample(Trajectory(frames=first, task=task), Trajectory(frames=second, task=task))
        samples += [pair, pair.swapped]
    return samples


def _case(index: int, seed: int) -> Case:
    random = np.random.default_rng([seed, index])
    task = TASKS[index % len(TASKS)]
    other = TASKS[random.choice([i for i in range(len(TASKS)) if TASKS[i] != task])]
    return Case(
        verb=VERBS[int(random.integers(len(VERBS)))],
        success=make_clip("success", task, seed),
        second_success=make_clip("success", task, seed + 1),
        failure=make_clip(FAILURES[int(random.integers(len(FAILURES)))], task, seed + 2),
        rewound=make_clip("rewound", task, seed + 3),
        other=make_clip("success", other, seed + 4),
        wrong_sentence=make_clip("success", other, seed, shown=task),
    )
