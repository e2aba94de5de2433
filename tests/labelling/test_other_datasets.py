# SPDX-License-Identifier: MIT
"""Datasets of HDF5 and of videos, and the labels of HDF5 files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pyarrow import parquet

from labelling import LEROBOT, BrightnessScorer, brightness
from pictures import numbered, numbers, write_video
from rfm_client.labelling import DatasetError, LabelOptions, label, open_dataset

LENGTHS = (5, 7, 3)
TASK = "put the bowl on the stove"


def frames_of(index: int, camera: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    size = 24 if camera == "agentview_rgb" else 16
    return np.random.default_rng([index, size]).integers(0, 256, (LENGTHS[index], size, size, 3), np.uint8)


@pytest.fixture
def libero(tmp_path: Path) -> Path:
    """As LIBERO writes it: the sentence in problem_info, two cameras of two sizes, actions and states."""
    file = tmp_path / "demos.hdf5"
    with h5py.File(file, "w") as opened:
        data = opened.create_group("data")
        data.attrs["problem_info"] = json.dumps({"language_instruction": TASK})
        data.attrs["env_args"] = json.dumps({"env_name": "Libero"})
        for index, length in reversed(list(enumerate(LENGTHS))):
            demo = data.create_group(f"demo_{index}")
            demo["actions"] = np.zeros((length, 7))
            for camera in ("agentview_rgb", "eye_in_hand_rgb"):
                demo[f"obs/{camera}"] = frames_of(index, camera)
            demo["obs/gripper_states"] = np.zeros((length, 2))
    return file


def test_an_hdf5_file_gives_its_demonstrations_in_the_order_of_their_numbers(libero: Path) -> None:
    dataset = open_dataset(libero)
    assert (dataset.kind, dataset.source, dataset.root) == ("HDF5", "demos.hdf5", libero.parent)
    assert list(dataset.cameras) == ["agentview_rgb", "eye_in_hand_rgb"]
    told = [(e.index, e.name, e.task, e.num_frames, e.first_index) for e in dataset.episodes]
    assert told == [(0, "demo_0", TASK, 5, 0), (1, "demo_1", TASK, 7, 5), (2, "demo_2", TASK, 3, 12)]
    for episode in dataset.episodes:
        for camera in dataset.cameras:
            upright = frames_of(episode.index, camera)[:, ::-1]  # as upstream turns LIBERO's
            np.testing.assert_array_equal(list(dataset.frames(episode, camera)), upright)
            assert dataset.check(episode, camera).num_bytes == frames_of(episode.index, camera).nbytes


def expected(index: int) -> Any:
    both = [brightness(frames_of(index, camera)) for camera in ("agentview_rgb", "eye_in_hand_rgb")]
    return np.mean(both, axis=0)


def test_labels_of_an_hdf5_file_go_to_a_file_beside_it(libero: Path) -> None:
    before = libero.read_bytes()
    report = label(open_dataset(libero), BrightnessScorer(), LabelOptions())
    assert report.files == [libero.with_name("demos.rfm_rewards.hdf5")]
    assert libero.read_bytes() == before
    with h5py.File(report.files[0]) as opened:
        assert sorted(opened["data"]) == ["demo_0", "demo_1", "demo_2"]
        provenance = json.loads(opened["data"].attrs["rfm_provenance"])
        assert provenance["dataset"]["kind"] == "HDF5"
        for index in range(3):
            demo = opened[f"data/demo_{index}"]
            assert demo["rfm_progress"].dtype == np.float32
            np.testing.assert_allclose(demo["rfm_progress"], expected(index), atol=1e-6)
            np.testing.assert_allclose(
                demo["rfm_progress.agentview_rgb"], brightness(frames_of(index, "agentview_rgb")), atol=1e-6
            )
            assert demo["rfm_success"].shape == (LENGTHS[index],)
    label(open_dataset(libero), BrightnessScorer(), LabelOptions())  # the same again
    with pytest.raises(DatasetError, match=r"rfm_rewards\.hdf5: .* same recipe, got sampling\.frames: 16 there, 2 now"):
        label(open_dataset(libero), BrightnessScorer(), LabelOptions(frames=2))


def test_labels_go_into_the_hdf5_file_when_asked(libero: Path) -> None:
    scorer = BrightnessScorer()
    for _ in range(2):
        report = label(open_dataset(libero), scorer, LabelOptions(in_place=True, name="mine"))
        assert report.files == [libero]
    assert scorer.num_samples == 2 * sum(LENGTHS)
    with h5py.File(libero) as opened:
        np.testing.assert_allclose(opened["data/demo_1/mine_progress"], expected(1), atol=1e-6)
        assert opened["data/demo_1/actions"].shape == (7, 7)
    assert report.summary is not None
    np.testing.assert_allclose(report.summary.final_progress, [expected(index)[-1] for index in range(3)], atol=1e-6)


def test_an_hdf5_file_may_have_parquet_labels(libero: Path) -> None:
    report = label(open_dataset(libero), BrightnessScorer(), LabelOptions(formats=("progress",)))
    table = parquet.read_table(report.files[0])
    assert table["index"].to_pylist() == list(range(15))


def broken(change: Any) -> Any:
    def apply(file: Path) -> None:
        with h5py.File(file, "r+") as opened:
            change(opened["data"])

    return apply


def shorten(data: Any) -> None:
    del data["demo_1/actions"]
    data["demo_1/actions"] = np.zeros((6, 7))


BROKEN: dict[str, tuple[Any, str]] = {
    "lengths that differ": (
        broken(shorten),
        r"data/demo_1: expected one length, above 0, got obs/agentview_rgb 7, .*actions 6",
    ),
    "a camera that is missing": (
        broken(lambda data: data["demo_2/obs"].pop("eye_in_hand_rgb")),
        r"cameras: expected some of agentview_rgb, got 'eye_in_hand_rgb', which is left out: missing in demo_2",
    ),
    "no task": (
        broken(lambda data: data.attrs.__delitem__("problem_info")),
        r"problem_info or env_args: expected a task as a sentence, got none",
    ),
    "no demonstration": (
        broken(lambda data: [data.pop(name) for name in list(data)]),
        r"data: expected demo_0, demo_1 and so on, got none",
    ),
    "a truncated file": (
        lambda file: file.write_bytes(file.read_bytes()[:3000]),
        r"demos\.hdf5: expected an HDF5 file, got ",
    ),
}


@pytest.mark.parametrize(("break_it", "message"), BROKEN.values(), ids=BROKEN)
def test_an_hdf5_file_that_contradicts_itself_is_refused(libero: Path, break_it: Any, message: str) -> None:
    break_it(libero)
    scorer = BrightnessScorer()
    with pytest.raises(DatasetError, match=message):
        label(open_dataset(libero), scorer, LabelOptions(cameras=("agentview_rgb", "eye_in_hand_rgb")))
    assert scorer.num_samples == 0


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    (folder / "day").mkdir(parents=True)
    write_video(folder / "b.mp4", numbered(6))
    write_video(folder / "day" / "a.mp4", numbered(4), times=[0, 1, 5, 6])
    return folder


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("tasks.csv", "task,video\nstack the cups,b.mp4\nopen the box,day/a.mp4\n"),
        ("tasks.json", '{"b.mp4": "stack the cups", "day/a.mp4": "open the box"}'),
    ],
)
@pytest.mark.parametrize("by_table", [True, False])
def test_a_folder_of_videos_is_read_in_the_order_of_its_table(
    videos: Path, name: str, text: str, by_table: bool, output: Path
) -> None:
    (videos / name).write_text(text)
    dataset = open_dataset(videos / name if by_table else videos)
    assert [(e.name, e.task, e.num_frames, e.first_index) for e in dataset.episodes] == [
        ("b.mp4", "stack the cups", 6, 0),
        ("day/a.mp4", "open the box", 4, 6),
    ]
    for episode in dataset.episodes:
        film = np.stack(list(dataset.frames(episode, "video")))
        assert numbers(film, episode.num_frames) == list(range(episode.num_frames))
    report = label(dataset, BrightnessScorer(), LabelOptions(output=output))
    assert parquet.read_table(report.files[0])["episode_index"].to_pylist() == [0] * 6 + [1] * 4


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("tasks.csv", '\ufeffvideo,task\r\nb.mp4,"put the block in the bowl, then close the lid"\r\n'),
        ("tasks.json", '\ufeff{"b.mp4": "put the block in the bowl, then close the lid"}'),
        ("tasks.csv", 'video,task\nb.mp4," put the block in the bowl, then close the lid "\n'),
        ("tasks.json", '{"b.mp4": "put the block in the bowl, then close the lid\\n"}'),
    ],
)
def test_a_task_may_have_commas_and_loses_the_blanks_around_it_and_the_table_its_byte_order_mark(
    videos: Path, name: str, text: str
) -> None:
    (videos / name).write_text(text)
    assert [e.task for e in open_dataset(videos).episodes] == ["put the block in the bowl, then close the lid"]


REFUSED = {
    "no table": (None, "", "expected one of tasks.csv and tasks.json with the task of each video, got none"),
    "no column of tasks": ("tasks.csv", "video\nb.mp4\n", "expected the columns video and task, got video"),
    "a video twice": ("tasks.csv", "video,task\nb.mp4,a\nb.mp4,b\n", "line 3: expected each video once, got b.mp4"),
    "no task": ("tasks.csv", "video,task\nb.mp4,\n", "b.mp4: expected a task as a sentence, got none"),
    "a task of blanks": ("tasks.csv", "video,task\nb.mp4,  \n", "b.mp4: expected a task as a sentence, got '  '"),
    "a comma without quotes": (
        "tasks.csv",
        "video,task\nday/a.mp4,a\nb.mp4,put the block in the bowl, then close the lid\n",
        "tasks.csv: line 3: expected 2 cells (text with a comma in quotes), got 3",
    ),
    "a row that ends early": (
        "tasks.csv",
        "video,note,task\nb.mp4,blue\n",
        "tasks.csv: line 2: expected 3 cells (text with a comma in quotes), got 2",
    ),
    "a video that is missing": ("tasks.json", '{"c.mp4": "a"}', "c.mp4: expected a video file, got none"),
    "no JSON": ("tasks.json", "{", "tasks.json: expected JSON, got "),
}


@pytest.mark.parametrize(("name", "text", "message"), REFUSED.values(), ids=REFUSED)
def test_a_table_of_videos_that_is_wrong_is_refused(videos: Path, name: str | None, text: str, message: str) -> None:
    if name is not None:
        (videos / name).write_text(text)
    with pytest.raises(DatasetError) as caught:
        _ = open_dataset(videos).episodes
    assert message in str(caught.value)


def lerobot(folder: Path, *tasks: str) -> Path:
    """A dataset whose first episodes have these tasks."""
    root = shutil.copytree(LEROBOT / "toy_v21", folder / "toy")
    lines = (root / "meta" / "tasks.jsonl").read_text().splitlines()
    lines[: len(tasks)] = [json.dumps({"task_index": index, "task": task}) for index, task in enumerate(tasks)]
    (root / "meta" / "tasks.jsonl").write_text("\n".join(lines))
    for file in (root / "meta").glob("episodes.jsonl"):
        episodes = [json.loads(line) for line in file.read_text().splitlines()]
        file.write_text("\n".join(json.dumps({**episode, "tasks": []}) for episode in episodes))
    return root


def hdf5(folder: Path, task: str) -> Path:
    with h5py.File(folder / "demos.hdf5", "w") as opened:
        opened.create_group("data").attrs["env_args"] = json.dumps({"env_name": "Lift", "lang": task})
        opened["data/demo_0/obs/front"] = np.zeros((3, 8, 8, 3), np.uint8)
    return folder / "demos.hdf5"


def table(folder: Path, text: str) -> Path:
    for name in ("a.mp4", "b.mp4"):
        write_video(folder / name, numbered(3))
    (folder / "tasks.csv").write_text(text)
    return folder


WITH_TASKS: dict[str, Callable[[Path], Path]] = {
    "LeRobot": lambda folder: lerobot(folder, "stack the cups"),
    "HDF5": lambda folder: hdf5(folder, "stack the cups"),
    "videos": lambda folder: table(folder, "video,task\na.mp4,stack the cups\nb.mp4,stack the cups\n"),
}
TOY_TASKS = [episode.task for episode in open_dataset(LEROBOT / "toy_v21").episodes]
WITHOUT_TASKS: dict[str, tuple[Callable[[Path], Path], list[str]]] = {
    "LeRobot": (
        lambda folder: lerobot(folder, " "),
        ["open the box" if task == TOY_TASKS[0] else task for task in TOY_TASKS],
    ),
    "HDF5": (lambda folder: hdf5(folder, ""), ["open the box"]),
    "videos, an empty cell": (
        lambda folder: table(folder, "video,task\na.mp4,\nb.mp4,stack the cups\n"),
        ["open the box", "stack the cups"],
    ),
    "videos, no column": (lambda folder: table(folder, "video\na.mp4\nb.mp4\n"), ["open the box"] * 2),
}


@pytest.mark.parametrize(("make", "expected"), WITHOUT_TASKS.values(), ids=WITHOUT_TASKS)
def test_a_task_fills_in_where_episodes_have_none(
    tmp_path: Path, make: Callable[[Path], Path], expected: list[str]
) -> None:
    source = make(tmp_path)
    with pytest.raises(DatasetError, match="--task"):
        _ = open_dataset(source).episodes
    assert [episode.task for episode in open_dataset(source, task="open the box").episodes] == expected


@pytest.mark.parametrize("make", WITH_TASKS.values(), ids=WITH_TASKS)
def test_a_task_replaces_those_of_episodes_only_on_request(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    source = make(tmp_path)
    with pytest.raises(DatasetError) as refused:
        _ = open_dataset(source, task="open the box").episodes
    assert str(refused.value) == (
        "task: expected none for episodes that all have tasks of their own, got 'open the box': leave it out, or put it "
        "in the place of theirs with --override-task"
    )
    told = {episode.task for episode in open_dataset(source, task="open the box", override_task=True).episodes}
    assert told == {"open the box"}


@pytest.mark.parametrize(("task", "got"), [(None, "none"), ("", "''"), (" ", "' '")])
def test_a_task_that_replaces_others_is_a_sentence(videos: Path, task: str | None, got: str) -> None:
    with pytest.raises(DatasetError, match=f"^task: expected a sentence, got {got}$"):
        open_dataset(videos, task=task, override_task=True)
