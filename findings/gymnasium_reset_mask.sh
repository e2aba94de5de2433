#!/bin/sh
# Gymnasium's vectors take reset_mask out of the caller's own options: after reset(options=options) the dictionary is
# empty. A loop that keeps one dictionary, and writes which environments ended into its mask, resets the right ones at
# first, and all of them from then on: running episodes end, and nothing says so. A copy per call avoids it.
#
# Seen with gymnasium 1.2.3 and 1.4.0, numpy 2.3.5, Python 3.11, in SyncVectorEnv and AsyncVectorEnv.
# Needs Python 3.10 or newer and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > masks.py <<'PYTHON'
import sys

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv


def main() -> None:
    changed = False
    for vector in (SyncVectorEnv, AsyncVectorEnv):
        makers = [lambda: gymnasium.make("CartPole-v1")] * 2
        envs = vector(makers, autoreset_mode=AutoresetMode.DISABLED)
        envs.reset(seed=0)
        options = {"reset_mask": np.array([True, False])}  # the second environment's episode goes on
        kept = []
        for _ in range(2):
            before, *_ = envs.step(np.zeros(2, int))
            second = before[1].copy()
            after, _ = envs.reset(options=options)
            kept.append(bool(np.array_equal(after[1], second)))
        envs.close()
        print(f"gymnasium {gymnasium.__version__}, {vector.__name__}: the second episode goes on: {kept}, options {options}")
        changed |= kept != [True, False] or bool(options)
    sys.exit(changed)


if __name__ == "__main__":
    main()
PYTHON
for version in 1.2.3 1.4.0; do
  python3 -m venv --clear venv
  venv/bin/pip install --quiet --disable-pip-version-check "gymnasium==$version" numpy==2.3.5
  venv/bin/python masks.py
done
