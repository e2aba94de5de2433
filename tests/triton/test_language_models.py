# SPDX-License-Identifier: MIT
"""Vision-language reward models behind a server: the gateway, the page, the command line, steps and labels.

A server in this process stands in for Triton, which is compared with it at night. tests/families compares each model
with the original code in more settings.
"""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pyarrow import parquet
from selenium.webdriver.support.select import Select

import fake_lerobot
import rfm_export
import robodopamine
import rynnvalue
from browsers import Browser
from encoding import encode_here
from engine_server import EngineServer
from environments import cart_pole, play
from gateways import TestClient, inside, running
from in_process import rfm_client
from paths import VIDEOS
from reward_models import ROOT, Reference, references
from rfm import published
from rfm.config import ExportConfig
from rfm.engine import Engine, Outcome
from rfm_client import (
    InvalidSampleError,
    ModelNotFoundError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardClient,
    Trajectory,
)
from rfm_rl import RewardModelWrapper, RewardOptions
from robodopamine import case_named
from servers import Endpoints, start_triton
from viewer_requests import SCORE, SERVED, events

fake_lerobot.provide()

from lerobot_reward_rfm import RfmRewardConfig, RfmRewardModel  # noqa: E402

pytestmark = pytest.mark.slow

TOP, ROBO = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied", ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint"
RYNN = ROOT / "rynnvalue" / "bro_symlog_bf16_tied" / "checkpoint"
DATASET = ROOT / "lerobot_rabc" / "home" / "golden" / "tiny_shared"
MODELS: dict[str, tuple[Path, dict[str, Any]]] = {
    "top": (TOP, {"reward_model": "topreward"}),
    "robo": (ROBO, {"reward_model": "roboreward"}),
    "rynn": (RYNN, rynnvalue.said(rynnvalue.USUAL)),
    "forward": (robodopamine.CHECKPOINT, {"reward_model": "robodopamine,mode=forward"}),
}
TASK = "put the red block in the bowl"
UNCLEAR, CLEAR = "fallback_digits_T2", "score5_T4"  # answers: 'Score 2 of 5', 'ANSWER: 5'
VIDEO = VIDEOS / "jaco_play_pick_up_green_cup.mp4"


@dataclass(frozen=True)
class Served:
    url: str

    def client(self, model: str) -> RewardClient:
        return RewardClient(self.url, model=model)

    def gateway(self, model: str) -> Any:
        """A gateway for the model, inside this process."""
        return inside(triton=self.url, model=model)

    def command(self, *words: object, model: str, fails: bool = False) -> str:
        """Run a command of ``rfm-client``. Return what it printed, in one line."""
        done = rfm_client(*words, "--url", self.url, "--model", model)
        assert (done.exit_code != 0) is fails, done.output + done.stderr
        return " ".join((done.stdout + done.stderr).replace("│", "").split())


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with EngineServer(tmp_path_factory.mktemp("language_models")) as server:
        for name, (checkpoint, settings) in MODELS.items():
            server.add(checkpoint, ExportConfig(name=name, num_gpus=0, **settings))
        yield Served(server.url)


def samples_of(name: str) -> list[ProgressSample]:
    """Return samples of reference cases for a model: of different lengths, with and without views, dense or not."""
    if name == "rynn":
        asked = rynnvalue_case("B3_ragged").asked()
        return [*(each.sample for each in asked), ProgressSample(asked[1].sample.trajectory, 8)]
    if name == "forward":
        return [case_named(each).sample for each in ("forward_T5", "forward_T4_odd_size", "baseline_T3_forward")]
    names = {"top": ("T8_48x80", "B2_T4"), "robo": ("batch_B3", UNCLEAR, CLEAR)}[name]
    section = MODELS[name][1]["reward_model"]
    return [sample for each in names for sample in case(section, each).samples()]


def assert_equal_scores(got: Outcome, expected: Outcome) -> None:
    assert isinstance(got, ProgressResult), got
    assert isinstance(expected, ProgressResult), expected
    assert got.arrays.keys() == expected.arrays.keys()
    for name, array in expected.arrays.items():
        np.testing.assert_allclose(got.arrays[name], array, rtol=1e-4, atol=1e-4, err_msg=name)


@pytest.mark.parametrize("name", MODELS)
def test_a_server_answers_as_the_engine_does(asked: Served, name: str) -> None:
    checkpoint, settings = MODELS[name]
    samples, engine = samples_of(name), Engine.of(published.load(checkpoint, **settings))
    with asked.client(name) as client:
        together, alone = (client.evaluate(each, logits=name == "robo") for each in (samples, samples[:1]))
    expected = engine.evaluate(samples)
    for outcome, wanted in zip((*together, *alone), (*expected, expected[0]), strict=True):
        assert_equal_scores(outcome, wanted)


@pytest.mark.nightly
@pytest.mark.triton
def test_triton_answers_the_same(asked: Served, tmp_path: Path) -> None:
    repository = tmp_path / "model_repository"
    for name, (checkpoint, settings) in MODELS.items():
        rfm_export.export(checkpoint, repository, ExportConfig(name=name, num_gpus=0, **settings))
    with start_triton(repository) as server:
        for url in (server.endpoints.grpc_url, server.endpoints.http_url):
            for name in MODELS:
                with asked.client(name) as here, RewardClient(url, model=name) as client:
                    expected, got = (each.evaluate(samples_of(name)) for each in (here, client))
                    assert client.model_info(frames=True) == here.model_info(frames=True)
                for left, right in zip(expected, got, strict=True):
                    assert_equal_scores(right, left)


def case(section: str, name: str) -> Reference:
    return next(each for each in references(section) if each.file.stem == name)


def rynnvalue_case(name: str) -> Any:
    return next(each for each in rynnvalue.CASES if each.checkpoint == RYNN and each.file.stem == name)


def body(samples: list[ProgressSample], **more: bool) -> dict[str, Any]:
    """A request to the gateway."""
    told = [{"task": sample.trajectory.task, "frames": sample.trajectory.positions.tolist()} for sample in samples]
    return {"samples": [{"sample_type": "progress", "trajectory": each} for each in told], **more}


def test_deltas_over_unanswered_frames_are_an_error(asked: Served) -> None:
    with asked.client("forward") as client:
        skipping = client.progress(samples_of("forward")[0].trajectory)
    assert skipping.is_answered.tolist() == [False, *[True] * (len(skipping.progress) - 1)]
    with pytest.raises(ValueError, match=r"progress: expected a score of each frame, got NaN: the model answered"):
        _ = skipping.progress_deltas


def test_steps_of_an_episode_are_those_of_the_original(asked: Served) -> None:
    told = case("roboreward", "steps_T4_T1")
    task, frames = told.samples()[0].trajectory.task, told.samples()[0].trajectory.positions
    with asked.client("robo") as client, client.episode(task, sampling="all") as episode:
        steps = [episode.add(frame).progress for frame in frames]
    assert steps == told.content["response"]["outputs_progress"]["progress_pred"][0]


def test_an_answer_without_a_score_fails_alone_and_unclear_answers_are_marked(asked: Served) -> None:
    samples = [case("roboreward", name).samples()[0] for name in ("unparsable_T3", UNCLEAR, CLEAR)]
    with asked.client("robo") as client:
        failed, *results = client.evaluate(samples, return_errors=True)
    assert isinstance(failed, InvalidSampleError)
    assert "answer: expected a score from 1 to 5 in the model's answer, got 'no idea'" in str(failed)
    assert [each.unclear.tolist() for each in results] == [[True] * 2, [False] * 4]  # type: ignore[union-attr]


def test_the_description_lists_the_scores_and_needs_of_each_model(asked: Served) -> None:
    infos = {}
    for name in MODELS:
        with asked.client(name) as client:
            infos[name] = client.model_info(frames=True)
            remedy = r"give frames, and ask model_info\(frames=True\)$"
            with pytest.raises(ModelNotFoundError, match=remedy):
                client.model_info()
    assert {name: info.kind for name, info in infos.items()} == {
        "top": "TOPReward, as LeRobot computes it", "robo": "RoboReward", "rynn": "RynnValue",
        "forward": "Robo-Dopamine, forward",
    }  # fmt: skip
    assert {name: info.scores for name, info in infos.items()} == {
        "top": ("progress", "log_prob"),
        "robo": ("progress", "progress_logits", "unclear"),
        "rynn": ("remaining_s", "relative_s", "entropy"),
        "forward": ("progress", "hop"),
    }
    assert [name for name, info in infos.items() if info.needs_whole_episode] == ["top", "forward"]
    assert [name for name, info in infos.items() if info.reads_views] == ["forward"]
    assert [name for name, info in infos.items() if not info.has_progress] == ["rynn"]
    assert infos["robo"].progress_bins == 5
    assert infos["top"].lacks == ("preference", "similarity", "success")


def test_samples_and_options_without_meaning_for_a_model_are_refused_by_name(asked: Served) -> None:
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
    views = Trajectory(frames=frames, task=TASK, views=(frames, frames), goal=frames[0])
    expected = "expected a model that reads views and a goal"
    with asked.client("robo") as client, pytest.raises(InvalidSampleError, match=expected):
        client.progress(views)
    with asked.client("forward") as client:
        with pytest.raises(InvalidSampleError, match="num_frames: expected at least 2"):
            client.progress(Trajectory(frames=frames[:1], task="t"))
        with pytest.raises(InvalidSampleError, match="frame_steps: expected 0"):
            client.progress(trajectory, frame_steps=2)


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


def test_the_gateway_answers_as_the_servers_of_the_originals(asked: Served) -> None:
    told = rynnvalue_case("steps_B2_T10_T3")
    with asked.gateway("rynn") as gateway:
        request = body([each.sample for each in told.asked()], use_frame_steps=True)
        answer = gateway.post("/evaluate_batch", json=request).json()
    for each, values in zip(told.asked(), answer["outputs_progress"]["progress_pred"], strict=True):
        (expected,) = each.engine.evaluate([each.sample])
        assert isinstance(expected, ProgressResult)
        assert expected.remaining_s is not None
        np.testing.assert_allclose(values, -expected.remaining_s, rtol=1e-4, atol=1e-4)
    assert "outputs_success" not in answer
    with asked.gateway("robo") as gateway:
        for name in ("batch_B3", "steps_T4_T1"):
            told = case("roboreward", name)
            request = body(told.samples(), use_frame_steps=told.content["use_frame_steps"])
            answer = gateway.post("/evaluate_batch", json=request).json()
            assert answer["outputs_progress"] == told.content["response"]["outputs_progress"]
            assert answer["outputs_preference"] is None
            assert "outputs_success" not in answer


def test_the_gateway_and_the_page_answer_null_at_frames_without_an_answer(asked: Served, tmp_path: Path) -> None:
    case, video = case_named("baseline_T3_forward"), tmp_path / "video.mp4"

    def by_page(gateway: TestClient, video: Path, **fields: object) -> Any:
        given = {"task": case.sample.trajectory.task, **fields}
        return gateway.post(f"/{SCORE}", data=given, files={"video": (video.name, video.read_bytes())})

    encode_here(video, case.sample.trajectory.positions, "libx264rgb", {"qp": "0"}, pixels="rgb24")
    (expected,) = case.engine().evaluate([case.sample])
    assert isinstance(expected, ProgressResult)
    with asked.gateway("forward") as gateway:
        answer = gateway.post("/evaluate_batch", json=body([case.sample])).json()
        served = gateway.get(f"/{SERVED}").json()["models"]
        _, (_, points), _ = events(by_page(gateway, video, fps="10"))
        refused = by_page(gateway, video, sampling="rint", frames=4)
    assert (refused.status_code, "relative to the whole episode" in refused.text) == (422, True)
    about = next(model for model in served if model["name"] == "forward")
    assert (about["rule"], about["reads_views"]) == ("all", True)
    assert (points["progress"][0], points["answered"]) == (None, [False, True, True])
    np.testing.assert_allclose(points["progress"][1:], expected.progress[1:], rtol=0, atol=1e-6)
    (values,) = answer["outputs_progress"]["progress_pred"]
    assert values[0] is None
    np.testing.assert_allclose(values[1:], expected.progress[1:], rtol=0, atol=1e-6)


def test_remaining_seconds_are_shown_in_tables_pictures_and_on_the_page(
    asked: Served, tmp_path: Path, quiet_browser: Browser
) -> None:
    rule = ["--fps", "0.5", "--sampling", "rint_pad", "--frames", "4", "--json", tmp_path / "scores.json"]
    pictures = ["--plot", tmp_path / "plot.svg", "--strips", tmp_path / "strips.svg"]
    output = asked.command("score", VIDEO, "--task", TASK, *rule, *pictures, model="rynn")
    (told,) = json.loads((tmp_path / "scores.json").read_text())["videos"]
    seconds, page = told["remaining_s"], quiet_browser
    assert {"remaining", "(s)", f"{seconds[-1]:.2f}"} <= {*output.split()}
    endpoints = Endpoints(grpc_port=int(asked.url.rpartition(":")[2]))
    with running(endpoints, tmp_path, "rynn") as gateway:
        page.open(gateway.url)
        page.run("document.getElementById('advanced').open = true")
        Select(page["rule"]).select_by_visible_text("rint_pad")
        for name, text in {"tasks": TASK, "fps": "0.5", "frames": "4"}.items():
            page.write(name, text)
        page.drop([VIDEO])
        page.until_text("scored", "1 of 1 scored")
        assert page.cells("#curves tr")[0][5:7] == [f"{seconds[-1]:.1f}", "-"]
        assert page.all("#numbers .leading")[0].text == "Final time remaining (s)"
        assert list(page.values("chart", "remaining_s").values()) == [f"{seconds[-1]:.1f}"]
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
        page.driver.get("about:blank")  # the page asks no more before its gateway ends


def test_score_says_how_many_answers_are_unclear(asked: Served, tmp_path: Path) -> None:
    for name in (UNCLEAR, CLEAR):
        trajectory = case("roboreward", name).samples()[0].trajectory
        np.save(tmp_path / f"{name}.npy", trajectory.positions)
    files, scores = [tmp_path / f"{name}.npy" for name in (UNCLEAR, CLEAR)], tmp_path / "scores.json"
    lines = asked.command("score", *files, "--task", trajectory.task, "--json", scores, model="robo")
    told = [video["unclear"] for video in json.loads(scores.read_text())["videos"]]
    assert told[0] == [True, True]
    said = "2 of 2 frames: the model's written answer states no single whole score"
    assert f"note: {files[0]}: {said}" in lines
    assert lines.count("no single whole score") == sum(map(any, told))


def test_the_command_line_sends_views_and_a_goal_and_only_where_they_are_read(asked: Served, tmp_path: Path) -> None:
    case = case_named("forward_T5")
    given, (expected,) = case.sample.trajectory, case.engine().evaluate([case.sample])
    files = {name: tmp_path / f"{name}.npy" for name in ("front", "left", "right")}
    for file, frames in zip(files.values(), (given.positions, *given.views), strict=True):
        np.save(file, frames)
    assert given.goal is not None
    Image.fromarray(given.goal).save(tmp_path / "goal.png")
    words = ["score", files["front"], "--task", given.task]
    views = ["--view", files["left"], "--view", files["right"]]
    more = ["--goal", tmp_path / "goal.png", "--json", tmp_path / "scores.json", "--plot", tmp_path / "plot.png"]
    asked.command(*words, *views, *more, model="forward")
    assert isinstance(expected, ProgressResult)
    told = json.loads((tmp_path / "scores.json").read_text())
    assert told["videos"][0]["progress"] == [None, *expected.progress[1:].tolist()]
    assert told["videos"][0]["hop"][0] is None
    assert told["views"] == [str(files["left"]), str(files["right"])]
    for wrong, fault in (
        (["--view", files["left"]], "--view: expected none with this model, which reads one camera and no goal"),
        ([files["left"], *views], "'--view': expected a single VIDEO, of which they are views, got 2"),
    ):
        assert fault in asked.command(*words, *wrong, model="robo", fails=True)


READER = """
import numpy as np
from rfm_labels import Episode

def episodes(folder):
    for file in sorted(folder.glob("*.npy")):
        yield Episode(file.stem, {"front": np.load(file)})
"""


def reader(folder: Path) -> str:
    """Return the name of a reader for the arrays in the folder."""
    (folder / "arrays.py").write_text(READER)
    return f"{folder / 'arrays.py'}:episodes"


def labelled(asked: Served, folder: Path, sample: ProgressSample, model: str, *words: object) -> Any:
    """Label a folder of two equal videos, the second after the first. Return the columns of the signals."""
    folder.mkdir()
    command = ["label", folder, "--reader", reader(folder), "--task", sample.trajectory.task, "--name", "own", *words]
    np.save(folder / "a.npy", sample.trajectory.positions)
    asked.command(*command, model=model)
    shutil.rmtree(folder / ".own_parts")  # restored from the file, with all columns
    np.save(folder / "b.npy", sample.trajectory.positions)
    asked.command(*command, model=model)
    return parquet.read_table(folder / "reward_signals" / "own.parquet")


def test_labels_mark_unclear_answers(asked: Served, tmp_path: Path) -> None:
    (sample,) = case("roboreward", UNCLEAR).samples()
    signals = labelled(asked, tmp_path / "data", sample, "robo", "--sampling", "all")
    marks = signals["reward.own.unclear"].to_numpy()
    assert marks.tolist()[1::2] == [1.0, 1.0]
    np.testing.assert_array_equal(parquet.read_table(tmp_path / "data" / "own_progress.parquet")["unclear"], marks)


def test_labels_of_seconds_name_the_rule_that_makes_progress(asked: Served, tmp_path: Path) -> None:
    frames = np.random.default_rng(1).integers(0, 256, (5, 48, 80, 3), np.uint8)
    trajectory = Trajectory(frames=frames, task=TASK)
    np.save(tmp_path / "a.npy", frames)
    told = asked.command("label", tmp_path, "--reader", reader(tmp_path), "--task", TASK, model="rynn", fails=True)
    assert "predicts remaining seconds and no progress, got none; give --progress-rule remaining_over_first" in told
    rule = ("--progress-rule", "remaining_over_first")
    signals = labelled(asked, tmp_path / "data", ProgressSample(trajectory), "rynn", *rule)
    with asked.client("rynn") as client:
        expected = client.progress(trajectory)
    assert expected.remaining_s is not None
    seconds = signals["reward.own.remaining_time_s"].to_numpy()
    np.testing.assert_allclose(seconds, np.tile(expected.remaining_s, 2), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(signals["reward.own.potential"].to_numpy(), -seconds)
    assert signals["reward.own.is_inference_frame"].to_pylist() == [1] * 10
    progress = signals["reward.own.progress"].to_numpy()
    expected_progress = np.tile(expected.progress_by("remaining_over_first"), 2)
    np.testing.assert_allclose(progress, expected_progress, rtol=0, atol=1e-3)
    provenance = json.loads(signals.schema.metadata[b"lerobot.reward_scoring.provenance"])
    assert "remaining_over_first" in json.dumps(provenance)


def test_a_dataset_is_labelled_through_the_server(asked: Served, tmp_path: Path) -> None:
    words = ["label", DATASET, "--output", tmp_path]
    expected = "whole of this model, whose scores are relative to the whole episode, got prefix; give --mode whole"
    assert f"mode: expected {expected}" in asked.command(*words, model="top", fails=True)
    unknown = asked.command(*words, model="robo", fails=True)
    assert "name them (--frames), or show all (--sampling all)" in unknown
    asked.command(*words, "--mode", "whole", model="top")
    labels = parquet.read_table(tmp_path / "rfm_progress.parquet")
    original = parquet.read_table(ROOT / "lerobot_rabc" / "topreward_progress.parquet")
    np.testing.assert_allclose(
        labels["progress_sparse"].to_numpy(), original["progress_sparse"].to_numpy(), rtol=0, atol=2e-5
    )
    assert np.isfinite(labels["log_prob"].to_numpy()).all()
