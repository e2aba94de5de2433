# SPDX-License-Identifier: MIT
"""Existing labels are kept: fewer episodes never replace more, and only new episodes are labelled."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from pyarrow import parquet

from labelling import FRONT, LEROBOT, WRIST, BrightnessScorer, Notes, command, without_cost
from rfm_labels import DatasetError, LabelOptions, label, open_dataset

TOY = LEROBOT / "toy_v30_many"
CAMERAS = (WRIST, FRONT)  # not in alphabetical order
PROGRESS = "rfm_progress.parquet"
EPISODE_FRAMES = [episode.num_frames for episode in open_dataset(TOY).episodes]


def labelled(root: Path, output: Path, **options: Any) -> tuple[int, list[str]]:
    """Return the number of scored frames per camera, and the messages of a run."""
    scorer, notes = BrightnessScorer(), Notes()
    label(open_dataset(root), scorer, LabelOptions(output=output, cameras=CAMERAS, frames=2, **options), notes)
    return scorer.num_samples // len(CAMERAS), notes.lines


def labels(output: Path) -> dict[str, bytes]:
    return {str(file.relative_to(output)): file.read_bytes() for file in label_files(output)}


def labels_without_cost(output: Path) -> dict[str, bytes]:
    return {str(file.relative_to(output)): without_cost(file) for file in label_files(output)}


def label_files(output: Path) -> list[Path]:
    return [file for file in sorted(output.rglob("*.parquet")) if ".rfm_parts" not in file.parts]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    output = tmp_path_factory.mktemp("undisturbed")
    labelled(TOY, output)
    return labels_without_cost(output)


@pytest.mark.parametrize(
    ("formats", "keeps_parts"),
    [(("progress", "signals"), True), (("progress",), False), (("signals",), False)],
    ids=["both, parts kept", "progress, parts gone", "signals, parts gone"],
)
def test_labels_of_further_episodes_are_joined_to_those_that_are_there(
    output: Path, undisturbed: dict[str, bytes], formats: Any, keeps_parts: bool
) -> None:
    labelled(TOY, output, formats=formats, episodes=range(6))
    if not keeps_parts:
        shutil.rmtree(output / ".rfm_parts")
    scored, notes = labelled(TOY, output, formats=formats, episodes=[6, 7, 8])
    assert scored == sum(EPISODE_FRAMES[6:9])
    assert "labels of 6 other episodes are there, and are kept" in notes
    assert notes[-1].startswith("9 of the dataset's 10 episodes have labels")
    if not keeps_parts:
        shutil.rmtree(output / ".rfm_parts")
    scored, notes = labelled(TOY, output, formats=formats)
    assert scored == EPISODE_FRAMES[9]
    assert not any("episodes have labels" in line for line in notes)
    found = labels_without_cost(output)
    assert found == {name: content for name, content in undisturbed.items() if name in found}
    assert len(found) == len(formats)


def test_a_server_that_names_no_computation_goes_on_with_the_labels_made_before(output: Path) -> None:
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
    "what tells files": (BrightnessScorer(), {"verify": True}, "verify: False there, True now"),
    "decoder": (BrightnessScorer(), {}, f"decoders.{FRONT}: {{decoder}} there, PyAV 1.0 now"),  # they differ in colours
    "weights": (BrightnessScorer(digest="new"), {}, "checkpoint.weights_digest: brightness there, new now"),
    "PyTorch": (
        BrightnessScorer(computation="float32, torch 2.14.0, sdpa"),
        {},
        "checkpoint.computation: float32, torch 2.13.0, sdpa there, float32, torch 2.14.0, sdpa now",
    ),
    "settings": (BrightnessScorer(settings="new"), {}, "checkpoint.settings_digest: settings there, new now"),
}


@pytest.mark.parametrize(("scorer", "options", "differs"), OTHERS.values(), ids=OTHERS)
def test_labels_of_another_recipe_are_refused_with_the_setting_that_differs(
    output: Path, scorer: BrightnessScorer, options: dict[str, Any], differs: str
) -> None:
    first = LabelOptions(output=output, cameras=(FRONT,), frames=2, formats=("progress",), episodes=[0, 1, 2])
    label(open_dataset(TOY), BrightnessScorer(), first)
    before = labels(output)
    told = json.loads(parquet.read_schema(output / PROGRESS).metadata[b"rfm.provenance"])
    expected = differs.format(rule=told["sampling"]["rule"], decoder=told["decoders"][FRONT])

    changed: dict[str, Any] = {**vars(first), "episodes": [3], **options}
    dataset = open_dataset(TOY)
    if "PyAV 1.0" in expected:
        dataset.decoder = lambda camera: "PyAV 1.0"  # type: ignore[method-assign]
    with pytest.raises(DatasetError) as caught:
        label(dataset, scorer, LabelOptions(**changed))
    got = f"{output / PROGRESS}: expected no labels, or those of the same recipe, got {expected}"
    assert str(caught.value) == f"{got}: choose another --name, or --overwrite"
    assert (labels(output), scorer.num_samples) == (before, 0)

    notes = Notes()
    label(dataset, scorer, LabelOptions(**{**changed, "overwrite": True}), notes)
    assert any(line.startswith(f"--overwrite: {got}; its labels of ") for line in notes.lines)
    assert notes.lines[-1].startswith("1 of the dataset's 10 episodes have labels; LeRobot's reader")
    assert parquet.read_table(output / PROGRESS)["episode_index"].unique().to_pylist() == [3]


@pytest.mark.parametrize("verify", [False, True])
def test_labels_of_a_video_hold_until_its_time_changes_or_where_they_are_verified_its_content(
    tmp_path: Path, output: Path, verify: bool
) -> None:
    root = shutil.copytree(TOY, tmp_path / TOY.name)
    video = root / "videos" / FRONT / "chunk-000" / "file-001.mp4"  # of episodes 4 to 7
    assert labelled(root, output, verify=verify)[0] == sum(EPISODE_FRAMES)
    for file in root.rglob("*.mp4"):
        os.utime(file, (1, 1))
    if verify:
        assert labelled(root, output, verify=True)[0] == 0
        video.write_bytes(video.read_bytes() + bytes(8))
        os.utime(video, (1, 1))
    else:
        with pytest.raises(
            DatasetError, match=r"labels of this dataset's episodes, got those of others, or of videos that"
        ):
            labelled(root, output)
        assert labelled(root, output, overwrite=True)[0] == sum(EPISODE_FRAMES)
        os.utime(video, (2, 2))
    assert labelled(root, output, verify=verify)[0] == sum(EPISODE_FRAMES[4:8])


def shifted_row(root: Path) -> None:
    """Change a time in a row of episode 3 and keep the video."""
    file = root / "data" / "chunk-000" / "episode_000003.parquet"
    table = parquet.read_table(file, partitioning=None)
    times_s = table["timestamp"].to_numpy().copy()
    times_s[4] += 0.06
    place = table.schema.get_field_index("timestamp")
    parquet.write_table(table.set_column(place, table.schema.field(place), pa.array(times_s)), file)


def damaged_in_silence(root: Path) -> None:
    """Zero the index of episode 3's video, without a change of size and time."""
    file = root / "videos" / "chunk-000" / WRIST / "episode_000003.mp4"
    status, content = file.stat(), bytearray(file.read_bytes())
    place = content.index(b"stsz")
    content[place : place + 200] = bytes(200)
    file.write_bytes(content)
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))


STALE: dict[str, tuple[Callable[[Path], None], str]] = {
    "the time of a row": (shifted_row, "episode 3"),
    "a film that was damaged": (damaged_in_silence, "episode_000003.mp4: expected "),
}


@pytest.mark.parametrize("episodes", [None, [0, 1]], ids=["all", "others"])
@pytest.mark.parametrize(("change", "message"), STALE.values(), ids=STALE)
def test_kept_labels_are_checked_as_new_ones_are_and_so_does_a_dry_run(
    tmp_path: Path, output: Path, change: Callable[[Path], None], message: str, episodes: list[int] | None
) -> None:
    root = shutil.copytree(LEROBOT / "toy_v21", tmp_path / "toy_v21")
    labelled(root, output)
    before = labels(output)
    change(root)
    with pytest.raises(DatasetError) as refused:
        labelled(root, output, episodes=episodes)
    assert message in str(refused.value)
    asked = LabelOptions(output=output, cameras=CAMERAS, frames=2, episodes=episodes)
    with pytest.raises(DatasetError) as refused_by_trial:
        dry_run(root, asked)
    assert str(refused_by_trial.value) == str(refused.value)
    assert labels(output) == before


def test_a_dry_run_refuses_labels_of_another_recipe(output: Path) -> None:
    labelled(TOY, output)
    with pytest.raises(
        DatasetError, match=r"expected no labels, or those of the same recipe, got sampling\.frames: 2 th"
    ):
        dry_run(TOY, LabelOptions(output=output, cameras=CAMERAS, frames=4))


def dry_run(root: Path, options: LabelOptions) -> None:
    command(root, options, BrightnessScorer(), dry_run=True)


def test_a_dataset_that_has_grown_is_labelled_where_it_is_new(tmp_path: Path, output: Path) -> None:
    whole = shutil.copytree(LEROBOT / "toy_v21", tmp_path / "whole")
    root = shutil.copytree(whole, tmp_path / "growing")
    info = json.loads((whole / "meta" / "info.json").read_text())
    lines = (whole / "meta" / "episodes.jsonl").read_text().splitlines(keepends=True)
    last = json.loads(lines[-1])["length"]
    shorter = {**info, "total_episodes": len(lines) - 1, "total_frames": info["total_frames"] - last}
    (root / "meta" / "info.json").write_text(json.dumps(shorter))
    (root / "meta" / "episodes.jsonl").write_text("".join(lines[:-1]))
    assert labelled(root, output)[0] == info["total_frames"] - last
    for name in ("info.json", "episodes.jsonl"):
        shutil.copy(whole / "meta" / name, root / "meta" / name)
    assert labelled(root, output)[0] == last
    assert len(parquet.read_table(output / PROGRESS)) == info["total_frames"]


BY_OTHERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no Parquet file": (lambda file: file.write_bytes(b"not ours"), "labels of another program"),
    "of LeRobot": (
        lambda file: parquet.write_table(parquet.read_table(file).replace_schema_metadata({}), file),
        "labels of another program",
    ),
}


@pytest.mark.parametrize(("make", "got"), BY_OTHERS.values(), ids=BY_OTHERS)
def test_labels_that_do_not_say_of_what_they_are_stay_unless_asked(
    output: Path, make: Callable[[Path], object], got: str
) -> None:
    labelled(TOY, output, limit=1, alias="sarm_progress")
    make(output / "sarm_progress.parquet")
    before = labels(output)
    with pytest.raises(DatasetError) as caught:
        labelled(TOY, output, limit=2, alias="sarm_progress")
    assert str(caught.value).endswith(f"got {got}: choose another --alias, or --overwrite")
    assert labels(output) == before
    labelled(TOY, output, limit=2, alias="sarm_progress", overwrite=True)
    assert labels(output)["sarm_progress.parquet"] == labels(output)[PROGRESS]
