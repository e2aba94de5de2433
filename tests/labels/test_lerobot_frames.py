# SPDX-License-Identifier: MIT
"""Rows of LeRobot datasets get the frame at their time, also where a video has frames without a row."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_commands import invoke
from encoding import encode_here
from labelling import FRONT, LEROBOT, BrightnessScorer, change_column
from pictures import write_video
from rfm_client import UInt8Array
from rfm_client.frames import video_file
from rfm_client.frames.video_decoding import read_packets
from rfm_labels import DatasetError, LabelOptions, label, open_dataset
from rfm_labels.datasets import lerobot

FPS = 10
LENGTHS = (58, 39, 59, 21)  # of the episodes in the first video of the front camera, in both datasets
EPISODES = range(len(LENGTHS))
STARTS = np.cumsum([0, *LENGTHS])[:-1]
DISCARDED = 255  # the number that frames without a row show
TAKES = (7, 0, 12, 3)  # frames without a row, behind or before each episode

V30 = LEROBOT / "toy_v30_many"
SPANS, ROWS = "meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-000.parquet"
VIDEO = f"videos/{FRONT}/chunk-000/file-000.mp4"


def coded(numbers: Sequence[int]) -> UInt8Array:
    """Frames that show a number up to 255 as black and white fields."""
    bits = np.array(numbers)[:, None] >> np.arange(8) & 1
    fields = np.where(bits.reshape(-1, 2, 4), 220, 30).astype(np.uint8)
    return np.ascontiguousarray(np.repeat(fields.repeat(16, axis=1).repeat(16, axis=2)[..., None], 3, axis=3))


def shown(frames: Sequence[UInt8Array]) -> list[int]:
    """The numbers that the frames show."""
    fields = np.stack(frames).mean(axis=3).reshape(-1, 2, 16, 4, 16).mean(axis=(2, 4))
    return ((fields.reshape(-1, 8) > 128) @ (1 << np.arange(8))).tolist()


def regular(length: int) -> list[float]:
    return [t / FPS for t in range(length)]


def by_a_clock(length: int) -> list[float]:
    """Shift each row's time by some milliseconds."""
    return [t / FPS + t * 7 % 10 / 1000 for t in range(length)]


def with_a_late_end(length: int) -> list[float]:
    return [*regular(length)[:-1], (length - 1) / FPS + 0.02]


@dataclass(frozen=True)
class Recording:
    """The parts of a v3.0 dataset. The frame of row t shows the row number.

    film: numbers that the video's frames show
    starts, lasts: frames of the episodes in the video
    """

    film: Sequence[int]
    starts: Sequence[int] = tuple(STARTS)
    lasts: Sequence[int] = LENGTHS
    times: Callable[[int], list[float]] = regular
    frames_a_row: int = 1
    opening: dict[str, Any] = field(default_factory=dict)


def rows_of(episode: int) -> list[int]:
    return list(range(STARTS[episode], STARTS[episode] + LENGTHS[episode]))


ALL = [row for episode in EPISODES for row in rows_of(episode)]
TAKES_BEHIND = [n for e in EPISODES for n in [*rows_of(e), *[DISCARDED] * TAKES[e]]]
TRIMMED = [*(n for e in EPISODES for n in [*[DISCARDED] * TAKES[e], *rows_of(e)]), *[DISCARDED] * 4]
CLOCK = {"tolerance_s": 0.01}
RECORDINGS = {
    "discarded takes": Recording(
        TAKES_BEHIND,
        starts=[int(STARTS[e]) + sum(TAKES[:e]) for e in EPISODES],
        lasts=[LENGTHS[e] + TAKES[e] for e in EPISODES],
    ),
    "trimmed episodes": Recording(TRIMMED, starts=[int(STARTS[e]) + sum(TAKES[: e + 1]) for e in EPISODES]),
    "a row for every second frame": Recording([number for row in ALL for number in (row, DISCARDED)], frames_a_row=2),
    "the times of a clock": Recording(ALL, times=by_a_clock, opening=CLOCK),
    "the times of a clock and discarded takes": Recording(
        TAKES_BEHIND,
        starts=[int(STARTS[e]) + sum(TAKES[:e]) for e in EPISODES],
        lasts=[LENGTHS[e] + TAKES[e] for e in EPISODES],
        times=by_a_clock,
        opening=CLOCK,
    ),
    "last rows that are late": Recording(ALL, times=with_a_late_end, opening={"tolerance_s": 0.03}),
}


def change(file: Path, columns: dict[str, Sequence[float]]) -> None:
    """Replace the first values of columns."""
    for name, new in columns.items():
        change_column(file, name, lambda values, new=new: [*new, *values[len(new) :]])  # type: ignore[misc]


def written(folder: Path, recording: Recording) -> Path:
    root = Path(shutil.copytree(V30, folder / "recorded"))
    starts_s = [start / FPS for start in recording.starts]
    ends_s = [(start + last) / FPS for start, last in zip(recording.starts, recording.lasts, strict=True)]
    change(root / SPANS, {f"videos/{FRONT}/from_timestamp": starts_s, f"videos/{FRONT}/to_timestamp": ends_s})
    change(root / ROWS, {"timestamp": [time_s for length in LENGTHS for time_s in recording.times(length)]})
    coding: dict[str, Any] = {"options": {"crf": "10", "g": "12"}, "rate": FPS * recording.frames_a_row}
    encode_here(root / VIDEO, coded(recording.film), **coding)
    return root


def options(output: Path, **more: Any) -> LabelOptions:
    chosen: dict[str, Any] = {"cameras": (FRONT,), "episodes": list(EPISODES), "frames": 2, "formats": ("progress",)}
    return LabelOptions(output=output, **{**chosen, **more})


@pytest.mark.parametrize("recording", RECORDINGS.values(), ids=RECORDINGS)
def test_each_row_has_the_frame_at_its_time(tmp_path: Path, output: Path, recording: Recording) -> None:
    dataset = open_dataset(written(tmp_path, recording), **recording.opening)
    assert not label(dataset, BrightnessScorer(), options(output)).failures
    for number in EPISODES:
        assert shown(list(dataset.frames(dataset.episode(number), FRONT))) == rows_of(number)


def test_a_row_that_is_further_from_its_frame_than_lerobot_allows_is_refused_with_the_option(
    tmp_path: Path, output: Path
) -> None:
    root = written(tmp_path, RECORDINGS["the times of a clock"])
    message = (
        "episode 0, row 1: .*: expected its frame at 0.1070 s, got one at 0.1000 s; if its rows have the times of a clock, "
        "take the nearest frames with --tolerance-s 0.009"
    )
    with pytest.raises(DatasetError, match=message):
        label(open_dataset(root), BrightnessScorer(), options(output))
    refused = invoke("label", root, "--dry-run", "--tolerance-s", "0")
    assert refused.exit_code
    assert re.search("tolerance.s: expected a number above 0, got 0", refused.output)


def test_other_row_times_are_another_episode(tmp_path: Path, output: Path) -> None:
    """Rows decide the labelled frames, so labels of earlier rows do not count."""
    takes = RECORDINGS["the times of a clock and discarded takes"]
    root = written(tmp_path, takes)
    label(open_dataset(root, **CLOCK), BrightnessScorer(), options(output))
    later = [time_s + 0.5 for time_s in by_a_clock(LENGTHS[0])]
    change(root / ROWS, {"timestamp": later})
    with pytest.raises(DatasetError, match="labels of the episodes as they are now, got others for 0, whose frames or"):
        label(open_dataset(root, **CLOCK), BrightnessScorer(), options(output))


def test_times_late_in_a_long_video_are_those_of_a_float32(tmp_path: Path) -> None:
    """LeRobot's tolerance is smaller than the rounding of time stamps."""
    begin = 7 * FPS * 3600 + 1
    root = Path(shutil.copytree(LEROBOT / "toy_v21", tmp_path / "toy"))
    file = root / f"videos/chunk-000/{FRONT}/episode_000000.mp4"
    count = open_dataset(root).episode(0).num_frames
    write_video(file, coded(range(count)), [begin + t for t in range(count)])
    rows = root / "data/chunk-000/episode_000000.parquet"
    change(rows, {"timestamp": [(begin + t) / FPS for t in range(count)]})
    dataset = open_dataset(root)
    assert shown(list(dataset.frames(dataset.episode(0), FRONT))) == list(range(count))


def test_times_that_fit_from_0_and_from_the_first_frame_are_refused(tmp_path: Path) -> None:
    root = Path(shutil.copytree(LEROBOT / "toy_v21", tmp_path / "toy"))
    file = root / f"videos/chunk-000/{FRONT}/episode_000000.mp4"
    write_video(file, coded(range(90)), [5 + t for t in range(90)])
    times_s = [1 + t / FPS for t in range(open_dataset(root).episode(0).num_frames)]
    change(root / "data/chunk-000/episode_000000.parquet", {"timestamp": times_s})
    dataset = open_dataset(root)
    with pytest.raises(
        DatasetError, match=r"expected times that count from 0 s or from the first frame, got a frame at"
    ):
        dataset.check(dataset.episode(0), FRONT)


def test_a_check_reads_the_packets_of_each_video_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with more cameras than videos that otherwise stay in memory."""
    read: list[Path] = []

    def counted(file: Any, container: str | None = None) -> Any:
        read.append(Path(file.name))
        return read_packets(file, container)

    monkeypatch.setattr(video_file, "read_packets", counted)
    monkeypatch.setattr(lerobot, "_VIDEOS_AT_A_TIME", 1)
    dataset = open_dataset(LEROBOT / "toy_v30_many")
    for episode in dataset.episodes:
        for camera in dataset.cameras:
            dataset.check(episode, camera)
    assert len(read) == len(set(read)) > len(dataset.cameras)
