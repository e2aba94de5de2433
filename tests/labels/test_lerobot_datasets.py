# SPDX-License-Identifier: MIT
"""LeRobot datasets that LeRobot's own writer made: frame t is the dataset's frame t, and contradictions are refused."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import PIL
import pyarrow as pa
import pytest
from PIL import Image
from pyarrow import parquet

import goldens
import local_hub
from encoding import encode, encode_here
from labelling import FRONT, LEROBOT, WRIST, BrightnessScorer, change_column, change_info
from rfm_client.frames import FrameFileError, Picture
from rfm_client.options import ConfigError
from rfm_labels import DatasetError, LabelOptions, RayOptions, label, open_dataset
from rfm_labels.commands import EpisodeTexts, LabelCommand, RunOptions
from rfm_page.datasets import ShownLeRobot

HUB_ID = "org/name"
ELSEWHERE = goldens.ROOT.parent / "lerobot"  # beside the further reference cases, where there are some
DATASETS = [
    pytest.param(LEROBOT / "toy_v21", id="v2.1"),
    pytest.param(LEROBOT / "toy_v30_many", id="v3.0 in several files"),
    *(
        pytest.param(folder, id=f"elsewhere {folder.name}", marks=pytest.mark.reference)
        for folder in (sorted(ELSEWHERE.glob("toy_*")) if ELSEWHERE != LEROBOT else [])
    ),
]


def whole_video(file: Path) -> list[np.ndarray[Any, Any]]:
    with av.open(str(file)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def videos(root: Path, camera: str) -> list[Path]:
    found = [file for file in root.rglob("*.mp4") if camera in file.parts]
    return sorted(found, key=lambda file: (file.parent.name if "chunk" in file.parent.name else "", file.name))


@pytest.mark.slow
@pytest.mark.parametrize("root", DATASETS)
def test_every_frame_is_that_of_the_video_in_order_and_every_episode_that_of_the_rows(root: Path) -> None:
    """LeRobot writes episodes one after another, so a camera's whole videos hold all frames."""
    dataset = open_dataset(root)
    assert list(dataset.cameras) == [FRONT, WRIST]
    info = json.loads((root / "meta" / "info.json").read_text())
    for camera, size in ((FRONT, 256), (WRIST, 128)):
        expected = (frame for file in videos(root, camera) for frame in whole_video(file))
        read = (frame for episode in dataset.episodes for frame in dataset.frames(episode, camera))
        pairs = zip(read, expected, strict=True)
        same = [one.shape == (size, size, 3) and np.array_equal(one, other) for one, other in pairs]
        assert same == [True] * info["total_frames"]
    tables = [parquet.read_table(file, partitioning=None) for file in sorted((root / "data").rglob("*.parquet"))]
    rows = pa.concat_tables([table.select(["index", "episode_index", "task_index"]) for table in tables]).to_pylist()
    sentences = {episode.task for episode in dataset.episodes}
    assert all(sentence.startswith("put the ") for sentence in sentences)
    assert len(sentences) == len({row["task_index"] for row in rows})
    for episode in dataset.episodes:
        own = [row for row in rows if row["episode_index"] == episode.index]
        assert (episode.num_frames, episode.first_index) == (len(own), own[0]["index"])


def test_av1_and_images_in_tables_are_read(tmp_path: Path) -> None:
    root = shutil.copytree(LEROBOT / "toy_v21", tmp_path / "mixed")
    video = root / "videos" / "chunk-000" / FRONT / "episode_000000.mp4"
    frames = whole_video(video)
    encode(video, frames, "libsvtav1", {"crf": "20", "g": "2", "svtav1-params": "lp=1"})
    stored = store_as_images(root, WRIST, saved())
    dataset = open_dataset(root)
    assert list(dataset.cameras) == [FRONT, WRIST]
    first = dataset.episodes[0]
    for frame, expected in zip(dataset.frames(first, FRONT), frames, strict=True):
        assert np.abs(frame.astype(int) - expected).mean() < 8
    for frame, expected in zip(dataset.frames(first, WRIST), stored, strict=True):
        np.testing.assert_array_equal(frame, expected)
    dataset.check(first, WRIST)
    assert dataset.decoder(WRIST) == f"Pillow {PIL.__version__}"
    assert (dataset.decoder(FRONT) or "").startswith(f"PyAV {av.__version__}, libswscale ")


DEPTH_MARKS: dict[str, dict[str, Any]] = {
    "info": {"info": {"video.is_depth_map": True}},
    "without a prefix": {"info": {"is_depth_map": True}},
}


@pytest.mark.parametrize("mark", DEPTH_MARKS.values(), ids=DEPTH_MARKS)
def test_a_depth_camera_counts_only_where_it_is_named(tmp_path: Path, mark: dict[str, Any]) -> None:
    root = shutil.copytree(LEROBOT / "toy_v21", tmp_path / "toy")
    change_info(root, lambda info: info["features"][WRIST].update(mark))
    dataset = open_dataset(root)
    assert dataset.chosen_cameras() == (FRONT,)
    assert (list(dataset.cameras), list(dataset.depth_cameras)) == ([FRONT, WRIST], [WRIST])
    assert dataset.chosen_cameras(["front", "wrist"]) == (FRONT, WRIST)
    report = label(dataset, BrightnessScorer(), LabelOptions(output=tmp_path, limit=1, frames=2, formats=("progress",)))
    assert "progress.wrist" not in parquet.read_schema(report.files[0]).names
    change_info(root, lambda info: info["features"][WRIST].update(shape=[128, 128, 1]))
    dataset = open_dataset(root)
    assert (list(dataset.cameras), list(dataset.left_out)) == ([FRONT], [WRIST])
    assert ShownLeRobot(dataset).cameras == [FRONT]
    with pytest.raises(DatasetError, match=r"which is left out: a depth map, \[128, 128, 1\]: expected 3 channels"):
        dataset.chosen_cameras([WRIST])
    change_info(root, lambda info: info["features"][FRONT].update(mark))
    with pytest.raises(DatasetError, match=r"^cameras: expected .* named: all are depth cameras, got none$"):
        open_dataset(root).chosen_cameras()


def saved(
    convert: Callable[[Any], Any] = lambda image: image, form: str = "PNG", **options: Any
) -> Callable[[Any], bytes]:
    """Return a function that encodes a picture. convert: applied before, to the Pillow image"""

    def save(image: Any) -> bytes:
        written = io.BytesIO()
        convert(image).save(written, form, **options)
        return written.getvalue()

    return save


def png_of_16_bits(image: Any) -> bytes:
    """Pillow writes none of 16 bits a channel, and would read the upper 8 alone."""
    encoder: Any = av.CodecContext.create("png", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = *image.size, "rgb48be", Fraction(1, 10)
    frame = av.VideoFrame.from_ndarray(np.asarray(image), format="rgb24").reformat(format="rgb48be")
    return b"".join(map(bytes, [*encoder.encode(frame), *encoder.encode()]))


PICTURES: dict[str, tuple[Callable[[Any], bytes], str | None]] = {
    "grey": (saved(lambda image: image.convert("L")), None),
    "transparency": (saved(lambda image: image.convert("RGBA")), None),
    "16 bits": (
        saved(lambda image: Image.fromarray(np.asarray(image.convert("L")).astype("u2"))),
        "PNG of 16-bit I;16",
    ),
    "16 bits a channel": (png_of_16_bits, "PNG of 16-bit RGB"),
    "floats": (saved(lambda image: image.convert("F"), "TIFF"), "TIFF of F"),
    "inks": (saved(lambda image: image.convert("CMYK"), "JPEG"), "JPEG of CMYK"),
}


@pytest.mark.parametrize(("save", "refused"), PICTURES.values(), ids=PICTURES)
def test_pictures_are_of_8_bit_colours(save: Callable[[Any], bytes], refused: str | None) -> None:
    picture = Picture(save(Image.fromarray(np.indices((48, 64, 3)).sum(0).astype(np.uint8))))
    if refused is None:
        picture.check()
        assert picture.pixels().shape == (48, 64, 3)
        return
    message = f"expected a picture of 8-bit colours (convert it, or leave a depth camera out: --cameras), got {refused}"
    for read in (picture.check, picture.pixels):
        with pytest.raises(FrameFileError, match=re.escape(message) + "$"):
            read()


def store_as_images(root: Path, camera: str, save: Callable[[Any], bytes]) -> list[np.ndarray[Any, Any]]:
    """Replace a camera's video of episode 0 by images, in the table and as files. Return the frames."""
    frames = whole_video(root / "videos" / "chunk-000" / camera / "episode_000000.mp4")
    images = []
    (root / "images").mkdir()
    for t, frame in enumerate(frames):
        stored = save(Image.fromarray(frame))
        if t % 2:
            (root / "images" / f"{t}.png").write_bytes(stored)
        images.append({"bytes": None if t % 2 else stored, "path": f"images/{t}.png"})
    file = root / "data" / "chunk-000" / "episode_000000.parquet"
    table = parquet.read_table(file, partitioning=None).append_column(camera, pa.array(images))
    parquet.write_table(table, file)
    change_info(root, lambda info: info["features"][camera].update(dtype="image"))
    return frames


V30_EPISODES = "meta/episodes/chunk-000/file-000.parquet"
V30_ROWS = "data/chunk-000/file-000.parquet"
V30_VIDEO = f"videos/{FRONT}/chunk-000/file-001.mp4"
V21_ROWS = "data/chunk-000/episode_000003.parquet"
V21_VIDEO = f"videos/chunk-000/{WRIST}/episode_000005.mp4"

Break = Callable[[Path], object]


def cells(file: str, column: str, change: Callable[[list[Any]], list[Any]]) -> Break:
    """Other values in a column of a table."""
    return lambda root: change_column(root / file, column, change)


def spans(change: Callable[[list[Any]], list[Any]]) -> Break:
    """Change the episodes' times in the front camera's videos."""

    def apply(root: Path) -> None:
        for name in ("from_timestamp", "to_timestamp"):
            change_column(root / V30_EPISODES, f"videos/{FRONT}/{name}", change)

    return apply


def at(place: int, change: Callable[[Any], Any]) -> Callable[[list[Any]], list[Any]]:
    return lambda values: [change(value) if k == place else value for k, value in enumerate(values)]


def appended(file: Path, line: str) -> None:
    with file.open("a") as opened:
        opened.write(f"\n{line}\n")


def told(**more: Any) -> Break:
    """Other statements in ``meta/info.json``."""
    return lambda root: change_info(root, lambda info: info.update(more))


def video(change: Callable[[list[Any]], list[Any]], file: str = V21_VIDEO, fps: Fraction = Fraction(10)) -> Break:
    """Write a video with other frames or another rate."""
    coded: dict[str, Any] = {"options": {"crf": "1"}, "pixels": "yuv444p", "rate": fps}
    return lambda root: encode_here(root / file, change(whole_video(root / file)), **coded)


END = r"to_timestamp: expected 3\.9000 s for 39 frames, got 3\.7000 s"
CONTRADICTIONS: dict[str, dict[str, tuple[Break, str]]] = {
    "toy_v30_many": {
        "a video that is too short for its episode": (
            cells(V30_EPISODES, f"videos/{FRONT}/to_timestamp", at(1, lambda time_s: time_s - 0.2)),
            rf"episode 1: .*{END}",
        ),
        "starts of episodes that drift": (
            spans(lambda times_s: [time_s - 0.01 * k for k, time_s in enumerate(times_s)]),
            r"episode 1, row 0: .*front: .*file-000\.mp4: expected its frame at 5\.7900 s, got one at 5\.8000 s; write ",
        ),
        "a row that is missing": (
            cells(V30_ROWS, "episode_index", at(60, lambda _: 0)),
            r"episode 0: .*file-000\.parquet: expected 58 rows, as its metadata say, got 59",
        ),
        "rows of other numbers": (
            cells(V30_ROWS, "index", at(7, lambda _: 9)),
            r"episode 0: .*parquet: index: expected 7 in row 7, got 9",
        ),
        "no task": (
            cells(V30_ROWS, "task_index", lambda values: [9] * 58 + values[58:]),
            r"episode 0: task 9 in meta/tasks: expected a task as a sentence, got none",
        ),
        "a row without a task": (
            cells(V30_ROWS, "task_index", at(3, lambda _: None)),
            r"episode 0: task_index: expected a task as a sentence, got none",
        ),
        "a second task that the metadata lack": (
            cells(V30_ROWS, "task_index", at(3, lambda _: 4)),
            r"episode 0: meta/episodes: tasks: expected 'put the .*', got \['put the .*'\]",
        ),
        "no metadata of episodes": (
            lambda root: shutil.rmtree(root / "meta" / "episodes"),
            r"meta/episodes: expected Parquet files, got none",
        ),
        "a camera without a place in the videos": (
            cells(V30_EPISODES, f"videos/{WRIST}/file_index", at(2, lambda _: None)),
            rf"episode 2: .*videos/{WRIST}/file_index: expected a value, got none: leave this camera out \(--cameras\), or",
        ),
        "a video that lacks its last frames": (
            video(lambda frames: frames[:-2], V30_VIDEO),
            r"episode \d, row \d+: .*front: .*file-001\.mp4: expected its frame at \d+\.\d+ s, got one at .*; write the",
        ),
        "episodes that share frames": (
            spans(at(1, lambda time_s: time_s - 0.5)),
            r"episode 0, row 53: .*front: .*: expected a frame of its own at 5\.3000 s, got that of episode 1, row 0; w",
        ),
    },
    "toy_v21": {
        "a video of another episode": (
            lambda root: shutil.copy(root / V21_VIDEO.replace("005", "007"), root / V21_VIDEO),
            r"episode 5, row 20: .*wrist: .*: expected its frame at 2\.0000 s, got one at 1\.9000 s; the video has 20 frames "
            r"for 49 rows, as if some were dropped in recording; write the dataset again, or leave this episode out \(--",
        ),
        "a video of half the rate": (
            video(lambda frames: frames[::2], fps=Fraction(5)),
            r"row 1: .* expected its frame at 0\.1000 s, got one at 0\.2000 s \(the video has 5\.00 frames a second, meta/info"
            r"\.json says 10\); write",
        ),
        "a video whose rate is nearly that of the rows": (
            video(lambda frames: frames, fps=Fraction(10_000, 1001)),
            r"episode 5, row 2: .*mp4: expected its frame at 0\.2000 s, got one at 0\.2002 s \(the video has 9\.99 frames "
            r"a second, meta/info\.json says 10\); give both the same rate$",
        ),
        "a row whose time is another's": (
            cells(V21_ROWS, "timestamp", at(4, lambda time_s: time_s + 0.06)),
            r"episode 3, row 4: .*front: .*mp4: expected its frame at 0\.4600 s, got one at 0\.5000 s; write ",
        ),
        "times that fall": (
            cells(V21_ROWS, "timestamp", at(4, lambda _: 0.0)),
            r"episode 3: .*timestamp: expected times that rise, after 0\.3000 s, got 0\.0000 s in row 4: write ",
        ),
        "an episode twice": (
            lambda root: appended(root / "meta" / "episodes.jsonl", '{"episode_index": 2, "length": 3}'),
            "meta: expected each episode once, got 2 several times",
        ),
        "two sentences of one number": (
            lambda root: appended(root / "meta" / "tasks.jsonl", '{"task_index": 0, "task": "open the box"}'),
            r"tasks\.jsonl: expected one sentence for the number 0, got 'put .* and 'open the box'",
        ),
        "a line that is no JSON": (
            lambda root: (root / "meta" / "episodes.jsonl").write_text('{"episode_index": 0\n'),
            r"episodes\.jsonl: line 1: expected a JSON object, got ",
        ),
        "a version of the future": (
            told(codebase_version="v4.0"),
            r"codebase_version: expected one of v2\.0, v2\.1, v3\.0, got 'v4\.0'",
        ),
        "a path out of the dataset": (
            told(data_path="../{episode_index}.parquet"),
            r"meta/info\.json: expected a path inside the dataset, got '\.\./0\.parquet'",
        ),
    },
}


@pytest.mark.parametrize(
    ("name", "break_it", "message"),
    [
        pytest.param(name, *case, id=f"{name}: {what}")
        for name, cases in CONTRADICTIONS.items()
        for what, case in cases.items()
    ],
)
def test_a_dataset_that_contradicts_itself_is_refused_before_a_frame_is_decoded(
    tmp_path: Path, name: str, break_it: Callable[[Path], object], message: str
) -> None:
    root = shutil.copytree(LEROBOT / name, tmp_path / name)
    with pytest.raises(DatasetError, match=message):
        break_it(root)
        dataset = open_dataset(root)
        for episode in dataset.episodes:
            for camera in dataset.cameras:
                dataset.check(episode, camera)


def rows_in_a_later_file(root: Path) -> None:
    """As LeRobot 0.4.0's converter left them: the metadata name the file before."""
    rows = parquet.read_table(root / V30_ROWS, partitioning=None)
    parquet.write_table(rows.slice(0, 221), root / V30_ROWS)
    parquet.write_table(rows.slice(221), root / V30_ROWS.replace("000.parquet", "001.parquet"))
    change_column(root / V30_EPISODES, "data/file_index", lambda values: [*values[:6], 1, 1, 1, 1])


def reversed_rows(file: Path) -> None:
    table = parquet.read_table(file)
    parquet.write_table(table.take(list(reversed(range(len(table))))), file)


WITH_NOTES: dict[str, tuple[Break, list[str]]] = {
    "info.json counts more": (
        told(total_episodes=11, total_frames=430),
        [
            f"{name}, as meta/episodes lists them; info.json says {told}"
            for name, told in (("episodes: 10", 11), ("frames: 428", 430))
        ],
    ),
    "no version": (
        lambda root: change_info(root, lambda info: info.pop("codebase_version")),
        ["version: v3.0, by the files of meta, since info.json has no codebase_version"],
    ),
    "rows in another file": (
        rows_in_a_later_file,
        [],
    ),
    "sentences out of order": (
        lambda root: reversed_rows(root / "meta" / "tasks.parquet"),
        [
            "tasks: meta/tasks.parquet is not in the order of task_index: LeRobot finds a sentence by position, so it may "
            "read a different one"
        ],
    ),
    "no place of a camera that is not asked for": (
        cells(V30_EPISODES, f"videos/{WRIST}/from_timestamp", lambda values: [None] * len(values)),
        [],
    ),
}


@pytest.mark.parametrize(("change", "notes"), WITH_NOTES.values(), ids=WITH_NOTES)
def test_oddities_that_lerobot_reads_are_read_with_a_note(tmp_path: Path, change: Break, notes: list[str]) -> None:
    root = shutil.copytree(LEROBOT / "toy_v30_many", tmp_path / "toy")
    change(root)
    dataset, whole = open_dataset(root), open_dataset(LEROBOT / "toy_v30_many")
    assert dataset.episodes == whole.episodes
    for number in (4, 5):
        dataset.check(dataset.episode(number), FRONT)
    assert list(dataset.notes) == notes


@pytest.mark.parametrize("tolerance_s", [0, -1, float("nan"), float("inf"), True, "a"])
def test_a_tolerance_is_a_number_above_0(tolerance_s: Any) -> None:
    with pytest.raises(DatasetError, match=f"tolerance_s: expected a number above 0, got '?{tolerance_s}"):
        open_dataset(LEROBOT / "toy_v30_many", tolerance_s=tolerance_s)


OPENED = f"""
import sys
from rfm_labels import DatasetError, open_dataset
for source in sys.argv[1:]:
    try:
        dataset = open_dataset(source)
        frames = dataset.frames(dataset.episodes[7], {WRIST!r})
        print(dataset.source, dataset.revision, len(dataset.episodes), len(list(frames)))
    except DatasetError as error:
        print(error)
"""


@pytest.mark.slow
def test_a_dataset_of_the_hub_is_fetched_at_its_revision(tmp_path: Path) -> None:
    """In a separate process, since the Hub's library reads settings at import."""
    old = shutil.copytree(LEROBOT / "toy_v21", tmp_path / "old")
    (old / "meta").rename(old / "meta_data")
    revisions = {"main": LEROBOT / "toy_v30_many", "v1": LEROBOT / "toy_v21", "old": old}
    with local_hub.hub({HUB_ID: revisions}, "datasets") as endpoint:
        environment = {**os.environ, "HF_ENDPOINT": endpoint, "HF_HOME": str(tmp_path), "HF_HUB_OFFLINE": "0"}
        words = [sys.executable, "-c", OPENED, *(HUB_ID + revision for revision in ("", "@v1", "@v2", "@old"))]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=100, check=True)
    newest, first, missing, of_v1 = done.stdout.splitlines()
    for name, line in {"main": newest, "v1": first}.items():
        episodes = open_dataset(revisions[name]).episodes
        assert line == f"{HUB_ID} {local_hub.commit_of(name)} {len(episodes)} {episodes[7].num_frames}"
    expected = f"org/name: expected a local dataset or one of the Hub, got none: {endpoint} has no such revision of it"
    assert missing == expected
    assert "expected a LeRobot dataset's meta/info.json, got a LeRobot dataset of v1: convert it to v2.0 with " in of_v1


def test_only_the_files_of_the_chosen_episodes_and_cameras_are_downloaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = LEROBOT / "toy_v21"
    address, notes, engine = f"hf://datasets/{HUB_ID}/", list[str](), BrightnessScorer()
    texts, few = EpisodeTexts(), LabelOptions(output=tmp_path / "out", episodes=[3], cameras=[WRIST], frames=4)
    command = LabelCommand(address, texts, few, RunOptions(), RayOptions(), lambda: nullcontext(engine), notes.append)
    with local_hub.hub({HUB_ID: {"main": source}}, "datasets") as endpoint, local_hub.asked(endpoint, tmp_path / "hub"):
        monkeypatch.setattr("rfm_labels.datasets.hub.ASK_BYTES", 10)
        with pytest.raises(ConfigError, match=r"^yes: expected --yes for more than 10 GB, got none for 0\.\d MB in 2 "):
            command.run()
        monkeypatch.undo()
        assert command.run() == 0
        (snapshot,) = (tmp_path / "hub").glob("*/snapshots/*")
        here = {str(file.relative_to(snapshot)) for file in snapshot.rglob("*") if file.is_file()}
        needed = ["data/chunk-000/episode_000003.parquet", f"videos/chunk-000/{WRIST}/episode_000003.mp4"]
        assert sorted(name for name in here if not name.startswith("meta/")) == needed
        assert replace(command, options=RunOptions(dry_run=True)).run() == 0  # all is here: no download
        assert [line.split(" MB")[1] for line in notes if "downloading" in line] == [
            " in 2 files, all that the chosen episodes and cameras need"
        ] * 2
        dataset = open_dataset(f"https://huggingface.co/datasets/{HUB_ID}/tree/main")
        assert sum(1 for _ in dataset.frames(dataset.episode(0), WRIST)) == dataset.episode(0).num_frames  # on demand
