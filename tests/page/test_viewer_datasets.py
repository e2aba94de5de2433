# SPDX-License-Identifier: MIT
"""The page's requests about datasets: episodes, curves, videos, refusals. No Triton is needed."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import cycle, islice, product
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute
import pytest
import requests
from PIL import Image
from pyarrow import parquet

import clip
import hdf5_writers as writers
import local_hub
from gateway_requests import failure
from gateways import StandIn, inside, listening
from labelling import LEROBOT, BrightnessScorer
from paths import ROOT
from pictures import turn
from rfm_client.frames import cached_snapshot, read_video
from rfm_client.options import ConfigError
from rfm_labels import LabelOptions, label, open_dataset, read_episode_labels
from rfm_labels.datasets import LeRobotDataset, open_to_show
from servers import PATIENCE_S, wait_for
from shown_datasets import CAMERAS, CODINGS, columns_of, copied, encoded_anew, hdf5

V21, V30 = range(2)  # datasets with labels; one without follows
VIDEO = "videos/observation.images.front/chunk-000/file-000.mp4"  # of the episodes below
OF_VIDEO = range(4)
NEEDS_LATER = {"g": "60", "keyint_min": "60", "sc_threshold": "0", "bf": "3", "b_strategy": "0"}
Get = Callable[[str], Any]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders by number of the dataset."""
    folder = tmp_path_factory.mktemp("shelf")
    labelled = [copied(name, folder) for name in ("toy_v21", "toy_v30_many")]
    for root in labelled:
        label(open_dataset(root), BrightnessScorer(), LabelOptions())
    return [*labelled, copied("toy_v30_many", folder / "plain")]


@contextmanager
def serving(*roots: Path | str, **settings: Any) -> Iterator[Get]:
    """Run a gateway that shows the datasets in these folders. Yields a function that asks it."""
    with inside(dataset=tuple(map(str, roots)), **settings) as gateway:
        yield lambda path: gateway.get(f"/viewer/datasets{path}")


@pytest.fixture(scope="module")
def get(folders: list[Path]) -> Iterator[Get]:
    with serving(*folders) as answers:
        yield answers


@pytest.mark.parametrize("number", [V21, V30])
def test_the_table_and_the_curves_are_those_of_the_labels(get: Get, folders: list[Path], number: int) -> None:
    told = get(f"/{number}").json()
    root = folders[number]
    episodes = LeRobotDataset(root).episodes
    assert [(each["episode"], each["task"], each["num_frames"]) for each in told["episodes"]] == [
        (episode.index, episode.task, episode.num_frames) for episode in episodes
    ]
    for row in told["episodes"]:
        columns = columns_of(root, row["episode"])
        apart = np.abs(columns[f"progress.{CAMERAS[0]}"] - columns[f"progress.{CAMERAS[1]}"])
        expected = {
            "final_progress": columns["progress_sparse"][-1],
            "best_success": columns["success"].max(),
            "last_success": columns["success"][-1],
            "voted_success": np.median(columns["success"][-3:]),
            "backwards": (np.diff(columns["progress_sparse"]) < -0.01).mean(),
            "disagreement": apart.mean(),
        }
        assert {name: row[name] for name in expected} == pytest.approx(expected, abs=1e-6)
    assert (told["labels"], told["cameras"], told["threshold"]) == ("rfm_progress.parquet", list(CAMERAS), 0.5)
    file = root / "rfm_progress.parquet"
    assert told["provenance"] == json.loads(parquet.read_schema(file).metadata[b"rfm.provenance"])
    assert told["written_s"] == pytest.approx(file.stat().st_mtime)
    shown, columns = get(f"/{number}/episodes/7").json(), columns_of(root, 7)
    np.testing.assert_allclose(shown["times_s"], columns["frame_index"] / 10, atol=1e-4)
    names = [(None, "progress_sparse", "success"), *((each, f"progress.{each}", f"success.{each}") for each in CAMERAS)]
    for curve, (camera, *pair) in zip(shown["curves"], names, strict=True):
        assert curve["camera"] == camera
        curves = np.array([curve["progress"], curve["success"]], np.float32)
        np.testing.assert_array_equal(curves, [columns[name] for name in pair])


def test_a_preview_has_the_first_and_the_last_frame_as_for_the_labels_and_a_few_points(
    get: Get, folders: list[Path]
) -> None:
    for number in (V21, V30):
        preview = get(f"/{number}/episodes/1/preview").json()
        labels = columns_of(folders[number], 1)["progress_sparse"]
        places = np.linspace(0, len(labels) - 1, min(32, len(labels))).round().astype(int)
        assert preview["progress"] == pytest.approx(labels[places].tolist(), abs=1e-6)
        dataset = LeRobotDataset(folders[number])
        frames = list(dataset.stored_frames(dataset.episode(1), CAMERAS[0]))
        for stored, end in zip(preview["pictures"], (frames[0], frames[-1]), strict=True):
            picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(stored))))
            expected = Image.fromarray(end)
            expected.thumbnail((96, 72))
            assert np.abs(picture.astype(int) - np.asarray(expected)).mean() < 5
    plain = get("/2/episodes/1/preview").json()
    assert plain["progress"] == []
    assert plain["pictures"]
    assert "expected one from 0 to" in failure(get("/0/episodes/99/preview"), 404)


NAMES = {"grouped": {"motors": ["dx"], "gripper": ["dy"]}, "by position": {"dx": 0, "dy": 1}, "of others": ["dx"]}


@pytest.mark.parametrize("kind", [*NAMES, "as stored"])
def test_actions_and_states_are_those_of_the_rows_under_their_names(tmp_path: Path, kind: str) -> None:
    root = copied("toy_v30_many", tmp_path)
    info = json.loads((root / "meta" / "info.json").read_text())
    info["features"]["action"]["names"] = NAMES.get(kind, ["dx", "dy"])
    (root / "meta" / "info.json").write_text(json.dumps(info))
    with serving(root) as get:
        motion = get("/0/episodes/2").json()["motion"]
        expected = {"action": ["0", "1"] if kind == "of others" else ["dx", "dy"], "state": ["x", "y"]}
        assert {name: each["names"] for name, each in motion.items()} == expected
        file = root / "data" / "chunk-000" / "file-000.parquet"
        table = parquet.read_table(file)
        of_episode = table.filter(pa.compute.equal(table["episode_index"], 2))
        for name, column in (("action", "action"), ("state", "observation.state")):
            assert np.transpose(motion[name]["values"]).tolist() == of_episode[column].to_pylist()
        place = table.column_names.index("action")

        def answer(*values: Any) -> Any:
            column = pa.array(list(islice(cycle(values), len(table))))
            parquet.write_table(table.set_column(place, "action", column), file)
            return get("/0/episodes/2")

        nulls = [None] * (len(table) - 1)  # in all rows but the last
        no_vectors: list[list[Any]] = [[[1.0], [1.0, 2.0]], [None, [1.0, 2.0]], [*nulls, [1.0]], [1.0, 2.0]]
        for values in no_vectors:
            assert answer(*values).json()["motion"] == {"state": motion["state"]}


def rlds(folder: Path) -> Path:
    return Path(shutil.copytree(ROOT / "tests" / "rlds" / "toy_steps_texts", folder / "rlds"))


def with_pictures_in_tables(folder: Path) -> Path:
    """Replace the wrist camera's videos by pictures in the tables."""
    root = copied("toy_v21", folder)
    info = json.loads((root / "meta" / "info.json").read_text())
    info["features"][CAMERAS[1]]["dtype"] = "image"
    for video in sorted((root / "videos").glob(f"*/{CAMERAS[1]}/*.mp4")):
        pictures = []
        for frame in read_video(video, None):
            Image.fromarray(frame).save(png := io.BytesIO(), "PNG")
            pictures.append({"bytes": png.getvalue(), "path": None})
        file = root / "data" / "chunk-000" / f"{video.stem}.parquet"
        table = parquet.read_table(file, partitioning=None).append_column(CAMERAS[1], pa.array(pictures))
        parquet.write_table(table, file)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


def by_pattern(folder: Path) -> str:
    for number, place in product(range(2), ("left", "right")):
        (folder / "recordings" / f"{number}" / place).mkdir(parents=True)
        for t, frame in enumerate(writers.video(4, seed=number)):
            Image.fromarray(frame).save(folder / "recordings" / f"{number}" / place / f"{t}.png")
    return f"{{episode}}/{{camera}}/*.png={folder}/recordings"


def by_reader(folder: Path) -> str:
    for number in range(2):
        np.save(folder / f"{number}.npy", writers.video(4, seed=number))
    reader = """
import numpy as np
from rfm_labels import Episode

def episodes(folder):
    for file in sorted(folder.glob("*.npy")):
        yield Episode(file.stem, {"front": np.load(file)}, fps=10)
"""
    (folder / "my_reader.py").write_text(reader)
    return f"{folder}/my_reader.py:episodes={folder}"


def folder_of_videos(folder: Path) -> Path:
    (folder / "videos").mkdir()
    for number in range(2):
        clip.write(folder / "videos" / f"{number}.mp4", writers.video(4, seed=number), 5)
    return folder / "videos"


def folder_of_old_videos(folder: Path) -> Path:
    """In a codec that no browser shows."""
    for file in folder_of_videos(folder).iterdir():
        encoded_anew(file, "mpeg4", {"q": "1"})
    return folder / "videos"


def folder_of_turned_videos(folder: Path) -> Path:
    """Recorded upside down."""
    for file in folder_of_videos(folder).iterdir():
        turn(file, (-1, 0, 0, -1))
    return folder / "videos"


def at_another_rate(folder: Path) -> str:
    """A reader that knows the rate better than its videos do."""
    reader = """
from rfm_labels import Episode

def episodes(folder):
    for file in sorted(folder.glob("*.mp4")):
        yield Episode(file.stem, {"front": file}, fps=10)
"""
    (folder / "my_reader.py").write_text(reader)
    return f"{folder}/my_reader.py:episodes={folder_of_videos(folder)}"


def folder_of_hdf5(folder: Path) -> Path:
    return hdf5(folder).parent


@pytest.mark.parametrize(
    "make",
    [
        *(rlds, with_pictures_in_tables, hdf5, folder_of_hdf5),
        *(folder_of_videos, folder_of_old_videos, folder_of_turned_videos, at_another_rate, by_pattern, by_reader),
    ],
)
def test_an_episode_of_any_dataset_is_shown_as_a_video(tmp_path: Path, make: Callable[[Path], Path | str]) -> None:
    root = make(tmp_path)
    (dataset,) = open_to_show(str(root))
    fps = 5 if make in (folder_of_videos, folder_of_turned_videos) else 10
    how = "stored" if make is folder_of_videos else "encoded"
    number, camera = dataset.numbers[1], len(dataset.cameras) - 1
    with serving(root) as get:
        table, curves = get("/0").json(), get(f"/0/episodes/{number}").json()
        video = get(f"/0/episodes/{number}/videos/{camera}")
        faults = get("/0/faults").json()
    assert (table["cameras"], video.headers["X-Frames"]) == ([*dataset.cameras], how)
    assert table["left_out"] == dataset.left_out
    assert [row["task"] for row in table["episodes"]] == [episode.task for episode in dataset.episodes]
    assert (curves["curves"], faults) == ([], {})
    expected = np.stack(list(dataset.frames(dataset.episode(number), dataset.cameras[camera])))
    assert curves["times_s"] == pytest.approx(np.arange(len(expected)) / fps)
    with av.open(io.BytesIO(video.content)) as container:
        frames = [(float(frame.time or 0), frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    assert [time_s for time_s, _ in frames] == pytest.approx(np.arange(len(expected)) / fps, abs=1e-3)
    shown = np.stack([frame[: expected.shape[1], : expected.shape[2]] for _, frame in frames])
    assert np.abs(shown.astype(int) - expected).mean() < 4  # colours at half the resolution


def test_times_are_those_of_a_camera_that_counts(tmp_path: Path) -> None:
    (tmp_path / "0").mkdir()
    for camera, num_frames in (("depth", 3), ("front", 4)):
        clip.write(tmp_path / "0" / f"{camera}.mp4", writers.video(num_frames), 5)
    with serving(f"{{episode}}/{{camera}}.mp4={tmp_path}") as get:
        assert get("/0/episodes/0").json()["times_s"] == pytest.approx([0, 0.2, 0.4, 0.6])


def test_labels_beside_an_hdf5_file_are_shown(tmp_path: Path) -> None:
    file = hdf5(tmp_path)
    label(open_dataset(file), BrightnessScorer(), LabelOptions())
    name = "demos.rfm_progress.parquet"
    labels = read_episode_labels(tmp_path / name, 7)
    assert labels is not None
    with serving(file) as get:
        assert get("").json() == {"datasets": [{"name": "demos.hdf5", "kind": "HDF5", "labels": [name]}]}
        assert get("/0").json()["episodes"][1]["final_progress"] == pytest.approx(labels.fused.progress[-1])
        curves = get("/0/episodes/7").json()["curves"]
        np.testing.assert_array_equal(np.float32(curves[0]["progress"]), labels.fused.progress)
        assert failure(get("/0/episodes/0"), 404) == "episode: expected one from 3 to 7, with gaps, got 0"


def check_frames(get: Get, root: Path, episode: int, number: int = 0, camera: int = 0) -> None:
    """The video that is answered has the episode's frames and no other, from 0 s on."""
    response = get(f"/{number}/episodes/{episode}/videos/{camera}")
    assert (response.status_code, response.headers["content-type"]) == (200, "video/mp4")
    with av.open(io.BytesIO(response.content)) as container:
        frames = [(float(frame.time or 0), frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    opened = LeRobotDataset(root)
    expected = list(opened.frames(opened.episodes[episode], CAMERAS[camera]))
    np.testing.assert_array_equal(np.stack([frame for _, frame in frames]), np.stack(expected))
    np.testing.assert_allclose([time for time, _ in frames], np.arange(len(frames)) / 10, atol=1e-3)


@pytest.mark.parametrize("number", [V21, V30])
def test_a_video_has_the_frames_of_its_episode(get: Get, folders: list[Path], number: int) -> None:
    for episode, camera in ((0, 1), (7, 0)):
        check_frames(get, folders[number], episode, number, camera)


@pytest.mark.slow
@pytest.mark.parametrize("coding", CODINGS.values(), ids=CODINGS)
def test_a_cut_is_exact_however_the_video_is_coded(tmp_path: Path, coding: tuple[str, dict[str, str]]) -> None:
    root = copied("toy_v30_many", tmp_path)
    encoded_anew(root / VIDEO, *coding)
    with serving(root) as get:
        for episode in OF_VIDEO:
            check_frames(get, root, episode)


HUB_ID = "org/name"
ADDRESSES = (HUB_ID, f"hf://datasets/{HUB_ID}", f"https://huggingface.co/datasets/{HUB_ID}")


def test_of_a_dataset_on_the_hub_only_the_watched_episode_is_downloaded_after_its_size_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, path = LEROBOT / "toy_v21", "/0/episodes/3"
    with (
        local_hub.hub({HUB_ID: {"main": source}}, "datasets") as endpoint,
        local_hub.asked(endpoint, tmp_path / "hub"),
        inside(dataset=ADDRESSES) as gateway,
    ):
        told = gateway.get("/viewer/datasets").json()["datasets"]
        assert told == [{"name": HUB_ID, "kind": "LeRobot v2.1", "labels": []}] * len(ADDRESSES)
        (snapshot,) = (tmp_path / "hub").glob("*/snapshots/*")

        def here() -> list[str]:
            files = (str(file.relative_to(snapshot)) for file in snapshot.rglob("*") if file.is_file())
            return sorted(name for name in files if not name.startswith("meta/"))

        def get(path: str) -> Any:
            return gateway.get(f"/viewer/datasets{path}")

        names = ("episode", "task", "num_frames")
        assert [[row[name] for name in names] for row in get("/0").json()["episodes"]] == [
            [each.index, each.task, each.num_frames] for each in LeRobotDataset(source).episodes
        ]
        assert (get("/0/faults").json(), get(f"{path}/preview").json()["pictures"]) == ({}, [])
        for each in (path, f"{path}/videos/0"):
            assert failure(get(each), 409).endswith("MB in 3 files on the Hub: download it first")
        assert here() == []
        needed = [
            "data/chunk-000/episode_000003.parquet",
            *(f"videos/chunk-000/{camera}/episode_000003.mp4" for camera in CAMERAS),
        ]
        size = f"{sum((source / name).stat().st_size for name in needed) / 1e6:.1f} MB in 3 files"
        assert get(f"{path}/missing").json() == {"size": size, "asks": False}
        monkeypatch.setattr("rfm_labels.datasets.hub.ASK_BYTES", 10)
        assert get(f"{path}/missing").json()["asks"] is True
        assert here() == []
        all_here = {"size": None, "asks": False}
        assert gateway.post(f"/viewer/datasets{path}/missing").json() == all_here
        assert here() == needed
        check_frames(get, source, 3)
        assert len(get(f"{path}/preview").json()["pictures"]) == 2
        assert here() == needed
    with serving(source) as get:
        assert get(f"{path}/missing").json() == all_here


def test_a_download_waits_for_the_one_before_also_if_its_caller_has_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    is_open = threading.Event()

    def slow(name: str, kind: str, revision: str | None, patterns: list[str]) -> Path:
        asked.append(patterns[-1])
        assert patterns[0].startswith("meta/") or is_open.wait(PATIENCE_S)
        return cached_snapshot(name, kind, revision, patterns)

    monkeypatch.setattr("rfm_labels.datasets.hub.cached_snapshot", slow)
    with (
        local_hub.hub({HUB_ID: {"main": LEROBOT / "toy_v21"}}, "datasets") as endpoint,
        local_hub.asked(endpoint, tmp_path / "hub"),
        listening(StandIn(), dataset=(HUB_ID,)) as gateway,
        ThreadPoolExecutor() as callers,
    ):
        first, begun = gateway.connect(), len(asked)
        first.request("POST", "/viewer/datasets/0/episodes/3/missing")
        wait_for(lambda: len(asked) == begun + 1)
        first.close()
        second = callers.submit(requests.post, f"{gateway.url}/viewer/datasets/0/episodes/5/missing")
        for _ in range(5):  # there is time to begin
            assert gateway.get("/viewer/datasets").ok
        assert (len(asked), second.done()) == (begun + 1, False)
        is_open.set()
        assert second.result(PATIENCE_S).json() == {"size": None, "asks": False}
        assert gateway.get("/viewer/datasets/0/episodes/3").ok


def test_an_episode_that_needs_frames_behind_its_end_is_refused(tmp_path: Path) -> None:
    root = copied("toy_v30_many", tmp_path)
    encoded_anew(root / VIDEO, "libx264", NEEDS_LATER)
    with serving(root) as get:
        responses = [get(f"/0/episodes/{episode}/videos/0") for episode in OF_VIDEO]
    refused = [response for response in responses if response.status_code != 200]
    assert refused
    for response in refused:
        assert "-bf 0" in failure(response, 500)


UNKNOWN = {
    "/3": "dataset: expected one of 3, got 3",
    "/0/episodes/-1": "episode: expected one from 0 to 7, got -1",
    "/0/episodes/0/videos/-1": "camera: expected one of 2 with videos, got -1",
    "/0?labels=../toy_v30_many/rfm_progress.parquet": "labels: expected one of rfm_progress.parquet, got another",
    "/0/episodes/..%2f..%2fmeta%2finfo.json": "Not Found",
}


@pytest.mark.parametrize(("path", "message"), UNKNOWN.items())
def test_unknown_datasets_episodes_and_files_are_not_found(get: Get, path: str, message: str) -> None:
    assert failure(get(path), 404) == message


def test_a_dataset_with_a_link_that_leaves_it_is_refused_at_start(folders: list[Path], tmp_path: Path) -> None:
    root = copied("toy_v30_many", tmp_path)
    (root / "videos").rename(tmp_path / "moved")
    (root / "videos").symlink_to(folders[V30] / "videos")
    expected = f"{root / 'videos'}: expected a file in the dataset's folder, got a link that leaves it"
    with pytest.raises(ConfigError, match=expected), inside(dataset=(str(root),)):
        pass


def linked(file: Path, outside: Path) -> None:
    file.unlink()
    file.symlink_to(outside)


def piped(file: Path, _outside: Path) -> None:
    file.unlink()
    os.mkfifo(file)  # opening it would block until a writer comes


def external_link(file: Path, outside: Path) -> None:
    with h5py.File(file, "r+") as opened:
        opened[WRIST] = h5py.ExternalLink(str(outside), "/data")


def virtual(file: Path, outside: Path) -> None:
    layout = h5py.VirtualLayout((12, 16, 16, 3), np.uint8)
    layout[:] = h5py.VirtualSource(str(outside), "data", layout.shape)
    with h5py.File(file, "r+") as opened:
        opened.create_virtual_dataset(WRIST, layout)


def raw(file: Path, outside: Path) -> None:
    with h5py.File(file, "r+") as opened:
        opened.create_dataset(WRIST, (16,), np.uint8, external=[(str(outside), 0, 16)])


WRIST = "data/demo_3/obs/wrist"
ELSEWHERE = f"{WRIST}: expected data in the file, got data in another file"
OF_VIDEO_0, OF_DEMO = "/0/episodes/0/videos/0", "/0/episodes/3/videos/0"
CHANGES: dict[str, tuple[str, Callable[[Path, Path], None], str, str]] = {  # a file, its change, the path, the message
    "a link": (VIDEO, linked, OF_VIDEO_0, "expected a file in the dataset's folder, got a link that leaves it"),
    "a pipe": (VIDEO, piped, OF_VIDEO_0, f"{VIDEO}: expected a file or a folder, got a pipe, a socket or a device"),
    "HDF5, a link": ("", external_link, OF_DEMO, ELSEWHERE),
    "HDF5, a view": ("", virtual, OF_DEMO, ELSEWHERE),
    "HDF5, another file's bytes": ("", raw, OF_DEMO, ELSEWHERE),
    "HDF5, a pipe": ("", piped, OF_DEMO, "an HDF5 file, got a folder, a pipe, a socket or a device"),
}


@pytest.mark.parametrize(("name", "change", "path", "message"), CHANGES.values(), ids=CHANGES)
def test_a_dataset_that_changes_to_show_another_file_is_not_read(
    tmp_path: Path, name: str, change: Callable[[Path, Path], None], path: str, message: str
) -> None:
    root = copied("toy_v30_many", tmp_path) if name else hdf5(tmp_path)
    outside = Path(shutil.copy(root / name, tmp_path / "outside"))
    with serving(root) as get:
        assert get(path).status_code == 200
        change(root / name, outside)
        assert message in failure(get(path), 500)


BROKEN: dict[str, tuple[str, bytes | None, str, str]] = {  # a file, the content, the requested path, the message
    "no video": (VIDEO, None, OF_VIDEO_0, "file-000.mp4: expected a video file, got none"),
    "a play list": (
        VIDEO,
        b"#EXTM3U\n/etc/passwd\n",
        OF_VIDEO_0,
        "expected a file with a video stream, got a file of another kind",
    ),
    "another video": (
        VIDEO,
        (LEROBOT / "toy_v30_many" / VIDEO.replace("000.mp4", "002.mp4")).read_bytes(),
        "/0/episodes/2/videos/0",
        r"episode 2, row 0: .*: expected its frame at 9\.7000 s, got one at 9\.5000 s",
    ),
    "no rows": (
        "data/chunk-000/file-000.parquet",
        None,
        "/0/episodes/2",
        "file-000.parquet: expected a Parquet file, got none",
    ),
    "no labels": ("rfm_progress.parquet", b"no labels", "/0", "rfm_progress.parquet: expected a file of labels"),
}


@pytest.mark.parametrize(("name", "content", "path", "message"), BROKEN.values(), ids=BROKEN)
def test_a_dataset_that_breaks_says_why(
    folders: list[Path], tmp_path: Path, name: str, content: bytes | None, path: str, message: str
) -> None:
    root = Path(shutil.copytree(folders[V30], tmp_path / "spoilt"))
    with serving(root) as get:
        (root / name).unlink()
        if content is not None:
            (root / name).write_bytes(content)
        told = failure(get(path), 500)
        assert re.search(message, told), told
        assert str(tmp_path) not in told


def test_an_episode_that_cannot_be_read_hides_no_other(folders: list[Path], tmp_path: Path) -> None:
    root = Path(shutil.copytree(folders[V21], tmp_path / "spoilt"))
    (root / "data" / "chunk-000" / "episode_000001.parquet").write_text("junk")
    with serving(root, folder_of_videos(tmp_path)) as get:
        (tmp_path / "videos" / "1.mp4").write_text("junk")
        for number in range(2):
            rows, faults = get(f"/{number}").json()["episodes"], get(f"/{number}/faults").json()
            assert [row["episode"] for row in rows if row["num_frames"] == 0] == [1]
            assert list(faults) == ["1"]
            assert faults["1"] in failure(get(f"/{number}/episodes/1"), 500)


def test_a_frame_of_another_size_is_refused_not_stretched(tmp_path: Path) -> None:
    (tmp_path / "demos" / "0").mkdir(parents=True)
    for t, frame in enumerate((*writers.video(3), writers.video(1)[0, :40])):
        Image.fromarray(frame).save(tmp_path / "demos" / "0" / f"{t}.png")
    with serving(tmp_path / "demos") as get:
        told = failure(get("/0/episodes/0/videos/0"), 500)
    assert "0: frames: frame 3: expected a frame of 48 x 64 pixels, as the first, got 40 x 64 pixels" in told


def test_labels_that_come_or_change_are_shown_at_once(tmp_path: Path) -> None:
    root = copied("toy_v21", tmp_path)
    with serving(root) as get:
        assert get("/0").json()["labels"] is None
        options = LabelOptions(name="later", cameras=("front",), formats=("signals",))
        label(open_dataset(root), BrightnessScorer(), options)
        first = get("/0").json()
        assert first["labels"] == "reward_signals/later.parquet"
        assert "disagreement" not in first["episodes"][0]  # there is one camera alone
        label(open_dataset(root), BrightnessScorer(), LabelOptions(limit=3))
        second = get("/0").json()
        assert second["labels"] == "rfm_progress.parquet"
        assert [("backwards" in row) for row in second["episodes"]] == [True] * 3 + [False] * 5
        assert get("/0?labels=reward_signals/later.parquet").json() == first
        assert get("/0/episodes/5").json()["curves"] == []
        by_name = get("/0/episodes/5?labels=reward_signals/later.parquet").json()["curves"]
        columns = columns_of(root, 5, "reward_signals/later.parquet")
        np.testing.assert_array_equal(np.float32(by_name[0]["progress"]), columns["reward.later.progress"])


def test_names_and_tasks_are_shown_as_they_are_now_and_labels_follow_the_names(tmp_path: Path) -> None:
    root, given = folder_of_videos(tmp_path), "push the block"

    def rows() -> dict[str, Any]:
        return {row["name"]: row for row in get("/0").json()["episodes"]}

    with serving(root) as get:
        assert {name: row["task"] for name, row in rows().items()} == {"0.mp4": "", "1.mp4": ""}
        (root / "tasks.csv").write_text("video,task\n1.mp4,open the drawer\n0.mp4,close it\n")
        assert {name: row["task"] for name, row in rows().items()} == {"0.mp4": "close it", "1.mp4": "open the drawer"}
        (first, *_) = label(open_dataset(root), BrightnessScorer(), LabelOptions()).files  # in the table's order
        for number, name in enumerate(("1.mp4", "0.mp4")):
            assert (rows()[name]["episode"], get(f"/0/episodes/{number}").json()["name"]) == (number, name)
            progress = columns_of(root, number, first.name)["progress_sparse"]
            assert rows()[name]["final_progress"] == pytest.approx(float(progress[-1]))
            for part, points in (("", "curves"), ("/preview", "progress")):
                told = get(f"/0/episodes/{rows()[name]['episode']}{part}").json()[points]
                assert (told if part else told[0]["progress"]) == pytest.approx(progress.tolist())
        overridden = open_dataset(root, task=given, override_task=True)
        label(overridden, BrightnessScorer(), LabelOptions(overwrite=True))
        assert {row["task"] for row in rows().values()} == {given}


def add_demonstration(file: Path) -> None:
    with h5py.File(file, "r+") as opened:
        opened.copy("data/demo_3", "data/demo_77")


def add_line(root: Path) -> None:
    file = root / "meta" / "episodes.jsonl"
    file.write_text(file.read_text() + '{"episode_index": 77, "tasks": ["push"], "length": 5}\n')


def add_recording(root: Path) -> None:
    (root / "later").mkdir()
    clip.write(root / "later" / "new.mp4", writers.video(4), 5)


READER = """from rfm_labels import Episode

def episodes(folder):
    return [Episode(file.stem, {"front": file}, "push") for file in sorted(folder.glob("**/*.mp4"))]
"""
GROWN: dict[str, tuple[Callable[[Path], Path], Callable[[Path], None]]] = {
    "HDF5": (hdf5, add_demonstration),
    "LeRobot": (lambda folder: copied("toy_v21", folder), add_line),
    "reader": (folder_of_videos, add_recording),
}


@pytest.mark.parametrize(("kind", "make", "add"), [(kind, *each) for kind, each in GROWN.items()], ids=GROWN)
def test_an_episode_that_is_recorded_later_is_listed(
    tmp_path: Path, kind: str, make: Callable[[Path], Path], add: Callable[[Path], None]
) -> None:
    (tmp_path / "reader.py").write_text(READER)
    root = make(tmp_path)
    with serving(f"{tmp_path}/reader.py:episodes={root}" if kind == "reader" else root) as get:
        before = get("/0").json()["episodes"]
        add(root)
        *same, new = get("/0").json()["episodes"]
        assert same == before
        assert new["episode"] == (2 if kind == "reader" else 77)
        preview = get(f"/0/episodes/{new['episode']}/preview").json()
        assert (preview["name"], preview["num_frames"]) == (new["name"], new["num_frames"])


def test_an_episode_that_is_recorded_while_the_dataset_is_opened_is_listed(tmp_path: Path) -> None:
    recorded = '    if not (folder / "new.mp4").exists():\n        (folder / "new.mp4").write_bytes(b"later")\n'
    (tmp_path / "reader.py").write_text(READER.replace("return", "found =") + recorded + "    return found\n")
    (dataset,) = open_to_show(f"{tmp_path}/reader.py:episodes={folder_of_videos(tmp_path)}")
    assert [len(each.numbers) for each in (dataset, dataset.as_now())] == [2, 3]


def test_a_dataset_stays_listed_while_a_file_is_unfinished(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = copied("toy_v30_many", tmp_path)
    file = root / "meta" / "episodes" / "chunk-000" / "file-001.parquet"
    with serving(root) as get:
        before = get("/0").json()
        with parquet.ParquetWriter(file, parquet.read_schema(file.with_name("file-000.parquet"))):
            assert [get("/0").json() for _ in range(2)] == [before] * 2
    assert caplog.text.count("showing the dataset as it was") == 1
    assert f"{file}: expected a readable Parquet file" in caplog.text


def test_tasks_are_those_of_the_reader_or_of_the_table_that_was_opened(tmp_path: Path) -> None:
    reader, folder = at_another_rate(tmp_path).split("=")
    other = Path(folder) / "other.csv"
    other.write_text("video,task\n0.mp4,open the drawer\n1.mp4,close it\n")
    with serving(f"{reader}={folder}", other) as get:
        for foreign in ("video,task\n0,push\n0.mp4,push\n", "id,task\n1,push\n"):
            (Path(folder) / "tasks.csv").write_text(foreign)
            told = [[row["task"] for row in get(f"/{number}").json()["episodes"]] for number in range(2)]
            assert told == [["", ""], ["open the drawer", "close it"]]


@pytest.mark.parametrize(
    "provenance", [{"dataset": "org/name"}, {"dataset": {"task": "push"}}, {"dataset": {"task": {}}}]
)
def test_the_provenance_of_another_writer_may_have_other_parts(
    folders: list[Path], tmp_path: Path, provenance: dict[str, Any]
) -> None:
    root = Path(shutil.copytree(folders[V21], tmp_path / "copy"))
    file = root / "rfm_progress.parquet"
    others = {"rfm.provenance": json.dumps({**provenance, "checkpoint": "a", "orientations": "b", "channels": "c"})}
    parquet.write_table(parquet.read_table(file).replace_schema_metadata(others), file)
    with serving(root) as get:
        told = get("/0").json()
    assert [row["task"] for row in told["episodes"]] == [each.task for each in LeRobotDataset(root).episodes]


def test_labels_of_others_may_lack_success_and_rows_and_tell_which_frames_the_model_skipped(tmp_path: Path) -> None:
    root = copied("toy_v21", tmp_path)
    episodes = LeRobotDataset(root).episodes
    lengths = [episode.num_frames for episode in episodes[:2]]
    tasks = root / "meta" / "tasks.jsonl"
    tasks.write_text(tasks.read_text().replace(episodes[0].task, "N/A"))  # no sentence
    progress = np.linspace(0, 1.5, sum(lengths), dtype=np.float32)
    progress[[3, lengths[0] - 1]] = np.nan
    identity = {
        "index": np.arange(sum(lengths)),
        "episode_index": np.repeat([0, 1], lengths),
        "frame_index": np.concatenate([np.arange(length) for length in lengths]),
    }
    is_answered = identity["frame_index"] % 4 != 2
    hop = np.where(is_answered, np.float32(0.1), np.float32("nan"))
    table = pa.table({**identity, "progress_sparse": progress, "hop": hop})
    parquet.write_table(table.filter(pa.array(identity["frame_index"] != 5)), root / "sarm_progress.parquet")
    with serving(root) as get:
        first, second, third, *_ = get("/0").json()["episodes"]
        assert (first["task"], second["task"]) == ("N/A", episodes[1].task)
        assert first["final_progress"] is None
        assert second["final_progress"] == pytest.approx(1.5)
        assert first.keys() == second.keys() == third.keys() | {"final_progress", "backwards"}
        (curve,) = get("/0/episodes/0").json()["curves"]
        missing = [t for t, value in enumerate(curve["progress"]) if value is None]
        assert (missing, curve["success"]) == ([3, 5, lengths[0] - 1], None)
        assert curve["answered"] == is_answered[: lengths[0]].tolist()
