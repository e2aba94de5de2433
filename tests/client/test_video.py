# SPDX-License-Identifier: MIT
"""Trajectories from video files and URLs."""

from __future__ import annotations

import re
import socket
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import clip
from pictures import numbered, numbers, write_video
from rfm_client import InvalidSampleError, load_trajectory
from rfm_client.frames import read_video
from servers import FolderRequest, web_server


def test_a_video_is_read_whole_or_at_a_frame_rate(video: Path) -> None:
    whole = load_trajectory(video, task=clip.TASK)
    assert whole.task == clip.TASK
    assert np.abs(whole.positions.astype(int) - clip.render()).mean() < 8  # lossy, but the same picture
    sampled = load_trajectory(str(video), fps=3).positions
    indices = np.linspace(0, clip.NUM_FRAMES - 1, round(clip.NUM_FRAMES * 3 / clip.FPS)).astype(int)
    np.testing.assert_array_equal(sampled, whole.positions[indices])


def test_memory_is_told_before_it_is_taken(video: Path) -> None:
    frame_bytes = clip.SIZE_PX**2 * 3
    told: list[int] = []
    frames = read_video(video, 1, take=told.append)
    assert len(told) > len(frames) + 1  # called for each decoded frame, so an error there ends the reading soon
    assert [size for size in told if size] == [*[frame_bytes] * len(frames), frames.nbytes]

    def refuse(num_bytes: int) -> None:
        raise MemoryError(num_bytes)

    with pytest.raises(MemoryError, match=f"^{frame_bytes}$"):
        read_video(video, take=refuse)


def test_frames_of_a_variable_rate_are_even_in_number(tmp_path: Path) -> None:
    write_video(tmp_path / "video.mp4", numbered(10), [0, 1, 2, 3, 4, 5, 6, 20, 40, 60])  # 1.6 fps on average
    assert numbers(read_video(tmp_path / "video.mp4"), 10) == list(range(10))
    assert numbers(read_video(tmp_path / "video.mp4", 0.82), 10) == [0, 2, 4, 6, 9]


def test_only_the_picked_frames_of_a_long_video_are_held(tmp_path: Path) -> None:
    frames = numbered(200)
    write_video(tmp_path / "video.mp4", frames)
    read_video(tmp_path / "video.mp4", 0.1)  # imports done
    tracemalloc.start()
    picked = read_video(tmp_path / "video.mp4", 0.2)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert numbers(picked, 200) == [0, 66, 132, 199]
    assert peak < 40 * frames[0].nbytes


def test_a_sound_is_no_video(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=16_000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16_000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(InvalidSampleError) as refused:
        read_video(tmp_path / "sound.mp4")
    assert str(refused.value) == f"video: expected a file with a video stream, got none ({tmp_path / 'sound.mp4'})"


class FileRequest(FolderRequest):
    """Serves the files of a folder and records the paths; ``/short/...`` ends early."""

    def __init__(self, asked: list[str], *connection: Any, **options: Any) -> None:
        self.asked = asked
        super().__init__(*connection, **options)

    def do_GET(self) -> None:  # noqa: N802  the base class's name
        self.asked.append(self.path)
        file = Path(self.directory, Path(self.path.partition("?")[0]).name)
        if not file.exists():
            self.send_error(404)
            return
        content = file.read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content[:-9] if self.path.startswith("/short/") else content)


@contextmanager
def serving(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Serve the folder's files. Yields the URL and the requested paths."""
    asked: list[str] = []
    with web_server(partial(FileRequest, asked, directory=str(folder))) as url:
        yield url, asked


def test_a_url_is_downloaded_once_and_read_as_the_file_is(video: Path) -> None:
    with serving(video.parent) as (url, asked):
        loaded = load_trajectory(f"{url}/clip.mp4?token=3", task=clip.TASK, fps=3)
        assert asked == ["/clip.mp4?token=3"]
    np.testing.assert_array_equal(loaded.positions, read_video(video, 3))


BAD_URLS = {
    "not there": ("nothing.mp4", "HTTP Error 404: Not Found"),
    "broken off": ("short/clip.mp4", "[0-9]+ of [0-9]+ bytes came"),
    "no video": ("text.mp4", "a file of another kind, or a damaged one"),
}


@pytest.mark.parametrize(("path", "reason"), BAD_URLS.values(), ids=BAD_URLS)
def test_a_url_that_fails_is_told_with_its_reason(video: Path, path: str, reason: str) -> None:
    (video.parent / "text.mp4").write_text("no video")
    with serving(video.parent) as (url, _), pytest.raises(InvalidSampleError) as refused:
        load_trajectory(f"{url}/{path}")
    expected = f"video: expected a file with a video stream, got {reason} "
    assert re.fullmatch(expected + re.escape(f"({url}/{path})"), str(refused.value))


def test_a_server_that_says_nothing_is_given_up() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/clip.mp4"
        with pytest.raises(InvalidSampleError, match=r"^video: expected .*, got timed out \(http://.*\)$"):
            read_video(url, 3, timeout_s=0.1)
    with pytest.raises(InvalidSampleError, match=r"^video: expected .*, got .*Connection refused.* \(http://.*\)$"):
        read_video(url, 3)


@pytest.mark.parametrize("url", ["http://", "http://localhost:none/", "https://lücke/\n"])
def test_a_url_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(InvalidSampleError, match=r"^video: expected a file with a video stream, got "):
        read_video(url, 3)
