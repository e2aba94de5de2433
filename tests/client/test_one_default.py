# SPDX-License-Identifier: MIT
"""By default a clip gets the same curve through every door."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet

from client_commands import invoke
from engine_server import EngineServer
from rfm_client import RewardClient, load_trajectory
from rfm_client.frames import Sampling
from rfm_labels import ClientScorer, LabelOptions, label, open_dataset
from tolerances import TOLERANCE
from toy_world import Task, make_clip
from toy_world.video import write_video

TASK = "put the red block in the bowl"


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("videos")
    write_video(folder / "success.mp4", make_clip("success", Task("red", "bowl"), 2_000_000).frames)
    (folder / "tasks.csv").write_text(f"video,task\nsuccess.mp4,{TASK}\n")
    return folder / "success.mp4"


def test_demo_score_episode_and_labels_agree_on_a_clip_of_the_demo(engines: EngineServer, video: Path) -> None:
    trajectory = load_trajectory(video, task=TASK)
    assert trajectory.frames is not None
    with RewardClient(engines.url) as client:
        info = client.model_info(frames=True)
        assert Sampling.of(None, None, info.max_frames, trained_padding=info.trained_padding) == Sampling("rint", 32)
        expected = client.progress(trajectory).progress  # as the demo asks
        curve = client.curve(trajectory).progress
        with client.episode(TASK) as episode:
            stepped = [episode.add(frame).progress for frame in trajectory.frames]
        report = label(open_dataset(video.parent), ClientScorer(client), LabelOptions())
    labelled = parquet.read_table(report.files[0])["progress_sparse"].to_numpy()
    shown = invoke("score", video, "--task", TASK, "--url", engines.url, "--json", "-")
    (scored,) = json.loads(shown.stdout)["videos"]
    assert expected[-1] > 0.95
    for each in (curve, stepped, labelled, scored["progress"]):
        np.testing.assert_allclose(each, expected, rtol=0, atol=TOLERANCE)
