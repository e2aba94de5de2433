# SPDX-License-Identifier: MIT
"""The toy world: clips are what their truth says."""

import numpy as np
import pytest

from demo_evaluation.figures import auroc, order_agreement, spearman
from demo_training.groups import GroupsDataset
from toy_world import FAILURES, KINDS, TASKS, Task, make_clip

SEEDS = range(20)


def test_a_seed_gives_the_same_clip_and_another_seed_another() -> None:
    first, again, other = (make_clip("success", TASKS[0], seed) for seed in (1, 1, 2))
    assert first.frames.dtype == np.uint8
    assert first.frames.shape == (16, 64, 64, 3)
    assert np.array_equal(first.frames, again.frames)
    assert not np.array_equal(first.frames, other.frames)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_success_rises_from_nothing_to_all_and_ends_done(seed: int) -> None:
    clip = make_clip("success", TASKS[seed % len(TASKS)], seed)
    assert clip.progress[0] == 0
    assert (np.diff(clip.progress) >= -1e-9).all()
    assert clip.progress[-1] > 0.9
    assert not clip.success[0]
    assert clip.success[-1]


@pytest.mark.parametrize("kind", FAILURES)
def test_a_failure_never_succeeds(kind: str) -> None:
    for seed in SEEDS:
        clip = make_clip(kind, TASKS[seed % len(TASKS)], seed)
        assert not clip.success.any()
        assert clip.progress.max() < 0.9


@pytest.mark.parametrize("seed", SEEDS)
def test_a_rewound_clip_falls_from_its_turn_on(seed: int) -> None:
    clip = make_clip("rewound", TASKS[seed % len(TASKS)], seed)
    assert 4 < clip.turn < len(clip.frames) - 3
    assert (np.diff(clip.progress[clip.turn :]) <= 1e-9).all()
    assert clip.progress[clip.turn] - clip.progress[-1] > 0.1
    assert not clip.success[-1]


def test_the_right_video_under_a_wrong_sentence_is_the_same_video_without_success() -> None:
    right, wrong = Task("red", "bowl"), Task("red", "plate")
    clip, same = make_clip("success", right, 5), make_clip("success", wrong, 5, shown=right)
    assert np.array_equal(clip.frames, same.frames)
    assert not same.success.any()
    assert same.progress[-1] < 0.5


def test_sentences_differ_by_task_and_verb() -> None:
    assert Task("red", "bowl").sentence() == "put the red block in the bowl"
    assert Task("blue", "plate").sentence("move") == "move the blue block on the plate"


def test_training_groups_are_the_same_for_the_same_seed_and_step() -> None:
    first, again = (GroupsDataset(3, 2, 2)[1] for _ in range(2))
    assert first.frames.shape == (2, 4, 12, 64, 64, 3)
    assert all(a.equal(b) for a, b in zip(first[:5], again[:5], strict=True))
    assert first.success[:, 0, -1].gather(1, first.task[:, None]).all()  # the first clip does the group's task


def test_rank_figures() -> None:
    assert spearman([1, 2, 3, 4], [10, 20, 40, 30]) == pytest.approx(0.8)
    assert auroc([0.1, 0.4, 0.35, 0.8], [0, 0, 1, 1]) == pytest.approx(0.75)
    assert auroc([0.5, 0.5], [0, 1]) == 0.5
    assert order_agreement([0.9, 0.1, 0.9, 0.6]) == pytest.approx(0.75)
    assert set(FAILURES) < set(KINDS)
