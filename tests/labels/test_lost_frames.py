# SPDX-License-Identifier: MIT
"""Videos whose decoder gives fewer frames than the file holds: no frame is lost without an error."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from encoding import encode_here
from rfm_client import InvalidSampleError, UInt8Array, load_trajectory
from rfm_client.frames import read_video
from rfm_labels import DatasetError, open_dataset

NUM_FRAMES = 40
FPS = 10
LOST = r"\(the decoder loses the others, .* download it again; or name a part: start_s of load_trajectory\)"


def moving() -> UInt8Array:
    """Return a moving noisy picture, so that the encoder predicts frames from others."""
    picture = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    return np.stack([np.roll(picture, 2 * t, axis=1) for t in range(NUM_FRAMES)])


def remux(source: Path, target: Path, change: Callable[[list[Any]], list[Any]], **options: str) -> None:
    """Write a file's packets after ``change``."""
    with av.open(str(source)) as whole, av.open(str(target), "w", options=options) as part:
        stream = part.add_stream_from_template(whole.streams.video[0])
        for packet in change([packet for packet in whole.demux(video=0) if packet.dts is not None]):
            packet.stream = stream
            part.mux(packet)


def assert_label_refuses(file: Path) -> None:
    (file.parent / "tasks.csv").write_text(f"video,task\n{file.name},stack the cups\n")
    with pytest.raises(DatasetError, match=file.name):
        dataset = open_dataset(file.parent)
        list(dataset.frames(dataset.episodes[0], "video"))


OPEN = "open-gop=1:keyint=10:min-keyint=10:scenecut=0:bframes=3"
STREAMS: dict[str, tuple[str, dict[str, str]]] = {
    "x264": ("libx264", {"g": "10", "bf": "0", "sc_threshold": "0"}),
    "x264 with open groups": ("libx264", {"x264-params": OPEN}),
    "x264 that refreshes piecewise": ("libx264", {"x264-params": "intra-refresh=1:keyint=10:bframes=0"}),
    "MPEG-2": ("mpeg2video", {"g": "10", "bf": "2", "sc_threshold": "1000000000"}),
}


@pytest.mark.parametrize(
    ("stream", "suffix"),
    [("x264", "mp4"), ("x264", "ts"), *((stream, "mkv") for stream in STREAMS), ("MPEG-2", "ts")],
)
def test_a_video_without_its_first_key_frame_is_refused_but_a_part_that_needs_none_is_read(
    tmp_path: Path, stream: str, suffix: str
) -> None:
    """Cut a video without encoding, like a recording that starts amid a stream."""
    file = tmp_path / f"video.{suffix}"
    encode_here(tmp_path / "all.mp4", moving(), *STREAMS[stream])
    remux(tmp_path / "all.mp4", file, lambda packets: packets[13:])
    with pytest.raises(InvalidSampleError, match=rf"^video: expected 27 frames, one for each packet, got \d+ {LOST}"):
        load_trajectory(file, fps=3)
    assert_label_refuses(file)
    with av.open(str(file)) as container:
        first_s = min(float(packet.pts * packet.time_base) for packet in container.demux(video=0) if packet.size)
    with av.open(str(file)) as container:
        last_s = [frame.time for frame in container.decode(video=0)][-1]
    part = read_video(file, start_s=last_s - first_s - 5 / FPS)
    np.testing.assert_array_equal(part, read_video(tmp_path / "all.mp4")[-6:])
    with pytest.raises(InvalidSampleError, match=rf"^video: expected \d+ frames in this part, .* got \d+ {LOST}"):
        read_video(file, start_s=0, end_s=2)


X265 = ("libx265", {"x265-params": f"log-level=none:{OPEN}"})


@pytest.mark.parametrize("suffix", ["mkv", "mp4", "ts"])
def test_an_hevc_video_without_its_first_key_frame_is_refused_whatever_the_decoder_makes_of_it(
    tmp_path: Path, suffix: str
) -> None:
    """FFmpeg 7 shows made-up pictures there, FFmpeg 8 nothing."""
    file = tmp_path / f"video.{suffix}"
    encode_here(tmp_path / "all.mp4", moving(), *X265)
    remux(tmp_path / "all.mp4", file, lambda packets: packets[13:])
    with pytest.raises(
        InvalidSampleError, match=r"^video: expected an HEVC video that begins with a key frame \(cut it"
    ):
        read_video(file)
    assert_label_refuses(file)


DROPPED = {  # overwrites the type of a coded picture; unknown to every decoder
    "H.264": (*STREAMS["x264"], 0x1E, r"expected frame 37 to be decoded \(download it again\), got Invalid data"),
    "HEVC": (*X265, 0x7E, f"expected 40 frames, one for each packet, got 37 {LOST}"),
}


@pytest.mark.parametrize(("codec", "options", "kind", "refused"), DROPPED.values(), ids=DROPPED)
def test_frames_that_the_decoder_drops_amid_a_video_are_missed(
    tmp_path: Path, codec: str, options: dict[str, str], kind: int, refused: str
) -> None:
    """Damage the head of a slice."""
    file = tmp_path / "video.mp4"
    encode_here(file, moving(), codec, options)
    assert len(read_video(file)) == NUM_FRAMES
    with av.open(str(file)) as container:
        begins = [packet.pos for packet in container.demux(video=0) if packet.size]
    content = bytearray(file.read_bytes())
    for begin in begins[-3:]:
        content[begin + 4] = kind
    file.write_bytes(content)
    with pytest.raises(InvalidSampleError, match=f"^video: {refused}"):
        read_video(file, 3)
    assert_label_refuses(file)


def test_frames_that_a_remuxed_stream_hides_are_missed(tmp_path: Path) -> None:
    """A bare stream has no time stamps: FFmpeg numbers packets as they are decoded, and the first ones get hidden."""
    file = tmp_path / "video.mp4"
    encode_here(tmp_path / "all.mp4", moving(), "libx264", {"bf": "2", "b_strategy": "0", "g": "10"})

    def numbered(packets: list[Any]) -> list[Any]:
        for k, packet in enumerate(packets):
            packet.pts = packet.dts = (k - 2) * packet.duration
        return packets

    remux(tmp_path / "all.mp4", file, numbered, avoid_negative_ts="disabled")
    refused = (
        r"^video: expected 40 frames \(.*ffmpeg -framerate FPS -i RAW.*\), got 38, and time stamps in another order"
    )
    with pytest.raises(InvalidSampleError, match=refused):
        read_video(file)
    with pytest.raises(InvalidSampleError, match=r"^video: expected frames in the order of their time stamps"):
        read_video(file, start_s=1.0)
    assert_label_refuses(file)


def test_a_bare_stream_is_scored_but_not_labelled(tmp_path: Path) -> None:
    encode_here(tmp_path / "video.h264", moving(), format="h264")
    assert len(read_video(tmp_path / "video.h264")) == NUM_FRAMES
    (tmp_path / "tasks.csv").write_text("video,task\nvideo.h264,stack the cups\n")
    with pytest.raises(DatasetError, match="expected 40 frames with time stamps, got 0"):
        open_dataset(tmp_path).episodes  # noqa: B018


def test_a_transport_stream_that_ends_inside_a_packet_is_refused(tmp_path: Path) -> None:
    """The decoder returns part of a still picture without an error."""
    file = tmp_path / "video.ts"
    encode_here(file, moving()[:1].repeat(NUM_FRAMES, axis=0))
    assert len(read_video(file)) == NUM_FRAMES
    file.write_bytes(file.read_bytes()[: 188 * 30 + 90])
    with pytest.raises(
        InvalidSampleError, match=r"^video: expected a whole video file, got one that ends inside a picture, after"
    ):
        read_video(file)
    assert_label_refuses(file)
