# SPDX-License-Identifier: MIT
"""Turned, broken and damaged videos: labels and scores judge them alike."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from encoding import encode_here
from pictures import TURNS, Matrix, numbered, numbers, turn, write_video
from rfm_client import InvalidSampleError, UInt8Array, load_trajectory
from rfm_client.frames import frame_times_s, read_video
from rfm_labels import DatasetError, open_dataset

NUM_FRAMES = 40
Write = Callable[[Path, UInt8Array], object]


def noise(count: int = NUM_FRAMES) -> UInt8Array:
    """Frames that hardly compress: the video is mostly frames."""
    return np.random.default_rng(0).integers(0, 256, (count, 64, 64, 3), np.uint8)


def labelled(file: Path) -> UInt8Array:
    """Return the frames that ``label`` reads from a folder with this video."""
    (file.parent / "tasks.csv").write_text(f"video,task\n{file.name},stack the cups\n")
    dataset = open_dataset(file.parent)
    episode = dataset.episodes[0]
    dataset.check(episode, "video")
    return np.stack(list(dataset.frames(episode, "video")))


def assert_both_refuse(file: Path, reason: str, of_label: str = "") -> None:
    """Both readers give a reason, a pattern; ``label`` perhaps another."""
    with pytest.raises(InvalidSampleError, match=rf"^video: {reason}.* \({file}\)$"):
        read_video(file)
    with pytest.raises(DatasetError, match=rf"{file}: {of_label or reason}"):
        labelled(file)


@pytest.mark.parametrize(("matrix", "shown"), TURNS.values(), ids=TURNS)
def test_a_turned_or_mirrored_video_is_read_upright(
    tmp_path: Path, matrix: Matrix, shown: Callable[[UInt8Array], UInt8Array]
) -> None:
    file = tmp_path / "video.mp4"
    pictures = np.zeros((3, 32, 64, 3), np.uint8)
    pictures[:, :16, :32], pictures[:, :16, 32:], pictures[:, 16:, :32] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    write_video(file, pictures)
    turn(file, matrix)
    read = labelled(file)
    upright = np.stack([shown(picture) for picture in pictures])
    assert read.shape == upright.shape
    assert np.abs(read.astype(int) - upright).mean() < 3
    np.testing.assert_array_equal(read, read_video(file))


@pytest.mark.parametrize("matrix", [(1, 1, -1, 1), (1, 0, 1, 1)], ids=["half a quarter turn", "skewed"])
def test_a_video_that_is_shown_aslant_is_refused(tmp_path: Path, matrix: Matrix) -> None:
    write_video(tmp_path / "video.mp4", numbered(3))
    turn(tmp_path / "video.mp4", matrix)
    reason = r"expected a video that is shown upright or by quarter turns \(turn it: ffmpeg -i IN OUT\), got one that"
    assert_both_refuse(tmp_path / "video.mp4", reason)


def test_packets_that_are_not_shown_are_no_frames(tmp_path: Path) -> None:
    file = tmp_path / "video.mp4"
    write_video(file, numbered(10), shown_from=4)
    with av.open(str(file)) as container:
        assert container.streams.video[0].frames == 10  # as the container says, wrongly
    assert numbers(labelled(file), 10) == numbers(read_video(file), 10) == [4, 5, 6, 7, 8, 9]
    assert numbers(read_video(file, 5), 10) == [4, 6, 9]


GREY = {"gray": False, "gray10le": True, "gray16le": True, "yuv420p10le": False, "bgr0": False}


@pytest.mark.parametrize(("pixels", "is_depth"), GREY.items())
def test_videos_of_one_deep_channel_are_refused_as_depth_maps(tmp_path: Path, pixels: str, is_depth: bool) -> None:
    file = tmp_path / "video.mkv"
    encode_here(file, numbered(3), "ffv1", pixels=pixels)
    if is_depth:
        refused = rf"expected a video of colours \(leave a depth camera out .*\), got {pixels}, as depth maps have"
        assert_both_refuse(file, refused)
    else:
        assert numbers(read_video(file), 3) == numbers(labelled(file), 3) == [0, 1, 2]


def write_streams(file: Path, *videos: tuple[UInt8Array, bool]) -> None:
    """Write several videos into a file. Each says whether it is an attached picture."""
    with av.open(str(file), "w") as container:
        streams: list[Any] = []
        for frames, attached in videos:
            stream: Any = container.add_stream("mjpeg" if attached else "libx264", rate=10)
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuvj420p" if attached else "yuv420p"
            if attached:
                stream.disposition = av.stream.Disposition.attached_pic.value
            streams.append(stream)
        for stream, (frames, _) in zip(streams, videos, strict=True):
            for image in [*frames, None]:
                frame = None if image is None else av.VideoFrame.from_ndarray(image, format="rgb24")
                container.mux(stream.encode(frame))


def test_cover_art_is_no_video_and_a_file_of_several_videos_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "video.mp4"
    write_streams(file, (numbered(1)[:, :16], True), (numbered(5), False))
    with av.open(str(file)) as container:
        assert len(container.streams.video) == 2
    assert numbers(read_video(file), 5) == numbers(labelled(file), 5) == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(frame_times_s(file, 5), np.arange(5) / 10)
    write_streams(file, (numbered(1), True))
    assert_both_refuse(file, "expected a file with a video stream, got none")
    write_streams(file, (numbered(1)[:, :16], False), (numbered(1), True), (numbered(5), False))
    refused = (
        r"expected one video stream \(take one: ffmpeg -i IN -map 0:v:N -c copy OUT\), "
        r"got 2: 0:v:\d \(h264, 32x16\), 0:v:\d \(h264, 32x32\)"
    )
    assert_both_refuse(file, refused)
    with pytest.raises(InvalidSampleError, match=f"^video: {refused}"):
        frame_times_s(file, 5)


def coded(codec: str = "libx264", **more: Any) -> Write:
    """Writes a video with this codec. more: as in ``encode_here``"""
    return lambda file, frames: encode_here(file, frames, codec, **more)


CONTAINERS: dict[str, tuple[str, Write]] = {
    "Matroska": ("video.mkv", write_video),
    "MP4": ("video.mp4", write_video),
    "MP4 with its index in front": ("video.mp4", coded(of_container={"movflags": "+faststart"})),
    "MP4 in fragments": ("video.mp4", coded(of_container={"movflags": "+frag_keyframe+empty_moov"})),
    "AVI": ("video.avi", coded("mpeg4")),
    "GIF": ("video.gif", coded("gif", pixels="rgb8")),
    "Ogg": ("video.ogv", coded("libvpx", options={"deadline": "realtime"})),
    "MPEG-TS": ("video.ts", coded()),
    "FLV": ("video.flv", coded("flv")),
}


@pytest.mark.parametrize(("name", "write"), CONTAINERS.values(), ids=CONTAINERS)
def test_a_truncated_video_is_refused_or_read_as_far_as_its_whole_frames_go(
    tmp_path: Path, name: str, write: Write
) -> None:
    file = tmp_path / name
    write(file, noise())
    shown = read_video(file)
    assert len(shown) == len(labelled(file)) == NUM_FRAMES
    assert len(read_video(file, fps=FPS / 2)) == NUM_FRAMES // 2
    whole = file.read_bytes()
    file.write_bytes(whole[: int(len(whole) * 0.31)])
    for read in (read_video, labelled):
        try:
            frames = read(file)
        except (InvalidSampleError, DatasetError):
            continue
        np.testing.assert_array_equal(frames, shown[: len(frames)])


def test_damage_counts_up_to_the_next_key_frame_and_only_in_frames_that_are_used(tmp_path: Path) -> None:
    """Every 20th frame is a key frame; others need the frame before. x264 notices damage in CAVLC."""
    file = tmp_path / "video.mp4"
    options = {"preset": "ultrafast", "bf": "0", "g": "20", "sc_threshold": "0"}
    encode_here(file, noise(), "libx264", options)
    assert len(read_video(file)) == len(labelled(file)) == NUM_FRAMES
    with av.open(str(file)) as container:
        packet = [packet for packet in container.demux(video=0) if packet.size][5]
        start = packet.pos + packet.size // 3
    content = bytearray(file.read_bytes())
    content[start : start + 40] = np.random.default_rng(1).integers(0, 256, 40, np.uint8).tobytes()
    file.write_bytes(content)
    refused = "expected an undamaged frame, got one that the decoder marks, or is made from such a one"
    assert_both_refuse(file, f"frame 5: {refused}")
    with pytest.raises(InvalidSampleError, match=rf"^video: frame 13: {refused}"):
        read_video(file, 1)  # frames 0, 13, 26 and 39
    assert len(read_video(file, start_s=0, end_s=0.5)) == 5
    assert len(read_video(file, start_s=2, end_s=4)) == 20


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
    with pytest.raises(DatasetError, match=file.name):
        labelled(file)
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
    assert_both_refuse(file, r"expected an HEVC video that begins with a key frame \(cut it", "expected ")


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
    assert_both_refuse(file, refused, "expected frame 3[57] ")


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
    with pytest.raises(DatasetError, match=file.name):
        labelled(file)


def test_a_bare_stream_is_scored_but_not_labelled(tmp_path: Path) -> None:
    encode_here(tmp_path / "video.h264", moving(), format="h264")
    assert len(read_video(tmp_path / "video.h264")) == NUM_FRAMES
    with pytest.raises(DatasetError, match="expected 40 frames with time stamps, got 0"):
        labelled(tmp_path / "video.h264")


def test_a_transport_stream_that_ends_inside_a_packet_is_refused(tmp_path: Path) -> None:
    """The decoder returns part of a still picture without an error."""
    file = tmp_path / "video.ts"
    encode_here(file, moving()[:1].repeat(NUM_FRAMES, axis=0))
    assert len(read_video(file)) == NUM_FRAMES
    file.write_bytes(file.read_bytes()[: 188 * 30 + 90])
    assert_both_refuse(file, "expected a whole video file, got one that ends inside a picture, after")
