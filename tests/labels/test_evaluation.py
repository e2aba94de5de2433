# SPDX-License-Identifier: MIT
"""Measures of label files, against slow formulas and known cases."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import hdf5_writers
from in_process import rfm_client
from labelling import WRIST, BrightnessScorer
from rfm_client import FrameScores
from rfm_labels import DatasetError, LabelOptions, evaluate_labels, label, open_dataset, read_outcomes, summarise
from rfm_labels.summary import voted_success
from shown_datasets import copied

Curves = Mapping[int, Sequence[float]]

RISING, FALLING, FLAT = [0.0, 0.2, 0.5, 0.9], [0.9, 0.5, 0.2, 0.0], [0.3] * 4


NAMES = {0: "red_cup.mp4", 1: "2", 2: "1", 3: "three.mp4", 4: "blue_cup.mp4"}


def labels(file: Path, progress: Curves, success: Curves | None = None, names: Mapping[int, str] | None = None) -> Path:
    episodes = np.concatenate([[episode] * len(values) for episode, values in progress.items()]).astype(np.int64)
    frames = np.concatenate([np.arange(len(values)) for values in progress.values()])
    columns = {"index": np.arange(len(episodes)), "episode_index": episodes, "frame_index": frames}
    scores = {"progress_sparse": progress} | ({"success": success} if success else {})
    columns |= {name: np.concatenate([*values.values()]).astype(np.float32) for name, values in scores.items()}
    metadata = {b"rfm.names": json.dumps(names or {}).encode()}
    parquet.write_table(pa.table(columns).replace_schema_metadata(metadata), file)
    return file


def test_thresholds_separate_successes_from_failures(tmp_path: Path) -> None:
    final = {0: 0.9, 1: 0.8, 2: 0.8, 3: 0.1}  # the last of each episode; a success ties with a failure
    success = {0: [0.9, 0.0, 0.7, 0.7], 1: [0.4, 0.4], 2: [0.9, 0.9, 0.3, 0.3, 0.9], 3: [0.1] * 4}  # the last 3 vote
    curves = {each: [*[0.0] * (len(success[each]) - 1), value] for each, value in final.items()}
    file = labels(tmp_path / "good_progress.parquet", curves, success)
    comparison = evaluate_labels([file], {0: True, 1: True, 2: False, 3: False})
    (found,) = comparison.evaluations
    assert found.name == "good"
    assert found.by_progress is not None
    assert found.by_success is not None
    assert found.by_progress.auroc == pytest.approx((4 - 0.5) / 4)  # one of four pairs is a tie
    assert (found.by_success.auroc, found.by_success.balanced_accuracy) == (1.0, 1.0)
    assert found.by_success.threshold == 0.35  # in the middle of 0.3 and 0.4
    assert (found.final_of_successes, found.final_of_failures) == (pytest.approx(0.85), pytest.approx(0.45))


def test_the_last_three_frames_decide_who_succeeds_and_an_undone_success_is_a_class_of_its_own(tmp_path: Path) -> None:
    success = {
        0: [0, 0, 0.9, 0.9],
        1: [0.9, 0.9, 0.1, 0.2],
        2: [0.1] * 4,
        3: [0, 0, 0, 0.9],
        4: [0.9, 0, 0.9],
        5: [0.8, 0],
    }
    file = labels(tmp_path / "rfm_progress.parquet", success, success)
    rows = dict(summarise(file).rows())
    assert {name: row for name, row in rows.items() if name.startswith("episodes that")} == {
        "episodes that succeed": "2: 0, 4",
        "episodes that succeed, then undo it": "3: 1, 3, 5",
        "episodes that never succeed": "1: 2",
    }
    for values in success.values():
        scores = FrameScores(progress=np.float32(values), success=np.float32(values))
        assert scores.succeeded(last=3) == (voted_success(scores.success) >= 0.5)
    done = rfm_client("label", file, "--report")
    assert done.exit_code == 0, done.output
    never = {"episodes that succeed": "0", "episodes that succeed, then undo it": "0"}
    assert never.items() <= dict(summarise(labels(file, {2: success[2]}, {2: success[2]})).rows()).items()


def test_another_programs_rows_may_be_in_any_order(tmp_path: Path) -> None:
    file = labels(tmp_path / "other_progress.parquet", {0: RISING, 1: [0.0, 0.1, 0.3, 0.2]})
    table = parquet.read_table(file)
    parquet.write_table(table.take(np.argsort(table["frame_index"].to_numpy())), file)
    summary = summarise(file)
    assert (summary.episodes.tolist(), summary.final_progress.tolist()) == ([0, 1], np.float32([0.9, 0.2]).tolist())
    assert evaluate_labels([file]).evaluations[0].final_progress.tolist() == summary.final_progress.tolist()


def test_of_two_thresholds_that_are_equally_good_the_lower_counts(tmp_path: Path) -> None:
    file = labels(tmp_path / "a.parquet", {episode: [0.0, episode / 10] for episode in range(8)})
    (found,) = evaluate_labels([file], {episode: episode in (2, 6) for episode in range(8)}).evaluations
    assert found.by_progress is not None
    assert found.by_progress.threshold == 0.15  # at 0.55, 1/2 and 5/6 are right, whose mean is 2/3, too
    assert found.by_progress.balanced_accuracy == pytest.approx((1 + 1 / 3) / 2)
    below_0 = labels(tmp_path / "b.parquet", {0: [-0.5], 1: [0.1]})  # as Robo-Dopamine's progress may be
    (found,) = evaluate_labels([below_0], {0: False, 1: True}).evaluations
    assert found.by_progress is not None
    assert found.by_progress.threshold == -0.2


BARELY_MORE = float(np.nextafter(np.float32(0.9), np.float32(1)))
THRESHOLDS = {
    "far apart": (0.03, 0.99885, "0.5144", 1),
    "closer than four decimals": (0.99881, 0.99885, "0.99883", 1),
    "neighbours in float32": (0.9, BARELY_MORE, "0.90000001", 1),
    "failures have the higher number": (0.9, 0.8, "0.4000", 0.5),
}


@pytest.mark.parametrize(("failure", "success", "threshold", "accuracy"), THRESHOLDS.values(), ids=THRESHOLDS)
def test_the_printed_threshold_gives_the_printed_accuracy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: float, success: float, threshold: str, accuracy: float
) -> None:
    monkeypatch.setenv("COLUMNS", "120")  # all columns in one row
    values = {0: [failure], 1: [success]}
    file = labels(tmp_path / "rfm_progress.parquet", values, values)
    done = rfm_client("evaluate", tmp_path, "--outcome", written(tmp_path / "a.csv", "episode,success\n0,0\n1,1\n"))
    assert done.stdout.splitlines()[4].split()[-3:-1] == [threshold, f"{accuracy:.4f}"]
    succeeds = parquet.read_table(file)["success"].to_numpy() >= float(threshold)
    assert (succeeds == [False, True]).mean() == accuracy
    assert "note: fewer than 10 successes or failures: AUROC may be off by 0.2 or more" in done.stderr


def test_the_order_is_that_of_successes_and_a_constant_curve_has_none(tmp_path: Path) -> None:
    file = labels(tmp_path / "a.parquet", {0: RISING, 1: FALLING, 2: FLAT})
    (of_all,) = evaluate_labels([file]).evaluations
    assert (of_all.spearman, of_all.kendall, of_all.num_constant) == (pytest.approx(0), pytest.approx(0), 1)
    assert (of_all.by_success, of_all.by_progress, of_all.final_of_successes) == (None, None, None)
    assert of_all.backwards == pytest.approx(1 / 3)
    (of_successes,) = evaluate_labels([file], {0: True, 1: False, 2: True}).evaluations
    assert (of_successes.spearman, of_successes.num_constant) == (pytest.approx(1), 1)


def test_models_are_compared_on_the_episodes_that_both_have_and_on_their_labelled_frames(tmp_path: Path) -> None:
    first = labels(tmp_path / "a.parquet", {0: RISING, 1: RISING, 7: FLAT})
    gaps = [0.1, np.nan, 0.3, 0.5]  # a frame without a label
    second = labels(tmp_path / "b.parquet", {0: FALLING, 1: gaps})
    comparison = evaluate_labels([first, second])
    assert (comparison.episodes, comparison.num_left_out) == ([0, 1], 1)
    assert [each.spearman for each in comparison.evaluations] == pytest.approx([1, 0])
    assert [each.num_frames for each in comparison.evaluations] == [8, 7]


def written(file: Path, text: str) -> str:
    file.write_text(text)
    return str(file)


def test_outcomes_are_read_from_a_table_the_frames_or_the_episodes(tmp_path: Path) -> None:
    outcomes = read_outcomes(written(tmp_path / "a.csv", "\ufeffepisode, success\n0, 1\n1,FALSE\n2,\n"))
    assert outcomes == {0: True, 1: False, 2: None}
    v30, v21 = copied("toy_v30_many", tmp_path), copied("toy_v21", tmp_path)
    for file in sorted(v30.rglob("data/**/*.parquet")):
        table = parquet.read_table(file)
        done = np.append(np.diff(table["episode_index"].to_numpy()) != 0, True)
        done &= table["episode_index"].to_numpy() % 2 == 0
        gaps = table["episode_index"].to_numpy() == 3
        parquet.write_table(table.append_column("next.success", pa.array(done, mask=gaps)), file)
    outcomes = read_outcomes("next.success", v30)
    assert outcomes == {
        each.index: each.index % 2 == 0 if each.index != 3 else None for each in open_dataset(v30).episodes
    }
    lines = v21 / "meta" / "episodes.jsonl"
    rows = [json.loads(line) | {"success": index % 3 == 0} for index, line in enumerate(lines.read_text().splitlines())]
    lines.write_text("\n".join(map(json.dumps, rows)))
    assert read_outcomes("success", v21) == {row["episode_index"]: row["success"] for row in rows}


def test_a_table_of_outcomes_has_numbers_or_names_as_tables_show_them(tmp_path: Path) -> None:
    rows = "red_cup.mp4,1\n1 (2),no\n3,Yes\n4 (blue_cup.mp4),0\n7,1\ngone.mp4,0\n"
    for column in ("episode", "video", "episode_index"):
        outcomes = read_outcomes(written(tmp_path / "a.csv", f"{column},success\n{rows}"), names=NAMES)
        assert outcomes == {0: True, 1: False, 3: True, 4: False, 7: True, "gone.mp4": False}


def with_column(folder: Path, name: str, value: Callable[[int, bool], Any]) -> Path:
    """Return a LeRobot dataset with another column. value: of an episode's last frame, or of another one"""
    root = copied("toy_v21", folder)
    for file in sorted(root.rglob("data/**/*.parquet")):
        table = parquet.read_table(file)
        episode, count = table["episode_index"][0].as_py(), len(table)
        stored = [value(episode, t == count - 1) for t in range(count)]
        parquet.write_table(table.append_column(name, pa.array(stored)), file)
    return root


@pytest.mark.parametrize(
    "value",
    {
        "rewards of 1 and 0": lambda episode, end: float(end and episode % 2),
        "rewards of 0 and -1": lambda episode, end: 0 if end and episode % 2 else -1,
        "success before the end": lambda episode, end: not end and episode % 2 == 1,
        "a word in each frame": lambda episode, end: "Success" if episode % 2 else "failure",
        "lists of one number": lambda episode, end: [episode % 2],
    }.items(),
    ids=itemgetter(0),
)
def test_outcomes_are_read_as_recorders_write_them(
    tmp_path: Path, value: tuple[str, Callable[[int, bool], Any]]
) -> None:
    root = with_column(tmp_path, "next.reward", value[1])
    assert read_outcomes("next.reward", root) == {
        each.index: each.index % 2 == 1 for each in open_dataset(root).episodes
    }


def test_outcomes_of_hdf5_are_attributes_or_arrays(tmp_path: Path) -> None:
    file = tmp_path / "demos.hdf5"
    hdf5_writers.write_robomimic(file, [{"front": hdf5_writers.video(3)} for _ in range(3)])
    with h5py.File(file, "r+") as opened:
        for number, (label, rewards) in enumerate(
            [("successful", [0, 0, 1]), ("failure", [0, 0, 0]), ("suboptimal", [])]
        ):
            opened[f"data/demo_{number}"].attrs["quality_label"] = label
            if rewards:
                opened[f"data/demo_{number}/rewards"] = np.array(rewards, np.float32)
    for name in ("quality_label", "rewards"):
        assert read_outcomes(name, file) == {0: True, 1: False, 2: None}
    with pytest.raises(DatasetError, match=r"outcome: expected .* one of .*quality_label.*rewards.*, got 'reward'"):
        read_outcomes("reward", file)


REFUSED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no such column": (
        lambda folder: read_outcomes("succes", copied("toy_v30_many", folder)),
        r"outcome: expected a CSV file, or a column of .*: .*frame_index.*, got 'succes'",
    ),
    "a column without a dataset": (
        lambda folder: read_outcomes("success", folder),
        "outcome: expected a CSV file, a column of a local LeRobot dataset, a name in an HDF5 file, or a reader, got 'suc",
    ),
    "a column of other numbers": (
        lambda folder: read_outcomes("timestamp", copied("toy_v30_many", folder)),
        r"outcome: timestamp: episode \d: expected true, false, 1, 0, success or failure, got ",
    ),
    "other headers, and a cell too many": (
        lambda folder: read_outcomes(written(folder / "a.csv", "id,ok\n0,1,2\n")),
        r"a\.csv: expected the columns episode and success, got id, ok",
    ),
    "an episode twice, by number and by name": (
        lambda folder: read_outcomes(written(folder / "a.csv", "episode,success\n0,1\nred_cup.mp4,0\n"), names=NAMES),
        r"a\.csv: line 3: expected each episode once, got red_cup.mp4 again",
    ),
    "the number of one episode and the name of another": (
        lambda folder: read_outcomes(written(folder / "a.csv", "episode,success\n2,1\n"), names=NAMES),
        r"a\.csv: line 2: episode: expected the number or name of one episode, got '2': write 1 \(2\) or 2 \(1\)",
    ),
    "outcomes of other episodes": (
        lambda folder: evaluate_labels([labels(folder / "a", {0: RISING}, names=NAMES)], {5: True, "a.mp4": False}),
        r"outcome: expected one that is known, got none for 1 episodes: 0 \(red_cup.mp4\); no labels for 5, a.mp4",
    ),
    "an episode twice": (
        lambda folder: read_outcomes(written(folder / "a.csv", "episode,success\n0,1\n0,0\n")),
        r"a\.csv: line 3: expected each episode once, got 0 again",
    ),
    "no outcome at all": (
        lambda folder: evaluate_labels([labels(folder / "a.parquet", {0: RISING})], {0: None}),
        "outcome: expected one that is known, got none for 1 episodes",
    ),
    "another word": (
        lambda folder: read_outcomes(written(folder / "a.csv", "episode,success\n0,maybe\n")),
        r"line 2: success: expected true, false, 1, 0, success or failure, got 'maybe'",
    ),
    "rewards that are 0 everywhere": (
        lambda folder: read_outcomes("next.reward", with_column(folder, "next.reward", lambda episode, end: 0.0)),
        "outcome: next.reward: expected -1 or 1 in some episode, which shows whether 0 is a failure, got 0 in all",
    ),
    "no common episode": (
        lambda folder: evaluate_labels([labels(folder / f"{n}.parquet", {n: RISING}) for n in range(2)]),
        "labels: expected an episode that all files have, got none",
    ),
    "files that name an episode differently": (
        lambda folder: evaluate_labels(
            [labels(folder / f"{name}_progress.parquet", {0: RISING}, names={0: name}) for name in ("a.mp4", "_0.mp4")]
        ),
        r"_0\.mp4_progress\.parquet: episode 0: expected a\.mp4 as in .*a\.mp4_progress\.parquet, got _0\.mp4: label ag",
    ),
    "one file twice": (
        lambda folder: evaluate_labels([labels(folder / "a.parquet", {0: RISING})] * 2),
        "labels: expected each file once",
    ),
}


@pytest.mark.parametrize("ask, message", REFUSED.values(), ids=REFUSED)
def test_incomparable_files_and_outcomes_are_refused(tmp_path: Path, ask: Callable[[Path], Any], message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        ask(tmp_path)


def test_no_number_is_cut_on_a_terminal_and_episodes_without_an_outcome_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    curves = {0: RISING, 1: FALLING, 2: RISING, 3: FLAT, 4: RISING}
    names = ("a_long_name_of_a_model", "b")
    files = [labels(tmp_path / f"{name}_progress.parquet", curves, curves, NAMES) for name in names[:1]]
    files.append(labels(tmp_path / "b_progress.parquet", {**curves, 8: FLAT}, None, NAMES))
    labels(tmp_path / "copy_progress.parquet", {**curves, 8: FLAT}, None, NAMES)
    outcomes = written(tmp_path / "a.csv", "Episode;success\n0;1\n1 (2);0\n\nthree.mp4;0\n4;1\n9;1\ngone.mp4;1\n")
    for name, value in {"COLUMNS": "80", "FORCE_COLOR": "1"}.items():  # as on a terminal
        monkeypatch.setenv(name, value)
    done = rfm_client("evaluate", tmp_path, "--outcome", outcomes, "--json", tmp_path / "out.json")
    assert done.exit_code == 0, done.output
    shown = re.sub(r"\x1b\[\d*m", "", done.stdout)
    title = (
        "4 episodes: 2 successes, 2 failures; 1 left out, not in a_long_name_of_a_model (--labels chooses the files); "
    )
    title += "1 left out, whose outcome is unknown; "
    title += "2 outcomes unused, of episodes without labels: 9, gone.mp4 "
    assert title in " ".join(shown.split())
    document = json.loads((tmp_path / "out.json").read_text())
    assert (document["episodes"], document["num_without_outcome"]) == ([0, 1, 3, 4], 1)
    assert document["without_labels"] == [9, "gone.mp4"]
    assert [f"rfm-client: note: {note}" for note in document["notes"]] == done.stderr.splitlines() != []
    assert document["notes"][0] == "copy: a copy of b"
    assert "copy" not in shown
    assert max(map(len, shown.partition("VOC: ")[0].splitlines())) <= 80
    for name, found in zip(
        ("a_", r"b\b"), evaluate_labels(files, read_outcomes(outcomes, names=NAMES)).evaluations, strict=True
    ):
        told = re.findall(rf"(?m)^ +{name}.*(?:\n {{4}}.*)?", shown)  # a name may have a line of its own
        best = found.by_success or found.by_progress
        assert found.final_of_successes is not None and best is not None
        numbers = [found.final, found.final_of_successes, best.threshold]
        assert {*(f"{number:.4f}" for number in numbers), f"{found.backwards:.1%}"} <= {*" ".join(told).split()}


@pytest.mark.slow
def test_the_command_prints_writes_and_draws(tmp_path: Path) -> None:
    root = copied("toy_v30_many", tmp_path)
    for name, frames in (("short", 2), ("long", 8)):
        options = LabelOptions(name=name, sampling="rint_pad", frames=frames, episodes=range(4), cameras=(WRIST,))
        label(open_dataset(root), BrightnessScorer(), options)
    numbers = range(4)
    rows = "".join(f"{number},{number % 2}\n" for number in numbers)
    outcomes = written(tmp_path / "outcomes.csv", f"episode,success\n{rows}")
    done = rfm_client("evaluate", root, "--outcome", outcomes)
    assert done.exit_code == 0, done.output
    assert all(
        word in done.stdout for word in ("short", "long", f"{sum(number % 2 for number in numbers)} successes", "AUROC")
    )
    json_file, picture = tmp_path / "out.json", tmp_path / "out.png"
    done = rfm_client("evaluate", root, "--json", json_file, "--plot", picture)
    assert done.exit_code == 0, done.output
    document = json.loads(json_file.read_text())
    assert [each["name"] for each in document["evaluations"]] == ["long", "short"]
    assert document["is_success"] is None
    assert picture.read_bytes().startswith(b"\x89PNG")
    empty = rfm_client("evaluate", tmp_path)
    assert (empty.exit_code, "expected label files, NAME_progress.parquet" in empty.stderr) == (1, True)
