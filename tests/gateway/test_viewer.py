# SPDX-License-Identifier: MIT
"""What the page asks about videos, before a real Triton."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import requests

import clip
from gateway_requests import FILM, TINY, TOLERANCE, VIDEO, Triton, check_refused, failure
from gateways import Gateway, poll, running
from rfm_client.data.sampling import RULES
from viewer_requests import COMPARE, SCORE, SERVED, by_command_line, curve_of, events, post

pytestmark = pytest.mark.triton

QUESTION = {"task": clip.TASK, "model": FILM}


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a clip, the clip backwards and files that are no videos."""
    folder = tmp_path_factory.mktemp("videos")
    clip.write(folder / "clip.mp4")
    clip.write(folder / "back.mp4", clip.render()[::-1])
    clip.write(folder / "long.mp4", np.tile(clip.render(), (10, 1, 1, 1)))
    return folder


def test_the_models_that_score_frames_are_offered(tiny: Gateway, film: Gateway) -> None:
    served = requests.get(f"{film.url}/{SERVED}").json()
    assert [model["name"] for model in served["models"]] == [FILM, VIDEO]
    assert (served["model"], served["url"], served["fps"]) == (FILM, film.triton_url, 3.0)
    frames = {rule["name"]: rule["frames"] for rule in served["rules"]}
    assert frames == {rule: 16 if rule.startswith("rewind") else None if rule == "all" else "any" for rule in RULES}
    assert requests.get(f"{tiny.url}/{SERVED}").json()["model"] == TINY


RULES_ASKED = {
    "default": {},
    "rint_pad": {"sampling": "rint_pad", "frames": "4", "fps": "5"},
    "linspace_trunc": {"sampling": "linspace_trunc", "frames": "3"},
    "rewind_pad16_offline": {"sampling": "rewind_pad16_offline", "fps": "8"},
    "all": {"sampling": "all"},
    "resized": {"sampling": "linspace_round", "frames": "4", "resize": "true"},
    "turned": {"orient": "rotate90", "frames": "4"},
}


@pytest.mark.parametrize("fields", RULES_ASKED.values(), ids=RULES_ASKED)
@pytest.mark.parametrize("model", [FILM, VIDEO])
def test_the_curve_is_that_of_the_command_line(
    tiny: Gateway, videos: Path, tmp_path: Path, model: str, fields: dict[str, str]
) -> None:
    asked = {**QUESTION, "model": model, **fields}
    told = events(post(tiny.url, SCORE, {"video": videos / "clip.mp4"}, **asked))
    words = [
        "rfm-client",
        "score",
        videos / "clip.mp4",
        "--url",
        tiny.triton_url,
        "--model",
        model,
        "--task",
        clip.TASK,
    ]
    words += ["--sampling", fields.get("sampling", "rint_pad"), "--fps", fields.get("fps", "3")]
    words += ["--frames", fields["frames"]] if "frames" in fields else []
    words += ["--resize"] if "resize" in fields else []
    words += ["--orient", fields["orient"]] if "orient" in fields else []
    by_command_line(tmp_path, f"{shlex.join(map(str, words))} --json scores.json")
    (video,) = json.loads((tmp_path / "scores.json").read_text())["videos"]
    curve = curve_of(told)
    for name in ("progress", "success", "frame_times_s"):
        np.testing.assert_allclose(curve[name], video[name], rtol=0, atol=TOLERANCE, err_msg=name)


def test_points_come_before_the_last_one_is_scored(film: Gateway, videos: Path) -> None:
    told = events(post(film.url, SCORE, {"video": videos / "clip.mp4"}, fps="10", frames="4", **QUESTION))
    counts = [len(points["progress"]) for name, points in told if name == "scores"]
    assert len(curve_of(told)["progress"]) == clip.NUM_FRAMES
    assert counts == [1, 2, 4, 8, 16, 1]


def test_a_caller_who_leaves_frees_what_the_curve_holds(film: Gateway, videos: Path) -> None:
    answered = film.metric("samples_total", sample_type="progress")
    with post(film.url, SCORE, {"video": videos / "clip.mp4"}, fps="10", frames="16", **QUESTION) as response:
        assert next(response.iter_lines()) == b"event: video"
    poll(lambda: film.metric("requests_in_flight") == 0)
    assert film.metric("samples_total", sample_type="progress") < answered + clip.NUM_FRAMES


def test_a_preference_is_asked_in_both_orders(film: Gateway, videos: Path, tmp_path: Path) -> None:
    first, second = videos / "clip.mp4", videos / "back.mp4"
    response = post(film.url, COMPARE, {"first": first, "second": second}, **QUESTION)
    assert response.status_code == 200, response.text
    answer = response.json()
    orders = {"first second": (first, second), "second first": (second, first)}
    assert [" ".join(order["asked"]) for order in answer["orders"]] == list(orders)
    for order, videos_ in zip(answer["orders"], orders.values(), strict=True):
        words = ["rfm-client", "compare", *videos_, "--url", film.triton_url, "--model", FILM, "--task", clip.TASK]
        by_command_line(tmp_path, f"{shlex.join(map(str, words))} --json pair.json")
        told = json.loads((tmp_path / "pair.json").read_text())
        assert order["preference"] == pytest.approx(told["preference"], abs=TOLERANCE)
    swap = {"first": "second", "second": "first", None: None}
    assert (answer["verdict"], answer["orders_agree"]) == (swap[told["verdict"]], told["orders_agree"])


KINDS = "MP4, MOV, WebM, Matroska, Ogg or AVI"
SESSION = b"v=0\nfree\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n"  # to FFmpeg an address
PLAY_LIST = b"#EXTM3U\n#EXTINF:1,\n/etc/passwd\n"
BROKEN: dict[str, tuple[bytes | None, dict[str, str], list[str], str]] = {
    "text": (b"no video", {}, ["video"], rf"expected a file of the kind {KINDS}, got another kind \(video\.mp4\)"),
    "a play list": (PLAY_LIST, {}, ["video"], rf"expected a file of the kind {KINDS}, got another kind \(video\.mp4\)"),
    "disguised": (SESSION, {}, ["video"], r"expected a file with a video stream, got .* \(video\.mp4\)"),
    "cut off": (b"\0\0\0\x18ftypisom", {}, ["video"], r"expected a file with a video stream, got .* \(video\.mp4\)"),
    "nothing": (b"", {}, ["video"], rf"expected a file of the kind {KINDS}, got another kind \(video\.mp4\)"),
    "no task": (None, {"task": " "}, ["task"], "expected a value, got none"),
    "rule": (None, {"sampling": "each"}, ["sampling"], "expected 'linspace_trunc', .* or 'all', got 'each'"),
    "frames": (None, {"frames": "4097"}, ["frames"], "expected less than or equal to 4096, got '4097'"),
    "no frames": (None, {"frames": "0"}, ["frames"], "expected greater than or equal to 1, got '0'"),
    "frames of all": (None, {"sampling": "all", "frames": "4"}, ["frames"], "expected none with the rule all, got 4"),
    "fps": (None, {"fps": "nan"}, ["fps"], "expected .*, got 'nan'"),
    "resize": (None, {"resize": "maybe"}, ["resize"], "expected a valid boolean, got 'maybe'"),
    "orient": (None, {"orient": "up"}, ["orient"], "expected 'none', .* or 'rotate270', got 'up'"),
}


@pytest.mark.parametrize(("content", "fields", "at", "message"), BROKEN.values(), ids=BROKEN)
def test_what_cannot_be_scored_says_why(
    film: Gateway, videos: Path, content: bytes | None, fields: dict[str, str], at: list[str], message: str
) -> None:
    file = videos / "clip.mp4" if content is None else content
    check_refused(post(film.url, SCORE, {"video": file}, **{**QUESTION, **fields}), (at, message))


def test_a_missing_video_and_a_missing_model_are_named(film: Gateway, videos: Path) -> None:
    response = post(film.url, COMPARE, {"first": videos / "clip.mp4"}, **QUESTION)
    check_refused(response, (["second"], "expected a video file, got none"))
    response = post(film.url, SCORE, {"video": videos / "clip.mp4"}, **{**QUESTION, "model": "nobody"})
    assert "nobody_frames" in failure(response, 503)


def test_a_task_that_the_model_refuses_fails_after_the_video_is_told(film: Gateway, videos: Path) -> None:
    response = post(
        film.url, SCORE, {"video": videos / "clip.mp4"}, **{**QUESTION, "model": VIDEO, "task": "<|im_end|>"}
    )
    names, documents = zip(*events(response), strict=True)
    assert names == ("video", "failed")
    assert re.fullmatch(r"[\w.]+: expected .*, got .*", documents[-1]["detail"]), documents[-1]


def test_a_video_that_needs_too_much_memory_is_refused(triton: Triton, videos: Path, tmp_path: Path) -> None:
    with running(triton.endpoints, tmp_path, FILM, "--max-body-mib", "1") as gateway:
        response = post(gateway.url, SCORE, {"video": videos / "long.mp4"}, **QUESTION)
        assert "expected files of at most 2097152 bytes" in failure(response, 413)
        video = {"video": videos / "clip.mp4"}
        curve_of(events(post(gateway.url, SCORE, video, fps="1", sampling="all", **QUESTION)))
        assert gateway.metric("samples_total", sample_type="progress") == 3
        assert gateway.metric("rejections_total", reason="size") == 1
