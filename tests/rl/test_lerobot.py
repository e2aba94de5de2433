# SPDX-License-Identifier: MIT
"""The reward model for LeRobot, on a fake of LeRobot's base classes where LeRobot is not installed."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import fake_lerobot
from coded_env import Code, CodeReader, Recorder
from environments import MODEL
from rfm_client import (
    InferenceFailedError,
    InvalidSampleError,
    ProgressResult,
    RewardClient,
    ServerError,
)
from servers import Served

fake_lerobot.provide()

from lerobot_reward_rfm import RfmRewardConfig, RfmRewardModel  # noqa: E402
from lerobot_reward_rfm.modeling_rfm import check_clear  # noqa: E402

KEY, TASK = "observation.images.top", "stack the cups"
PIXELS = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (2, 5, 3, 48, 64), np.uint8))  # [B, T, 3, H, W]
CLOSE = {"atol": 1e-5, "rtol": 0}
FORMS = {
    "uint8": PIXELS,
    "floats": PIXELS / 255,
    "half floats": (PIXELS / 255).half(),
    "channels last": PIXELS.permute(0, 1, 3, 4, 2) / 255,
    "an array": PIXELS.numpy(),
}


@pytest.fixture
def model(client: RewardClient) -> RfmRewardModel:
    """A model that asks the shared Triton."""
    return RfmRewardModel(RfmRewardConfig(sampling="linspace_round", frames=3), client=client)


def stepped(client: RewardClient, images: torch.Tensor, task: str) -> list[float]:
    """The progress of an episode, step by step."""
    with client.episode(task, sampling="linspace_round", frames=3) as episode:
        return [episode.add(image.permute(1, 2, 0).numpy()).progress for image in images]


@pytest.mark.parametrize("form", FORMS)
def test_a_reward_is_the_score_of_the_episode_at_the_newest_frame(
    model: RfmRewardModel, client: RewardClient, form: str
) -> None:
    reward = model.compute_reward({KEY: FORMS[form], "task": [TASK, "open the drawer"]})
    assert reward.dtype == torch.float32
    wanted = [stepped(client, PIXELS[0], TASK)[-1], stepped(client, PIXELS[1], "open the drawer")[-1]]
    torch.testing.assert_close(reward, torch.tensor(wanted), **CLOSE)
    assert wanted[0] != wanted[1]


@pytest.mark.parametrize("repeats", [1, 8], ids=["one call", "more frames than are sent at a time"])
def test_the_scores_of_all_frames_are_those_of_a_running_episode(
    model: RfmRewardModel, client: RewardClient, repeats: int
) -> None:
    images = PIXELS[:, [0, 1, 2, 3, 4] * repeats]
    prediction = model.predict_progress({KEY: images, "task": TASK})
    wanted = torch.tensor([stepped(client, video, TASK) for video in images])
    torch.testing.assert_close(prediction.progress, wanted, **CLOSE)
    assert prediction.success_probability is not None
    assert prediction.success_probability.shape == images.shape[:2]
    singles = model.compute_reward({KEY: images[:, 0], "task": TASK})  # [B, 3, H, W]: one frame each
    torch.testing.assert_close(singles, wanted[:, 0], **CLOSE)


def test_padding_is_not_shown_and_gets_the_score_of_the_frame_that_it_repeats(
    model: RfmRewardModel, recorder: Recorder
) -> None:
    repeated = PIXELS[:, [0, 0, 0, 1, 2]]
    pads = torch.tensor([[True, True, False, False, False]] * 2)
    padded = {KEY: repeated, f"{KEY}_is_pad": pads, "task": TASK}
    real = {KEY: PIXELS[:, :3], "task": TASK}
    torch.testing.assert_close(model.compute_reward(padded), model.compute_reward(real), **CLOSE)
    progress = model.predict_progress(padded).progress
    torch.testing.assert_close(progress, model.predict_progress(real).progress[:, [0, 0, 0, 1, 2]], **CLOSE)
    RfmRewardModel(RfmRewardConfig(sampling="all"), client=recorder).compute_reward(padded)
    assert [len(window) for window in recorder.pixels] == [3, 3]


def test_pixels_arrive_exactly_and_upright(recorder: Recorder) -> None:
    turned = RfmRewardModel(RfmRewardConfig(sampling="all", orient="rotate180"), client=recorder)
    turned.compute_reward({KEY: PIXELS / 255, "task": TASK})
    for window, images in zip(recorder.pixels, PIXELS, strict=True):
        np.testing.assert_array_equal(window, images.permute(0, 2, 3, 1).numpy()[:, ::-1, ::-1])


REFUSED = {
    "normalized": ({KEY: PIXELS / 127.5 - 1, "task": TASK}, r"^sample 0 of the batch: .* got values from -1 to 1"),
    "floats in 0..255": ({KEY: PIXELS.float(), "task": TASK}, "sample 0 .* got values from 0 to 255"),
    "grey": ({KEY: PIXELS[:, :, :1], "task": TASK}, r"got uint8 \[5, 1, 48, 64\]"),
    "no batch": ({KEY: PIXELS[0, 0], "task": TASK}, r"expected images \[B, 3, H, W\], .* got \[3, 48, 64\]$"),
    "another camera": (
        {"observation.images.wrist": PIXELS, "task": TASK},
        "^batch: expected images under 'observation.images.top' .*, got observation.images.wrist$",
    ),
    "no task": ({KEY: PIXELS}, "^task of sample 0: expected a sentence: .* default_task, got None$"),
    "a blank task": ({KEY: PIXELS, "task": [TASK, " "]}, "^task of sample 1: expected a sentence"),
    "too few tasks": (
        {KEY: PIXELS, "task": [TASK]},
        "^task: expected one sentence, or one for each of 2 samples, got 1$",
    ),
    "padding of another shape": (
        {KEY: PIXELS, f"{KEY}_is_pad": torch.zeros(2, 4, dtype=torch.bool), "task": TASK},
        r"_is_pad: expected bool \[2, 5\], got \[2, 4\]$",
    ),
    "nothing but padding": (
        {KEY: PIXELS, f"{KEY}_is_pad": torch.ones(2, 5, dtype=torch.bool), "task": TASK},
        "sample 0 of the batch: frames: expected at least one frame",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_batch_that_cannot_be_scored_is_refused(recorder: Recorder, case: str) -> None:
    batch, message = REFUSED[case]
    model = RfmRewardModel(RfmRewardConfig(), client=recorder)
    for ask in (model.compute_reward, model.predict_progress):
        with pytest.raises(InvalidSampleError, match=message):
            ask(batch)
    assert not recorder.calls


def test_a_batch_without_a_task_gets_the_default_task_and_a_failed_request_is_no_reward() -> None:
    with Recorder(failing=0) as client:
        model = RfmRewardModel(RfmRewardConfig(sampling="all", default_task=TASK), client=client)
        batch = {KEY: PIXELS, "task": ["open the drawer", ""]}
        with pytest.raises(ServerError, match="the server is restarting"):
            model.compute_reward(batch)
        assert model.compute_reward(batch).shape == (2,)
    assert [sorted(task for _, task in call) for call in client.calls] == [["open the drawer", TASK]] * 2


class SuccessAlone(CodeReader):
    """A server whose success is the given number."""

    success: float

    def scores(self, codes: list[Code]) -> dict[str, Any]:
        return {"success": [self.success] * len(codes)}


@pytest.mark.parametrize(("success", "reward"), [(0.8, 1.0), (0.7, 0.0), (float("nan"), None)])
def test_the_reward_of_success_is_one_or_zero(success: float, reward: float | None) -> None:
    server = SuccessAlone()
    server.success = success
    config = RfmRewardConfig(sampling="all", reward_output="success", success_threshold=0.8 - 1e-6)
    with Recorder(server=server) as client:
        model, batch = RfmRewardModel(config, client=client), {KEY: PIXELS, "task": TASK}
        if reward is not None:
            assert model.compute_reward(batch).tolist() == [reward, reward]
        else:
            expected = r"^reward_output: expected progress, got success, which the checkpoint does"
            with pytest.raises(ValueError, match=expected):
                model.compute_reward(batch)
            assert model.predict_progress(batch).success_probability is None


def test_an_answer_without_a_clear_score_is_an_error() -> None:
    score = np.array([0.5, 0.5], np.float32)
    result = ProgressResult(progress=score, success=score, unclear=np.array([False, True]))
    check_clear(result, 0, "sample 3 of the batch")
    with pytest.raises(
        InferenceFailedError, match=r"^sample 3 of the batch: the model's written answer states no single"
    ):
        check_clear(result, 1, "sample 3 of the batch")


def test_a_copy_of_a_model_asks_with_a_client_of_its_own(served: Served) -> None:
    model = RfmRewardModel(RfmRewardConfig(url=served.url("grpc"), model=MODEL))
    batch = {KEY: PIXELS, "task": TASK}
    reward = model.compute_reward(batch)
    copies = copy.deepcopy(model), pickle.loads(pickle.dumps(model))
    for other in copies:
        torch.testing.assert_close(other.compute_reward(batch), reward, **CLOSE)
        assert other.client is not model.client
    model.close()
    torch.testing.assert_close(model.compute_reward(batch), reward, **CLOSE)  # with a new client
    for each in (model, *copies):
        each.close()


def test_a_model_with_a_client_of_yours_has_no_copies(recorder: Recorder) -> None:
    """A copy would ask the configuration's server, which may be another."""
    model = RfmRewardModel(RfmRewardConfig(), client=recorder)
    for copied in (copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match=r"expected no client of yours .* name its server in the configuration"):
            copied(model)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no address": ({"url": " "}, "^url: expected the server's address"),
    "a key of no camera": ({"image_key": "pixels"}, "^image_key: expected observation.image or"),
    "a rule": ({"sampling": "newest"}, "^sampling: expected None or one of linspace_trunc"),
    "a turn": ({"orient": "up"}, "^orient: expected one of none, rotate180"),
    "an output": (
        {"reward_output": "delta"},
        "^reward_output: expected one of progress, success, remaining_s, got 'delta'$",
    ),
    "a threshold": ({"success_threshold": 80}, "^success_threshold: expected a probability, 0 to 1, got 80$"),
    "no frames": ({"frames": 0}, "^frames: expected"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_setting_is_refused(case: str) -> None:
    settings, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        RfmRewardConfig(**settings)


def test_the_key_stays_in_its_file(tmp_path: Path, served: Served) -> None:
    file = tmp_path / "key"
    file.write_text("secret-key\n")
    config = RfmRewardConfig(url=served.url("grpc"), model=MODEL, api_key_file=str(file))
    with config.connect() as client:  # an HTTP/2 header would refuse the line's end
        assert client.model_info(frames=True).name
    assert "secret" not in repr(config)
