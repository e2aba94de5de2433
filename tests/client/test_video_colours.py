# SPDX-License-Identifier: MIT
"""Colours of videos equal those of ``ffmpeg -pix_fmt rgb24`` in every pixel."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

import av
import numpy as np
import pytest

from paths import VIDEOS
from rfm_client.frames import read_video
from rfm_client.frames.video_decoding import Upright

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
