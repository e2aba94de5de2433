# SPDX-License-Identifier: MIT
"""Readers: the forms of an episode, what is refused, the examples on recordings of their tools.

Minari 0.5.4 wrote tests/recordings/minari, and mcap 1.6.0 tests/recordings/video.mcap, by the script beside them. The
other recordings are made here as their tools document them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import check_reader
import hdf5_writers
from client_commands import invoke
from hdf5_writers import RGB_MARK, TASK, decoded, jpeg, video
from labelling import BrightnessScorer, brightness, command
from paths import ROOT
from pictures import numbered, numbers, write_video
from rfm_client.command_line import ExitCode
from rfm_labels import (
    DatasetError,
    Episode,
    LabelOptions,
    label,
    open_dataset,
    read_episode_labels,
    read_outcomes,
)
from rfm_labels.datasets import episodes as forms

READERS = ROOT / "examples" / "readers"
RECORDINGS = ROOT / "tests" / "recordings"
MOST_LINES = 40
CLIPS = [video(length, seed) for seed, length in enumerate((4, 6))]

Expected = list[tuple[str, str | None, bool | None, Mapping[str, Any]]]  # name, task, success, frames by camera


def calvin(folder: Path) -> Expected:
    """A file for each step; two stretches with sentences, of which the last step is a part."""
    stretches = [(3, 6), (5, 10)]
    steps = video(12)
    for step, frame in enumerate(steps):
        np.savez_compressed(
            folder / f"episode_{step:07d}.npz", rgb_static=frame, rgb_gripper=frame[:32, :32], actions=[0]
        )
    sentences = {"ann": ["open the drawer", "push the button"], "task": ["open_drawer", "push_button"], "emb": []}
    (folder / "lang_annotations").mkdir()
    np.save(folder / "lang_annotations" / "auto_lang_ann.npy", {"language": sentences, "info": {"indx": stretches}})  # type: ignore[arg-type]
    return [
        (f"0000{n}_{start}_{end}", sentences["ann"][n], None, {"rgb_static": steps[start : end + 1]})
        for n, (start, end) in enumerate(stretches)
    ]


def unitree(folder: Path) -> Expected:
    """xr_teleoperate: the pictures of all cameras in one folder, and ``data.json``."""
    expected: Expected = []
    for number, clip in enumerate(CLIPS):
        name, rows = f"episode_{number:04d}", []
        (folder / name / "colors").mkdir(parents=True)
        cameras = {"color_0": clip, "color_1": clip[:, ::-1]}
        for t in range(len(clip)):
            names = {camera: f"colors/{t:06d}_{camera}.png" for camera in cameras}
            for camera, file in names.items():
                Image.fromarray(cameras[camera][t]).save(folder / name / file)
            rows.append({"idx": t, "colors": names, "depths": {}})
        recording = {"info": {"image": {"fps": 30}}, "text": {"goal": TASK, "desc": "", "steps": ""}, "data": rows}
        (folder / name / "data.json").write_text(json.dumps(recording))
        expected.append((name, TASK, None, cameras))
    return expected


def minari(folder: Path) -> Expected:
    """As Minari's own reader decodes it."""
    folder.rmdir()
    folder.symlink_to(RECORDINGS / "minari")
    stored = np.load(RECORDINGS / "minari.npz")
    return [(f"episode_{n}", None, bool(n), {"pixels": stored[f"pixels_{n}"]}) for n in range(2)]


def droid(folder: Path) -> Expected:
    """MP4 files named by the cameras' serial numbers, and ``metadata_*.json``; SVO and stereo files beside them."""
    expected: Expected = []
    for outcome, date in (("failure", "Fri_Jul__7_09:50:13_2023"), ("success", "Fri_Jul__7_09:45:02_2023")):
        place = folder / "AUTOLab" / outcome / "2023-07-07" / date
        (place / "recordings" / "MP4").mkdir(parents=True)
        serials = {"wrist": "18026681", "ext1": "22008760", "ext2": "24400334"}
        for serial in serials.values():
            write_video(place / "recordings" / "MP4" / f"{serial}.mp4", numbered(4))
        (place / "recordings" / "MP4" / f"{serial}-stereo.mp4").write_bytes(b"both eyes")
        paths = {f"{name}_mp4_path": f"{outcome}/{date}/recordings/MP4/{each}.mp4" for name, each in serials.items()}
        about = {"current_task": TASK, "success": outcome == "success", "trajectory_length": 4, **paths}
        (place / "metadata_AUTOLab+0d4edc83+2023-07-07-09h-45m-02s.json").write_text(json.dumps(about))
        expected.append((str(place.relative_to(folder)), TASK, outcome == "success", dict.fromkeys(serials, 4)))
    return expected


def robotwin(folder: Path) -> Expected:
    marked = [jpeg(frame, RGB_MARK) for frame in CLIPS[0]]
    before = [jpeg(frame) for frame in CLIPS[0]]
    hdf5_writers.write_robotwin(folder, {"head_camera": marked, "left_camera": before})
    pixels = np.stack([decoded(each) for each in before])
    return [("episode0", TASK, None, {"head_camera": pixels, "left_camera": pixels[..., ::-1]})]


def robomind(folder: Path) -> Expected:
    files = [jpeg(frame) for frame in CLIPS[0]]
    raw = np.random.default_rng(5).integers(0, 256, (480, 640, 3), np.uint8)
    place = folder / "success_episodes" / "train" / "1014_144602" / "data" / "trajectory.hdf5"
    hdf5_writers.write_robomind(place, {"top": files, "left": [raw.tobytes()] * 4})
    pixels = np.stack([decoded(each) for each in files])
    name = str(place.parent.relative_to(folder))
    return [(name, TASK, None, {"top": pixels, "left": np.stack([raw[..., ::-1]] * 4)})]


def aloha(folder: Path) -> Expected:
    files = {camera: [jpeg(frame) for frame in CLIPS[n]] for n, camera in enumerate(("high", "left"))}
    files["left"] = files["left"][:4]
    hdf5_writers.write_aloha(folder / "episode_10.hdf5", files, task=TASK)
    hdf5_writers.write_aloha(folder / "episode_2.hdf5", {"high": CLIPS[0], "left": CLIPS[1][:4]}, task=TASK)
    pixels = {camera: np.stack([decoded(each) for each in stored]) for camera, stored in files.items()}
    return [
        ("episode_2", TASK, None, {"high": CLIPS[0], "left": CLIPS[1][:4]}),
        ("episode_10", TASK, None, pixels),
    ]


def maniskill(folder: Path) -> Expected:
    frames = {2: {"base_camera": CLIPS[0]}, 10: {"base_camera": CLIPS[1]}}
    hdf5_writers.write_maniskill(folder / "trajectory.rgb.h5", frames)
    return [(f"trajectory.rgb/traj_{number}", None, False, cameras) for number, cameras in frames.items()]


def mcap_video(folder: Path) -> Expected:
    (folder / "video.mcap").symlink_to(RECORDINGS / "video.mcap")
    return [("video", None, None, {"/camera/front": 6, "/camera/wrist": 6})]


EXAMPLES: dict[str, Callable[[Path], Expected]] = {
    "calvin": calvin,
    "unitree": unitree,
    "minari_pictures": minari,
    "mcap_video": mcap_video,
    "droid_raw": droid,
    "aloha": aloha,
    "maniskill": maniskill,
    "robotwin": robotwin,
    "robomind": robomind,
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_reads_a_recording_in_its_tool_s_form(tmp_path: Path, name: str) -> None:
    folder, reader = tmp_path / "recordings", f"{READERS / name}.py:episodes"
    folder.mkdir()
    expected = EXAMPLES[name](folder)
    assert len((READERS / f"{name}.py").read_text().splitlines()) < MOST_LINES
    task = None if expected[0][1] else TASK
    dataset = open_dataset(folder, reader=reader, task=task)
    assert [(each.name, each.task) for each in dataset.episodes] == [
        (name, own or TASK) for name, own, _, _ in expected
    ]
    for episode, (_, _, _, cameras) in zip(dataset.episodes, expected, strict=True):
        for camera, frames in cameras.items():
            shown = np.stack(list(dataset.frames(episode, camera)))
            if isinstance(frames, int):
                assert numbers(shown, frames) == list(range(frames))
            else:
                np.testing.assert_array_equal(shown, frames)
    assert read_outcomes(reader, folder) == {number: success for number, (_, _, success, _) in enumerate(expected)}
    assert len(check_reader.check(reader, folder)) == len(expected)


def test_every_example_has_a_recording() -> None:
    assert {file.stem for file in READERS.glob("*.py")} == EXAMPLES.keys()


# A reader of one's own

SOURCE = """
from functools import partial
import numpy as np
from rfm_labels import Episode

def episodes(folder):
    for number, file in enumerate(sorted(folder.glob("*.npy"))):
        yield Episode(file.stem, {"front": partial(read, file)}, task="stack", success=number == 0)

def read(file):
    yield from np.load(file)

def broken(folder):
    yield Episode("a", {"front": np.load(folder / "a.npy")}, task="stack")
    yield Episode(missing, {})

def returns_nothing(folder):
    [Episode("a", {"front": "a.mp4"})]

def yields_paths(folder):
    yield from folder.glob("*.npy")

def last_of_a_loop(folder):
    for file in sorted(folder.glob("*.npy")):
        yield Episode(file.stem, {"front": lambda: np.load(file)}, task="stack")

def changes_a_variable(folder):
    for file in sorted(folder.glob("*.npy")):
        yield Episode(file.stem, {camera: (lambda: np.load(file) if camera else None) for camera in ["front"]}, task="stack")

def changes_for_a_partial(folder):
    def load(camera):
        return np.load(file)
    for file in sorted(folder.glob("*.npy")):
        yield Episode(file.stem, {"front": partial(load, "front")}, task="stack")

def one_buffer(folder):
    for file in sorted(folder.glob("*.npy")):
        yield Episode(file.stem, {"front": partial(into_one_array, file)}, task="stack")

def into_one_array(file):
    clip = np.load(file)
    buffer = np.empty_like(clip[0])
    for frame in clip:
        buffer[:] = frame
        yield buffer

def same_name(folder):
    for file in folder.glob("*.npy"):
        yield Episode("a", {"front": np.load(file)})

def nothing(folder):
    yield from ()

def one_camera_each(folder):
    for file in sorted(folder.glob("*.npy")):
        yield Episode(file.stem, {file.stem: np.load(file)}, task="stack")

def two_lengths(folder):
    yield Episode("a", {"front": np.load(folder / "a.npy"), "wrist": np.load(folder / "a.npy")[1:]}, task="stack")

def grey(folder):
    yield Episode("a", {"front": lambda: np.load(folder / "a.npy")[..., 0]}, task="stack")

def fails_later(folder):
    def read():
        yield np.load(folder / "a.npy")[0]
        raise KeyError("frame 1")
    yield Episode("a", {"front": read}, task="stack")
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "recordings"
    root.mkdir()
    (tmp_path / "my_reader.py").write_text(SOURCE)
    for name, clip in zip("ab", CLIPS, strict=True):
        np.save(root / f"{name}.npy", clip)
    return root


def named(folder: Path, function: str) -> str:
    return f"{folder.parent / 'my_reader.py'}:{function}"


def test_label_and_evaluate_take_a_reader_by_its_name(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reader = named(folder, "episodes")
    assert command(folder, LabelOptions(), BrightnessScorer(), reader=reader) == ExitCode.OK
    labels = read_episode_labels(folder / "rfm_progress.parquet", 1)
    assert labels is not None
    np.testing.assert_allclose(labels.fused.progress, brightness(CLIPS[1]), atol=1e-6)
    again = BrightnessScorer()
    assert command(folder, LabelOptions(), again, reader=reader) == ExitCode.OK
    assert again.num_samples == 0
    assert "2: 0 (a), 1 (b)" in capsys.readouterr().out
    done = invoke("evaluate", folder, "--outcome", reader)
    assert done.exit_code == 0, done.output
    assert "2 episodes: 1 success, 1 failure" in done.stdout
    np.save(folder / "0.npy", CLIPS[0])  # now the first episode
    done = invoke("evaluate", folder, "--outcome", reader)
    assert "outcome: episode 0: expected a, got 0: label again, and yield new recordings last" in done.stderr


def test_a_reader_may_fill_the_same_array_again(folder: Path) -> None:
    dataset = open_dataset(folder, reader=named(folder, "one_buffer"))
    np.testing.assert_array_equal(list(dataset.frames(dataset.episode(1), "front")), CLIPS[1])


REFUSED: dict[str, str] = {
    "gone": "my_reader.py: expected a function gone, got episodes, read, broken,",
    "broken": r"reader: my_reader.py:broken: expected a reader that runs, got NameError: name 'missing' is not defined \(my_reader.py, line 15\)",
    "returns_nothing": r"got TypeError: 'NoneType' object is not iterable",
    "yields_paths": r"expected rfm_labels.Episode\(name, frames\) of each recording, got PosixPath",
    "last_of_a_loop": r"b: front: expected a function of its own, got that of a: front: give a function for each, with what",
    "changes_a_variable": r"a: front: expected a function whose variables keep their values, got one that changed later: give",
    "changes_for_a_partial": r"a: front: expected a function whose variables keep their values, got one that changed later: give",
    "same_name": "name: expected each once, got 'a' again",
    "nothing": "my_reader.py:nothing: expected at least one episode, got none",
    "one_camera_each": r"b: expected a camera as uint8 \[T, H, W, 3\], got a: missing in b\nto continue .*: --episodes 0$",
    "two_lengths": "a: wrist: expected 4 frames, as the other cameras, got 3: cut them alike, or leave",
    "grey": r"a: front: frame 0: expected uint8 \[H, W, 3\], got ",
    "fails_later": r"a: front: expected a reader that runs, got KeyError: 'frame 1' \(my_reader.py, line ",
}


@pytest.mark.parametrize(("function", "message"), REFUSED.items(), ids=REFUSED)
def test_a_reader_s_mistake_is_refused_with_its_place(folder: Path, function: str, message: str) -> None:
    scorer = BrightnessScorer()
    with pytest.raises(DatasetError, match=message):
        label(open_dataset(folder, reader=named(folder, function)), scorer)
    assert scorer.num_samples == 0


READER_OPTIONS: dict[str, tuple[dict[str, Any], str]] = {
    "no function": (
        {"reader": "my_reader.py"},
        "reader: expected FILE.py:FUNCTION, such as my_reader.py:episodes, got ",
    ),
    "no file": ({"reader": "gone.py:episodes"}, "reader: gone.py: expected a Python file, got none"),
    "a pattern, too": ({"reader": "a.py:b", "videos": "{episode}.mp4"}, "videos: expected none with a reader"),
    "a column of tasks": ({"reader": "a.py:b", "task_column": "x"}, "task_column: expected none"),
}


@pytest.mark.parametrize(("options", "message"), READER_OPTIONS.values(), ids=READER_OPTIONS)
def test_wrong_options_of_a_reader_are_refused(tmp_path: Path, options: Any, message: str) -> None:
    with pytest.raises(DatasetError, match=f"^{message}"):
        open_dataset(tmp_path, **options)


def generator() -> Iterator[Any]:
    yield CLIPS[0][0]


EPISODES: dict[str, tuple[dict[str, Any], str]] = {
    "no name": ({"name": " "}, "Episode: name: expected a text, got ' '"),
    "no camera": ({"frames": {}}, "Episode 'a': frames: expected a dict by camera, "),
    "a path alone": ({"frames": "a.mp4"}, "frames: expected a dict by camera, such as .*, got str"),
    "floats": (
        {"frames": {"front": CLIPS[0] / 255}},
        r"frames\['front'\]: expected uint8 \[T, H, W, 3\], got float64 .* 0..255",
    ),
    "channels first": ({"frames": {"front": CLIPS[0].transpose(0, 3, 1, 2)}}, "channels first: "),
    "no frames": ({"frames": {"front": CLIPS[0][:0]}}, "got no frames"),
    "a list of arrays": ({"frames": {"front": list(CLIPS[0])}}, "got list: np.stack a list of arrays"),
    "a generator": (
        {"frames": {"front": generator()}},
        "got generator: np.stack .* give a function itself, not what",
    ),
    "a task of another type": ({"task": 3}, "task: expected a sentence, got 3"),
    "no rate": ({"fps": 0}, "fps: expected frames per second, above 0, got 0"),
    "an outcome in words": ({"success": "yes"}, r"success: expected True, False or None .*, got 'yes'"),
}


@pytest.mark.parametrize(("given", "message"), EPISODES.values(), ids=EPISODES)
def test_an_episode_of_another_form_is_refused_with_its_name(given: Any, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        Episode(**{"name": "a", "frames": {"front": "a.mp4"}, **given})


def test_arrays_that_would_fill_the_memory_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forms, "MAX_ARRAY_BYTES", CLIPS[0].nbytes)
    given = [Episode(name, {"front": clip}, task=TASK) for name, clip in zip("ab", CLIPS, strict=True)]
    assert len(open_dataset(folder, reader=lambda _: given[:1]).episodes) == 1
    with pytest.raises(
        DatasetError, match=r"b: front: expected arrays of at most .* GiB in all episodes, got more: give a function"
    ):
        open_dataset(folder, reader=lambda _: given)


UNSTEADY: dict[str, tuple[Callable[[Any], Any], str]] = {
    "other frames": (lambda seed: [Episode("a", {"front": partial(next, seed)})], "a: front: expected the same frames each time"),
    "another name": (lambda seed: [Episode(f"{next(seed).sum()}", {"front": CLIPS[0]})], "expected the same episodes each time"),
    "more episodes": (
        lambda seed: [Episode(f"{k}", {"front": CLIPS[0]}) for k in range(1 + next(seed).max() % 7)],
        "expected the same episodes each time",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("make", "message"), UNSTEADY.values(), ids=UNSTEADY)
def test_a_reader_that_differs_from_call_to_call_is_found_by_its_check(
    folder: Path, make: Callable[[Any], Any], message: str
) -> None:
    seeds = iter([np.full((4, 8, 8, 3), value, np.uint8) for value in (0, 1, 2, 3, 4, 5)])
    with pytest.raises(DatasetError, match=message):
        check_reader.check(lambda _: make(seeds), folder)  # type: ignore[arg-type]
