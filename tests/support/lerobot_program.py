# SPDX-License-Identifier: MIT
"""A program of LeRobot's kind, for a Python with LeRobot and the plug-in: ``test_lerobot_itself.py`` runs it.

python tests/support/lerobot_program.py --reward_model.discover_packages_path=lerobot_reward_rfm ...
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import parser
from lerobot.configs.rewards import RewardModelConfig
from lerobot.datasets import LeRobotDataset
from lerobot.rewards import (
    PreTrainedRewardModel,
    get_reward_model_class,
    make_reward_model,
    make_reward_pre_post_processors,
)

CAMERA = "observation.images.front"
CLOSE = {"atol": 1e-5, "rtol": 0}


@dataclass
class Settings:
    """What the command line sets."""

    reward_model: RewardModelConfig | None = None


@parser.wrap()  # type: ignore[untyped-decorator]
def main(settings: Settings) -> None:
    config: Any = settings.reward_model
    config.image_key = CAMERA
    model = make_reward_model(config)
    assert isinstance(model, PreTrainedRewardModel)
    assert (config.type, model.name, model.is_trainable) == ("rfm", "rfm", False)
    batch = batch_of_windows()
    reward = model.compute_reward(batch)
    assert reward.shape == (4,)
    check_processors(config, model, batch, reward)
    check_saved(model, batch, reward)
    model.close()
    print("all is well")


def batch_of_windows() -> dict[str, Any]:
    """Return a batch with three frames a sample, of which LeRobot pads some."""
    dataset = LeRobotDataset(
        "me/my_dataset", root="my_dataset", delta_timestamps={CAMERA: [-0.4, -0.2, 0.0]}, video_backend="pyav"
    )
    batch: dict[str, Any] = next(iter(torch.utils.data.DataLoader(dataset, batch_size=4)))
    assert batch[f"{CAMERA}_is_pad"].any()
    return batch


def check_processors(config: Any, model: Any, batch: dict[str, Any], reward: torch.Tensor) -> None:
    """The pipelines keep a batch's reward, and add a batch dimension to a single image."""
    before, after = make_reward_pre_post_processors(config)
    torch.testing.assert_close(model.compute_reward(before(dict(batch))), reward, **CLOSE)
    torch.testing.assert_close(after(reward), reward)
    single = before({CAMERA: batch[CAMERA][0, -1], "task": batch["task"][0]})
    torch.testing.assert_close(model.compute_reward(single), reward[:1], **CLOSE)  # whose other frames are padding


def check_saved(model: Any, batch: dict[str, Any], reward: torch.Tensor) -> None:
    """A saved model scores as before, loaded by its class or by its configuration."""
    with tempfile.TemporaryDirectory() as folder:
        model.save_pretrained(folder)
        assert {file.name for file in Path(folder).iterdir()} == {"config.json", "model.safetensors"}
        config = RewardModelConfig.from_pretrained(folder)
        config.pretrained_path = folder
        for loaded in (make_reward_model(config), get_reward_model_class("rfm").from_pretrained(folder)):
            torch.testing.assert_close(loaded.compute_reward(batch), reward, **CLOSE)
            loaded.close()


if __name__ == "__main__":
    main()
