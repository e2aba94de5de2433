#!/bin/sh
# An environment that returns the same array each step loses its last observation in Gymnasium 1.4.0's SAME_STEP vectors:
# the reset in the same step draws over infos["final_obs"] before anyone reads it, and nothing says so. Observations of
# other steps are copied. Values that learners bootstrap from final_obs, and rewards of its picture, are the next episode's.
#
# Seen with gymnasium 1.4.0 and numpy 2.3.5, Python 3.11, SyncVectorEnv and AsyncVectorEnv.
# Needs Python 3.11 or newer and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check gymnasium==1.4.0 numpy==2.3.5
cd "$folder"
cat > final.py <<'PYTHON'
import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv


class Counter(gym.Env):
    """Shows the number of steps; an episode has three."""

    observation_space = gym.spaces.Box(0, 3, (1,), np.int64)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, copies):
        self.copies, self.shown = copies, np.zeros(1, np.int64)

    def observed(self):
        return self.shown.copy() if self.copies else self.shown

    def reset(self, *, seed=None, options=None):
        self.shown[0] = 0
        return self.observed(), {}

    def step(self, action):
        self.shown[0] += 1
        return self.observed(), 0.0, bool(self.shown[0] == 3), False, {}


if __name__ == "__main__":
    seen = {}
    for kind in (SyncVectorEnv, AsyncVectorEnv):
        for copies in (True, False):
            vector = kind([lambda: Counter(copies)], autoreset_mode=AutoresetMode.SAME_STEP)
            vector.reset()
            *shown, last = [vector.step(np.zeros(1, int)) for _ in range(3)]
            seen[kind.__name__, copies] = [int(step[0][0, 0]) for step in shown], int(last[4]["final_obs"][0][0])
            vector.close()
            print(kind.__name__, "returns copies" if copies else "returns one array", *seen[kind.__name__, copies])
    expected = {(kind, copies): ([1, 2], 3 if copies else 0) for kind, copies in seen}
    raise SystemExit(seen != expected)
PYTHON
"$folder/venv/bin/python" final.py
