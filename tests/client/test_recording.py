# SPDX-License-Identifier: MIT
"""Recordings for Rerun's viewer, read back with Rerun's own reader."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from client_commands import MODEL, TASK, WIDTHS, invoke
from engine_server import EngineServer
from recordings import entities, logged
from rfm_client import FrameScores, load_trajectory
from rfm_client.command_line import ExitCode
from rfm_client.frames import frame_times_s
from rfm_client.recording import Recording

JPEG_ERROR = 30  # largest difference after compression
NS_PER_S = 1e9


def test_score_records_frames_and_curves_on_one_timeline(engines: EngineServer, video: Path, tmp_path: Path) -> None:
    other, seen = tmp_path / "other clip.mp4", tmp_path / "seen.npz"
    shutil.copy(video, other)
    np.savez(seen, video_embeddings=np.ones((5, WIDTHS[0]), np.float32), text_embedding=np.ones(WIDTHS[1], np.float32))
    out, target = tmp_path / "out.rrd", tmp_path / "scores.json"
    result = invoke(
        *("score", video, other, "missing.mp4", seen, "--task", TASK, "--fps", 10),
        *("--rrd", out, "--json", target, "--url", engines.url, "--model", MODEL),
    )
    assert result.exit_code == ExitCode.FAILED  # of the missing one alone
    of_video, of_seen = {"image", "progress", "success"}, {"progress", "success"}
    stems = {"clip": of_video, r"other\ clip": of_video, "seen": of_seen}
    assert {f"/{stem}/{name}" for stem, names in stems.items() for name in names} <= entities(out)
    assert not any("missing" in entity for entity in entities(out))
    scores = {Path(each["source"]).stem: each for each in json.loads(target.read_text())["videos"]}
    frames = load_trajectory(video, fps=10).frames
    assert frames is not None
    expected_ns = np.rint(frame_times_s(video, len(frames)) * NS_PER_S)
    times, images = logged(out, "video_time", "/clip/image", "Blob")
    np.testing.assert_allclose(times, expected_ns, atol=1)
    for image, frame in zip(images, frames, strict=True):
        shown = np.asarray(Image.open(io.BytesIO(bytes(image))))
        assert np.abs(shown.astype(int) - frame).mean() < JPEG_ERROR
    indices = scores["clip"]["frame_indices"]
    assert len(indices) == 16  # of 32
    for name in ("progress", "success"):
        curve_times, values = logged(out, "video_time", f"/clip/{name}", "Scalar")
        assert curve_times == [times[index] for index in indices]  # video and curves meet
        np.testing.assert_array_equal(values, scores["clip"][name])
        steps, values = logged(out, "frame", f"/seen/{name}", "Scalar")
        assert steps == scores["seen"]["frame_indices"]
        np.testing.assert_array_equal(values, scores["seen"][name])


def test_a_score_that_is_not_predicted_has_no_curve_and_nothing_makes_no_file(tmp_path: Path) -> None:
    told = FrameScores(progress=np.float32([0.25, 0.5]), success=np.full(2, np.nan, np.float32))
    with Recording(tmp_path / "one.rrd") as recording:
        recording.add("a/b", told, np.zeros((2, 8, 8, 3), np.uint8))
        recording.add("timed", told, None, np.array([0.5, 1.5]))
        recording.add("untimed", told)
    file = tmp_path / "one.rrd"
    found = {entity for entity in entities(file) if "__" not in entity}
    assert found == {r"/a\/b/progress", r"/a\/b/image", "/timed/progress", "/untimed/progress"}
    assert logged(file, "video_time", "/timed/progress", "Scalar") == ([500_000_000, 1_500_000_000], [0.25, 0.5])
    assert logged(file, "video_time", "/untimed/progress", "Scalar") == ([], [])
    assert logged(file, "frame", "/untimed/progress", "Scalar") == ([0, 1], [0.25, 0.5])
    with Recording(tmp_path / "none.rrd"):
        pass
    assert not (tmp_path / "none.rrd").exists()
