# SPDX-License-Identifier: MIT
"""Folders of pictures: order by name, orientation by EXIF data, and pictures stored as BGR."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps, PngImagePlugin

from labelling import BrightnessScorer, Notes
from pictures import numbered, numbers
from rfm_client import UInt8Array
from rfm_labels import DatasetError, LabelOptions, label, open_dataset
from rfm_labels.audit import audit
from rfm_labels.datasets.pictures_in_order import in_order_of_numbers
from rfm_labels.datasets.stored_files import digest_of, file_identity

TASK = "stack the cups"
ORIENTATION, RESOLUTION_UNIT = 0x0112, 0x0128  # EXIF's tags
BRIGHT = np.zeros((6, 8, 3), np.uint8)  # no turn and no swap leaves it as it is
BRIGHT[:2, :3], BRIGHT[0, 0] = (200, 60, 20), (20, 200, 60)


def stored(folder: Path, names: Sequence[str]) -> Path:
    """Write a dataset of one episode with frames of these names. Return the folder."""
    (folder / "0").mkdir(parents=True)
    for frame, name in zip(numbered(len(names)), names, strict=True):
        Image.fromarray(frame).save(folder / "0" / name)
    return folder


def order(root: Path, count: int) -> list[int]:
    """Return the numbers of the frames of the only episode."""
    dataset = open_dataset(root, task=TASK)
    (episode,) = dataset.episodes
    return numbers(np.stack(list(dataset.frames(episode, "frames"))), count)


IN_ORDER: dict[str, Sequence[str]] = {
    "counts": ["frame_0.png", "frame_2.png", "frame_10.png"],
    "times, as Python prints them": [f"frame_{0.25 * t}.png" for t in range(10)],
    "times since 1970": [f"{1764168000 + 0.125 * t}.png" for t in range(12)],
    "times in nanoseconds": ["1764168000.123456788.png", "1764168000.123456789.png"],
    "times with and without decimals": ["0.5.png", "1.png", "1.25.png", "10.png"],
    "times without a zero": ["t_.25.png", "t_.5.png"],
    "tiny times": ["0.0.png", "1e-05.png", "5e-05.png", "0.0001.png", "1.5e+01.png"],
    "negative numbers": ["-10.png", "-2.png", "-1.png", "0.png", "1.png"],
    "negative times": ["t_-0.5.png", "t_-0.25.png", "t_0.png"],
    "a hyphen before a count": ["frame-1.png", "frame-2.png", "frame-10.png"],
    "a point before a count": ["frame.1.png", "frame.2.png", "frame.10.png"],
    "versions": ["v1.2.9.png", "v1.2.10.png", "v1.10.0.png"],
    "dates": ["2026-10-26_12-30-00.png", "2026-11-05_09-00-00.png", "2026-11-26_08-00-00.png"],
    "dates with milliseconds": [f"20261126T1200{s:02d}_{ms:03d}.png" for s in range(3) for ms in (0, 500 + s, 900)],
    "seconds and nanoseconds": ["1_500.png", "1_900.png", "2_100.png", "2_500.png"][:3],
    "a count and a time": [f"frame{t}_{0.1 * t:.1f}.png" for t in range(11)],
    "gaps": ["0.png", "1.png", "3.png"],
    "one picture without a number": ["only.png"],
}


@pytest.mark.parametrize("names", IN_ORDER.values(), ids=IN_ORDER)
def test_numbers_in_names_order_the_frames(tmp_path: Path, names: Sequence[str]) -> None:
    assert in_order_of_numbers(tmp_path, sorted(names, reverse=True)) == list(names)
    assert order(stored(tmp_path / "pictures", names), len(names)) == list(range(len(names)))


SKIPPING = {  # names of pictures, and the pictures around a gap
    "a count": (["f_0001.png", "f_0002.png", "f_0004.png"], "f_0002.png and f_0004.png;"),
    "every fifth": (["0.png", "5.png", "10.png", "25.png", "30.png", "40.png"], "10.png and 25.png, and 1 more"),
    "a clock in ms at 30 Hz": ([f"{ms}.png" for ms in (0, 33, 66, 100, 133, 166, 233)], "166.png and 233.png;"),
    "times of a clock": ([f"{ms}.png" for ms in (1000, 1031, 1068, 1101, 1190)], None),
}


@pytest.mark.parametrize(("names", "told"), SKIPPING.values(), ids=SKIPPING)
def test_a_dry_run_doubts_missing_numbers(tmp_path: Path, names: Sequence[str], told: str | None) -> None:
    dataset = open_dataset(stored(tmp_path, names), task=TASK)
    doubts = [str(each) for each in audit(dataset, dataset.episodes, dataset.cameras) if "no picture" in each.text]
    assert len(doubts) == (told is not None)
    assert all(doubt.startswith(f"episode 0: frames: no picture between {told}") for doubt in doubts)


def test_a_run_notes_missing_numbers(tmp_path: Path) -> None:
    dataset, notes = open_dataset(stored(tmp_path / "data", ["1.png", "2.png", "4.png", "5.png"]), task=TASK), Notes()
    label(dataset, BrightnessScorer(), LabelOptions(output=tmp_path), notes)
    assert (
        "doubt: episode 0: frames: no picture between 2.png and 4.png; were frames dropped while recording?"
        in notes.lines
    )


def of_cameras(pattern: str, cameras: Sequence[object], count: int = 3) -> list[str]:
    return [pattern.format(camera=camera, t=t) for camera in cameras for t in range(count)]


SEVERAL = "expected pictures of one camera, whose names differ in a number, got "
SEVERAL_KINDS = {  # names, what is told, the pattern
    "words before": (
        of_cameras("{camera}_{t:04d}.png", ("left", "right")),
        "left_*.png (3) and right_*.png (3)",
        "{camera}_*.png",
    ),
    "colours and depths": (
        of_cameras("{camera}_{t}.png", ("depth", "rgb")),
        "depth_*.png (3) and rgb_*.png (3)",
        "{camera}_*.png",
    ),
    "masks": (of_cameras("{t:04d}{camera}.png", ("", "_mask")), "*.png (3) and *_mask.png (3)", "*.png"),
    "a copy of a browser": ([*of_cameras("{t}.png", ("",)), "1 (1).png"], "*.png (3) and * (*).png (1)", "*.png"),
    "a picture of the goal": ([*of_cameras("{t}.png", ("",)), "goal.png"], "*.png (3) and goal.png (1)", "*.png"),
    "numbers of cameras": (of_cameras("cam{camera}_{t}.png", (0, 1))[:-1], "cam*_*.png (5)", "{camera}_*.png"),
    "numbers of cameras behind": (of_cameras("{t}_cam{camera}.png", (0, 1)), "*_cam*.png (6)", "*_{camera}.png"),
    "a grid of numbers": (of_cameras("{t:04d}_{camera}.png", (1, 2)), "*_*.png (6)", "*_{camera}.png"),
}


@pytest.mark.parametrize(("names", "told", "pattern"), SEVERAL_KINDS.values(), ids=SEVERAL_KINDS)
def test_several_kinds_of_names_are_refused(tmp_path: Path, names: Sequence[str], told: str, pattern: str) -> None:
    with pytest.raises(DatasetError) as refused:
        in_order_of_numbers(tmp_path, names)
    remedy = f"name the frame's number and the camera, as --videos '{{episode}}/{pattern}'"
    assert str(refused.value) == f"{tmp_path}: {SEVERAL}{told}: {remedy}"


TWICE = {
    "leading zeros": (["001.png", "1.png"], "expected each number once, got 001.png and 1.png: leave the episode"),
    "two endings": (["1.jpeg", "1.jpg", "2.jpg"], "expected each number once, got 1.jpeg and 1.jpg: leave the ep"),
    "a decimal more": (["1.1.png", "1.10.png"], "expected each number once, got 1.1.png and 1.10.png: leave the e"),
    "no number": (["a.png", "b.png"], "expected names that differ in a number, got a.png (1) and b.png (1): copy t"),
}


@pytest.mark.parametrize(("names", "message"), TWICE.values(), ids=TWICE)
def test_names_without_a_clear_order_are_refused(tmp_path: Path, names: Sequence[str], message: str) -> None:
    dataset = open_dataset(stored(tmp_path / "pictures", names), task=TASK)
    with pytest.raises(DatasetError) as refused:
        _ = dataset.episodes
    assert message in str(refused.value)


def with_exif(orientation: int, form: str) -> bytes:
    exif, written = Image.Exif(), io.BytesIO()
    exif[ORIENTATION] = orientation
    Image.fromarray(BRIGHT).save(written, form, exif=exif, quality=100)
    return written.getvalue()


def with_xmp() -> bytes:
    written, info = io.BytesIO(), PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", '<x tiff:Orientation="6"/>')
    Image.fromarray(BRIGHT).save(written, "PNG", pnginfo=info)
    return written.getvalue()


TURNED = {
    **{f"JPEG {number}": with_exif(number, "JPEG") for number in (3, 6, 7)},
    "PNG": with_exif(6, "PNG"),
    "XMP": with_xmp(),
}
AS_STORED = {f"JPEG {number}": with_exif(number, "JPEG") for number in (1, 9)}


def shown(picture: bytes) -> UInt8Array:
    """Decode a picture as ``datasets.Image``, and so LeRobot, does."""
    opened = Image.open(io.BytesIO(picture))
    opened.load()
    if opened.getexif().get(ORIENTATION) is not None:
        opened = ImageOps.exif_transpose(opened)
    return np.asarray(opened.convert("RGB"))


@pytest.mark.parametrize(
    "picture", [*TURNED.values(), *AS_STORED.values()], ids=[*TURNED, *(f"{n}, as stored" for n in AS_STORED)]
)
def test_exif_data_turn_the_frames_of_a_folder_and_change_their_identity(tmp_path: Path, picture: bytes) -> None:
    is_turned = picture in TURNED.values()
    file = tmp_path / "0" / ("0.png" if picture.startswith(b"\x89PNG") else "0.jpg")
    file.parent.mkdir()
    file.write_bytes(picture)
    dataset = open_dataset(tmp_path, task=TASK)
    (episode,) = dataset.episodes
    (frame,) = dataset.frames(episode, "frames")
    np.testing.assert_array_equal(frame, shown(picture))
    assert np.array_equal(frame, np.asarray(Image.open(file).convert("RGB"))) != is_turned
    before = digest_of([f"{file.name} {file_identity(file)}".encode()])
    assert (dataset.identity(episode, "frames") != before) == is_turned  # labels of other pictures stay


def test_other_exif_data_may_be_spoilt(tmp_path: Path) -> None:
    exif, file = Image.Exif(), tmp_path / "0" / "0.jpg"
    exif[ORIENTATION], exif[RESOLUTION_UNIT] = 6, 2
    spoilt = exif.tobytes().replace(
        RESOLUTION_UNIT.to_bytes(2, "big") + b"\0\3", RESOLUTION_UNIT.to_bytes(2, "big") + b"\0\2"
    )
    file.parent.mkdir()
    Image.fromarray(BRIGHT).save(file, exif=spoilt, quality=100)
    with pytest.raises(struct.error):
        ImageOps.exif_transpose(Image.open(file))
    dataset = open_dataset(tmp_path, task=TASK)
    (frame,) = dataset.frames(dataset.episodes[0], "frames")
    np.testing.assert_array_equal(frame, shown(with_exif(6, "JPEG")))


def test_exif_data_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    """``datasets`` fails at them, too."""
    file = tmp_path / "0" / "0.png"
    file.parent.mkdir()
    file.write_bytes(with_exif(6, "PNG"))
    whole = file.read_bytes()
    begin = whole.index(b"eXIf") + 4
    chunk = b"eXIf" + b"no" + whole[begin + 2 : begin + int.from_bytes(whole[begin - 8 : begin - 4], "big")]
    end = begin - 4 + len(chunk)
    file.write_bytes(whole[: begin - 4] + chunk + zlib.crc32(chunk).to_bytes(4, "big") + whole[end + 4 :])
    dataset = open_dataset(tmp_path, task=TASK)
    episode = dataset.episodes[0]
    assert dataset.identity(episode, "frames")
    with pytest.raises(DatasetError, match=r"0\.png: expected an image, got not a TIFF file"):
        list(dataset.frames(episode, "frames"))
