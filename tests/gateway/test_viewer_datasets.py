# SPDX-License-Identifier: MIT
"""What the page asks of datasets: episodes, curves and videos, and what it is refused. No Triton is needed for that."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pytest
import requests
from pyarrow import parquet

from gateway_requests import failure
from gateways import Gateway, poll, running
from labelling import LEROBOT, BrightnessScorer
from pictures import TURNS, numbered, turn, write_video
from rfm.launch.process import Endpoints
from rfm_client.contract.settings import ConfigError
from rfm_client.data.datasets.films import Span
from rfm_client.data.orientation import Orient
from rfm_client.data.video import read_video
from rfm_client.labelling import LabelOptions, label, open_dataset, summarise
from rfm_client.labelling.options import Format
from rfm_gateway.config import GatewayConfig
from rfm_gateway.viewer.cuts import cut
from rfm_gateway.viewer.datasets import ShownDataset
from shown_datasets import CAMERAS, CODINGS, columns_of, copied, dataset, encoded_anew, labelled

KEY = "open sesame"
V21, V30, PLAIN = range(3)  # numbers of the datasets: two with labels, one without
NAMES = ("toy_v21", "toy_v30_many", "toy_v30_many")


@dataclass(frozen=True)
class Shelf:
    """A gateway with datasets. folders: of the datasets, by their numbers"""

    gateway: Gateway
    folders: tuple[Path, ...]

    def get(self, path: str, **more: Any) -> requests.Response:
        return requests.get(f"{self.gateway.url}/viewer/datasets{path}", timeout=60, **more)

    def video(self, number: int, episode: int, camera: int, **more: Any) -> requests.Response:
        return self.get(f"/{number}/episodes/{episode}/videos/{camera}", **more)


def serving(folder: Path, *roots: Path, options: tuple[str, ...] = (), **environment: str) -> Any:
    words = [word for root in roots for word in ("--dataset", str(root))]
    return running(Endpoints.free(), folder, "rfm", *words, *options, **environment)


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shelf]:
    folder = tmp_path_factory.mktemp("shelf")
    (folder / "plain").mkdir()
    roots = labelled(NAMES[V21], folder), labelled(NAMES[V30], folder), copied(NAMES[PLAIN], folder / "plain")
    with serving(folder, *roots) as gateway:
        yield Shelf(gateway, roots)


def test_the_datasets_are_told_in_their_order(shelf: Shelf) -> None:
    told = shelf.get("").json()["datasets"]
    assert [(each["name"], each["kind"], each["labels"]) for each in told] == [
        ("toy_v21", "LeRobot v2.1", ["rfm_progress.parquet"]),
        ("toy_v30_many", "LeRobot v3.0", ["rfm_progress.parquet"]),
        ("toy_v30_many", "LeRobot v3.0", []),
    ]


@pytest.mark.parametrize("number", [V21, V30])
def test_the_table_tells_what_the_labels_say_of_each_episode(shelf: Shelf, number: int) -> None:
    told = shelf.get(f"/{number}").json()
    root = shelf.folders[number]
    summary = summarise(root / "rfm_progress.parquet")
    never = summary.never_succeed
    assert never is not None
    episodes = dataset(root).episodes
    assert [(each["episode"], each["task"], each["num_frames"]) for each in told["episodes"]] == [
        (episode.index, episode.task, episode.num_frames) for episode in episodes
    ]
    for row, backwards in zip(told["episodes"], summary.backwards, strict=True):
        columns = columns_of(root, row["episode"])
        apart = np.abs(columns[f"progress.{CAMERAS[0]}"] - columns[f"progress.{CAMERAS[1]}"])
        falls = np.diff(columns["progress_sparse"]) < -0.01
        expected = {
            "final_progress": columns["progress_sparse"][-1],
            "best_success": columns["success"].max(),
            "backwards": falls.mean(),
            "disagreement": apart.mean(),
        }
        assert {name: row[name] for name in expected} == pytest.approx(expected, abs=1e-6)
        assert row["backwards"] == backwards
        assert row["never_succeeds"] == (columns["success"].max() < 0.5) == (row["episode"] in never)
    assert sum(told["bins"]["counts"]) == len(episodes)
    counts, edges = np.histogram(summary.final_progress, bins=20, range=(0, 1))
    assert told["bins"] == {"edges": edges.tolist(), "counts": counts.tolist()}
    assert (told["labels"], told["cameras"], told["threshold"]) == ("rfm_progress.parquet", list(CAMERAS), 0.5)


@pytest.mark.parametrize("form", ["progress", "signals"])
def test_the_table_tells_how_pictures_were_turned_for_the_labels(tmp_path: Path, form: Format) -> None:
    root = copied("toy_v21", tmp_path)
    turned = open_dataset(root, orient=Orient.parse(["wrist=rotate180"]))
    label(turned, BrightnessScorer(), LabelOptions(formats=(form,)))
    assert ShownDataset.open(str(root)).table(None)["orientations"] == ["none", "rotate180"]


def test_a_dataset_without_labels_lists_tasks_and_lengths(shelf: Shelf) -> None:
    told = shelf.get(f"/{PLAIN}").json()
    assert (told["labels"], told["bins"]) == (None, None)
    assert {tuple(row) for row in told["episodes"]} == {("episode", "task", "num_frames")}
    assert len(told["episodes"]) == len(dataset(shelf.folders[PLAIN]).episodes)
    curves = shelf.get(f"/{PLAIN}/episodes/3").json()
    assert (len(curves["times_s"]), curves["curves"]) == (told["episodes"][3]["num_frames"], [])


@pytest.mark.parametrize(("number", "episode"), [(V21, 0), (V21, 7), (V30, 0), (V30, 4), (V30, 9)])
def test_the_curves_are_those_of_the_labels(shelf: Shelf, number: int, episode: int) -> None:
    told = shelf.get(f"/{number}/episodes/{episode}").json()
    columns = columns_of(shelf.folders[number], episode)
    np.testing.assert_allclose(told["times_s"], columns["frame_index"] / 10, atol=1e-4)
    names = [(None, "progress_sparse", "success"), *((each, f"progress.{each}", f"success.{each}") for each in CAMERAS)]
    assert [curve["camera"] for curve in told["curves"]] == [name for name, *_ in names]
    for curve, (_, progress, success) in zip(told["curves"], names, strict=True):
        np.testing.assert_array_equal(np.float32(curve["progress"]), columns[progress])
        np.testing.assert_array_equal(np.float32(curve["success"]), columns[success])


def decoded(video: bytes, folder: Path) -> tuple[list[float], np.ndarray[Any, Any]]:
    """Times and frames of an MP4 file."""
    file = folder / "answer.mp4"
    file.write_bytes(video)
    with av.open(str(file)) as container:
        frames = [(float(frame.time or 0), frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    return [time for time, _ in frames], np.stack([frame for _, frame in frames])


def check_frames(video: bytes, root: Path, episode: int, camera: int, folder: Path) -> None:
    """The video has the episode's frames and no other, from 0 s on."""
    opened = dataset(root)
    times_s, frames = decoded(video, folder)
    np.testing.assert_array_equal(frames, np.stack(list(opened.frames(opened.episodes[episode], CAMERAS[camera]))))
    np.testing.assert_allclose(times_s, np.arange(len(frames)) / 10, atol=1e-3)


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("number", [V21, V30])
def test_a_video_has_the_frames_of_its_episode(shelf: Shelf, tmp_path: Path, number: int, camera: int) -> None:
    root = shelf.folders[number]
    for episode in range(len(dataset(root).episodes)):
        response = shelf.video(number, episode, camera)
        assert (response.status_code, response.headers["content-type"]) == (200, "video/mp4")
        assert response.headers["x-content-type-options"] == "nosniff"
        check_frames(response.content, root, episode, camera, tmp_path)


@pytest.mark.parametrize("coding", CODINGS.values(), ids=CODINGS)
def test_a_cut_is_exact_however_the_film_is_coded(tmp_path: Path, coding: tuple[str, dict[str, str]]) -> None:
    root = copied("toy_v30_many", tmp_path)
    encoded_anew(root, *coding)
    with serving(tmp_path, root) as gateway:
        shelf = Shelf(gateway, (root,))
        for episode in range(len(dataset(root).episodes)):
            check_frames(shelf.video(0, episode, 0).content, root, episode, 0, tmp_path)


@pytest.mark.parametrize("matrix", [matrix for matrix, _ in TURNS.values()], ids=TURNS)
def test_a_cut_of_a_turned_film_is_turned_alike(tmp_path: Path, matrix: tuple[int, int, int, int]) -> None:
    write_video(tmp_path / "film.mp4", numbered(6))
    turn(tmp_path / "film.mp4", matrix)
    times_s, rotation = shown(tmp_path / "film.mp4")
    cut(Span(tmp_path / "film.mp4", times_s[:4], 0.01, "episode 0"), tmp_path / "cut.mp4", lambda num_bytes: None)
    cut_times_s, cut_rotation = shown(tmp_path / "cut.mp4")
    assert cut_rotation == rotation
    assert len(cut_times_s) == 4
    np.testing.assert_array_equal(read_video(tmp_path / "cut.mp4"), read_video(tmp_path / "film.mp4")[:4])


def shown(film: Path) -> tuple[np.ndarray[Any, np.dtype[np.float64]], set[int]]:
    """The times of a film's frames, in seconds, and how far they are turned."""
    with av.open(str(film)) as container:
        frames = list(container.decode(video=0))
    return np.array([float(frame.time) for frame in frames]), {frame.rotation for frame in frames}


def test_ranges_are_parts_of_the_same_video(shelf: Shelf) -> None:
    whole = shelf.video(V30, 4, 0)
    size = len(whole.content)
    assert whole.headers["accept-ranges"] == "bytes"
    for asked, part in (("0-99", slice(0, 100)), ("100-", slice(100, None)), ("-7", slice(-7, None))):
        response = shelf.video(V30, 4, 0, headers={"Range": f"bytes={asked}", "If-Range": whole.headers["etag"]})
        assert (response.status_code, response.content) == (206, whole.content[part]), asked
        first = range(size)[part][0]
        assert response.headers["content-range"] == f"bytes {first}-{first + len(response.content) - 1}/{size}"
    response = shelf.video(V30, 4, 0, headers={"Range": f"bytes={size}-"})
    assert (response.status_code, response.headers["content-range"]) == (416, f"bytes */{size}")
    assert shelf.video(V30, 4, 0, headers={"Range": "bytes=0-9", "If-Range": '"other"'}).content == whole.content


UNKNOWN = {
    "/3": "dataset: expected one of 3, got 3",
    "/-1": "dataset: expected one of 3, got -1",
    "/0/episodes/8": "episode: expected one from 0 to 7, got 8",
    "/0/episodes/-1": "episode: expected one from 0 to 7, got -1",
    "/0/episodes/8/videos/0": "episode: expected one from 0 to 7, got 8",
    "/0/episodes/0/videos/2": "camera: expected one of 2 with films, got 2",
    "/0/episodes/0/videos/-1": "camera: expected one of 2 with films, got -1",
    "/0?labels=../toy_v30_many/rfm_progress.parquet": "labels: expected one of rfm_progress.parquet, got another",
    "/0?labels=/etc/passwd": "labels: expected one of rfm_progress.parquet, got another",
    "/0/episodes/0?labels=meta/info.json": "labels: expected one of rfm_progress.parquet, got another",
    "/2?labels=rfm_progress.parquet": "labels: expected one of none, got another",
}


@pytest.mark.parametrize(("path", "message"), UNKNOWN.items())
def test_what_is_not_there_is_not_found(shelf: Shelf, path: str, message: str) -> None:
    assert failure(shelf.get(path), 404) == message


TRAVERSALS = [
    "0/episodes/0/videos/../../../../../../etc/passwd", "0/episodes/..%2f..%2fmeta%2finfo.json", "..%2f..%2fetc%2fpasswd",
    "0/meta/info.json", "0/episodes/0/videos/0%2f..%2f..", "0/episodes/%00", "toy_v21", "0/videos/chunk-000",
]  # fmt: skip


@pytest.mark.parametrize("path", TRAVERSALS)
def test_no_path_is_taken_from_a_request(shelf: Shelf, path: str) -> None:
    with closing(shelf.gateway.connect()) as connection:
        connection.request("GET", f"/viewer/datasets/{path}")  # as it stands there: requests would shorten it
        response = connection.getresponse()
        assert response.status in (404, 422)
        assert set(json.loads(response.read())) == {"detail"}


@pytest.mark.parametrize("headers", [{}, {"X-API-Key": "sesame"}], ids=["none", "another"])
def test_nothing_is_told_without_the_key(shelf: Shelf, tmp_path: Path, headers: dict[str, str]) -> None:
    with serving(tmp_path, shelf.folders[V21], RFM_GATEWAY_API_KEY=KEY) as gateway:
        keyed = Shelf(gateway, shelf.folders)
        for path in ("", "/0", "/0/episodes/0", "/0/episodes/0/videos/0"):
            assert failure(keyed.get(path, headers=headers), 401).startswith("key: expected X-API-Key")
            assert keyed.get(path, headers={"X-API-Key": KEY}).ok


def a_link(path: Path, target: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(target)


LINKED = {
    "a film": "videos/observation.images.front/chunk-000/file-000.mp4",
    "a table": "data/chunk-000/file-000.parquet",
    "metadata": "meta/tasks.parquet",
    "labels": "rfm_progress.parquet",
    "another file": "README.md",
}


@pytest.mark.parametrize("name", LINKED.values(), ids=LINKED)
def test_a_dataset_with_links_that_leave_it_is_refused(shelf: Shelf, tmp_path: Path, name: str) -> None:
    root = copied("toy_v30_many", tmp_path)
    a_link(root / name, shelf.folders[V30] / name)
    expected = f"{root / name}: expected a file in the dataset's folder, got a link that leaves it"
    with pytest.raises(ConfigError, match=expected):
        GatewayConfig(dataset=(str(root),)).shown_datasets()


def test_a_folder_behind_a_link_is_refused_and_links_inside_are_followed(shelf: Shelf, tmp_path: Path) -> None:
    root = copied("toy_v30_many", tmp_path)
    (root / "videos").rename(root / "films")
    (root / "videos").symlink_to(root / "films")
    (root / "loop").symlink_to(root / "loop")
    with pytest.raises(ConfigError, match=r"loop: expected a file in the dataset's folder"):
        GatewayConfig(dataset=(str(root),)).shown_datasets()
    (root / "loop").unlink()
    with serving(tmp_path, root) as gateway:
        check_frames(Shelf(gateway, (root,)).video(0, 1, 0).content, root, 1, 0, tmp_path)
    (root / "videos").unlink()
    (root / "videos").symlink_to(shelf.folders[V30] / "videos")
    with pytest.raises(ConfigError, match=r"videos: expected a file in the dataset's folder"):
        GatewayConfig(dataset=(str(root),)).shown_datasets()


def test_a_link_that_is_made_later_is_refused_when_it_is_asked_for(shelf: Shelf, tmp_path: Path) -> None:
    root, other = labelled("toy_v30_many", tmp_path), shelf.folders[V30]
    with serving(tmp_path, root) as gateway:
        told = Shelf(gateway, (root,))
        assert told.video(0, 0, 0).ok
        for name in ("a film", "labels"):
            a_link(root / LINKED[name], other / LINKED[name])
        message = "expected a file in the dataset's folder, got a link that leaves it: copy the file there"
        assert failure(told.video(0, 0, 0), 500) == f"toy_v30_many/{LINKED['a film']}: {message}"
        assert failure(told.get("/0"), 500) == f"toy_v30_many/{LINKED['labels']}: {message}"
        assert told.video(0, 0, 1).ok


BROKEN: dict[str, tuple[Callable[[Path], object], str, str]] = {
    "no film": (
        lambda root: (root / LINKED["a film"]).unlink(), "/0/episodes/0/videos/0", r"file-000.mp4: expected a video file, got none",
    ),
    "a play list": (
        lambda root: (root / LINKED["a film"]).write_text("#EXTM3U\n/etc/passwd\n"), "/0/episodes/0/videos/0",
        r"file-000.mp4: expected a whole video file, got Invalid data",
    ),
    "another film": (
        lambda root: shutil.copy(root / LINKED["a film"].replace("000.mp4", "002.mp4"), root / LINKED["a film"]),
        "/0/episodes/2/videos/0", r"episode 0 to episode 3: .*: expected 177 frames, one for each row, got 96",
    ),
    "no rows": (lambda root: (root / LINKED["a table"]).unlink(), "/0", r"file-000.parquet: expected a Parquet file, got none"),
    "no labels": (
        lambda root: (root / LINKED["labels"]).write_text("no labels"), "/0", r"rfm_progress.parquet: expected a file of labels",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "path", "message"), BROKEN.values(), ids=BROKEN)
def test_a_dataset_that_breaks_says_why(
    tmp_path: Path, spoil: Callable[[Path], object], path: str, message: str
) -> None:
    root = labelled("toy_v30_many", tmp_path)
    with serving(tmp_path, root) as gateway:
        spoil(root)
        told = failure(Shelf(gateway, (root,)).get(path), 500)
        assert re.search(message, told), told
        assert str(tmp_path) not in told


def test_labels_that_come_or_change_are_shown_at_once(tmp_path: Path) -> None:
    root = copied("toy_v21", tmp_path)
    with serving(tmp_path, root) as gateway:
        told = Shelf(gateway, (root,))
        assert told.get("/0").json()["labels"] is None
        options = LabelOptions(name="later", cameras=("front",), formats=("signals",))
        label(open_dataset(root), BrightnessScorer(), options)
        first = told.get("/0").json()
        assert first["labels"] == "reward_signals/later.parquet"
        assert "disagreement" not in first["episodes"][0]  # there is one camera alone
        label(open_dataset(root), BrightnessScorer(), LabelOptions(limit=3))
        second = told.get("/0").json()
        assert second["labels"] == "rfm_progress.parquet"
        assert [("backwards" in row) for row in second["episodes"]] == [True] * 3 + [False] * 5
        assert told.get("/0?labels=reward_signals/later.parquet").json() == first
        assert told.get("/0/episodes/5").json()["curves"] == []
        by_name = told.get("/0/episodes/5?labels=reward_signals/later.parquet").json()["curves"]
        columns = columns_of(root, 5, "reward_signals/later.parquet")
        np.testing.assert_array_equal(np.float32(by_name[0]["progress"]), columns["reward.later.progress"])


def test_labels_of_others_may_lack_success_and_rows(tmp_path: Path) -> None:
    root = copied("toy_v21", tmp_path)
    lengths = [episode.num_frames for episode in dataset(root).episodes[:2]]
    progress = np.linspace(0, 1.5, sum(lengths), dtype=np.float32)
    progress[[3, lengths[0] - 1]] = np.nan
    identity = {
        "index": np.arange(sum(lengths)),
        "episode_index": np.repeat([0, 1], lengths),
        "frame_index": np.concatenate([np.arange(length) for length in lengths]),
    }
    table = pa.table({**identity, "progress_sparse": progress})
    is_kept = identity["frame_index"] != 5
    parquet.write_table(table.filter(pa.array(is_kept)), root / "sarm_progress.parquet")
    with serving(tmp_path, root) as gateway:
        told = Shelf(gateway, (root,))
        first, second, third, *_ = (rows := told.get("/0").json())["episodes"]
        assert first["final_progress"] is None
        assert second["final_progress"] == pytest.approx(1.5)
        assert first.keys() == second.keys() == third.keys() | {"final_progress", "backwards"}
        assert sum(rows["bins"]["counts"]) == rows["bins"]["counts"][-1] == 1
        (curve,) = told.get("/0/episodes/0").json()["curves"]
        missing = [t for t, value in enumerate(curve["progress"]) if value is None]
        assert (missing, curve["success"]) == ([3, 5, lengths[0] - 1], None)


def test_a_video_that_needs_too_much_memory_is_refused(tmp_path: Path) -> None:
    root, left = copied("toy_v30_many", tmp_path), tmp_path / "left"
    left.mkdir()
    encoded_anew(root, "libx264", {"g": "2", "qp": "0"}, noise=np.random.default_rng(0))
    limits = ("--max-body-mib", "1", "--max-memory-mib", "1")
    with serving(tmp_path, root, options=limits, TMPDIR=str(left)) as gateway:
        told = Shelf(gateway, (root,))
        for _ in range(3):  # what was held is free again
            poll(lambda: told.video(0, 2, 0).status_code != 503)  # an answer is held until the last of it is sent
            expected = "body: expected one that takes at most 1048576 bytes of memory, got more"
            assert failure(told.video(0, 2, 0), 413) == expected
            assert told.video(0, 3, 1).ok
        poll(lambda: not list(left.iterdir()))


REFUSED = {
    "nothing": ("nowhere", r"expected the folder of a LeRobot dataset, which holds meta/info.json, got .*nowhere"),
    "another folder": ("", r"expected the folder of a LeRobot dataset, which holds meta/info.json, got "),
    "another version": ("v9", r"codebase_version: expected one of v2.0, v2.1, v3.0, got 'v9.9'"),
}


@pytest.mark.parametrize(("name", "message"), REFUSED.values(), ids=REFUSED)
def test_a_folder_that_is_no_dataset_is_refused_at_start(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "v9" / "meta").mkdir(parents=True)
    info = json.loads((LEROBOT / "toy_v21" / "meta" / "info.json").read_text())
    (tmp_path / "v9" / "meta" / "info.json").write_text(json.dumps({**info, "codebase_version": "v9.9"}))
    words = ["--triton", "grpc://127.0.0.1:1", "--dataset", str(tmp_path / name)]
    command = [sys.executable, "-m", "rfm_gateway", *words]
    environment = {**os.environ, "COLUMNS": "1000", "NO_COLOR": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 2
    assert re.search(rf"--dataset: .*{message}", done.stderr), done.stderr


def test_a_missing_package_names_the_mend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    message = r'dataset: expected pyarrow, which reads datasets, got none: pip install "./client\[label\]"'
    with pytest.raises(ConfigError, match=message):
        GatewayConfig(triton="grpc://robot:8001", dataset=(str(LEROBOT / "toy_v21"),)).check({})


def test_without_the_page_there_are_no_datasets(shelf: Shelf, tmp_path: Path) -> None:
    with serving(tmp_path, shelf.folders[V21], options=("--no-viewer",)) as gateway:
        assert failure(Shelf(gateway, ()).get(""), 404) == "Not Found"
