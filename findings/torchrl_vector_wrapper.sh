#!/bin/sh
# TorchRL's GymWrapper takes a vector environment of Gymnasium, and fails with the same one in any of Gymnasium's own
# vector wrappers, such as RecordEpisodeStatistics: it reads `autoreset_mode`, which the wrappers do not pass on. Who
# puts rewards into a vector by a wrapper has to add that property.
#
# Seen with torchrl 0.14.1, torch 2.13.0 and gymnasium 1.4.0, Python 3.11, CartPole.
# Needs Python 3.10 to 3.13 and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check torchrl==0.14.1 torch==2.13.0 gymnasium==1.4.0
cd "$folder"
cat > wrap.py <<'PYTHON'
import gymnasium
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torchrl.envs import GymWrapper


def vector(mode):
    return gymnasium.make_vec("CartPole-v1", 2, "sync", vector_kwargs={"autoreset_mode": mode})


for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):  # those that TorchRL asks for
    shape = tuple(GymWrapper(vector(mode)).rollout(3, break_when_any_done=False)["next", "reward"].shape)
    print(f"{mode.name}, the vector itself: rewards {shape}")
    assert shape == (2, 3, 1)
    try:
        GymWrapper(RecordEpisodeStatistics(vector(mode)))
    except AttributeError as error:
        print(f"{mode.name}, in RecordEpisodeStatistics: {error}")
        assert "autoreset_mode" in str(error)
    else:
        raise AssertionError("the wrapper is taken")
PYTHON
"$folder/venv/bin/python" -W ignore wrap.py
