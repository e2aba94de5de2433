# SPDX-License-Identifier: MIT
"""Labels are the scores of prefixes: through Triton, through the engine, by hand."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, get_args

import av
import numpy as np
import pytest
from pyarrow import parquet

import engines
from labelling import FRONT, LEROBOT, WRIST, BrightnessScorer, Notes
from paths import ROOT
from repositories import description_of
from rfm_client import ModelInfo, ProgressSample, RewardClient, Trajectory
from rfm_client.contract.description import TOY
from rfm_client.frames import Rule, Sampling
from rfm_labels import (
    ClientScorer,
    DatasetError,
    LabelOptions,
    Report,
    Scorer,
    iter_episodes,
    label,
    open_dataset,
    parse_episodes,
)
from tolerances import TOLERANCE

MODELS = ROOT / "model_repository"


def engine_scorer(checkpoint: Path, encoders: Path) -> Scorer:
    options = {name: str(encoders / name) for name in ("image_encoder", "text_encoder")}
    return engines.scorer(str(checkpoint), **options)


def test_a_checkpoint_is_another_with_other_settings(tmp_path: Path) -> None:
    for folder in (MODELS / "rfm" / "1", MODELS / "rfm_encoder" / "1"):
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    told = [engine_scorer(tmp_path / "checkpoint", tmp_path).checkpoint()]
    for file in ("checkpoint/config.json", "image_encoder/preprocessor_config.json"):
        changed = tmp_path / file
        changed.write_text(changed.read_text() + "\n")
        told.append(engine_scorer(tmp_path / "checkpoint", tmp_path).checkpoint())
    assert len({facts.settings_digest for facts in told}) == 3
    assert len({facts.weights_digest for facts in told}) == 1


def test_a_toy_checkpoint_is_the_same_in_this_process_and_served() -> None:
    scorer = engine_scorer(MODELS / "rfm" / "1" / "checkpoint", MODELS / "rfm_encoder" / "1")
    assert scorer.checkpoint().weights_digest == description_of(MODELS / "rfm_frames").weights_digest
    early = ROOT / "examples" / "early_checkpoint"
    facts = [scorer.checkpoint(), engine_scorer(early / "checkpoint", early).checkpoint()]
    assert [ModelInfo.warning_of(each.weights_digest) for each in facts] == [TOY, TOY]


def progress_of(report: Report) -> dict[str, np.ndarray[Any, Any]]:
    table = parquet.read_table(report.files[0])
    return {name: column.to_numpy() for name, column in zip(table.column_names, table.columns, strict=True)}


@pytest.mark.slow
@pytest.mark.triton
def test_triton_and_the_engine_score_each_frame_on_its_prefix_and_tell_successes_from_failures(
    client: RewardClient, output: Path
) -> None:
    dataset = open_dataset(LEROBOT / "toy_v30_many")
    (output / "engine").mkdir()
    report = label(dataset, ClientScorer(client), LabelOptions(output=output))
    kinds = json.loads((LEROBOT / "kinds.json").read_text())["toy_v30_many"]
    assert report.summary is not None
    is_success = np.array(kinds) == "success"
    final = report.summary.final_progress
    assert np.mean(final[is_success][:, None] > final[~is_success]) >= 0.95  # the area under the ROC curve
    assert not report.summary.outcomes["never succeed"][is_success].any()

    served = progress_of(report)
    engine = engine_scorer(MODELS / "rfm" / "1" / "checkpoint", MODELS / "rfm_encoder" / "1")
    own = progress_of(label(dataset, engine, LabelOptions(output=output / "engine")))
    assert list(served) == list(own)
    np.testing.assert_array_equal(served["index"], np.arange(sum(e.num_frames for e in dataset.episodes)))
    for name in served:
        np.testing.assert_allclose(served[name], own[name], rtol=0, atol=TOLERANCE)

    sampling = Sampling("rint", client.model_info(frames=True).max_frames)
    episode, trajectories = next(iter_episodes(dataset))
    for camera, video in trajectories.items():
        assert video.frames is not None
        shown = [sampling.prefix(t) for t in range(episode.num_frames)]
        samples = [ProgressSample(Trajectory(frames=video.frames[p.indices], task=episode.task)) for p in shown]
        results = client.evaluate(samples)
        by_hand = [(r.progress[p.read], r.success[p.read]) for r, p in zip(results, shown, strict=True)]
        for name, expected in zip(("progress", "success"), zip(*by_hand, strict=True), strict=True):
            got = served[f"{name}.{camera}"][: episode.num_frames]
            np.testing.assert_allclose(got, expected, rtol=0, atol=TOLERANCE)


@pytest.mark.slow
@pytest.mark.triton
def test_one_pass_of_a_causal_network_gives_the_scores_of_its_prefixes(client: RewardClient, output: Path) -> None:
    dataset = open_dataset(LEROBOT / "toy_v21")
    short = [episode.index for episode in dataset.episodes if episode.num_frames <= 32]
    options = LabelOptions(output=output, cameras=(FRONT,), sampling="all", episodes=short)
    told = progress_of(label(dataset, ClientScorer(client), options))
    assert "progress." + FRONT not in told  # a single camera needs no fusion
    start = 0
    for episode, videos in iter_episodes(dataset, [FRONT]):
        if episode.index in short:
            frames = videos[FRONT].frames
            assert frames is not None
            results = client.evaluate(
                ProgressSample(Trajectory(frames=frames[: t + 1], task=episode.task)) for t in range(len(frames))
            )
            expected = [result.last_progress for result in results]
            np.testing.assert_allclose(
                told["progress_sparse"][start : start + len(frames)], expected, rtol=0, atol=TOLERANCE
            )
            start += len(frames)


@pytest.mark.parametrize("rule", get_args(Rule))
def test_any_rule_labels_each_frame_with_the_slot_that_it_reads(rule: Any, output: Path) -> None:
    """The scorer returns each slot's brightness: rules read frame t, except for K = 1."""
    dataset = open_dataset(LEROBOT / "toy_v21")
    scorer = BrightnessScorer(max_frames=None)
    frames = None if rule == "all" or rule.startswith("rewind") else 4
    options = LabelOptions(output=output, sampling=rule, frames=frames, cameras=(WRIST,), episodes=[3, 7])
    told = progress_of(label(dataset, scorer, options))
    expected = [frame.mean() / 255 for index in (3, 7) for frame in dataset.frames(dataset.episodes[index], WRIST)]
    np.testing.assert_allclose(told["progress_sparse"], expected, atol=1e-6)
    assert told["episode_index"].tolist() == [3] * 21 + [7] * 20
    assert told["index"].tolist() == [*range(112, 133), *range(251, 271)]
    assert told["frame_index"].tolist() == [*range(21), *range(20)]
    assert scorer.tasks == {dataset.episodes[index].task for index in (3, 7)}


@pytest.mark.parametrize(("fuse", "function"), [("mean", np.mean), ("min", np.min), ("max", np.max)])
def test_cameras_of_two_sizes_are_fused_and_each_is_kept(fuse: Any, function: Any, output: Path) -> None:
    options = LabelOptions(output=output, frames=4, fuse=fuse, episodes=[0])
    told = progress_of(label(open_dataset(LEROBOT / "toy_v21"), BrightnessScorer(), options))
    for name, fused in (("progress", "progress_sparse"), ("success", "success")):
        both = np.stack([told[f"{name}.{FRONT}"], told[f"{name}.{WRIST}"]])
        assert not np.array_equal(both[0], both[1])
        np.testing.assert_allclose(told[fused], function(both, axis=0), atol=1e-7)


def test_the_files_have_the_documented_form(output: Path) -> None:
    options = LabelOptions(output=output, name="mine", alias="sarm_progress", episodes=[1, 2])
    report = label(open_dataset(LEROBOT / "toy_v30_many"), BrightnessScorer(), options)
    assert [str(file.relative_to(output)) for file in report.files] == [
        "mine_progress.parquet",
        "sarm_progress.parquet",
        "reward_signals/mine.parquet",
    ]
    progress, alias, signals = (parquet.read_table(file) for file in report.files)
    assert alias.equals(progress, check_metadata=True)
    identity = ["index", "episode_index", "frame_index"]
    cameras = [f".{FRONT}", f".{WRIST}"]
    scores = ["progress_sparse", *(f"progress{c}" for c in cameras), "success", *(f"success{c}" for c in cameras)]
    assert progress.column_names == [*identity, *scores]
    signal_names = [
        f"reward.mine.{name}{camera}" for name in ("progress", "success_probability") for camera in ("", *cameras)
    ]
    assert signals.column_names == [*identity, *signal_names]
    for table in (progress, signals):
        assert [str(field.type) for field in table.schema] == ["int64"] * 3 + ["float"] * 6
        assert not any(field.nullable for field in table.schema)
        assert table["index"].to_pylist() == list(range(58, 156))
        assert table["frame_index"].to_pylist() == [*range(39), *range(59)]
    np.testing.assert_array_equal(progress["progress_sparse"], signals["reward.mine.progress"])
    np.testing.assert_array_equal(progress["success"], signals["reward.mine.success_probability"])

    metadata = {key.decode(): value.decode() for key, value in signals.schema.metadata.items()}
    own = {key.removeprefix("lerobot.reward_scoring."): value for key, value in metadata.items()}
    own_names = ["descriptors", "episode_indices", "format", "provenance", "rfm.episodes", "schema_version"]
    assert sorted(own) == own_names
    assert sorted(json.loads(own["rfm.episodes"])) == ["1", "2"]
    assert progress.schema.metadata[b"rfm.episodes"] == signals.schema.metadata[b"rfm.episodes"]
    assert (own["format"], own["schema_version"], own["episode_indices"]) == ("lerobot.frame_signals", "1", "[1,2]")
    descriptors = json.loads(own["descriptors"])
    assert sorted(descriptors) == signal_names
    assert descriptors["reward.mine.progress"] == {
        "description": "Share of the task that is done",
        "direction": "higher",
        "bounds": [0.0, 1.0],
        "unit": None,
        "missing_values": "forbidden",
        "allow_nan": False,
    }
    provenance = json.loads(own["provenance"])
    assert provenance["checkpoint"] == {
        "source": "toy/brightness",
        "revision": None,
        "weights_digest": "brightness",
        "settings_digest": "settings",
        "computation": "float32, torch 2.13.0, sdpa",
    }
    assert provenance["sampling"] == {"rule": "rint_pad", "frames": 16}
    assert provenance["cameras"] == [FRONT, WRIST]
    assert set(provenance["decoders"]) == {FRONT, WRIST}
    assert provenance["decoders"][FRONT].startswith(f"PyAV {av.__version__}")
    assert (provenance["dataset"]["kind"], provenance["dataset"]["source"]) == ("LeRobot v3.0", "toy_v30_many")
    assert progress.schema.metadata[b"reward_model_path"] == b"toy/brightness"
    assert json.loads(progress.schema.metadata[b"rfm.provenance"]) == provenance


def test_a_run_prints_each_decision_with_its_reason(output: Path) -> None:
    notes = Notes()
    label(open_dataset(LEROBOT / "toy_v21"), BrightnessScorer(), LabelOptions(output=output, limit=1), notes)
    assert notes.lines == [
        f"cameras: {FRONT}, {WRIST} (all but depth cameras)",
        "sampling: rint_pad (as upstream's training pads shorter clips)",
        "frames: 16 (the most in training; if the checkpoint does not say, the most its network takes)",
        "fuse: mean of 2 cameras",
        "1 of the dataset's 8 episodes have labels; LeRobot's reader gives frames of the others the weight 1.0",
    ]


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a camera that is not there": ({"cameras": ("top",)}, f"cameras: expected some of {FRONT}, {WRIST}, got 'top'"),
    "an episode that is not there": (
        {"episodes": [3, 8]},
        "episodes: expected some of the dataset's 8 episodes, got 8",
    ),
    "a whole episode that is too long": (
        {"mode": "whole"},
        "episode 2: expected at most 16 frames, as the checkpoint takes, got 53: use mode prefix and a rule with a",
    ),
    "an output in a file": (
        {"output": Path(__file__) / "labels"},
        f"{__file__}/labels: expected a folder for the labels, got Not a directory: name another one with --output",
    ),
}


@pytest.mark.parametrize(("options", "message"), REFUSED.values(), ids=REFUSED)
def test_unusable_options_are_refused_before_the_first_frame(
    options: dict[str, Any], message: str, output: Path
) -> None:
    scorer = BrightnessScorer()
    with pytest.raises(DatasetError) as caught:
        label(open_dataset(LEROBOT / "toy_v21"), scorer, LabelOptions(**{"output": output, **options}))
    assert str(caught.value).startswith(message)
    assert scorer.num_samples == 0


CONTRADICTORY: dict[str, tuple[dict[str, Any], str]] = {
    "a name that is no file": ({"name": "../x"}, "name: expected 1 to 64 letters, digits, _ or -, got '../x'"),
    "another mode": ({"mode": "dense"}, "mode: expected one of prefix, whole, got 'dense'"),
    "whole with a rule": ({"mode": "whole", "sampling": "rint_pad"}, "sampling: expected all in mode whole"),
    "a camera twice": ({"cameras": ("a", "a")}, "cameras: expected each once, got a, a"),
    "a shard behind the last": ({"shard": (2, 2)}, "shard: expected i/n with i from 0 to n - 1, got 2/2"),
    "no worker": ({"workers": 0}, "workers: expected at least 1, got 0"),
}


@pytest.mark.parametrize(("options", "message"), CONTRADICTORY.values(), ids=CONTRADICTORY)
def test_options_that_contradict_themselves_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as caught:
        LabelOptions(**options)
    assert str(caught.value).startswith(message)


def test_episodes_are_named_by_numbers_and_ranges() -> None:
    assert parse_episodes("0:3,205, 7") == [0, 1, 2, 7, 205]
    for text in ("", "3:1", "a", "1-3"):
        with pytest.raises(ValueError, match=r"^episodes: expected numbers and ranges such as 0:100,205, got "):
            parse_episodes(text)
