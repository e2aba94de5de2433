# SPDX-License-Identifier: MIT
"""A folder of videos, one for each episode. Every frame of a video counts. Needs PyAV."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from rfm_client import UInt8Array
from rfm_client.frames import check_local_video, decoder
from rfm_labels.datasets.episode_files import Contents, EpisodeFiles
from rfm_labels.datasets.protocol import DatasetEpisode, chosen_cameras, require
from rfm_labels.datasets.video_frames import Span, decode, video_identity, video_packets

_FILES_AT_A_TIME = 4


class VideoFolder(EpisodeFiles):
    """Episodes in videos, each in a file of its own."""

    kind = "videos"
    cameras = ("video",)

    def __init__(self, contents: Contents) -> None:
        super().__init__(contents)
        self._packets = lru_cache(_FILES_AT_A_TIME)(video_packets)

    def length(self, file: Path) -> int:
        check_local_video(file)
        packets = self._packets(file)
        expected = f"{packets.count} frames with time stamps (ffmpeg -framerate FPS -i IN OUT.mp4 gives them)"
        require(file, len(packets.times_s) == packets.count, expected, len(packets.times_s))
        return packets.count

    def decoder(self, camera: str) -> str | None:
        return decoder()

    def identity(self, episode: DatasetEpisode, camera: str, *, verify: bool) -> str:
        return video_identity(self.root / episode.name, verify=verify)

    def check(self, episode: DatasetEpisode, camera: str) -> int:
        chosen_cameras(self, [camera])
        return sum(self._packets(self.root / episode.name).num_bytes)

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        file = self.root / episode.name
        times_s = self._packets(file).times_s
        gaps_s = times_s[1:] - times_s[:-1]
        tolerance_s = 0.5 * float(gaps_s.min()) if len(gaps_s) else 0.5
        return decode(Span(file, times_s, tolerance_s, episode.name))
