# SPDX-License-Identifier: MIT
"""Trajectories from video files: frames, parts, and colours, which equal those of ``ffmpeg -pix_fmt rgb24``."""

from __future__ import annotations

import hashlib
import subprocess
import tracemalloc
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

import clip
from paths import VIDEOS
from pictures import TOP, numbered, numbers, write_video
from rfm_client import InvalidSampleError, load_trajectory
from rfm_client.frames import frame_times_s, read_video
from rfm_client.frames.video_decoding import Upright


def test_a_video_is_read_whole_or_at_a_frame_rate(video: Path) -> None:
    whole = load_trajectory(video, task=clip.TASK)
    assert whole.task == clip.TASK
    assert np.abs(whole.positions.astype(int) - clip.render()).mean() < 8  # lossy, but the same picture
    sampled = load_trajectory(str(video), fps=3).positions
    indices = np.linspace(0, clip.NUM_FRAMES - 1, round(clip.NUM_FRAMES * 3 / clip.FPS)).astype(int)
    np.testing.assert_array_equal(sampled, whole.positions[indices])


def test_read_video_announces_memory_before_it_takes_it(video: Path) -> None:
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
    assert numbers(read_video(tmp_path / "video.mp4", start_s=0.3, end_s=0.6), 10) == [3, 4, 5]


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


def test_a_text_is_no_video(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InvalidSampleError) as refused:
        read_video(tmp_path / "text.mp4")
    expected = "expected a file with a video stream, got a file of another kind, or a damaged one"
    assert str(refused.value) == f"video: {expected} ({tmp_path / 'text.mp4'})"


@pytest.mark.parametrize("url", ["http://host/clip.mp4?a=b", "https://host/clip.npy"])
def test_a_url_is_to_be_downloaded_first(url: str) -> None:
    with pytest.raises(InvalidSampleError) as refused:
        load_trajectory(url)
    told = "video: expected a video file, got a URL; download it first: curl -LO URL"
    assert str(refused.value) == f"{told} ({url})"


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


WIDTH, HEIGHT = 128, 96

# SHA-256 of ``ffmpeg -i FILE -pix_fmt rgb24 -f rawvideo -``.
DIGESTS = {
    "deep_h264_420_10.mp4": "53bc22c197b736ad",
    "deep_h264_422_10.mp4": "4c78ce747bb5c69e",
    "deep_hevc_420_12.mp4": "44a21879987fc66e",
    "deep_vp9_422_12.mp4": "7c543237a213307e",
    "deep_av1_444_10.mp4": "5670ae6f1ed3724c",
}


@pytest.mark.parametrize(("name", "digest"), DIGESTS.items())
def test_videos_of_10_and_12_bits_have_the_colours_that_ffmpeg_shows(name: str, digest: str) -> None:
    frames = read_video(VIDEOS / name)
    assert frames.shape == (2, 48, 64, 3)
    assert hashlib.sha256(frames.tobytes()).hexdigest()[:16] == digest


CODECS = {
    "libx264": ("mp4", ["yuv420p", "yuv422p", "yuv444p", "yuv420p10le", "yuv422p10le", "yuv444p10le"]),
    "libx265": ("mp4", ["yuv420p10le", "yuv422p10le", "yuv420p12le", "yuv422p12le", "yuv444p12le"]),
    "libvpx-vp9": ("webm", ["yuv420p", "yuv420p10le", "yuv440p10le", "gbrp"]),
    "ffv1": ("mkv", ["yuv411p", "yuv420p9le", "yuv420p16le", "yuva444p", "gray", "bgr0", "gbrp12le"]),
    "mjpeg": ("avi", ["yuvj420p", "yuvj444p"]),
}
TAGS = {
    "BT.709": ["-colorspace", "bt709", "-color_range", "tv"],
    "BT.709, full range": ["-colorspace", "bt709", "-color_range", "pc"],
    "BT.601": ["-colorspace", "smpte170m", "-color_range", "tv"],
    "BT.2020": ["-colorspace", "bt2020nc", "-color_range", "tv"],
    "of constant luminance": ["-colorspace", "bt2020c", "-color_range", "tv"],  # which FFmpeg does not apply
}
FILMS = {
    **{f"{codec} {pixels}": (codec, pixels, []) for codec, (_, kinds) in CODECS.items() for pixels in kinds},
    **{
        f"{pixels}, {name}": ("libx264", pixels, tags)
        for pixels in ("yuv420p", "yuv444p10le")
        for name, tags in TAGS.items()
    },
}


def run(*arguments: str | Path) -> bytes:
    command = [*map(str, arguments[:1]), "-v", "error", "-y", "-threads", "1", *map(str, arguments[1:])]
    return subprocess.run(command, check=True, capture_output=True).stdout


@pytest.mark.parametrize(("codec", "pixels", "tags"), FILMS.values(), ids=FILMS)
def test_colours_equal_those_of_the_program_ffmpeg(
    tmp_path: Path, ffmpeg: str, codec: str, pixels: str, tags: list[str]
) -> None:
    file = tmp_path / f"video.{CODECS[codec][0]}"
    source = f"testsrc2=s={WIDTH}x{HEIGHT}:r=10:d=0.2,noise=alls=20:allf=t"
    quick = {"libx265": ["-x265-params", "log-level=none"], "libvpx-vp9": ["-deadline", "realtime"]}.get(codec, [])
    run(ffmpeg, "-f", "lavfi", "-i", source, "-pix_fmt", pixels, "-c:v", codec, *quick, *tags, file)
    shown = run(ffmpeg, "-i", file, "-pix_fmt", "rgb24", "-f", "rawvideo", "-")
    expected = np.frombuffer(shown, np.uint8).reshape(-1, HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(read_video(file), expected)


def test_frames_whose_kind_changes_are_converted_as_if_alone() -> None:
    rng = np.random.default_rng(0)
    frames = []
    for size, pixels, matrix in (((32, 48), "yuv420p", 1), ((32, 48), "yuv420p", 5), ((16, 16), "yuv444p10le", 9)):
        frame = av.VideoFrame.from_ndarray(rng.integers(0, 256, (*size, 3), np.uint8), format="rgb24")
        frames.append(frame.reformat(format=pixels))
        frames[-1].colorspace = matrix
    upright = Upright()
    for frame in (*frames, *frames):
        np.testing.assert_array_equal(upright(frame), Upright()(frame))
    assert not np.array_equal(upright(frames[0]), np.zeros_like(upright(frames[0])))
