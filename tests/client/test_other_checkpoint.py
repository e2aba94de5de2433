# SPDX-License-Identifier: MIT
"""Another checkpoint is served while episodes grow. The server is a stand-in, whose checkpoint tests replace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coded_env import CodedEnv
from rfm_client import FrameSize, InvalidSampleError, RewardClient
from rfm_rl import RewardModelWrapper, RewardOptions
from shelves import V1, V2, Shelf

SHORT, LONG = replace(V1, max_frames=4), replace(V2, max_frames=8)
TASK = "put the block in the bowl"
FRAME = np.zeros((32, 32, 3), np.uint8)


@pytest.mark.parametrize("wraps", [False, True], ids=["an episode", "a wrapper"])
def test_as_many_frames_are_shown_as_the_checkpoint_was_trained_on_by_now(wraps: bool) -> None:
    shelf = Shelf(SHORT, LONG, after=3, has_encoder=False)
    with RewardClient("", transports=[shelf]) as client:
        if wraps:
            env = RewardModelWrapper(CodedEnv(lengths=(9,)), client, TASK, RewardOptions(frames_from="pixels"))
            env.reset()
            for _ in range(4):
                env.step(0)
        else:
            episode = client.episode(TASK)
            for _ in range(5):
                episode.add(FRAME)
    # the fourth answer is by another checkpoint
    assert [shape[1] for shape in shelf.shapes] == [4, 4, 4, 4, 8]


def test_frames_are_resized_as_the_checkpoint_reads_them_by_now() -> None:
    """Kept frames have the size of the episode's first."""
    small, large = (
        replace(kept, frame_size=FrameSize("exact", (size, size))) for kept, size in ((SHORT, 8), (LONG, 16))
    )
    shelf = Shelf(small, large, after=1, has_encoder=False)
    with RewardClient("", transports=[shelf]) as client, client.episode(TASK, resize=True) as episode:
        for _ in range(2):
            episode.add(FRAME)
        with pytest.raises(InvalidSampleError, match=r"as the episode's first, or a reset, got uint8 \[16, 16, 3\]"):
            episode.add(FRAME)
        assert {shape[2:4] for shape in shelf.shapes} == {(8, 8)}
        episode.reset()
        episode.add(FRAME)
        assert shelf.shapes[-1] == (1, 8, 16, 16, 3)
        kept = client.episode(TASK, resize=True)
        kept.keep(FRAME)
        shelf.other = small
        kept.keep(FRAME)
        client.score_episodes([kept])
        assert shelf.shapes[-1][2:4] == (16, 16)
