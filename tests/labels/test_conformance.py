# SPDX-License-Identifier: MIT
"""Every format of datasets alike: episodes, tasks, frames, labels, resumed runs, corrections, a broken episode."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

import hdf5_writers
from hdf5_writers import TASK, video
from labelling import LEROBOT, WRIST, BrightnessScorer, brightness
from paths import ROOT
from pictures import numbered, numbers, write_video
from rfm_client import RewardError, UInt8Array
from rfm_labels import Dataset, DatasetError, LabelOptions, iter_episodes, label, open_dataset, read_episode_labels

RLDS = ROOT / "tests" / "rlds"
LENGTHS = (4, 6, 3)
CLIPS = [video(length, seed) for seed, length in enumerate(LENGTHS)]

Frames = Mapping[str, UInt8Array]


@dataclass(frozen=True)
class Written:
    """A dataset on disk.

    episodes: number, task, and the frames of each camera; None: other tests compare the frames
    spoil: breaks the second episode; None: other tests break it
    more: further arguments of ``open_dataset``
    """

    source: Path
    episodes: list[tuple[int, str, Frames | None]]
    spoil: Callable[[], object] | None = None
    task: str | None = None
    more: Mapping[str, Any] = field(default_factory=dict)

    def open(self, **opening: Any) -> Dataset:
        return open_dataset(self.source, **{"task": self.task, **self.more, **opening})


def lerobot(name: str) -> Callable[[Path], Written]:
    def write(folder: Path) -> Written:
        root = Path(shutil.copytree(LEROBOT / name, folder / name))
        tasks = [episode.task for episode in open_dataset(root).episodes]
        film = root / "videos" / "chunk-000" / WRIST / "episode_000001.mp4"
        spoil = (lambda: film.write_bytes(film.read_bytes()[:2000])) if film.exists() else None
        return Written(root, [(number, task, None) for number, task in enumerate(tasks)], spoil)

    return write


def robomimic(folder: Path) -> Written:
    file = folder / "demos.hdf5"
    frames = {
        number: {"front": clip, "wrist": clip[:, :32, ::-1]} for number, clip in zip((1, 4, 10), CLIPS, strict=True)
    }
    hdf5_writers.write_robomimic(file, frames)

    def spoil() -> None:
        with h5py.File(file, "r+") as opened:
            del opened["data/demo_4/actions"]
            opened["data/demo_4/actions"] = np.zeros((2, 7))

    return Written(file, [(number, TASK, cameras) for number, cameras in frames.items()], spoil)


def arena(folder: Path) -> Written:
    """IsaacLab-Arena's recorder: the first picture is the last one of the episode before."""
    file = hdf5_writers.write_robomimic(folder / "demos.hdf5", [{"front": clip} for clip in CLIPS])
    with h5py.File(file, "r+") as opened:
        for number in range(len(CLIPS)):
            opened.move(f"data/demo_{number}/obs", f"data/demo_{number}/camera_obs")
            opened[f"data/demo_{number}/obs/joints"] = np.zeros((LENGTHS[number], 54))
    return Written(file, [(number, TASK, {"front": clip[1:]}) for number, clip in enumerate(CLIPS)])


def rlds(folder: Path) -> Written:
    stored = dict(np.load(RLDS / "toy_episode_texts.npz"))
    places = ("train/0", "train/1", "train/2", "val/0", "val/1")
    tasks = [str(stored[f"{place}/task"][0]) for place in places]
    return Written(
        Path(shutil.copytree(RLDS / "toy_episode_texts", folder / "rlds")),
        [(number, task, None) for number, task in enumerate(tasks)],
    )


def with_table(folder: Path, names: list[str]) -> None:
    (folder / "tasks.csv").write_text("episode,task\n" + "".join(f"{name},task of {name}\n" for name in names))


def videos(folder: Path) -> Written:
    names = ["b.mp4", "a.mp4", "c.mp4"]
    for name, length in zip(names, LENGTHS, strict=True):
        write_video(folder / name, numbered(length))
    with_table(folder, names)
    spoil = lambda: (folder / "a.mp4").write_bytes((folder / "a.mp4").read_bytes()[:300])  # noqa: E731
    return Written(folder, [(number, f"task of {name}", None) for number, name in enumerate(names)], spoil)


def pictures(folder: Path) -> Written:
    for number, clip in enumerate(CLIPS):
        (folder / f"{number}").mkdir()
        for t, frame in enumerate(clip):
            Image.fromarray(frame).save(folder / f"{number}" / f"frame_{t + 8}.png")  # 8, 9, 10, ...
    Image.fromarray(CLIPS[0][0]).save(folder / "rfm_summary.png")  # of earlier labels
    episodes: list[Any] = [(number, TASK, {"frames": clip}) for number, clip in enumerate(CLIPS)]
    return Written(folder, episodes, lambda: (folder / "1" / "frame_9.png").write_bytes(b"no picture"), task=TASK)


def pattern(folder: Path) -> Written:
    """Pictures of all cameras in one folder for each episode."""
    episodes: list[Any] = []
    for number, clip in enumerate(CLIPS):
        cameras = {"color_0": clip, "color_1": clip[:, ::-1]}
        (folder / f"episode_{number}" / "colors").mkdir(parents=True)
        for camera, frames in cameras.items():
            for t, frame in enumerate(frames):
                Image.fromarray(frame).save(folder / f"episode_{number}" / "colors" / f"{t + 8}_{camera}.png")
        episodes.append((number, TASK, cameras))
    spoil = lambda: (folder / "episode_1/colors/9_color_1.png").write_bytes(b"no picture")  # noqa: E731
    return Written(folder, episodes, spoil, task=TASK, more={"videos": "{episode}/colors/*_{camera}.png"})


READER = """
from functools import partial
import numpy as np
from rfm_labels import Episode

def episodes(folder):
    for file in sorted(folder.glob("*.npy")):
        yield Episode(file.stem, {"array": np.load(file, mmap_mode="r"), "function": partial(mirrored, folder / "later" / file.name)}, task=f"task {file.stem}")

def mirrored(file):
    for frame in np.load(file):
        yield frame[:, ::-1]
"""


def reader(folder: Path) -> Written:
    file = folder.parent / "my_reader.py"
    file.write_text(READER)
    (folder / "later").mkdir()
    for number, clip in enumerate(CLIPS):
        for place in (folder, folder / "later"):
            np.save(place / f"{number}.npy", clip)
    episodes: list[Any] = [(n, f"task {n}", {"array": c, "function": c[:, :, ::-1]}) for n, c in enumerate(CLIPS)]
    spoil = lambda: (folder / "later" / "1.npy").write_bytes(b"no arrays")  # noqa: E731
    return Written(folder, episodes, spoil, more={"reader": f"{file}:episodes"})


FORMATS: dict[str, Callable[[Path], Written]] = {
    "LeRobot v2.1": lerobot("toy_v21"),
    "LeRobot v3.0": lerobot("toy_v30_many"),
    "robomimic": robomimic,
    "IsaacLab-Arena": arena,
    "RLDS": rlds,
    "videos": videos,
    "pictures": pictures,
    "pattern": pattern,
    "reader": reader,
}
every_format = pytest.mark.parametrize("write", FORMATS.values(), ids=FORMATS)


def written(write: Callable[[Path], Written], folder: Path) -> tuple[Written, Dataset]:
    (folder / "data").mkdir()
    there = write(folder / "data")
    return there, there.open()


@every_format
def test_episodes_have_their_numbers_tasks_and_frames(tmp_path: Path, write: Callable[[Path], Written]) -> None:
    there, dataset = written(write, tmp_path)
    assert [(each.index, each.task) for each in dataset.episodes] == [(n, task) for n, task, _ in there.episodes]
    first = 0
    for episode, (_, _, expected) in zip(dataset.episodes, there.episodes, strict=True):
        assert episode.first_index == first
        first += episode.num_frames
        for camera in dataset.chosen_cameras() if expected is not None else ():
            dataset.check(episode, camera)
            np.testing.assert_array_equal(np.stack(list(dataset.frames(episode, camera))), expected[camera])
            assert episode.num_frames == len(expected[camera])
    if there.source.name == "data":  # the folders of videos
        read = [
            numbers(shown[camera].positions, n)
            for (_, shown), n in zip(iter_episodes(dataset), LENGTHS, strict=True)
            for camera in shown
            if camera == "video"
        ]
        assert read in ([], [list(range(length)) for length in LENGTHS])
    overridden = there.open(task="wave", override_task=True)
    assert {episode.task for episode in overridden.episodes} == {"wave"}


@pytest.mark.slow
@every_format
def test_each_frame_gets_its_label_and_a_second_run_scores_only_missing_episodes(
    tmp_path: Path, output: Path, write: Callable[[Path], Written]
) -> None:
    _, dataset = written(write, tmp_path)
    cameras = dataset.chosen_cameras()[:2]
    scorer, chosen = BrightnessScorer(), dataset.numbers[:2]
    options = LabelOptions(output=output, frames=2, cameras=cameras, episodes=chosen, workers=1)
    report = label(dataset, scorer, options)
    for number in chosen:
        labels = read_episode_labels(report.files[0], number)
        assert labels is not None
        expected = [brightness(np.stack(list(dataset.frames(dataset.episode(number), each)))) for each in cameras]
        np.testing.assert_allclose(labels.fused.progress, np.mean(expected, axis=0), atol=1e-6)
        assert labels.frames.tolist() == list(range(len(expected[0])))
    num_scored = sum(dataset.episode(number).num_frames for number in chosen) * len(cameras)
    assert scorer.num_samples == num_scored
    files = [file.read_bytes() for file in report.files]
    (output / ".rfm_parts" / f"{report.plan.items[0].key}.parquet").unlink()
    again = BrightnessScorer()
    report = label(dataset, again, options)
    assert again.num_samples == dataset.episode(chosen[0]).num_frames * len(cameras)
    assert [file.read_bytes() for file in report.files] == files


@every_format
def test_a_camera_is_turned_and_its_colours_swapped_on_request_and_the_recipe_says_so(
    tmp_path: Path, output: Path, write: Callable[[Path], Written]
) -> None:
    there, stored = written(write, tmp_path)
    camera, *others = stored.chosen_cameras()
    swapped = "rgb" if stored.corrections.get(camera) else "bgr"  # other than by default
    dataset = there.open(orient={camera: "rotate90"}, channels={camera: swapped})
    episode = stored.episodes[0]
    pixels = np.stack(list(stored.stored_frames(episode, camera)))
    expected = np.rot90(pixels, -1, axes=(1, 2))[..., :: -1 if swapped == "bgr" else 1]
    np.testing.assert_array_equal(np.stack(list(dataset.frames(episode, camera))), expected)
    for other in others:
        np.testing.assert_array_equal(list(dataset.frames(episode, other)), list(stored.frames(episode, other)))
    options = LabelOptions(output=output, frames=2, cameras=(camera,), episodes=[episode.index])
    label(stored, BrightnessScorer(), options)
    with pytest.raises(DatasetError, match=rf"orientations\.{camera}: \w.* there, rotate90 now"):
        label(dataset, BrightnessScorer(), options)
    with pytest.raises(DatasetError, match=rf"orient: expected one of the cameras .*{camera}.*, got 'top'"):
        there.open(orient={"top": "rotate90"})


@pytest.mark.parametrize(
    "write",
    [FORMATS[name] for name in ("LeRobot v2.1", "robomimic", "videos", "pictures", "pattern", "reader")],
)
def test_a_broken_episode_is_named_before_a_score_and_lets_the_others_through(
    tmp_path: Path, output: Path, write: Callable[[Path], Written]
) -> None:
    there, dataset = written(write, tmp_path)
    assert there.spoil is not None
    there.spoil()
    dataset, scorer = there.open(), BrightnessScorer()
    numbers_ = [number for number, _, _ in there.episodes]
    options: dict[str, Any] = {"output": output, "frames": 2, "cameras": dataset.chosen_cameras()[-1:]}
    with pytest.raises(RewardError, match=r"--episodes \d"):
        label(dataset, scorer, LabelOptions(**options))
    assert scorer.num_samples == 0
    rest = [number for number in numbers_ if number != numbers_[1]]
    report = label(dataset, scorer, LabelOptions(**options, episodes=rest))
    assert report.summary is not None
    assert report.summary.episodes.tolist() == rest
