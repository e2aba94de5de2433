# SPDX-License-Identifier: MIT
"""Robo-Dopamine behind Triton: both protocols, the gateway, the command line and labels."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import requests
from PIL import Image
from pyarrow import parquet

import rfm_export
from encoding import encode_here
from faulty_servers import url_of
from gateways import metric_at, poll, running
from in_process import rfm_client
from reward_models import ROOT
from rfm.config import ExportConfig
from rfm_client import InvalidSampleError, ProgressResult, RewardClient, Trajectory
from robodopamine import CHECKPOINT, case_named
from servers import Endpoints, start_triton
from viewer_requests import SCORE, SERVED, events, post

pytestmark = pytest.mark.triton

FORWARD = ("forward_T5", "forward_T4_odd_size", "baseline_T3_forward")
ROBOREWARD = ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint"


@pytest.fixture(scope="module")
def endpoints(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Endpoints]:
    repository = tmp_path_factory.mktemp("robodopamine") / "model_repository"
    for name, checkpoint, said in (
        ("forward", CHECKPOINT, "robodopamine,mode=forward"),
        ("steps", CHECKPOINT, "robodopamine,mode=incremental"),
        ("robo", ROBOREWARD, "roboreward"),
    ):
        rfm_export.export(checkpoint, repository, ExportConfig(name=name, num_gpus=0, reward_model=said))
    with start_triton(repository) as server:
        yield server.endpoints


def test_samples_with_and_without_views_are_answered_as_by_the_engine(endpoints: Endpoints, protocol: str) -> None:
    samples = [case_named(name).sample for name in FORWARD]
    with RewardClient(url_of(endpoints, protocol), model="forward") as client:
        together, alone = client.evaluate(samples), [client.progress(each.trajectory) for each in samples]
        info = client.model_info(frames=True)
    assert (info.kind, info.scores, info.reads_views) == ("Robo-Dopamine, forward", ("progress", "hop"), True)
    for expected, *results in zip(case_named(FORWARD[0]).engine().evaluate(samples), together, alone, strict=True):
        assert isinstance(expected, ProgressResult), expected
        for result in results:
            assert isinstance(result, ProgressResult), result
            np.testing.assert_array_equal(result.progress, expected.progress)
            np.testing.assert_array_equal(result.hop, expected.hop)
            assert result.is_answered.tolist() == [False, *[True] * (len(result.progress) - 1)]
            assert result.last_progress == expected.progress[-1]
            with pytest.raises(
                ValueError, match=r"progress: expected a score of each frame, got NaN: the model answered"
            ):
                _ = result.progress_deltas


def test_an_answer_without_a_score_is_an_error_and_counted(endpoints: Endpoints) -> None:
    def unreadable() -> float:
        return metric_at(endpoints.metrics_url, "rfm_unreadable_answers_total", model="steps_frames")

    before, case = unreadable(), case_named("incremental_T4_one_view")
    with RewardClient(endpoints.grpc_url, model="steps") as client, pytest.raises(InvalidSampleError) as error:
        client.progress(case.sample.trajectory)
    assert error.value.got == "'no score'"
    poll(lambda: unreadable() == before + 1)


def test_what_cannot_be_compared_is_refused_by_name(endpoints: Endpoints) -> None:
    frames = np.zeros((3, 32, 32, 3), np.uint8)
    views = Trajectory(frames=frames, task="t", views=(frames, frames), goal=frames[0])
    expected = "expected a model that reads views and a goal"
    with (
        RewardClient(endpoints.grpc_url, model="robo") as client,
        pytest.raises(InvalidSampleError, match=expected),
    ):
        client.progress(views)
    with RewardClient(endpoints.grpc_url, model="forward") as client:
        with pytest.raises(InvalidSampleError, match="num_frames: expected at least 2"):
            client.progress(Trajectory(frames=frames[:1], task="t"))
        with pytest.raises(InvalidSampleError, match="frame_steps: expected 0"):
            client.progress(Trajectory(frames=frames, task="t"), frame_steps=2)


def test_the_gateway_and_the_page_answer_null_at_frames_without_an_answer(endpoints: Endpoints, tmp_path: Path) -> None:
    case = case_named("baseline_T3_forward")
    video = tmp_path / "video.mp4"
    encode_here(video, case.sample.trajectory.positions, "libx264rgb", {"qp": "0"}, pixels="rgb24")
    (expected,) = case.engine().evaluate([case.sample])
    assert isinstance(expected, ProgressResult)
    trajectory = {"task": case.sample.trajectory.task, "frames": case.sample.trajectory.positions.tolist()}
    body = {"samples": [{"sample_type": "progress", "trajectory": trajectory}]}
    with running(endpoints, tmp_path, "forward") as gateway:
        answer = requests.post(f"{gateway.url}/evaluate_batch", json=body, timeout=60).json()
        served = requests.get(f"{gateway.url}/{SERVED}", timeout=60).json()["models"]
        _, (_, points), _ = events(post(gateway.url, SCORE, {"video": video}, task=trajectory["task"], fps="10"))
    about = next(model for model in served if model["name"] == "forward")
    assert (about["rule"], about["reads_views"]) == ("all", True)
    assert (points["progress"][0], points["answered"]) == (None, [False, True, True])
    np.testing.assert_allclose(points["progress"][1:], expected.progress[1:], rtol=0, atol=1e-6)
    (values,) = answer["outputs_progress"]["progress_pred"]
    assert values[0] is None
    np.testing.assert_allclose(values[1:], expected.progress[1:], rtol=0, atol=1e-6)


def test_the_command_line_writes_null_at_frames_without_an_answer(endpoints: Endpoints, tmp_path: Path) -> None:
    case, file = case_named("baseline_T3_forward"), tmp_path / "frames.npy"
    np.save(file, case.sample.trajectory.positions)
    words = [str(file), "--task", case.sample.trajectory.task, "--url", endpoints.grpc_url, "--model", "forward"]
    written = tmp_path / "scores.json"
    done = rfm_client("score", *words, "--json", str(written), "--plot", str(tmp_path / "plot.png"))
    assert done.exit_code == 0, done.output + done.stderr
    (told,) = json.loads(written.read_text())["videos"]
    assert told["progress"][0] is None
    assert told["hop"][0] is None
    assert len(told["progress"]) == 3


def test_the_command_line_sends_views_and_a_goal_and_only_where_they_are_read(
    endpoints: Endpoints, tmp_path: Path
) -> None:
    case = case_named("forward_T5")
    given, (expected,) = case.sample.trajectory, case.engine().evaluate([case.sample])
    files = {name: tmp_path / f"{name}.npy" for name in ("front", "left", "right")}
    for file, frames in zip(files.values(), (given.positions, *given.views), strict=True):
        np.save(file, frames)
    assert given.goal is not None
    Image.fromarray(given.goal).save(tmp_path / "goal.png")
    words = ["score", files["front"], "--task", given.task, "--url", endpoints.grpc_url]
    views = ["--view", files["left"], "--view", files["right"]]
    done = rfm_client(*words, "--model", "forward", *views, "--goal", tmp_path / "goal.png", "--json", "-")
    assert done.exit_code == 0, done.output + done.stderr
    assert isinstance(expected, ProgressResult)
    told = json.loads(done.stdout)
    assert told["videos"][0]["progress"][1:] == expected.progress[1:].tolist()
    assert told["views"] == [str(files["left"]), str(files["right"])]
    for wrong, fault in (
        (["--view", files["left"]], "--view: expected none with this model, which reads one camera and no goal"),
        ([files["left"], *views], "'--view': expected a single VIDEO, of which they are views, got 2"),
    ):
        refused = rfm_client(*words, "--model", "robo", *wrong)
        assert refused.exit_code != 0
        assert fault in " ".join((refused.output + refused.stderr).replace("│", "").split())


def test_labels_are_nan_at_frames_without_an_answer(endpoints: Endpoints, tmp_path: Path) -> None:
    case, data = case_named("baseline_T3_forward"), tmp_path / "data"
    data.mkdir()
    np.save(data / "a.npy", case.sample.trajectory.positions)
    words = ["label", data, "--task", case.sample.trajectory.task, "--url", endpoints.grpc_url, "--model", "forward"]
    words += ["--mode", "whole", "--name", "grm"]
    (expected,) = case.engine().evaluate([case.sample])
    assert isinstance(expected, ProgressResult)
    done = rfm_client(*words)
    assert done.exit_code == 0, done.output + done.stderr
    shutil.rmtree(data / ".grm_parts")  # restored from the file
    np.save(data / "b.npy", case.sample.trajectory.positions)
    again = rfm_client(*words)
    assert again.exit_code == 0, again.output + again.stderr
    signals = parquet.read_table(data / "reward_signals" / "grm.parquet")
    for column, values in (("progress", expected.progress), ("hop", expected.hop)):
        np.testing.assert_array_equal(signals[f"reward.grm.{column}"].to_numpy(), np.tile(values, 2))
    assert signals["reward.grm.is_inference_frame"].to_pylist() == [0, 1, 1] * 2
