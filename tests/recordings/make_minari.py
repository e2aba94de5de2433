# SPDX-License-Identifier: MIT
"""Write the Minari dataset of the tests, and the frames that Minari reads from it. Needs "minari[create,hdf5]".

MINARI_DATASETS_PATH=/tmp/datasets python make_minari.py
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np

HERE = Path(__file__).parent
LENGTHS = (3, 5)  # actions of the episodes, of which the second succeeds


class Pictures(gym.Env[Any, Any]):
    """Shows smooth pictures."""

    observation_space = gym.spaces.Dict(pixels=gym.spaces.Box(0, 255, (48, 64, 3), np.uint8))
    action_space = gym.spaces.Discrete(2)
    episode = -1

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        self.episode, self.step_number = self.episode + 1, 0
        return self._shown(), {"success": False}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.step_number += 1
        ended = self.step_number == LENGTHS[self.episode]
        return self._shown(), 0.0, ended, False, {"success": ended and self.episode == 1}

    def _shown(self) -> dict[str, Any]:
        rows, columns = np.mgrid[:48, :64]
        picture = np.stack([rows * 4, columns * 3, rows * 0 + 40 * self.step_number + 20 * self.episode], -1)
        return {"pixels": picture.astype(np.uint8)}


if __name__ == "__main__":
    collector = minari.DataCollector(Pictures(), record_infos=True)
    for length in LENGTHS:
        collector.reset()
        for _ in range(length):
            collector.step(0)
    dataset = collector.create_dataset("rfm/pictures-v0", author="rfm-triton", author_email="none@example.com")
    shutil.rmtree(HERE / "minari", ignore_errors=True)
    shutil.copytree(dataset.storage.data_path, HERE / "minari" / "data", ignore=shutil.ignore_patterns("metadata.json"))
    frames = {f"pixels_{each.id}": each.observations["pixels"] for each in dataset.iterate_episodes()}
    np.savez_compressed(HERE / "minari.npz", **frames)
