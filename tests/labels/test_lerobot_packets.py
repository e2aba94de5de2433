# SPDX-License-Identifier: MIT
"""A check reads each video of a LeRobot dataset once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from labelling import LEROBOT
from rfm_client.frames import video_file
from rfm_client.frames.video_decoding import read_packets
from rfm_labels import open_dataset
from rfm_labels.datasets import lerobot


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
