# SPDX-License-Identifier: MIT
"""A video of several LeRobot episodes is no trajectory, but a part of it may be."""

from __future__ import annotations

import socket
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from pictures import TOP, numbered, numbers, write_video
from rfm_client import InvalidSampleError, load_trajectory
from rfm_client.frames import frame_times_s, read_video

V30_VIDEO = f"videos/{TOP}/chunk-000/file-000.mp4"
ONE_EPISODE = "video: expected a video of one episode, got a file in the layout of LeRobot v3.0, which holds several: "


def shared_file(root: Path) -> Path:
    file = root / V30_VIDEO
    file.parent.mkdir(parents=True)
    write_video(file, numbered(10))
    return file


def test_a_lerobot_v3_file_is_refused_also_behind_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, outside = shared_file(tmp_path), tmp_path / "video.mp4"
    file.rename(tmp_path / "blob")
    file.symlink_to(tmp_path / "blob")  # as a Hub download consists of links into a cache
    outside.symlink_to(shared_file(tmp_path / "other"))
    monkeypatch.chdir(file.parent)
    for path in (file, Path(file.name), outside):
        for read in (read_video, load_trajectory):
            with pytest.raises(InvalidSampleError, match=f"^{ONE_EPISODE}label the dataset with"):
                read(path)


def test_a_part_of_a_lerobot_v3_file_is_read(tmp_path: Path) -> None:
    file = shared_file(tmp_path)
    part = load_trajectory(file, start_s=0.30000001, end_s=0.7, task="stack the cups")
    assert numbers(part.positions, 10) == [3, 4, 5, 6]
    assert numbers(read_video(file, 5, start_s=0.0, end_s=0.8), 10) == [0, 2, 4, 7]
    for start_s, end_s in ((0.3, 0.3), (5.0, 6.0)):
        with pytest.raises(
            InvalidSampleError, match=r"^start_s to end_s: expected a part with frames, got .* of 0\.9 s"
        ):
            read_video(file, start_s=start_s, end_s=end_s)
    with pytest.raises(InvalidSampleError, match=ONE_EPISODE):
        read_video(file, start_s=0.3)


@pytest.mark.parametrize("begin", [2, 14], ids=["from 0.2 s on", "from 1.4 s on"])
@pytest.mark.parametrize("suffix", ["mp4", "mkv", "webm", "ts"])
def test_a_part_counts_from_the_first_frame_wherever_the_time_stamps_begin(
    tmp_path: Path, suffix: str, begin: int
) -> None:
    file = tmp_path / f"video.{suffix}"
    if suffix == "webm":
        write_video(tmp_path / "video.mkv", numbered(20), list(range(begin, begin + 20)), codec="libvpx")
        (tmp_path / "video.mkv").rename(file)
    else:
        write_video(file, numbered(20), list(range(begin, begin + 20)))
    with av.open(str(file)) as container:
        assert min(packet.pts * packet.time_base for packet in container.demux(video=0) if packet.size) >= Fraction(
            begin, 10
        )
    assert numbers(load_trajectory(file, start_s=0.5, end_s=0.9).positions, 20) == [5, 6, 7, 8]
    assert numbers(read_video(file, 5, start_s=0.0, end_s=0.8), 20) == [0, 2, 4, 7]
    assert numbers(read_video(file, 5), 20) == [0, 2, 4, 6, 8, 10, 12, 14, 16, 19]
    np.testing.assert_allclose(frame_times_s(file, 20), np.arange(20) / 10, atol=1e-3)
    with pytest.raises(InvalidSampleError, match=r"got 2\.0 to None of 1\.9 s"):
        read_video(file, start_s=2.0)


@pytest.mark.parametrize("camera", [TOP, TOP.replace(".", "%2E")])
def test_a_lerobot_v3_file_behind_a_url_is_refused_and_not_downloaded(camera: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        url = f"http://127.0.0.1:{server.getsockname()[1]}/toy/resolve/main/videos/{camera}/chunk-000/file-000.mp4?a=b"
        with pytest.raises(InvalidSampleError, match=ONE_EPISODE):
            load_trajectory(url)
        with pytest.raises(BlockingIOError):
            server.accept()
