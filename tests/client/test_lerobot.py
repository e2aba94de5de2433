# SPDX-License-Identifier: MIT
"""A video of several LeRobot episodes is not a trajectory."""

from __future__ import annotations

import json
import socket
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from pictures import TOP, numbered, numbers, write_video
from rfm_client import InvalidSampleError, load_trajectory
from rfm_client.frames import frame_times_s, read_video


def lerobot_dataset(root: Path, version: str, video: str, episodes: int) -> Path:
    """A dataset's folder, as far as a video's reader looks: ``meta/info.json`` and one file. Gives the file."""
    file = root / video
    file.parent.mkdir(parents=True)
    write_video(file, numbered(10))
    (root / "meta").mkdir()
    info = {"codebase_version": version, "total_episodes": episodes}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return file


V30_VIDEO = f"videos/{TOP}/chunk-000/file-000.mp4"
V21_VIDEO = f"videos/chunk-000/{TOP}/episode_000000.mp4"
ONE_EPISODE = "video: expected a video of one episode, got "
INSTEAD = "label the dataset with rfm-client label, or name the part of the file"


@pytest.mark.parametrize(
    ("version", "video", "held"),
    [
        ("v3.0", V30_VIDEO, "10 episodes"),
        ("v3.1", "videos/000.mp4", "some of the dataset's 10 episodes"),
        (3, "videos/000.mp4", "some of the dataset's 10 episodes"),
    ],
)
def test_a_lerobot_file_that_may_hold_several_episodes_is_refused(
    tmp_path: Path, version: Any, video: str, held: str
) -> None:
    file = lerobot_dataset(tmp_path, version, video, 10)
    for read in (read_video, load_trajectory):
        with pytest.raises(InvalidSampleError) as caught:
            read(file)
        told = f"{ONE_EPISODE}a LeRobot {version} file that holds "
        assert str(caught.value).startswith(told)
        assert f"{held}: {INSTEAD}" in str(caught.value)
        assert str(caught.value).endswith(f"({file})")


def test_a_part_of_a_lerobot_v3_file_is_read(tmp_path: Path) -> None:
    file = lerobot_dataset(tmp_path, "v3.0", V30_VIDEO, 10)
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


def test_a_lerobot_v3_file_without_its_dataset_is_known_by_its_path(tmp_path: Path) -> None:
    file = lerobot_dataset(tmp_path, "v3.0", V30_VIDEO, 10)
    (tmp_path / "meta" / "info.json").unlink()
    with pytest.raises(
        InvalidSampleError, match=f"{ONE_EPISODE}a file in the layout of LeRobot v3.0, which holds many"
    ):
        read_video(file)


@pytest.mark.parametrize("camera", [TOP, TOP.replace(".", "%2E")])
def test_a_lerobot_v3_file_behind_a_url_is_refused_and_not_downloaded(camera: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        url = f"http://127.0.0.1:{server.getsockname()[1]}/toy/resolve/main/videos/{camera}/chunk-000/file-000.mp4?a=b"
        with pytest.raises(InvalidSampleError, match=f"{ONE_EPISODE}a file in the layout of LeRobot v3.0"):
            load_trajectory(url)
        with pytest.raises(BlockingIOError):
            server.accept()


@pytest.mark.parametrize(
    ("version", "video", "episodes"),
    [("v2.1", V21_VIDEO, 10), ("v2.0", V21_VIDEO, 10), ("v3.0", V30_VIDEO, 1), (None, "videos/file-000.mp4", 10)],
    ids=["v2.1", "v2.0", "v3.0 with one episode in all", "another project's info.json"],
)
def test_a_video_of_one_episode_is_read(tmp_path: Path, version: str | None, video: str, episodes: int) -> None:
    file = lerobot_dataset(tmp_path, version or "", video, episodes)
    if version is None:
        (tmp_path / "meta" / "info.json").write_text('{"about": "another project"}')
    assert numbers(read_video(file), 10) == list(range(10))


@pytest.mark.parametrize(("version", "video", "episodes"), [("v2.1", V21_VIDEO, 10), ("v3.0", V30_VIDEO, 1)])
def test_a_video_with_frames_of_a_discarded_take_is_refused(
    tmp_path: Path, version: str, video: str, episodes: int
) -> None:
    file = lerobot_dataset(tmp_path, version, video, episodes)
    (tmp_path / "meta" / "episodes.jsonl").write_text('{"episode_index": 0, "length": 7}\n')
    info = {"codebase_version": version, "total_episodes": episodes, "total_frames": 7}
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    told = f"{ONE_EPISODE}10 frames, of which the episode has 7: {INSTEAD}"
    with pytest.raises(InvalidSampleError, match=f"^{told}"):
        load_trajectory(file)
    assert numbers(read_video(file, start_s=0.0, end_s=0.7), 10) == list(range(7))


def test_a_lerobot_dataset_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    file = lerobot_dataset(tmp_path, "v3.0", V30_VIDEO, 10)
    (tmp_path / "meta" / "info.json").write_text('{"codebase_version": "v3')
    with pytest.raises(InvalidSampleError, match=r"^meta/info\.json: expected a readable JSON file, got Unterminated"):
        read_video(file)


def test_a_lerobot_v3_file_is_known_behind_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, outside = lerobot_dataset(tmp_path / "data", "v3.0", V30_VIDEO, 10), tmp_path / "video.mp4"
    file.rename(tmp_path / "blob")
    file.symlink_to(tmp_path / "blob")  # as a Hub download consists of links into a cache
    outside.symlink_to(lerobot_dataset(tmp_path / "other", "v3.0", V30_VIDEO, 10))
    monkeypatch.chdir(file.parent)
    for path in (Path(file.name), outside):
        with pytest.raises(InvalidSampleError, match=r"a LeRobot v3\.0 file that holds 10 episodes"):
            read_video(path)
