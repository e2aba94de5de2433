# SPDX-License-Identifier: MIT
"""TOPReward and RoboReward behind Triton: both protocols, the gateway, episodes and labels."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import requests
from pyarrow import parquet
from selenium.webdriver.support.select import Select

import fake_lerobot
import rfm_export
import rynnvalue
from browsers import Browser
from environments import cart_pole, play
from faulty_servers import url_of
from gateways import metric_at, poll, running
from in_process import rfm_client
from paths import VIDEOS
from reward_models import BASE, ROOT, Reference, as_before_marks, references
from rfm import published
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm_client import (
    InvalidSampleError,
    ModelInfo,
    ModelNotFoundError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardClient,
    Trajectory,
)
from rfm_rl import RewardModelWrapper, RewardOptions
from servers import Endpoints, start_triton
from transports import Connection
from viewer_requests import SCORE, curve_of, events, post

fake_lerobot.provide()

from lerobot_reward_rfm import RfmRewardConfig, RfmRewardModel  # noqa: E402

pytestmark = pytest.mark.triton

TOP, ROBO = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied", ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint"
RYNN = ROOT / "rynnvalue" / "bro_symlog_bf16_tied" / "checkpoint"
LEROBOT = ROOT / "lerobot_robometer" / "tok_disc10" / "checkpoint"
DATASET = ROOT / "lerobot_rabc" / "home" / "golden" / "tiny_shared"
NAMES = {"top": (TOP, "topreward"), "baseline": (TOP, "topreward-robometer"), "robo": (ROBO, "roboreward")}
TASK = "put the red block in the bowl"


@dataclass(frozen=True)
class Served:
    endpoints: Endpoints

    def client(self, model: str, protocol: str = "grpc") -> RewardClient:
        return RewardClient(url_of(self.endpoints, protocol), model=model)


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("language_models")
    repository = folder / "model_repository"
    for name, (checkpoint, reward_model) in NAMES.items():
        rfm_export.export(checkpoint, repository, ExportConfig(name=name, num_gpus=0, reward_model=reward_model))
    rynn: Any = rynnvalue.said(rynnvalue.USUAL)
    rfm_export.export(RYNN, repository, ExportConfig(name="rynn", num_gpus=0, **rynn))
    of_lerobot = ExportConfig(name="lerobot", num_gpus=0, base_model=str(BASE))
    rfm_export.export(LEROBOT, repository, of_lerobot)
    rfm_export.export(ROBO, repository, ExportConfig(name="robo_old", num_gpus=0, reward_model="roboreward"))
    as_before_marks(repository / "robo_old_frames" / "config.pbtxt")
    with start_triton(repository) as server:
        yield Served(server.endpoints)


def case(section: str, name: str) -> Reference:
    return next(each for each in references(section) if each.file.stem == name)


@pytest.mark.parametrize("model", ["top", "baseline"])
def test_topreward_is_answered_as_by_the_engine(asked: Served, protocol: str, model: str) -> None:
    samples = [sample for name in ("T8_48x80", "B2_T4") for sample in case("topreward", name).samples()]
    engine = Engine.of(published.load(str(TOP), reward_model=NAMES[model][1]))
    with asked.client(model, protocol) as client:
        results = client.evaluate(samples, log_prob=True)
        plain, full = client.evaluate(samples), client.evaluate(samples, all_scores=True)
    for result, without, every, expected in zip(results, plain, full, engine.evaluate(samples), strict=True):
        assert isinstance(every, ProgressResult)
        assert isinstance(result, ProgressResult)
        assert isinstance(without, ProgressResult)
        assert isinstance(expected, ProgressResult)
        assert result.log_prob is not None
        np.testing.assert_allclose(result.log_prob, expected.log_prob, rtol=0, atol=2e-5)
        np.testing.assert_allclose(result.progress, expected.progress, rtol=0, atol=1e-4)
        assert without.log_prob is None
        assert every.log_prob is not None
        np.testing.assert_allclose(every.log_prob, expected.log_prob, rtol=0, atol=2e-5)
        assert np.isnan(result.success).all()


def test_remaining_seconds_are_those_of_the_original(asked: Served, protocol: str) -> None:
    told = next(each for each in rynnvalue.CASES if each.checkpoint == RYNN and each.file.stem == "B3_ragged")
    samples = told.asked()
    with asked.client("rynn", protocol) as client:
        results = client.evaluate([each.sample for each in samples])
        (dense,) = client.evaluate([ProgressSample(samples[1].sample.trajectory, 8)])
        info = client.model_info(frames=True)
    assert info.scores == ("remaining_s", "relative_s", "entropy")
    for each, result in zip(samples, results, strict=True):
        assert isinstance(result, ProgressResult)
        seconds = told.expected(each.prefix, "value.pred_value")
        np.testing.assert_allclose(result.remaining_s, seconds, rtol=2e-4, atol=2e-4)
        assert np.isnan(result.progress).all()
        assert np.isnan(result.success).all()
        assert result.relative_s is not None
        assert result.relative_s[0] == 0
        assert result.entropy is not None
        with pytest.raises(ValueError, match="this checkpoint does not predict it"):
            _ = result.last_progress
        shares = result.progress_by("remaining_over_first")
        np.testing.assert_allclose(shares, (1 - seconds / seconds[0]).clip(0, 1), rtol=0, atol=1e-3)
    assert isinstance(dense, ProgressResult)
    assert dense.remaining_s is not None
    assert len(dense.remaining_s) == 3


def test_steps_and_rewards_are_made_of_remaining_seconds(asked: Served) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (4, 48, 80, 3), np.uint8)
    with asked.client("rynn") as client:
        whole = client.progress(Trajectory(frames=frames, task=TASK))
        with client.episode(TASK, score="remaining_s") as episode:
            steps = [episode.add(frame) for frame in frames]
        expected = r"progress: expected a score of each frame, got NaN: .*; score='remaining_s' takes what it predicts"
        with client.episode(TASK) as episode, pytest.raises(ValueError, match=expected):
            episode.add(frames[0])
        batch = {"observation.images.top": frames[np.newaxis].transpose(0, 1, 4, 2, 3), "task": TASK}
        paid = RfmRewardModel(RfmRewardConfig(reward_output="remaining_s"), client).compute_reward(batch)
        with pytest.raises(ValueError, match=r"^reward_output: expected remaining_s, got progress, which the check"):
            RfmRewardModel(RfmRewardConfig(), client).compute_reward(batch)
        options = RewardOptions(mode="shaping", gamma=1.0, score="remaining_s", max_frames=4)
        with RewardModelWrapper(cart_pole(max_episode_steps=3), client, TASK, options) as env:
            rewards, infos = play(env)
    np.testing.assert_allclose(
        [step.more_scores["remaining_s"] for step in steps], whole.remaining_s, rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(paid, [-steps[-1].more_scores["remaining_s"]], rtol=1e-4, atol=1e-4)
    assert all(np.isnan(step.progress) and not step.succeeded for step in steps)
    seconds = [info["reward_model"]["remaining_s"] for info in infos]
    assert np.isfinite(seconds).all()
    np.testing.assert_allclose(rewards, -np.diff(seconds), rtol=0, atol=1e-4)


def test_the_gateway_answers_as_rynnvalue_s_server(asked: Served, tmp_path: Path) -> None:
    told = next(each for each in rynnvalue.CASES if each.checkpoint == RYNN and each.file.stem == "steps_B2_T10_T3")
    samples = [
        {
            "sample_type": "progress",
            "trajectory": {
                "task": each.sample.trajectory.task,
                "frames": each.sample.trajectory.positions.tolist(),
            },
        }
        for each in told.asked()
    ]
    with running(asked.endpoints, tmp_path, "rynn") as gateway:
        url = f"{gateway.url}/evaluate_batch"
        answer = requests.post(url, json={"samples": samples, "use_frame_steps": True}, timeout=60).json()
    for each, values in zip(told.asked(), answer["outputs_progress"]["progress_pred"], strict=True):
        (expected,) = each.engine.evaluate([each.sample])
        assert isinstance(expected, ProgressResult)
        assert expected.remaining_s is not None
        np.testing.assert_allclose(values, -expected.remaining_s, rtol=1e-4, atol=1e-4)
    assert "outputs_success" not in answer


def test_lerobot_s_robometer_is_answered_as_by_lerobot(asked: Served) -> None:
    told = next(each for each in references("lerobot_robometer") if each.config == LEROBOT.parent)
    with asked.client("lerobot") as client:
        results = client.evaluate(told.samples(told.content.get("cropped_to_last")))
    for result, progress in zip(results, told.content["decoded"]["progress_pred"], strict=True):
        assert isinstance(result, ProgressResult)
        np.testing.assert_allclose(result.progress, progress, rtol=0, atol=2e-5)


def test_roboreward_is_answered_as_by_the_original(asked: Served, protocol: str) -> None:
    told = case("roboreward", "batch_B3")
    with asked.client("robo", protocol) as client:
        results = client.evaluate(told.samples(), logits=True)
    for result, progress, text in zip(
        results, told.content["compute_progress"], told.content["generations"], strict=True
    ):
        assert isinstance(result, ProgressResult)
        assert result.progress_logits is not None
        np.testing.assert_array_equal(result.progress, np.float32(progress))
        np.testing.assert_allclose(result.progress_logits[0], text["digit_logits_at_answer"], rtol=0, atol=0.3)


def test_an_answer_without_a_score_fails_alone(asked: Served) -> None:
    samples = [*case("roboreward", "unparsable_T3").samples(), *case("roboreward", "score5_T4").samples()]
    with asked.client("robo") as client:
        failed, result = client.evaluate(samples, return_errors=True)
    assert isinstance(failed, InvalidSampleError)
    assert "answer: expected a score from 1 to 5 in the model's answer, got 'no idea'" in str(failed)
    assert isinstance(result, ProgressResult)
    assert result.last_progress == 1.0


UNCLEAR, CLEAR = "fallback_digits_T2", "score5_T4"  # answers: 'Score 2 of 5', 'ANSWER: 5'
SAID = "2 of 2 frames: the model's written answer states no single whole score"


def test_unclear_answers_are_marked(asked: Served) -> None:
    unclear, clear = (case("roboreward", name).samples()[0] for name in (UNCLEAR, CLEAR))
    with asked.client("robo") as client:
        first = client.progress(unclear.trajectory)
        results = client.evaluate([unclear, clear])
        marks = [each.unclear if each.unclear is None else each.unclear.tolist() for each in (first, *results)]
        assert marks == [[True] * 2, [True] * 2, [False] * 4]
        assert "unclear" in client.model_info(frames=True).scores
    assert first.last_progress == 1.0


class Newer(Connection):
    """Claims marks that the server's export lacks, like a description from before a rollback."""

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        info = await super().model_info(model, timeout_s)
        return replace(info, more_scores=(*info.more_scores, "unclear"))


def test_a_client_goes_on_when_an_older_export_takes_the_place_of_a_newer(asked: Served) -> None:
    (sample,) = case("roboreward", UNCLEAR).samples()
    newer = Newer(asked.endpoints.grpc_url)
    with RewardClient("", transports=[newer], model="robo_old") as client:
        result = client.progress(sample.trajectory)
        with client.episode(sample.trajectory.task, sampling="all") as episode:
            steps = [episode.add(frame) for frame in sample.trajectory.positions]
    assert (result.last_progress, result.unclear) == (1.0, None)
    assert (steps[-1].progress, steps[-1].unclear) == (1.0, False)


def test_a_step_tells_that_its_answer_is_unclear(asked: Served) -> None:
    (sample,) = case("roboreward", UNCLEAR).samples()
    with (
        asked.client("robo") as client,
        client.episode(sample.trajectory.task, sampling="all") as episode,
        client.episodes(2, sample.trajectory.task, sampling="all") as episodes,
    ):
        steps = [episode.add(frame) for frame in sample.trajectory.positions]
        for frame in sample.trajectory.positions:
            scores = episodes.add([frame, frame])
    assert steps[-1].unclear
    assert scores.unclear.tolist() == [True, True]


def test_unclear_answers_are_counted_by_a_metric(asked: Served) -> None:
    (sample,) = case("roboreward", UNCLEAR).samples()

    def count() -> float:
        return metric_at(asked.endpoints.metrics_url, "rfm_unclear_answers_total", model="robo_frames")

    with asked.client("robo") as client:
        client.progress(sample.trajectory)
        poll(lambda: count() > 0)
        before = count()
        client.progress(sample.trajectory)
    poll(lambda: count() > before)


def test_score_says_how_many_answers_are_unclear(asked: Served, tmp_path: Path) -> None:
    files = []
    for name in (UNCLEAR, CLEAR):
        sample = case("roboreward", name).samples()[0]
        files.append(tmp_path / f"{name}.npy")
        np.save(files[-1], sample.trajectory.positions)
        task = sample.trajectory.task
    words = [*files, "--task", task, "--url", asked.endpoints.grpc_url, "--model", "robo"]
    done = rfm_client("score", *words, "--json", str(tmp_path / "scores.json"))
    assert done.exit_code == 0, done.output
    told = [video["unclear"] for video in json.loads((tmp_path / "scores.json").read_text())["videos"]]
    lines = " ".join(done.stderr.split())
    assert told[0] == [True, True]
    assert f"note: {files[0]}: {SAID}" in lines
    assert lines.count("no single whole score") == sum(map(any, told))


def test_labels_mark_unclear_answers(asked: Served, tmp_path: Path) -> None:
    (sample,) = case("roboreward", UNCLEAR).samples()
    data = tmp_path / "data"
    data.mkdir()
    for name in ("a", "b"):
        np.save(data / f"{name}.npy", sample.trajectory.positions)
    words = ["label", data, "--task", sample.trajectory.task, "--url", asked.endpoints.grpc_url, "--model", "robo"]
    words += ["--sampling", "all", "--no-picture"]
    done = rfm_client(*words)
    assert done.exit_code == 0, done.output + done.stderr
    marks = parquet.read_table(data / "rfm_progress.parquet")["unclear"].to_numpy()
    assert marks.tolist()[1::2] == [1.0, 1.0]
    assert f"{int(marks.sum())} of 4 frames: the model's written answer" in " ".join(done.stderr.split())
    signals = parquet.read_table(data / "reward_signals" / "rfm.parquet")
    np.testing.assert_array_equal(signals["reward.rfm.unclear"].to_numpy(), marks)
    shutil.rmtree(data / ".rfm_parts")  # restored from the file, with all columns
    np.save(data / "c.npy", sample.trajectory.positions)
    again = rfm_client(*words)
    assert again.exit_code == 0, again.output + again.stderr
    assert len(parquet.read_table(data / "rfm_progress.parquet")["unclear"]) == 6


def test_labels_of_seconds_name_the_rule_that_makes_progress(asked: Served, tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    frames = np.random.default_rng(1).integers(0, 256, (5, 48, 80, 3), np.uint8)
    np.save(data / "a.npy", frames)
    words = ["label", data, "--task", TASK, "--url", asked.endpoints.grpc_url, "--model", "rynn", "--no-picture"]
    words += ["--name", "rynnvalue"]
    refused = rfm_client(*words)
    assert refused.exit_code != 0
    told = " ".join((refused.output + refused.stderr).split())
    assert "predicts remaining seconds and no progress, got none; give --progress-rule remaining_over_first" in told
    done = rfm_client(*words, "--progress-rule", "remaining_over_first")
    assert done.exit_code == 0, done.output + done.stderr
    with asked.client("rynn") as client:
        expected = client.progress(Trajectory(frames=frames, task=TASK))
    assert expected.remaining_s is not None
    signals = parquet.read_table(data / "reward_signals" / "rynnvalue.parquet")
    seconds = signals["reward.rynnvalue.remaining_time_s"].to_numpy()
    np.testing.assert_allclose(seconds, expected.remaining_s, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(signals["reward.rynnvalue.potential"].to_numpy(), -seconds)
    assert signals["reward.rynnvalue.is_inference_frame"].to_pylist() == [1] * 5
    progress = signals["reward.rynnvalue.progress"].to_numpy()
    np.testing.assert_allclose(progress, expected.progress_by("remaining_over_first"), rtol=0, atol=1e-3)
    provenance = json.loads(signals.schema.metadata[b"lerobot.reward_scoring.provenance"])
    assert "remaining_over_first" in json.dumps(provenance)
    again = rfm_client(*words, "--progress-rule", "remaining_over_first")
    assert again.exit_code == 0, again.output + again.stderr


def test_the_description_tells_what_is_given(asked: Served) -> None:
    infos = {}
    for name in (*NAMES, "rynn"):
        with asked.client(name) as client:
            infos[name] = client.model_info(frames=True)
    assert infos["rynn"].kind == "RynnValue"
    assert not infos["rynn"].has_progress
    assert infos["top"].kind == "TOPReward, as LeRobot computes it"
    assert infos["robo"].kind == "RoboReward"
    assert {name: info.needs_whole_episode for name, info in infos.items()} == {
        "top": True, "baseline": True, "robo": False, "rynn": False,
    }  # fmt: skip
    assert infos["top"].scores == ("progress", "log_prob")
    assert infos["robo"].scores == ("progress", "progress_logits", "unclear")
    assert infos["robo"].progress_bins == 5
    assert infos["baseline"].max_frames == 64
    assert infos["top"].lacks == ("preference", "similarity", "success")


def test_a_model_for_frames_alone_says_how_to_ask_for_its_description(asked: Served) -> None:
    remedy = r"give frames, and ask model_info\(frames=True\)$"
    with asked.client("robo") as client, pytest.raises(ModelNotFoundError, match=remedy):
        client.model_info()


def test_what_has_no_meaning_is_refused_by_name(asked: Served) -> None:
    frames = np.zeros((3, 64, 96, 3), np.uint8)
    trajectory = Trajectory(frames=frames, task=TASK)
    with asked.client("top") as client:
        dense, preference = client.evaluate(
            [ProgressSample(trajectory, frame_steps=2), PreferenceSample(trajectory, trajectory)], return_errors=True
        )
        with (
            pytest.raises(InvalidSampleError, match="relative to the whole episode: score it at its end"),
            client.episode(TASK) as episode,
        ):
            episode.add(frames[0])
    assert "frame_steps: expected 0 (TOPReward's progress" in str(dense)
    assert "this checkpoint has no preference head" in str(preference)


def test_roboreward_scores_an_episode_step_by_step(asked: Served) -> None:
    told = case("roboreward", "steps_T4_T1")
    frames = told.samples()[0].trajectory.positions
    with asked.client("robo") as client, client.episode(told.samples()[0].trajectory.task, sampling="all") as episode:
        steps = [episode.add(frame).progress for frame in frames]
    assert steps == told.content["response"]["outputs_progress"]["progress_pred"][0]


def test_the_gateway_answers_as_robometer_s_baseline_server(asked: Served, tmp_path: Path) -> None:
    with running(asked.endpoints, tmp_path, "robo") as gateway:
        for name in ("batch_B3", "steps_T4_T1"):
            told = case("roboreward", name)
            samples = [
                {
                    "sample_type": "progress",
                    "trajectory": {
                        "task": sample.trajectory.task,
                        "frames": sample.trajectory.positions.tolist(),
                    },
                }
                for sample in told.samples()
            ]
            body = {"samples": samples, "use_frame_steps": told.content["use_frame_steps"]}
            answer = requests.post(f"{gateway.url}/evaluate_batch", json=body, timeout=60).json()
            assert answer["outputs_progress"] == told.content["response"]["outputs_progress"]
            assert answer["outputs_preference"] is None
            assert "outputs_success" not in answer


def test_the_page_shows_the_whole_episode_s_curve(asked: Served, tmp_path: Path) -> None:
    video = VIDEOS / "jaco_play_pick_up_green_cup.mp4"
    words = [video, "--task", TASK, "--url", asked.endpoints.grpc_url, "--model", "top", "--fps", "0.5"]
    done = rfm_client("score", *words, "--json", str(tmp_path / "scores.json"))
    assert done.exit_code == 0, done.output
    (told,) = json.loads((tmp_path / "scores.json").read_text())["videos"]
    with running(asked.endpoints, tmp_path, "top") as gateway:
        curve = curve_of(events(post(gateway.url, SCORE, {"video": video}, task=TASK, fps=0.5)))
        refused = post(gateway.url, SCORE, {"video": video}, task=TASK, sampling="rint", frames=4)
    np.testing.assert_allclose(curve["progress"], told["progress"], rtol=0, atol=1e-4)
    assert len(told["log_prob"]) == len(told["progress"])
    assert {*curve["success"]} == {None}
    assert refused.status_code == 422
    assert "relative to the whole episode" in refused.text


ROBOT_VIDEO = VIDEOS / "jaco_play_pick_up_green_cup.mp4"


def scored(asked: Served, folder: Path, *more: object) -> tuple[list[float], str]:
    """The remaining seconds of a video by ``rfm-client score``, and what it printed."""
    words = [ROBOT_VIDEO, "--task", TASK, "--url", asked.endpoints.grpc_url, "--model", "rynn", "--fps", "0.5"]
    rule = ["--sampling", "rint_pad", "--frames", "4", "--json", folder / "scores.json"]
    done = rfm_client("score", *words, *rule, *more)
    assert done.exit_code == 0, done.output
    (told,) = json.loads((folder / "scores.json").read_text())["videos"]
    return told["remaining_s"], done.output


def test_tables_and_pictures_show_remaining_seconds(asked: Served, tmp_path: Path) -> None:
    seconds, output = scored(asked, tmp_path, "--plot", tmp_path / "plot.svg", "--strips", tmp_path / "strips.svg")
    (row,) = (line for line in output.splitlines() if ROBOT_VIDEO.name[-10:] in line)
    assert f"{seconds[-1]:.2f} s" in row
    assert "In s, in place of progress: seconds that remain until the task is done." in " ".join(output.split())


def test_the_page_shows_remaining_seconds(asked: Served, tmp_path: Path, quiet_browser: Browser) -> None:
    page, (seconds, _) = quiet_browser, scored(asked, tmp_path)
    with running(asked.endpoints, tmp_path, "rynn") as gateway:
        page.open(gateway.url)
        page.run("document.getElementById('advanced').open = true")
        Select(page["rule"]).select_by_visible_text("rint_pad")
        for name, text in {"tasks": TASK, "fps": "0.5", "frames": "4"}.items():
            page.write(name, text)
        page.drop([ROBOT_VIDEO])
        page.until_text("scored", "1 of 1 scored")
        assert page.cells("#curves tr")[0][5:7] == [f"{seconds[-1]:.1f}", "-"]
        assert page.all("#numbers .leading")[0].text == "Final time remaining (s)"
        assert list(page.values("chart", "remaining_s").values()) == [f"{seconds[0]:.1f}"]
        assert page.values("chart", "progress") == {}
        page["json"].click()
        (shown,) = json.loads(page.saved("curves.json"))["videos"]
        np.testing.assert_allclose(shown["remaining_s"], seconds, rtol=1e-4, atol=1e-4)
        page["csv"].click()
        lines = list(csv.DictReader(io.StringIO(page.saved("curves.csv").decode())))
        assert [line["progress"] for line in lines] == [""] * len(seconds)
        np.testing.assert_allclose([float(line["remaining_s"]) for line in lines], seconds, rtol=1e-4, atol=1e-4)
        page["svg"].click()
        assert "time remaining (s)" in page.saved("curves.svg").decode()
        assert not page["threshold"].is_displayed()


def test_a_dataset_is_labelled_through_the_server(asked: Served, tmp_path: Path) -> None:
    words = [
        "label",
        DATASET,
        "--url",
        asked.endpoints.grpc_url,
        "--model",
        "top",
        "--output",
        tmp_path,
        "--no-picture",
    ]
    refused = rfm_client(*words)
    assert refused.exit_code != 0
    expected = "whole of this model, whose scores are relative to the whole episode, got prefix; give --mode whole"
    assert f"mode: expected {expected}" in refused.output + refused.stderr
    unknown = rfm_client(*["robo" if word == "top" else str(word) for word in words])
    assert unknown.exit_code != 0
    assert "name them (--frames), or show all (--sampling all)" in " ".join((unknown.output + unknown.stderr).split())
    done = rfm_client(*words, "--mode", "whole")
    assert done.exit_code == 0, done.output
    labels = parquet.read_table(tmp_path / "rfm_progress.parquet")
    expected = parquet.read_table(ROOT / "lerobot_rabc" / "topreward_progress.parquet")
    np.testing.assert_allclose(
        labels["progress_sparse"].to_numpy(), expected["progress_sparse"].to_numpy(), rtol=0, atol=2e-5
    )
    assert np.isfinite(labels["log_prob"].to_numpy()).all()
