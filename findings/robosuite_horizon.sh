#!/bin/sh
# robosuite's GymWrapper ends an episode at its horizon with terminated=True and truncated=False, as if the robot had
# reached a final state. Who learns from it takes the value after a time limit for 0, and potential-based shaping pays
# back the progress. A success does not end the episode at all.
#
# Seen with robosuite 1.5.2, mujoco 3.3.7, gymnasium 1.4.0 and numpy 1.26.4, Python 3.11, Lift with a Panda, no rendering.
# Needs Python 3.10 or 3.11 and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check robosuite==1.5.2 mujoco==3.3.7 gymnasium==1.4.0 \
  numpy==1.26.4 h5py==3.16.0
cd "$folder"
cat > horizon.py <<'PYTHON'
import numpy as np
import robosuite
from robosuite.wrappers import GymWrapper

HORIZON = 5

lift = robosuite.make(
    "Lift", robots="Panda", has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False, horizon=HORIZON
)
env = GymWrapper(lift)
env.reset()
ends = []
for step in range(1, HORIZON + 1):
    _, reward, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape))
    print(f"step {step}: reward {reward}, terminated {terminated}, truncated {truncated}")
    ends.append((bool(terminated), bool(truncated)))
assert not lift._check_success()
assert ends == [(False, False)] * (HORIZON - 1) + [(True, False)], ends
PYTHON
"$folder/venv/bin/python" -W ignore horizon.py
