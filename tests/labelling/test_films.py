# SPDX-License-Identifier: MIT
"""Films that are turned, that break off, that are damaged: labels and scores judge them alike."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from encoding import encode
from pictures import TURNS, numbered, turn, write_video
from rfm_client import InvalidSampleError
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.datasets.films import Packets, Span, decode
from rfm_client.data.video import read_video
from rfm_client.labelling import DatasetError, open_dataset

NUM_FRAMES = 40
Write = Callable[[Path, UInt8Array], object]


def noise(count: int = NUM_FRAMES) -> UInt8Array:
    """Frames that hardly compress: the film is mostly frames."""
    return np.random.default_rng(0).integers(0, 256, (count, 64, 64, 3), np.uint8)


def labelled(file: Path) -> UInt8Array:
    """The frames that ``label`` shows of a folder that holds this film."""
    (file.parent / "tasks.csv").write_text(f"video,task\n{file.name},stack the cups\n")
    dataset = open_dataset(file.parent)
    episode = dataset.episodes[0]
    dataset.check(episode, "video")
    return np.stack(list(dataset.frames(episode, "video")))


@pytest.mark.parametrize(("matrix", "quarter_turns"), TURNS.values(), ids=TURNS)
def test_a_turned_film_is_labelled_upright_as_it_is_scored(
    tmp_path: Path, matrix: tuple[int, int, int, int], quarter_turns: int
) -> None:
    file = tmp_path / "film.mp4"
    pictures = np.ascontiguousarray(numbered(3)[:, :, :16])
    pictures[:, :8] //= 2
    write_video(file, pictures)
    turn(file, matrix)
    read = labelled(file)
    assert read.shape[1:3] == ((32, 16) if quarter_turns == 2 else (16, 32))
    assert np.abs(read.astype(int) - np.rot90(pictures, quarter_turns, axes=(1, 2))).mean() < 3
    np.testing.assert_array_equal(read, read_video(file))


def with_container(options: dict[str, str] | None = None, codec: str = "libx264", sound_s: float = 0.0) -> Write:
    """Writes a film with these options of its container, and with sound of this length."""

    def write(file: Path, frames: UInt8Array) -> None:
        with av.open(str(file), "w", options=options or {}) as container:
            stream: Any = container.add_stream(codec, rate=10, options={"g": "10"})
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
            sound: Any = container.add_stream("libopus", rate=48_000, layout="mono") if sound_s else None
            for image in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode())
            if sound:
                silence = np.zeros((1, round(48_000 * sound_s)), np.float32)
                heard = av.AudioFrame.from_ndarray(silence, format="fltp", layout="mono")
                heard.sample_rate = 48_000
                container.mux(sound.encode(heard))
                container.mux(sound.encode())

    return write


def at_irregular_times(file: Path, frames: UInt8Array) -> None:
    write_video(file, frames, times=[2 * t + 30 * (t > 10) + 90 * (t == len(frames) - 1) for t in range(len(frames))])


class Pipe:
    """What a live recording is written to: nothing in it is corrected afterwards."""

    def __init__(self, file: Path) -> None:
        self._file = file.open("wb")

    def write(self, content: bytes) -> int:
        return self._file.write(content)

    def close(self) -> None:
        self._file.close()


def live(codec: str) -> Write:
    def write(file: Path, frames: UInt8Array) -> None:
        pipe = Pipe(file)
        with av.open(pipe, "w", format="matroska") as container:
            stream: Any = container.add_stream(codec, rate=10)
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
            for image in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode())
        pipe.close()

    return write


BROKEN_OFF: dict[str, tuple[str, Write]] = {
    "Matroska": ("film.mkv", write_video),
    "Matroska of a variable rate": ("film.mkv", at_irregular_times),
    "Matroska with longer sound": ("film.mkv", with_container(sound_s=9)),
    "WebM": ("film.webm", lambda file, frames: encode(file, frames, "libvpx", {"deadline": "realtime"})),
    "MP4": ("film.mp4", write_video),
    "MP4 with its index in front": ("film.mp4", with_container({"movflags": "+faststart"})),
    "MP4 in fragments": ("film.mp4", with_container({"movflags": "+frag_keyframe+empty_moov"})),
    "AVI": ("film.avi", with_container(codec="mpeg4")),
}
WHOLE: dict[str, tuple[str, Write]] = BROKEN_OFF | {
    "Matroska recorded live": ("film.mkv", live("libx264")),
    "Matroska recorded live, whose rate is told": ("film.mkv", live("mpeg4")),
    "raw Matroska recorded live": ("film.mkv", live("rawvideo")),
    "MPEG-TS": ("film.ts", with_container()),
}


@pytest.mark.parametrize(("name", "write"), WHOLE.values(), ids=WHOLE)
def test_a_whole_film_is_read(tmp_path: Path, name: str, write: Write) -> None:
    write(tmp_path / name, noise())
    assert len(read_video(tmp_path / name)) == NUM_FRAMES
    assert len(labelled(tmp_path / name)) == NUM_FRAMES


CUTS = [
    pytest.param(name, write, num_bytes, id=f"{kind} {where}")
    for kind, (name, write) in BROKEN_OFF.items()
    for where, num_bytes in (("behind a frame", 0), ("amid a frame", 100))
    if num_bytes or kind != "AVI"  # its sizes are made up where it is recorded live: they are not believed
]


@pytest.mark.parametrize(("name", "write", "num_bytes"), CUTS)
def test_a_film_that_breaks_off_is_refused(tmp_path: Path, name: str, write: Write, num_bytes: int) -> None:
    file = tmp_path / name
    write(file, noise())
    with av.open(str(file)) as container:
        begins = sorted(packet.pos for packet in container.demux(video=0) if packet.size)
    content = file.read_bytes()
    file.write_bytes(content[: begins[24] + num_bytes])
    with pytest.raises(InvalidSampleError, match=r"^video: expected a whole file, got .*film\.\w+\)$"):
        read_video(file)
    with pytest.raises(DatasetError, match=r"film\.\w+: expected a whole video file, got "):
        labelled(file)


def test_a_film_that_breaks_off_is_told_with_its_sizes(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mkv", noise())
    content = (tmp_path / "film.mkv").read_bytes()
    (tmp_path / "film.mkv").write_bytes(content[: len(content) * 6 // 10])
    told = f"the first {len(content) * 6 // 10} bytes of at least {len(content)}"
    with pytest.raises(DatasetError, match=f"film.mkv: expected a whole video file, got {told}$"):
        labelled(tmp_path / "film.mkv")


def spoil(file: Path, number: int) -> None:
    """Noise amid a frame."""
    with av.open(str(file)) as container:
        packet = [packet for packet in container.demux(video=0) if packet.size][number]
        start = packet.pos + packet.size // 3
    content = bytearray(file.read_bytes())
    content[start : start + 40] = np.random.default_rng(1).integers(0, 256, 40, np.uint8).tobytes()
    file.write_bytes(content)


def in_groups(file: Path, frames: UInt8Array) -> None:
    """Each 20th frame needs no other; the others are made from the one before. x264 notices damage in CAVLC."""
    options = {"preset": "ultrafast", "bf": "0", "g": "20", "sc_threshold": "0"}
    with av.open(str(file), "w") as container:
        stream: Any = container.add_stream("libx264", rate=10, options=options)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


REFUSED = "expected an undamaged frame, got one that the decoder marks, or is made from such a one"


def test_a_frame_that_the_decoder_marks_as_damaged_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "film.mp4"
    in_groups(file, noise())
    assert len(read_video(file)) == len(labelled(file)) == NUM_FRAMES
    spoil(file, 5)
    with pytest.raises(InvalidSampleError, match=rf"^video: frame 5: {REFUSED} \(.*film\.mp4\)$"):
        read_video(file)
    with pytest.raises(DatasetError, match=rf"^film\.mp4: .*film\.mp4: frame 5: {REFUSED}$"):
        labelled(file)


def test_damage_counts_up_to_the_next_key_frame_and_only_in_frames_that_are_used(tmp_path: Path) -> None:
    file = tmp_path / "film.mp4"
    in_groups(file, noise())
    spoil(file, 5)
    with pytest.raises(InvalidSampleError, match=rf"^video: frame 13: {REFUSED}"):
        read_video(file, 1)  # frames 0, 13, 26 and 39
    assert len(read_video(file, start_s=0, end_s=0.5)) == 5
    assert len(read_video(file, start_s=2, end_s=4)) == 20
    for first, count in ((0, 5), (20, 20)):
        times_s = Packets.read(file).times_s[first : first + count]
        assert len(list(decode(Span(file, times_s, 0.05, "episode")))) == count


OPEN = "open-gop=1:keyint=10:min-keyint=10:scenecut=0:bframes=3"
STREAMS = {
    "x264 with open groups": ("libx264", {"x264-params": OPEN}),
    "x264 that refreshes piecewise": ("libx264", {"x264-params": "intra-refresh=1:keyint=10:bframes=0"}),
    "x265 with open groups": ("libx265", {"x265-params": f"log-level=none:{OPEN}"}),
    "MPEG-2": ("mpeg2video", {"g": "10", "bf": "2"}),
}


@pytest.mark.parametrize("at_key_frame", [True, False])
@pytest.mark.parametrize(("codec", "options"), STREAMS.values(), ids=STREAMS)
def test_a_film_that_begins_amid_a_stream_is_not_called_damaged(
    tmp_path: Path, codec: str, options: dict[str, str], at_key_frame: bool
) -> None:
    """As cutting without encoding leaves it: the decoder leaves out what it cannot show."""
    encode(tmp_path / "all.mkv", noise(), codec, options)
    with av.open(str(tmp_path / "all.mkv")) as whole, av.open(str(tmp_path / "film.mkv"), "w") as part:
        stream = part.add_stream_from_template(whole.streams.video[0])
        packets = [packet for packet in whole.demux(video=0) if packet.dts is not None]
        second = [k for k, packet in enumerate(packets) if packet.is_keyframe][1:2] if at_key_frame else []
        for packet in packets[second[0] if second else 13 :]:
            packet.stream = stream
            part.mux(packet)
    assert len(read_video(tmp_path / "film.mkv")) >= 15
