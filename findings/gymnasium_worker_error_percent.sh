#!/bin/sh
# An environment in a worker of Gymnasium's AsyncVectorEnv raises an error, and the caller gets a TypeError in its place if
# the worker's traceback has a percent sign anywhere, in the message or in a line of source code: the traceback is taken
# for a format string. The cause is lost, and so is the vector: its next step and reset raise AlreadyPendingCallError,
# since the failed step counts as pending.
#
# Seen with gymnasium 1.2.3 and 1.4.0, numpy 2.3.5, Python 3.11.
# Needs Python 3.10 or newer and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > workers.py <<'PYTHON'
import warnings

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv


class Gripper(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 1, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, message):
        self.message = message

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        raise RuntimeError(self.message)


def raised(call):
    try:
        call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "nothing"


def main():
    warnings.simplefilter("ignore")  # Gymnasium's own lines about the worker
    for message in ("gripper jammed", "gripper jammed at 80 %"):
        envs = AsyncVectorEnv([lambda: Gripper(message)])
        envs.reset(seed=0)
        seen = [raised(lambda: envs.step(np.zeros(1, int))), raised(envs.reset)]
        print(f"gymnasium {gymnasium.__version__}, {message!r}: step raises {seen[0]!r}, the next reset {seen[1][:60]!r}")
        assert (seen[0] == f"RuntimeError: {message}") == ("%" not in message), seen
        assert seen[0].startswith("TypeError") == ("%" in message), seen
        assert "AlreadyPendingCallError" in seen[1] if "%" in message else "AlreadyPending" not in seen[1], seen
        envs.close(terminate=True)


if __name__ == "__main__":
    main()
PYTHON
for version in 1.2.3 1.4.0; do
  python3 -m venv --clear venv
  venv/bin/pip install --quiet --disable-pip-version-check "gymnasium==$version" numpy==2.3.5
  venv/bin/python workers.py
done
