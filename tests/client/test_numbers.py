# SPDX-License-Identifier: MIT
"""Numbers that callers give: refused where they cannot hold, taken from numpy as from Python."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfm_client import FrameScores, RewardClient, load_trajectory
from rfm_client.episodes import EpisodeOptions, SuccessRule
from rfm_client.frames import Sampling, read_video
from rfm_labels import LabelOptions, RayOptions
from rfm_rl import RewardOptions

URL = "grpc://127.0.0.1:1"
SCORES = FrameScores(progress=np.full(4, 0.5, np.float32), success=np.full(4, 0.5, np.float32))

Given = Callable[[Any], object]


def client(**options: Any) -> None:
    RewardClient(URL, **options).close()


def giving(kind: Callable[..., object], *names: str, **others: Any) -> dict[str, Given]:
    """By name, what takes the number as this argument."""
    return {f"{kind.__name__}.{name}": lambda value, name=name: kind(**others, **{name: value}) for name in names}


SHARES = {**giving(SuccessRule, "threshold"), **giving(SCORES.succeeded, "threshold")}
COUNTS = {
    **giving(SuccessRule, "last"),
    **giving(SCORES.succeeded, "last"),
    **giving(RewardOptions, "every", "max_pending"),
    **giving(RewardOptions, "max_frames", sampling="rint_pad"),
    **giving(EpisodeOptions, "frames", sampling="rint_pad"),
    **giving(Sampling, "frames", rule="linspace_trunc"),
    **giving(LabelOptions, "workers", "limit", "frames"),
    "LabelOptions.shard": lambda value: LabelOptions(shard=(0, value)),
    **giving(RayOptions, "actors"),
    **giving(client, "max_in_flight"),
}
NO_NUMBERS = [math.nan, math.inf, True, "8"]
KINDS: list[tuple[dict[str, Given], list[Any], list[Any]]] = [  # and what is refused and what is taken
    (SHARES, [-0.01, 1.01], [0, np.float32(0.8)]),
    (COUNTS, [0, 2.5], [np.int64(8)]),
    ({"LabelOptions.episodes": lambda value: LabelOptions(episodes=[value])}, [-1, 2.5], [0, np.int64(8)]),
    (giving(client, "timeout_s"), [0, -1], [np.float32(0.5)]),
    ({**giving(RewardOptions, "scale"), **giving(RayOptions, "num_gpus_per_actor")}, [], [0, np.float32(0.5)]),
]


def cases(kinds: dict[str, Given], values: list[Any]) -> list[Any]:
    return [pytest.param(give, value, id=f"{name}-{value!r}") for name, give in kinds.items() for value in values]


REFUSED = [case for kinds, refused, _ in KINDS for case in cases(kinds, [*NO_NUMBERS, *refused])]


@pytest.mark.parametrize(("give", "value"), REFUSED)
def test_a_number_that_cannot_hold_is_refused(give: Given, value: Any) -> None:
    with pytest.raises(ValueError, match=r"^\w+: expected .*, got "):
        give(value)


@pytest.mark.parametrize(("give", "value"), [case for kinds, _, taken in KINDS for case in cases(kinds, taken)])
def test_a_number_may_be_numpy_s(give: Given, value: Any) -> None:
    give(value)


@pytest.mark.parametrize("give", SHARES.values(), ids=SHARES)
def test_a_threshold_in_percent_is_refused_with_the_probability_to_give(give: Given) -> None:
    with pytest.raises(
        ValueError, match=r"^threshold: expected a number from 0 to 1, got 80; for 80 percent give 0\.8$"
    ):
        give(80)


@pytest.mark.parametrize("value", [math.nan, -1.0, True])
@pytest.mark.parametrize("read", [load_trajectory, read_video])
@pytest.mark.parametrize("name", ["fps", "start_s", "end_s"])
def test_a_part_of_a_video_has_times_that_can_be(tmp_path: Path, read: Any, name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: expected .*, got "):
        read(tmp_path / "video.mp4", **{name: value})
