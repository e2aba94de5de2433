# SPDX-License-Identifier: MIT
"""The page's requests about videos, with a real Triton."""

from __future__ import annotations

import re
import resource
import shlex
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import requests

import clip
from gateway_requests import ENCODERS, TINY, VLM, Triton, check_refused, failure
from gateways import Gateway, running
from rfm_client.frames import Rule
from servers import wait_for
from tolerances import TOLERANCE
from viewer_requests import COMPARE, SCORE, SERVED, SERVER, by_command_line, curve_of, events, post

pytestmark = pytest.mark.triton

QUESTION = {"task": clip.TASK, "model": ENCODERS}


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a clip and a long one."""
    folder = tmp_path_factory.mktemp("videos")
    clip.write(folder / "clip.mp4")
    clip.write(folder / "long.mp4", np.tile(clip.render(), (10, 1, 1, 1)))
    return folder


def test_the_models_that_score_frames_are_offered(tiny: Gateway, encoders: Gateway) -> None:
    served = requests.get(f"{encoders.url}/{SERVED}").json()
    assert [model["name"] for model in served["models"]] == [ENCODERS, VLM]
    assert served["model"] == ENCODERS
    server = requests.get(f"{encoders.url}/{SERVER}").json()
    assert (server["url"], server["fps"]) == (encoders.triton_url, 3.0)
    frames = {rule["name"]: rule["frames"] for rule in server["rules"]}
    assert frames == {
        rule: 16 if rule.startswith("rewind") else None if rule == "all" else "any" for rule in get_args(Rule)
    }
    assert requests.get(f"{tiny.url}/{SERVED}").json()["model"] == TINY


RULES_ASKED = {
    "default": {},
    "vision-language": {"model": VLM, "sampling": "rint_pad", "frames": "4", "fps": "5"},
    "all": {"sampling": "all"},
    "resized": {"sampling": "linspace_round", "frames": "4", "resize": "true"},
}


@pytest.mark.parametrize("fields", RULES_ASKED.values(), ids=RULES_ASKED)
def test_the_curve_is_that_of_the_command_line(tiny: Gateway, videos: Path, fields: dict[str, str]) -> None:
    asked = {**QUESTION, **fields}
    told = events(post(tiny.url, SCORE, {"video": videos / "clip.mp4"}, **asked))
    options = {"sampling": "rint_pad", "fps": "3", **asked, "url": tiny.triton_url}
    has_resize = options.pop("resize", None)
    words = [word for name, value in options.items() for word in (f"--{name}", value)]
    command = ["rfm-client", "score", "clip.mp4", *words, *(["--resize"] if has_resize else [])]
    (video,) = by_command_line(videos, f"{shlex.join(command)} --json scores.json")["videos"]
    curve = curve_of(told)
    for name in ("progress", "success", "frame_times_s"):
        np.testing.assert_allclose(curve[name], video[name], rtol=0, atol=TOLERANCE, err_msg=name)


def test_a_curve_says_that_its_video_shows_nothing(encoders: Gateway, videos: Path, tmp_path: Path) -> None:
    clip.write(tmp_path / "dark.mp4", (clip.render() * 0.02).astype(np.uint8))
    for video, told in ((tmp_path / "dark.mp4", "black pictures, no value above "), (videos / "clip.mp4", "None")):
        (_, about), *_ = events(post(encoders.url, SCORE, {"video": video}, **QUESTION))
        assert str(about["blank"]).startswith(told)


def test_points_come_before_the_last_one_is_scored(encoders: Gateway, videos: Path) -> None:
    told = events(post(encoders.url, SCORE, {"video": videos / "clip.mp4"}, fps="10", frames="4", **QUESTION))
    counts = [len(points["progress"]) for name, points in told if name == "scores"]
    assert len(curve_of(told)["progress"]) == clip.NUM_FRAMES
    assert counts == [1, 2, 4, 8, 16, 1]


def test_a_caller_who_leaves_stops_the_scoring_of_the_curve(encoders: Gateway, videos: Path) -> None:
    answered = encoders.metric("samples_total", sample_type="progress")
    with post(encoders.url, SCORE, {"video": videos / "clip.mp4"}, fps="10", frames="16", **QUESTION) as response:
        assert next(response.iter_lines()) == b"event: video"
    wait_for(lambda: encoders.metric("requests_in_flight") == 0)
    assert encoders.metric("samples_total", sample_type="progress") < answered + clip.NUM_FRAMES


NO_KIND = r"expected a file of the kind MP4, MOV, WebM, Matroska, Ogg or AVI, got another kind \(video\.mp4\)"
NO_STREAM = r"expected a file with a video stream, got .* \(video\.mp4\)"
SESSION = b"v=0\nfree\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n"  # to FFmpeg an address
BROKEN: dict[str, tuple[bytes | None, dict[str, str], str, str]] = {
    "text": (b"no video", {}, "video", NO_KIND),
    "a play list": (b"#EXTM3U\n#EXTINF:1,\n/etc/passwd\n", {}, "video", NO_KIND),
    "disguised": (SESSION, {}, "video", NO_STREAM),
    "no task": (None, {"task": " "}, "task", "expected a value, got none"),
    "rule": (None, {"sampling": "each"}, "sampling", "expected 'linspace_trunc', .* or 'all', got 'each'"),
    "frames": (None, {"frames": "4097"}, "frames", "expected less than or equal to 4096, got '4097'"),
    "frames of all": (None, {"sampling": "all", "frames": "4"}, "frames", "expected none with the rule all, got 4"),
    "fps": (None, {"fps": "nan"}, "fps", "expected .*, got 'nan'"),
}


@pytest.mark.parametrize(("content", "fields", "at", "message"), BROKEN.values(), ids=BROKEN)
def test_a_wrong_question_says_why(
    encoders: Gateway, videos: Path, content: bytes | None, fields: dict[str, str], at: str, message: str
) -> None:
    file = videos / "clip.mp4" if content is None else content
    check_refused(post(encoders.url, SCORE, {"video": file}, **{**QUESTION, **fields}), ([at], message))


NUM_COMPARED = r"expected 2 to 12 video files \(rfm-client compare takes more\)"


def test_a_missing_video_a_missing_model_and_a_refused_task_are_named(encoders: Gateway, videos: Path) -> None:
    video = videos / "clip.mp4"
    response = post(encoders.url, COMPARE, {"first": video}, **QUESTION)
    check_refused(response, (["videos"], f"{NUM_COMPARED}, got 1"))
    response = post(encoders.url, COMPARE, {f"{number}": b"" for number in range(13)}, **QUESTION)
    check_refused(response, (["videos"], f"{NUM_COMPARED}, got 13"))
    response = post(encoders.url, SCORE, {"video": video}, **{**QUESTION, "model": "missing"})
    assert "missing_frames" in failure(response, 503)
    response = post(encoders.url, SCORE, {"video": video}, model=VLM, task="<|im_end|>")
    names, documents = zip(*events(response), strict=True)
    assert names == ("video", "failed")
    assert re.fullmatch(r"[\w.]+: expected .*, got .*", documents[-1]["detail"]), documents[-1]


@pytest.mark.slow
def test_a_video_that_needs_too_much_memory_is_refused(triton: Triton, videos: Path, tmp_path: Path) -> None:
    with running(triton.endpoints, tmp_path, ENCODERS, "--max-body-mib", "1") as gateway:
        response = post(gateway.url, SCORE, {"video": videos / "long.mp4"}, **QUESTION)
        assert "expected files of at most 2097152 bytes" in failure(response, 413)
        video = {"video": videos / "clip.mp4"}
        curve_of(events(post(gateway.url, SCORE, video, fps="1", sampling="all", **QUESTION)))
        assert gateway.metric("samples_total", sample_type="progress") == 3
        assert gateway.metric("requests_total", endpoint=f"/{SCORE}", code="413") == 1


@pytest.mark.slow
def test_a_video_that_finds_no_room_in_the_temporary_folder_is_a_503(triton: Triton, tmp_path: Path) -> None:
    """The kernel refuses files above 1 MiB to the gateway's process, as a full disk does."""
    with running(triton.endpoints, tmp_path, ENCODERS, TMPDIR=str(tmp_path)) as gateway:
        resource.prlimit(gateway.process.pid, resource.RLIMIT_FSIZE, (2**20, 2**20))
        response = post(gateway.url, SCORE, {"video": b"\0\0\0\x18ftyp" + bytes(2**21)}, **QUESTION)
        told = f"body: expected room in {tmp_path} of the gateway, got File too large: try again, or "
        assert failure(response, 503).startswith(told)
        assert (response.headers["Connection"], response.headers["Retry-After"]) == ("close", "1")
        assert requests.get(f"{gateway.url}/metrics").ok
        assert gateway.log.count(f"503 POST /{SCORE}") == 1
