#!/bin/sh
# LeRobot's make_reward_model with pretrained_path reads the weights from the folder, but not the config.json beside them:
# every option that you do not repeat is the class's default. Options with other shapes raise; the number of attention
# heads has none, so SARM gives other rewards for the same frames, and nothing says so. from_pretrained of the reward
# model's class reads both files.
#
# Seen with lerobot 0.6.1 (SARM), torch 2.11.0, Python 3.12.
# Needs Python 3.12 or newer, as PYTHON, and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.12}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check lerobot==0.6.1 torch==2.11.0 torchvision==0.26.0 \
  transformers==5.5.4
cd "$folder"
cat > rewards.py <<'PYTHON'
from importlib.metadata import version

import torch
from lerobot.rewards.factory import make_reward_model
from lerobot.rewards.sarm.configuration_sarm import SARMConfig
from lerobot.rewards.sarm.modeling_sarm import SARMRewardModel

torch.manual_seed(0)
frames, task = torch.randn(1, 9, 512), torch.randn(1, 512)  # embeddings of nine frames and of the task


def rewards(model):
    return torch.from_numpy(model.eval().calculate_rewards(task, frames, return_all_frames=True))[0]


trained = SARMRewardModel(SARMConfig(num_heads=8, device="cpu"))
expected = rewards(trained)
trained.save_pretrained("saved")
by_class = SARMRewardModel.from_pretrained("saved")
by_factory = make_reward_model(SARMConfig(pretrained_path="saved", device="cpu"))

print("lerobot", version("lerobot"), "torch", torch.__version__)
for name, model in (("saved", trained), ("from_pretrained", by_class), ("make_reward_model", by_factory)):
    same = all(torch.equal(one, other) for one, other in zip(trained.parameters(), model.parameters(), strict=True))
    far = (rewards(model) - expected).abs().max().item()
    print(f"{name}: {model.config.num_heads} heads, equal weights: {same}, rewards differ by up to {far:.3f}")
    assert same
    assert (model.config.num_heads, far > 0.001) == ((12, True) if model is by_factory else (8, False))
PYTHON
venv/bin/python rewards.py
