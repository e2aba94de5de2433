# SPDX-License-Identifier: MIT
"""Values for the RoboValue benchmark, from a real server.

RoboValue is in no package index: ``vmbmk`` is a fake with the names that the adapter imports. Queries, playback and
comparison behave as its documents say.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from environments import MODEL, assert_close
from rfm_client import InvalidSampleError, RewardClient
from servers import Served

pytestmark = pytest.mark.triton

TASK = "stack the cups"
VIDEO = np.random.default_rng(0).integers(0, 256, (24, 48, 64, 3), np.uint8)


@dataclass(frozen=True)
class FakePlayback:
    """A recording that is played forward, or forward and back as one timeline."""

    playback: str

    def timeline_anchor(self, frame: int) -> int:
        return frame if self.playback == "forward" else 2 * (len(VIDEO) - 1) - frame

    def read_many(self, times: Sequence[int]) -> list[Image.Image]:
        return [Image.fromarray(VIDEO[min(t, 2 * (len(VIDEO) - 1) - t)]) for t in times]


def fake_require(config: Mapping[str, Any], adapter: Any, fields: set[str], *, requires_checkpoint: bool) -> None:
    unknown = set(config) - {"adapter", "python", *fields}
    if unknown or requires_checkpoint:
        raise ValueError(f"unknown={sorted(unknown)}")


def query(frame: int, playback: str = "forward", task: str = TASK) -> Any:
    return SimpleNamespace(state=SimpleNamespace(anchor_frame=frame), instruction=task, playback=playback)


def fake_compare(queries: Sequence[Any], value: Callable[[Sequence[Any]], list[float]]) -> list[float]:
    values = value([query(each.state_a) for each in queries] + [query(each.state_b) for each in queries])
    return [values[len(queries) + index] - values[index] for index in range(len(queries))]


@pytest.fixture
def adapter(monkeypatch: pytest.MonkeyPatch, served: Served) -> Iterator[Any]:
    """The adapter over a fake of RoboValue, made from the configuration of a run."""
    for name in ("vmbmk", "vmbmk.adapters", "vmbmk.adapters.base", "vmbmk.adapters.video_inputs"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    base: Any = sys.modules["vmbmk.adapters.base"]
    base.Adapter, base.require_config, base.compare_value_difference = object, fake_require, fake_compare
    inputs: Any = sys.modules["vmbmk.adapters.video_inputs"]
    inputs.query_view = lambda dataset, query, view: FakePlayback(query.playback)
    from rfm_rl.robovalue import RfmAdapter

    config = {"adapter": "mine", "python": "python", "batch_size": 2, "url": served.url("grpc")}
    made = RfmAdapter.from_config({**config, "client": {"model": MODEL}}, None)
    yield made
    made.close()
    del sys.modules["rfm_rl.robovalue"]


def progress(client: RewardClient, pictures: Sequence[Any]) -> float:
    with client.episode(TASK) as episode:
        for picture in pictures:
            episode.keep(picture)
        return client.score_episodes([episode])[0].progress


def test_a_value_is_the_progress_of_an_episode_that_has_come_to_the_frame(adapter: Any, client: RewardClient) -> None:
    frames = [0, 3, 23]  # shorter and longer than the checkpoint's number of frames
    assert_close(adapter.value([query(frame) for frame in frames]), [progress(client, VIDEO[: t + 1]) for t in frames])


def test_a_cycle_keeps_what_was_shown_before_its_turn(adapter: Any, client: RewardClient) -> None:
    there_and_back = [*VIDEO, *VIDEO[20:-1][::-1]]
    assert_close(adapter.value([query(20, "cycle")])[0], progress(client, there_and_back))


def test_a_comparison_is_the_second_value_minus_the_first(adapter: Any, client: RewardClient) -> None:
    difference = progress(client, VIDEO[:10]) - progress(client, VIDEO[:4])
    assert_close(adapter.compare([SimpleNamespace(state_a=3, state_b=9)]), [difference])


def test_a_query_at_fault_is_an_error_and_no_value(adapter: Any) -> None:
    with pytest.raises(InvalidSampleError, match="task"):
        adapter.value([query(0), query(3, task="")])


def test_it_runs_without_a_gpu_and_without_weights_and_refuses_unknown_settings(adapter: Any) -> None:
    kind = type(adapter)
    assert not kind.requires_gpu
    assert not kind.requires_checkpoint
    with pytest.raises(ValueError, match="fps"):
        kind.from_config({"adapter": "mine", "python": "python", "url": "grpc://host:1", "fps": 3}, None)
