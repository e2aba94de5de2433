# SPDX-License-Identifier: MIT
"""A dry run lists doubts about recordings that contradict nothing."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from labelling import FRONT, LEROBOT, BrightnessScorer
from rfm_client import UInt8Array
from rfm_labels import Dataset, Episode, LabelOptions, RayOptions, open_dataset
from rfm_labels.audit import MOST_DECODED, audit
from rfm_labels.commands import EpisodeTexts, LabelCommand, RunOptions

RANDOM = np.random.default_rng(0)


def moving(first: int, count: int = 4) -> UInt8Array:
    """Frames, uint8 [T, 16, 16, 3], through which a bright column moves."""
    frames = RANDOM.integers(60, 62, (count, 16, 16, 3)).astype(np.uint8)
    for t, frame in enumerate(frames):
        frame[:, (first + 3 * t) % 16] = 255
    return frames


def opened(folder: Path, clips: Sequence[UInt8Array]) -> Dataset:
    episodes = [Episode(f"{number:03d}", {"front": clip}, task="push the cube") for number, clip in enumerate(clips)]
    return open_dataset(folder, reader=lambda _: episodes)


def test_frozen_blank_and_stale_frames_are_doubted(tmp_path: Path) -> None:
    stale = moving(2)
    before = moving(11)
    stale[0] = before[-1]
    episodes = [
        moving(0),
        before,
        stale,
        np.repeat(moving(5, 1), 4, axis=0),
        np.zeros((4, 16, 16, 3), np.uint8),
        moving(1),
    ]
    dataset = opened(tmp_path, episodes)
    doubts = [(each.episode, each.text) for each in audit(dataset, dataset.episodes, dataset.cameras)]
    assert doubts == [
        (2, "the first frame equals the last of the episode before, then the picture jumps"),
        (3, "the picture never changes"),
        (4, "black pictures"),
    ]


def test_a_large_dataset_is_sampled_in_pairs(tmp_path: Path) -> None:
    dataset = opened(tmp_path, [np.zeros((2, 8, 8, 3), np.uint8)] * (MOST_DECODED + 10))
    episodes = [each.episode for each in audit(dataset, dataset.episodes, dataset.cameras)]
    assert len(episodes) == MOST_DECODED
    assert {0, 1, MOST_DECODED + 8, MOST_DECODED + 9} <= {*episodes}


def test_a_dry_run_writes_its_doubts_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = shutil.copytree(LEROBOT / "toy_v21", tmp_path / "toy")
    (video,) = root.rglob(f"{FRONT}/episode_000002.mp4")
    shutil.copy(video, video.with_name("episode_000099.mp4"))
    for file in sorted(root.rglob("data/**/*.parquet")):
        table = parquet.read_table(file)
        done = [None if file.stem.endswith("3") else True] * len(table)
        table = table.append_column("next.success", pa.array(done, pa.bool_()))
        parquet.write_table(table.append_column("success", pa.array([0.5] * len(table))), file)
    options = LabelOptions(output=tmp_path / "out", cameras=(FRONT,), frames=4)
    connect = lambda: nullcontext(BrightnessScorer())  # noqa: E731
    run = RunOptions(dry_run=True, json="-")
    assert LabelCommand(str(root), EpisodeTexts(), options, run, RayOptions(), connect, str).run() == 0
    document = json.loads(capsys.readouterr().out)
    assert [each["text"] for each in document["doubts"]] == [
        "1 file that no episode uses: videos/chunk-000/observation.images.front/episode_000099.mp4; left from a recording "
        "that was written again?",
        "next.success: 1 episode without an outcome: 3",
        "outcome: success: episode 0: expected true, false, 1, 0, success or failure, got 0.5",
    ]
    assert (document["episodes"], document["cameras"]) == (len(open_dataset(root).episodes), [FRONT])
    assert any(note.startswith("sampling: ") for note in document["notes"])
    assert not (tmp_path / "out").exists()
