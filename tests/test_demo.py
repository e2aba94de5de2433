# SPDX-License-Identifier: MIT
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from test_serve_command import nothing_left_behind
from typer.testing import CliRunner

from rfm.cli import app
from rfm.demo import clip
from rfm.demo.checkpoint import write_random_checkpoint
from rfm_client import InvalidSampleError
from rfm_client.video import frame_indices, read_video

VIDEOS = Path(__file__).parents[2] / "shared" / "videos"
ROOT = Path(__file__).parents[1]
PNG = b"\x89PNG"


@pytest.fixture
def video(tmp_path: Path) -> Path:
    clip.write(tmp_path / "clip.mp4")
    return tmp_path / "clip.mp4"


def test_the_demo_shows_what_it_promises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    with nothing_left_behind():
        result = CliRunner().invoke(app, ["demo", "--output", str(tmp_path)])
    assert result.exit_code == 0, result.output
    for shown in ("random weights", "over grpc://", "over http://", "P(first) = ", "similarity = ", clip.TASK):
        assert shown in result.output
    for shown in ("executions", "nv_cpu_utilization", "rfm_encoder", "rfm_frames"):
        assert shown in result.output
    assert (tmp_path / "rewards.png").read_bytes().startswith(PNG)


def test_one_s_own_video_needs_its_task(tmp_path: Path, video: Path) -> None:
    result = CliRunner().invoke(app, ["demo", "--output", str(tmp_path), "--video", str(video)])
    assert result.exit_code == 1
    assert result.stderr == "rfm: --video and --task: expected both or neither, got one\n"


def test_the_clip_survives_its_video_file(video: Path) -> None:
    frames = read_video(video, clip.FPS)
    assert frames.shape == clip.render().shape
    assert np.abs(frames.astype(int) - clip.render()).mean() < 8  # lossy, but the same picture


@pytest.mark.parametrize(
    ("name", "fps", "count"),
    [
        ("soar_put_green_stick_in_brown_bowl", 3, 10),
        ("berkeley_rpt_stack_cup", 3, 10),
        ("jaco_play_pick_up_green_cup", 2, 13),
    ],
)
@pytest.mark.skipif(not VIDEOS.is_dir(), reason="robot videos are not at hand")
def test_robot_videos_are_read_frame_for_frame(name: str, fps: float, count: int) -> None:
    frames = read_video(VIDEOS / f"{name}.mp4", fps)
    assert frames.shape[0] == count
    assert frames.shape[3] == 3
    assert frames.std() > 10


FRAMES = {
    "3 of 10 fps": ((32, 10.0, 3.0), 10),
    "2 of 10 fps": ((64, 10.0, 2.0), 13),
    "all": ((7, 10.0, 30.0), 7),
    "at least one": ((5, 30.0, 0.1), 1),
}


@pytest.mark.parametrize(("arguments", "count"), FRAMES.values(), ids=FRAMES)
def test_frames_are_picked_as_the_original_client_picks_them(arguments: tuple[int, float, float], count: int) -> None:
    indices = frame_indices(*arguments)
    assert indices.tolist() == np.linspace(0, arguments[0] - 1, count).astype(int).tolist()


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InvalidSampleError, match=r"video: expected a file with a video stream, got .*text\.mp4"):
        read_video(tmp_path / "text.mp4", 3)
    with pytest.raises(InvalidSampleError, match=r"video: expected a file with a video stream, got .*nothing\.mp4"):
        read_video(tmp_path / "nothing.mp4", 3)


def test_the_committed_weights_are_those_of_the_random_checkpoint(tmp_path: Path) -> None:
    written = write_random_checkpoint(tmp_path)
    fresh = load_file(written.checkpoint / "model.safetensors")
    committed = load_file(ROOT / "model_repository" / "rfm" / "1" / "checkpoint" / "model.safetensors")
    for name, tensor in committed.items():
        torch.testing.assert_close(fresh[name], tensor, rtol=0, atol=1e-6)
    size = sum(file.stat().st_size for file in (ROOT / "model_repository").rglob("*") if file.is_file())
    assert size < 3e6
