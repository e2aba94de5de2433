# SPDX-License-Identifier: MIT
"""The published package daft-physical-ai scores episodes with the gateway. Needs the network."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clip
from field_clients import CHECKPOINT
from gateways import running
from rfm_client import Trajectory
from servers import Served
from tolerances import TOLERANCE

pytestmark = pytest.mark.triton

SCORE = """
import json, sys
import daft
from daft import col
from daft_physical_ai.rewards import score_rewards
url, video, task = sys.argv[1:]
episodes = {"task": [task] * 2, "length": [32, 16], "start": [0.0, 1.6], "end": [3.2, 3.2], "video": [video] * 2}
columns = [col(name) for name in episodes]
rewards = daft.from_pydict(episodes).select(score_rewards(*columns, url=url).alias("reward")).to_pydict()
print(json.dumps(rewards["reward"]))
"""


def decoded(video: Path) -> Any:
    import av

    with av.open(str(video)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


@pytest.mark.nightly
def test_score_rewards_of_daft_gives_the_scores_of_the_python_client(served: Served, tmp_path: Path) -> None:
    clip.write(tmp_path / "video.mp4")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "daft"], check=True)
    python = tmp_path / "daft" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", "daft-physical-ai"], check=True)
    with running(served.endpoints, tmp_path, CHECKPOINT, "--no-viewer") as gateway:
        words = [python, "-c", SCORE, gateway.url, tmp_path / "video.mp4", clip.TASK]
        rewards = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
        with gateway.client() as client:
            for reward, first in zip(rewards, (0, 16), strict=True):
                indices = [first + frame["index"] for frame in reward["reward_frames"]]
                assert len(indices) == 8
                scores = client.progress(Trajectory(frames=decoded(tmp_path / "video.mp4")[indices], task=clip.TASK))
                np.testing.assert_allclose(reward["reward_score"], scores.progress, rtol=0, atol=TOLERANCE)
                np.testing.assert_allclose(reward["robometer_success"], scores.success, rtol=0, atol=TOLERANCE)
