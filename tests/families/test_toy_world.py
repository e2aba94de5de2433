# SPDX-License-Identifier: MIT
"""The toy world: clips show their ground truth."""

import numpy as np
import pytest

from demo_training.groups import GroupsDataset
from toy_world import FAILURES, TASKS, Task, make_clip


def test_a_seed_gives_the_same_clip_and_another_seed_another() -> None:
    first, again, other = (make_clip("success", TASKS[0], seed) for seed in (1, 1, 2))
    assert first.frames.dtype == np.uint8
    assert first.frames.shape == (16, 64, 64, 3)
    assert np.array_equal(first.frames, again.frames)
    assert not np.array_equal(first.frames, other.frames)


@pytest.mark.parametrize("seed", range(20))
def test_clips_rise_fall_and_end_as_their_kind_says(seed: int) -> None:
    clips = {kind: make_clip(kind, TASKS[seed % len(TASKS)], seed) for kind in ("success", "rewound", *FAILURES)}
    success, rewound = clips["success"], clips["rewound"]
    assert success.progress[0] == 0
    assert (np.diff(success.progress) >= -1e-9).all()
    assert success.progress[-1] > 0.9
    assert not success.success[0]
    assert success.success[-1]
    assert 4 < rewound.turn < len(rewound.frames) - 3
    assert (np.diff(rewound.progress[rewound.turn :]) <= 1e-9).all()
    assert rewound.progress[rewound.turn] - rewound.progress[-1] > 0.1
    assert not rewound.success[-1]
    for kind in FAILURES:
        assert not clips[kind].success.any()
        assert clips[kind].progress.max() < 0.9


def test_the_right_video_under_a_wrong_sentence_is_the_same_video_without_success() -> None:
    right, wrong = Task("red", "bowl"), Task("red", "plate")
    clip, same = make_clip("success", right, 5), make_clip("success", wrong, 5, shown=right)
    assert np.array_equal(clip.frames, same.frames)
    assert not same.success.any()
    assert same.progress[-1] < 0.5


def test_training_groups_are_the_same_for_the_same_seed_and_step() -> None:
    first, again = (GroupsDataset(3, 2, 2)[1] for _ in range(2))
    assert first.frames.shape == (2, 4, 12, 64, 64, 3)
    assert all(a.equal(b) for a, b in zip(first[:5], again[:5], strict=True))
    assert first.success[:, 0, -1].gather(1, first.task[:, None]).all()  # the first clip does the group's task
