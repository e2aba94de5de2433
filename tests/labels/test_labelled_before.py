# SPDX-License-Identifier: MIT
"""Existing label files: a run replaces them if it gives all their labels again by the same recipe, else on request."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pyarrow import parquet

from hdf5_writers import video, write_robomimic
from in_process import rfm_client
from labelling import FRONT, LEROBOT, WRIST, BrightnessScorer, Notes, command
from rfm_labels import DatasetError, LabelOptions, label, open_dataset

TOY = LEROBOT / "toy_v30_many"
PROGRESS = "rfm_progress.parquet"
NO_LABELS = "label it first, or name their --output"
EPISODE_FRAMES = [episode.num_frames for episode in open_dataset(TOY).episodes]


def labelled(root: Path, output: Path, **options: Any) -> tuple[int, list[str]]:
    """Return the number of scored frames, and the messages of a run."""
    scorer, notes = BrightnessScorer(), Notes()
    label(
        open_dataset(root),
        scorer,
        LabelOptions(**{"output": output, "cameras": (FRONT,), "frames": 2, **options}),
        notes,
    )
    return scorer.num_samples, notes.lines


def labels(output: Path) -> dict[str, bytes]:
    files = [file for file in sorted(output.rglob("*.parquet")) if ".rfm_parts" not in file.parts]
    return {str(file.relative_to(output)): file.read_bytes() for file in files}


def test_more_episodes_are_scored_alone_and_fewer_never_replace_more(output: Path) -> None:
    assert labelled(TOY, output, episodes=[0, 1])[0] == sum(EPISODE_FRAMES[:2])
    scored, notes = labelled(TOY, output, episodes=[0, 1, 4])
    assert scored == EPISODE_FRAMES[4]
    assert notes[-1].startswith("3 of the dataset's 10 episodes have labels; LeRobot's reader")
    before = labels(output)
    with pytest.raises(DatasetError) as refused:
        labelled(TOY, output, episodes=[2, 4])
    remedy = "choose another --name, or --overwrite"
    expected = "expected labels of the chosen episodes alone, got those of 0:2, too"
    assert str(refused.value) == f"{output / PROGRESS}: {expected}: {remedy}"
    assert labels(output) == before


def test_labels_of_a_server_that_names_no_computation_have_no_such_field(output: Path) -> None:
    options = LabelOptions(output=output, cameras=(FRONT,), frames=2, formats=("progress",), episodes=[0])
    label(open_dataset(TOY), BrightnessScorer(computation=None), options)
    metadata = parquet.read_schema(output / PROGRESS).metadata
    assert set(json.loads(metadata[b"rfm.provenance"])["checkpoint"]) == {
        *("source", "revision", "weights_digest", "settings_digest")
    }


OTHERS: dict[str, tuple[BrightnessScorer, dict[str, Any], str]] = {
    "rule": (BrightnessScorer(), {"sampling": "linspace_round"}, "sampling.rule: {rule} there, linspace_round now"),
    "cameras": (
        BrightnessScorer(),
        {"cameras": (WRIST,)},
        f"cameras: {FRONT} there, {WRIST} now; decoders.{WRIST}: none there, {{decoder}} now; "
        f"decoders.{FRONT}: {{decoder}} there, none now",
    ),
    "decoder": (BrightnessScorer(), {}, f"decoders.{FRONT}: {{decoder}} there, PyAV 1.0 now"),  # they differ in colours
    "weights": (BrightnessScorer(digest="new"), {}, "checkpoint.weights_digest: brightness there, new now"),
    "PyTorch": (
        BrightnessScorer(computation="float32, torch 2.14.0, sdpa"),
        {},
        "checkpoint.computation: float32, torch 2.13.0, sdpa there, float32, torch 2.14.0, sdpa now",
    ),
}


@pytest.mark.parametrize(("scorer", "options", "differs"), OTHERS.values(), ids=OTHERS)
def test_labels_of_another_recipe_are_refused_with_the_setting_that_differs(
    output: Path, scorer: BrightnessScorer, options: dict[str, Any], differs: str
) -> None:
    first = LabelOptions(output=output, cameras=(FRONT,), frames=2, formats=("progress",), episodes=[0])
    label(open_dataset(TOY), BrightnessScorer(), first)
    before = labels(output)
    told = json.loads(parquet.read_schema(output / PROGRESS).metadata[b"rfm.provenance"])
    expected = differs.format(rule=told["sampling"]["rule"], decoder=told["decoders"][FRONT])

    changed: dict[str, Any] = {**vars(first), "episodes": [3], **options}
    dataset = open_dataset(TOY)
    if "PyAV 1.0" in expected:
        dataset.decoder = lambda camera: "PyAV 1.0"  # type: ignore[method-assign]
    got = f"{output / PROGRESS}: expected no labels, or those of the same recipe, got {expected}"
    for dry_run in (False, True):
        with pytest.raises(DatasetError) as caught:
            if dry_run and "PyAV 1.0" not in expected:
                command(TOY, LabelOptions(**changed), scorer, dry_run=True)
            else:
                label(dataset, scorer, LabelOptions(**changed))
        assert str(caught.value) == f"{got}: choose another --name, or --overwrite"
    assert (labels(output), scorer.num_samples) == (before, 0)

    notes = Notes()
    label(dataset, scorer, LabelOptions(**{**changed, "overwrite": True}), notes)
    assert f"--overwrite: {got}; its labels of 1 episode are replaced" in notes.lines
    assert parquet.read_table(output / PROGRESS)["episode_index"].unique().to_pylist() == [3]


def test_labels_of_another_dataset_or_of_lost_episodes_are_replaced_only_on_request(tmp_path: Path) -> None:
    demos = [{"front": video(4, seed)} for seed in range(3)]
    file, options = tmp_path / "demos.hdf5", {"output": tmp_path, "cameras": ("front",)}
    assert labelled(write_robomimic(file, demos), **options)[0] == 12
    write_robomimic(file, [demos[0], {"front": video(4, 9)}, demos[2]])
    with pytest.raises(DatasetError, match=r"labels of the episodes as they are now, got others for 1, whose frames"):
        labelled(file, **options)
    assert labelled(file, **options, overwrite=True)[0] == 4
    write_robomimic(file, demos[:1])
    with pytest.raises(DatasetError, match=r"labels of the chosen episodes alone, got those of 1:3, too"):
        labelled(file, **options)
    assert labelled(file, **options, overwrite=True)[0] == 0


def test_labels_of_a_video_hold_until_its_time_changes(tmp_path: Path, output: Path) -> None:
    root = shutil.copytree(TOY, tmp_path / TOY.name)
    video = root / "videos" / FRONT / "chunk-000" / "file-001.mp4"  # of episodes 4 to 7
    asked: dict[str, Any] = {"episodes": [3, 4], "overwrite": True}
    assert labelled(root, output, **asked)[0] == sum(EPISODE_FRAMES[3:5])
    os.utime(video, (1, 1))
    assert labelled(root, output, **asked)[0] == EPISODE_FRAMES[4]
    video.write_bytes(video.read_bytes() + bytes(8))
    assert labelled(root, output, **asked)[0] == EPISODE_FRAMES[4]


def test_an_alias_that_a_later_run_leaves_behind_is_named_with_the_option_that_replaces_it(output: Path) -> None:
    labelled(TOY, output, episodes=[0], alias="sarm_progress")
    assert not any("sarm" in note for note in labelled(TOY, output, episodes=[0])[1])
    _, notes = labelled(TOY, output, episodes=[0, 1])
    added = "add --alias sarm_progress --overwrite to replace them there, too"
    assert f"sarm_progress.parquet keeps the labels that this run replaces: {added}" in notes
    _, notes = labelled(TOY, output, episodes=[0, 1], alias="sarm_progress", overwrite=True)
    assert not any("keeps" in note for note in notes)
    assert labels(output)["sarm_progress.parquet"] == labels(output)[PROGRESS]


BY_OTHERS: dict[str, Callable[[Path], object]] = {
    "no Parquet file": lambda file: file.write_bytes(b"not ours"),
    "of LeRobot": lambda file: parquet.write_table(parquet.read_table(file).replace_schema_metadata({}), file),
}


@pytest.mark.parametrize("make", BY_OTHERS.values(), ids=BY_OTHERS)
def test_labels_of_another_program_stay_unless_overwriting_is_requested(
    output: Path, make: Callable[[Path], object]
) -> None:
    labelled(TOY, output, limit=1, alias="sarm_progress")
    make(output / "sarm_progress.parquet")
    before = labels(output)
    with pytest.raises(DatasetError) as caught:
        labelled(TOY, output, limit=2, alias="sarm_progress")
    assert str(caught.value).endswith("got labels of another program: choose another --alias, or --overwrite")
    assert labels(output) == before
    labelled(TOY, output, limit=2, alias="sarm_progress", overwrite=True)
    assert labels(output)["sarm_progress.parquet"] == labels(output)[PROGRESS]


def test_labels_are_listed_and_deleted_by_name_and_finished_episodes_stay(output: Path) -> None:
    for name in ("rfm", "other"):
        labelled(TOY, output, name=name, episodes=[0])
    before = labels(output)
    remove = ("label", TOY, "--output", output, "--remove", "rfm")
    with (output / f".{PROGRESS}.{os.getuid()}.tmp").open("ab") as writing:  # as a run that writes the file
        fcntl.flock(writing, fcntl.LOCK_EX)
        refused = rfm_client(*remove)
        assert "expected no run that writes it, got one" in refused.stderr
    assert labels(output) == before
    done = rfm_client(*remove)
    assert done.stdout.splitlines() == [
        f"deleted {output / file}, labels of 1 episode by toy/brightness"
        for file in (PROGRESS, "reward_signals/rfm.parquet")
    ]
    assert labels(output).keys() == {name for name in before if "other" in name}
    assert labelled(TOY, output, episodes=[0])[0] == 0
    assert labels(output) == before
    (output / "third_progress.parquet").write_bytes(b"of another program")
    labelled(TOY, output, name="wide", frames=3, episodes=[0])  # another recipe, which gives the same labels
    listed = rfm_client("label", TOY, "--output", output, "--list").stdout.splitlines()[2:]
    assert [line.split() for line in listed if line] == [
        ["rfm", "toy/brightness", "1", "-"],
        ["other", "toy/brightness", "1", "rfm"],
        ["third", "-", "-", "-"],
        ["wide", "toy/brightness", "1", "rfm"],
    ]
    for parts in output.glob(".*_parts"):
        shutil.rmtree(parts)
    assert "expected --yes for labels that must be scored again" in rfm_client(*remove).stderr
    assert (output / PROGRESS).exists()
    assert rfm_client(*remove, "--yes").exit_code == 0
    assert "expected labels of rfm-client, got others" in rfm_client(*remove[:-1], "third").stderr


@pytest.mark.parametrize("name", ["sarm", "sarm_progress"])
def test_an_alias_is_deleted_by_its_listed_name_and_by_the_one_given_to_label(output: Path, name: str) -> None:
    labelled(TOY, output, episodes=[0], alias="sarm_progress")
    before = labels(output)
    wrong = rfm_client("label", TOY, "--output", output, "--remove", "nothing")
    assert f"{output}: expected one of the labels rfm, sarm, got 'nothing'" in wrong.stderr
    done = rfm_client("label", TOY, "--output", output, "--remove", name)
    assert done.stdout == f"deleted {output / 'sarm_progress.parquet'}, labels of 1 episode by toy/brightness\n"
    assert f"writes them again from {output / '.rfm_parts'}\n" in done.stderr
    assert before.keys() - labels(output).keys() == {"sarm_progress.parquet"}


def test_labels_are_deleted_whole_by_the_name_of_their_file_beside_a_foreign_file_named_as_parts(output: Path) -> None:
    labelled(TOY, output, episodes=[0], name="first")
    (output / ".first_parts").rename(output / ".moved_parts")
    (output / ".junk_parts").write_text("no folder")
    done = rfm_client("label", TOY, "--output", output, "--remove", "first_progress")
    deleted = [f"{output / file}, labels" for file in ("first_progress.parquet", "reward_signals/first.parquet")]
    assert [line.partition(" of")[0] for line in done.stdout.splitlines()] == [f"deleted {line}" for line in deleted]
    assert f"writes them again from {output / '.moved_parts'}\n" in done.stderr
    assert not list(output.rglob("*first*"))


REFUSED = {  # words after --remove, and the refusal
    "no name": (["", "--yes"], "'--remove': expected 1 to 64 letters, digits, _ or -, got ''"),
    "some episodes": (["rfm", "--episodes", "0"], "--remove excludes --episodes"),
    "two names": (["rfm", "--name", "other"], "--remove excludes --name"),
    "a dataset on the Hub": (
        ["rfm"],
        "org/name: expected a local dataset, got none: name the folder of its labels with",
    ),
}


@pytest.mark.parametrize(("words", "message"), REFUSED.values(), ids=REFUSED)
def test_a_removal_that_may_mean_something_else_is_refused(output: Path, words: list[str], message: str) -> None:
    source = ["org/name"] if "org" in message else [TOY, "--output", output]
    refused = rfm_client("label", *source, "--remove", *words, env={"COLUMNS": "200"})
    assert refused.exit_code != 0
    assert message in refused.stderr


def test_labels_of_a_folder_of_hdf5_files_are_listed_reported_and_deleted_together(tmp_path: Path) -> None:
    folder = tmp_path / "demos"
    folder.mkdir()
    files = [write_robomimic(folder / f"{name}.hdf5", [{"front": video(4, 0)}]) for name in "abc"]
    for file in (files[0], files[2]):
        labelled(file, folder, cameras=("front",), alias="sarm_progress")
    listed = rfm_client("label", folder, "--list")
    assert listed.stderr.splitlines()[-3:-1] == [
        f"rfm-client: {line}" for line in (files[1], f"{files[1]}: no labels in {folder}: {NO_LABELS}")
    ]
    assert [line.split() for line in listed.stdout.splitlines() if "toy/" in line] == [
        ["rfm", "toy/brightness", "1", "-"],
        ["sarm", "toy/brightness", "1", "rfm"],
    ] * 2
    told = rfm_client("label", folder, "--report")
    assert (told.exit_code, told.stdout.count("final progress: median")) == (1, 2)
    assert f"{folder / 'b.rfm_progress.parquet'}: expected a file of labels, got none: label" in told.stderr
    shutil.rmtree(folder / ".rfm_parts")
    before = labels(folder)
    assert (
        "expected --yes for labels that must be scored again" in rfm_client("label", folder, "--remove", "rfm").stderr
    )
    assert labels(folder) == before
    done = rfm_client("label", folder, "--remove", "rfm", "--yes")
    assert (done.exit_code, len(done.stdout.splitlines())) == (0, 4)
    assert labels(folder).keys() == {"a.sarm_progress.parquet", "c.sarm_progress.parquet"}
    for name in labels(folder):
        assert f"note: {folder / name} has the same labels and stays; --remove sarm deletes it" in done.stderr
