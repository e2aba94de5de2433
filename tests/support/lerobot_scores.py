# SPDX-License-Identifier: MIT
"""Checkpoints and scores of LeRobot's own Robometer and TOPReward, for ``test_lerobot_scores.py``.

Runs in a Python with LeRobot. FOLDER holds ``settings.json``, {name: settings}, and ``frames.npy``, [T, H, W, 3].

python tests/support/lerobot_scores.py FOLDER BASE
"""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.rewards import PreTrainedRewardModel, make_reward_pre_post_processors
from lerobot.rewards.robometer.configuration_robometer import ROBOMETER_SPECIAL_TOKENS, RobometerConfig
from lerobot.rewards.robometer.modeling_robometer import (
    ROBOMETER_FEATURE_PREFIX,
    RobometerRewardModel,
    decode_progress_outputs,
)
from lerobot.rewards.topreward.configuration_topreward import TOPRewardConfig
from lerobot.rewards.topreward.modeling_topreward import TOPRewardModel
from transformers import AutoConfig, AutoTokenizer, Qwen3VLForConditionalGeneration

TASK = "put the red block in the bowl"
CAMERA = "observation.images.top"
HEADS = 3  # odd, in the text and in the tower
WIDTH = HEADS * 16
TEXT = {"hidden_size": WIDTH, "num_hidden_layers": 4, "num_attention_heads": HEADS, "num_key_value_heads": HEADS}
VISION = {
    "depth": 5,
    "hidden_size": WIDTH,
    "out_hidden_size": WIDTH,
    "num_heads": HEADS,
    "deepstack_visual_indexes": [0, 2, 3],
}


def backbone(base: str, num_tokens: int) -> Any:
    """Return the configuration of a small Qwen3-VL with 3 levels of deepstack."""
    config = AutoConfig.from_pretrained(base).to_dict()
    config["text_config"].update(TEXT, vocab_size=num_tokens)
    config["vision_config"].update(VISION)
    return config


def scatter(model: torch.nn.Module) -> None:
    """Give the model weights with which frames differ clearly."""
    random = torch.Generator().manual_seed(0)
    for name, weight in model.named_parameters():
        noise = torch.randn(weight.shape, generator=random)
        scale = (8 if "head.4" in name else 1) * weight[0].numel() ** -0.5 if weight.ndim > 1 else 0.1
        is_gain = "norm" in name and name.endswith("weight")
        weight.data = (noise * scale + is_gain).to(weight.dtype)


def encoded(model: PreTrainedRewardModel, frames: torch.Tensor) -> dict[str, Any]:
    before, _ = make_reward_pre_post_processors(model.config)
    return dict(before({CAMERA: frames[None], "task": [TASK]}))


def robometer(folder: Path, base: str, frames: torch.Tensor, settings: dict[str, Any]) -> dict[str, Any]:
    vlm_config = backbone(base, len(AutoTokenizer.from_pretrained(base)) + len(ROBOMETER_SPECIAL_TOKENS))
    config = RobometerConfig(
        device="cpu", image_key=CAMERA, base_model_id=base, max_frames=None, vlm_config=vlm_config, **settings
    )
    made = RobometerRewardModel(config)
    scatter(made)
    made.save_pretrained(folder)
    model = RobometerRewardModel.from_pretrained(folder, strict=True)
    batch = encoded(model, frames)
    inputs = {
        key.removeprefix(ROBOMETER_FEATURE_PREFIX): value
        for key, value in batch.items()
        if key.startswith(ROBOMETER_FEATURE_PREFIX)
    }
    with torch.no_grad():
        logits = model._compute_rbm_logits(inputs)
    scores = decode_progress_outputs(*logits, is_discrete_mode=model.config.use_discrete_progress)
    assert model.compute_reward(batch).item() == np.float32(np.clip(scores["progress_pred"][0][-1], 0, 1))
    return {"progress": scores["progress_pred"][0], "success": scores["success_probs"][0]}


def topreward(folder: Path, base: str, frames: torch.Tensor, settings: dict[str, Any]) -> dict[str, Any]:
    vlm_folder = folder / "vlm"
    shutil.copytree(base, vlm_folder)
    config = AutoConfig.for_model(**backbone(base, AutoConfig.from_pretrained(base).text_config.vocab_size))
    vlm = Qwen3VLForConditionalGeneration(config)
    scatter(vlm)
    vlm.to(getattr(torch, settings["torch_dtype"])).save_pretrained(vlm_folder)
    model = TOPRewardModel(TOPRewardConfig(device="cpu", image_key=CAMERA, vlm_name=str(vlm_folder), **settings))
    model.save_pretrained(folder)
    prefixes = [encoded(model, frames[:length]) for length in range(1, len(frames) + 1)]
    return {"log_prob": [model.compute_reward(batch).item() for batch in prefixes]}


def main() -> None:
    folder, base = Path(sys.argv[1]), sys.argv[2]
    frames = torch.from_numpy(np.load(folder / "frames.npy")).permute(0, 3, 1, 2)
    scores = {}
    for name, settings in json.loads((folder / "settings.json").read_text()).items():
        score = {"robometer": robometer, "topreward": topreward}[settings.pop("model")]
        scores[name] = score(folder / name, base, frames, settings)
    (folder / "scores.json").write_text(json.dumps(scores))


if __name__ == "__main__":
    main()
