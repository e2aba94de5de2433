# SPDX-License-Identifier: MIT
"""Labels in HDF5 files are read as those in Parquet files are, and other programs may write into the file meanwhile."""

from __future__ import annotations

import fcntl
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from client_commands import invoke
from labelling import BrightnessScorer, Notes
from rfm_client import ProgressResult
from rfm_labels import (
    DatasetError,
    LabelOptions,
    evaluate_labels,
    find_label_files,
    label,
    open_dataset,
    read_episode_labels,
    summarise,
)
from rfm_labels import in_place as writing

LENGTHS = (5, 7, 3)
TASK = "open the drawer"
IN_PLACE = LabelOptions(in_place=True)


@pytest.fixture
def demos(tmp_path: Path) -> Path:
    return demonstrations(tmp_path / "demos.hdf5")


def demonstrations(file: Path) -> Path:
    file.parent.mkdir(exist_ok=True)
    with h5py.File(file, "w") as opened:
        opened.create_group("data").attrs["env_args"] = f'{{"env_name": "Lift", "lang": "{TASK}"}}'
        for index, length in enumerate(LENGTHS):
            for seed, camera in enumerate(("front", "wrist")):
                frames = np.random.default_rng([index, seed]).integers(0, 256, (length, 16, 16, 3), np.uint8)
                opened[f"data/demo_{index}/obs/{camera}"] = frames
    return file


def names_in(file: Path) -> set[str]:
    with h5py.File(file) as opened:
        return {name.partition("_")[0] for demo in opened["data"].values() for name in demo} - {"obs"}


def write_filter_key(file: Path) -> None:
    with h5py.File(file, "r+") as opened:
        opened["mask/train"] = np.array(["demo_0"], "S8")


def filter_keys(file: Path) -> list[str]:
    with h5py.File(file) as opened:
        return list(opened.get("mask", ()))


@pytest.fixture
def while_copied(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Path], object]], None]:
    """Does something to the dataset's file whenever it has just been copied."""

    def arrange(happens: Callable[[Path], object]) -> None:
        copy = shutil.copy2

        def copied(source: Path, target: Path) -> Any:
            done = copy(source, target)
            happens(Path(source))
            return done

        monkeypatch.setattr(shutil, "copy2", copied)

    return arrange


def test_two_runs_at_once_keep_the_labels_of_both(demos: Path, while_copied: Any) -> None:
    both = threading.Barrier(2)

    def meet(_: Path) -> None:
        with suppress(threading.BrokenBarrierError):  # runs that wait for each other never meet
            both.wait(0.5)

    while_copied(meet)
    notes, failures = Notes(), []

    def run(name: str) -> None:
        try:
            label(open_dataset(demos), BrightnessScorer(), replace(IN_PLACE, name=name), notes)
        except (DatasetError, OSError) as error:
            failures.append(error)

    runs = [threading.Thread(target=run, args=(name,)) for name in ("one", "two")]
    for each in runs:
        each.start()
    for each in runs:
        each.join()
    assert not failures
    assert names_in(demos) == {"one", "two"}
    assert f"{demos}: waiting for another run that writes labels into it" in notes.lines
    assert sorted(file.name for file in demos.parent.iterdir()) == [".one_parts", ".two_parts", "demos.hdf5"]


def test_what_another_program_writes_during_the_copy_is_kept(demos: Path, while_copied: Any) -> None:
    while_copied(lambda file: None if filter_keys(file) else write_filter_key(file))
    notes = Notes()
    label(open_dataset(demos), BrightnessScorer(), IN_PLACE, notes)
    assert (filter_keys(demos), names_in(demos)) == (["train"], {"rfm"})
    assert f"{demos} has changed in the meantime: copying it again" in notes.lines


def test_a_file_that_never_stays_the_same_is_left_alone(demos: Path, while_copied: Any) -> None:
    while_copied(lambda file: file.write_bytes(file.read_bytes()))
    with pytest.raises(
        OSError, match=r"demos\.hdf5: expected a file that other programs leave alone, got changes at each"
    ):
        label(open_dataset(demos), BrightnessScorer(), IN_PLACE)
    assert names_in(demos) == set()
    assert not list(demos.parent.glob(".tmp-*"))


def test_a_file_that_another_program_has_open_for_writing_is_left_alone(
    demos: Path, while_copied: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "PATIENCE_S", 0.0)
    held: list[Any] = []
    while_copied(lambda file: held.append(h5py.File(file, "r+")))
    expected = "expected a file that no other program has open for writing, got an open one: close it there"
    with pytest.raises(OSError, match=expected):
        label(open_dataset(demos), BrightnessScorer(), IN_PLACE)
    held[0]["mask/train"] = np.array(["demo_0"], "S8")
    held[0].close()
    monkeypatch.undo()
    scorer = BrightnessScorer()
    label(open_dataset(demos), scorer, IN_PLACE)
    assert (filter_keys(demos), names_in(demos), scorer.num_samples) == (["train"], {"rfm"}, 0)


def test_a_dataset_that_another_program_has_open_for_writing_is_refused(demos: Path) -> None:
    with demos.open("rb") as opened:
        fcntl.flock(opened, fcntl.LOCK_EX)  # as HDF5 does; it shares an open file within a process
        told = invoke("label", demos, "--report", "--in-place")
    assert told.exit_code != 0
    assert (
        "demos.hdf5: expected a file that no other program has open for writing, got an open one: close" in told.stderr
    )


def remove(file: Path) -> None:
    with h5py.File(file) as opened:
        is_there = "demo_1" in opened["data"]
    if is_there:
        with h5py.File(file, "r+") as opened:
            del opened["data/demo_1"]


def test_a_demonstration_that_another_program_removes_gets_no_labels(demos: Path, while_copied: Any) -> None:
    while_copied(remove)
    with pytest.raises(
        DatasetError, match=r"demo_1: expected 7 frames, got another, changed while it was labelled: run"
    ):
        label(open_dataset(demos), BrightnessScorer(), IN_PLACE)
    assert names_in(demos) == set()


@pytest.mark.parametrize("in_place", [False, True], ids=["beside", "in place"])
def test_labels_are_read_as_those_in_parquet_files(demos: Path, in_place: bool) -> None:
    dataset, parquet = open_dataset(demos), demos.with_name("parquet")
    for name in ("rfm", "other"):
        options = LabelOptions(name=name, cameras=("front", "wrist"), fuse="min" if name == "other" else "mean")
        label(dataset, BrightnessScorer(), replace(options, in_place=in_place))
        label(dataset, BrightnessScorer(), replace(options, formats=("progress",), output=parquet))
    files = find_label_files(demos)
    stored = demos if in_place else demos.with_name("demos.{}_rewards.hdf5")
    assert [str(file) for file in files] == [f"{stored}/{name}".replace("{}", name) for name in ("rfm", "other")]
    assert find_label_files(demos.parent) == files

    expected = find_label_files(parquet)
    for one, another in zip(files, expected, strict=True):
        mine, theirs = summarise(one), summarise(another)
        for name, values in vars(theirs).items():
            np.testing.assert_array_equal(getattr(mine, name), values)
        for number in range(3):
            curves, others = read_episode_labels(one, number), read_episode_labels(another, number)
            assert curves is not None
            assert others is not None
            np.testing.assert_array_equal(curves.fused.progress, others.fused.progress)
            np.testing.assert_array_equal(curves.cameras["wrist"].success, others.cameras["wrist"].success)
    outcomes = {0: True, 1: False, 2: True}
    found, known = evaluate_labels(files, outcomes), evaluate_labels(expected, outcomes)
    assert [vars(each) for each in found.agreements] == [vars(each) for each in known.agreements]
    for mine_, theirs_ in zip(found.evaluations, known.evaluations, strict=True):
        assert (mine_.name, mine_.final, mine_.spearman) == (theirs_.name, theirs_.final, theirs_.spearman)
        assert mine_.frames_per_s is not None


@pytest.mark.parametrize("in_place", [False, True], ids=["beside", "in place"])
def test_the_commands_show_labels_in_hdf5(demos: Path, in_place: bool) -> None:
    for name in ("rfm", "other"):
        label(open_dataset(demos), BrightnessScorer(), LabelOptions(name=name, in_place=in_place))
    words = ["--in-place"] if in_place else []
    told = invoke("label", demos, "--report", "--name", "other", *words)
    assert told.exit_code == 0, told.stderr
    assert "frames" in told.stdout
    assert f"{demos.with_name('demos.other_summary.png')}" in told.stdout.replace("\n", "")
    told = invoke("label", demos.parent, "--report", "--no-picture", *words)
    assert told.exit_code == 0, told.stderr
    told = invoke("evaluate", demos)
    assert told.exit_code == 0, told.stderr
    assert all(name in told.stdout for name in ("rfm", "other", "3 episodes"))
    told = invoke("label", demos, "--report", "--name", "gone", *words)
    assert "expected labels with the name gone, in demos.gone_rewards.hdf5 or in place, got " in told.stderr


def test_labels_of_two_datasets_are_not_compared(demos: Path) -> None:
    for file in (demos, demonstrations(demos.with_name("more.hdf5"))):
        label(open_dataset(file), BrightnessScorer())
    with pytest.raises(DatasetError, match=r"expected labels of one dataset, got demos, more: name one of the files"):
        find_label_files(demos.parent)
    assert len(find_label_files(demos)) == 1


class Likelihoods(BrightnessScorer):
    """A checkpoint that predicts log-probabilities, but no success."""

    def evaluate(self, samples: Any) -> list[ProgressResult]:
        results = super().evaluate(samples)
        none = [np.full_like(result.progress, np.nan) for result in results]
        return [
            ProgressResult(progress=result.progress, success=nan, log_prob=-result.progress)
            for result, nan in zip(results, none, strict=True)
        ]


FORMATS: dict[str, LabelOptions] = {
    "in place": IN_PLACE,
    "beside": LabelOptions(formats=("hdf5",)),
    "progress": LabelOptions(formats=("progress",)),
    "signals": LabelOptions(formats=("signals",)),
}


@pytest.mark.parametrize("options", FORMATS.values(), ids=FORMATS)
def test_log_probabilities_are_kept_without_the_parts(demos: Path, options: LabelOptions) -> None:
    label(open_dataset(demos), Likelihoods(), replace(options, episodes=[0, 1]))
    shutil.rmtree(demos.with_name(".rfm_parts"))
    scorer = Likelihoods()
    label(open_dataset(demos), scorer, options)
    assert scorer.num_samples == 2 * LENGTHS[2]
