# SPDX-License-Identifier: MIT
"""Live reports of episodes, which never delay or change them."""

from __future__ import annotations

import base64
import gc
import io
import logging
import math
import pickle
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trustme
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from PIL import Image

from coded_env import CodedEnv, Recorder
from environments import MODEL, TASK, cart_pole, play
from gateways import poll
from live_reports import Taker, picture, taking
from rfm_client import RewardClient, ServerUnavailableError
from rfm_client.episodes import StepScore, SuccessRule
from rfm_rl import LiveView, RewardModelVectorWrapper, RewardModelWrapper, RewardOptions, live
from servers import Served


@pytest.fixture
def taker() -> Iterator[Taker]:
    with taking() as started:
        yield started


def score(step: int, progress: float = 0.5, success: float = 0.25) -> StepScore:
    return StepScore(progress, success, False, step, 7.5)


def episodes_of(taker: Taker) -> list[dict[str, Any]]:
    """Return the reports by episode, in the order of the first report."""
    found: dict[str, dict[str, Any]] = {}
    for body in taker.bodies:
        for told in body["episodes"]:
            known = found.setdefault(told["id"], {**told, "ended": False, "steps": []})
            known["steps"] += told["steps"]
            known |= {name: told[name] for name in ("reward", "total_reward") if name in told}
            known["ended"] |= told["ended"]
    return list(found.values())


def test_every_step_arrives_in_order_and_exactly(taker: Taker) -> None:
    numbers = np.random.default_rng(0).random((500, 2), np.float32)
    with LiveView(taker.url, name="run 3", api_key="open") as view:
        episode = view.episode("stack the cups", env=2, threshold=0.75)
        for step, (progress, success) in enumerate(numbers.tolist()):
            episode.add(picture(), score(step, progress, success))
    (told,) = episodes_of(taker)
    assert [(each["progress"], each["success"]) for each in told["steps"]] == [tuple(row) for row in numbers.tolist()]
    assert [each["step"] for each in told["steps"]] == list(range(500))
    about = {name: told[name] for name in ("name", "env", "task", "threshold", "ended")}
    assert about == {"name": "run 3", "env": 2, "task": "stack the cups", "threshold": 0.75, "ended": True}
    assert {body["path"] for body in taker.bodies} == {"/live/reports"}
    assert {headers["authorization"] for headers in taker.headers} == {"Bearer open"}


def test_there_are_few_reports_and_the_newest_frame_wins(taker: Taker) -> None:
    began_s = time.monotonic()
    with LiveView(taker.url) as view:
        episodes = [view.episode("stack the cups", env) for env in range(40)]
        for step in range(20):
            for env, episode in enumerate(episodes):
                episode.add(picture(100 * env + step, (600, 800)), score(step))
    took_s = time.monotonic() - began_s
    at_the_end = math.ceil(40 / live.MOST_FRAMES) + 1  # when no caller waits any more
    assert len(taker.bodies) <= took_s / live.REPORT_EVERY_S + 1 + at_the_end
    assert max(len(body["frames"]) for body in taker.bodies) == live.MOST_FRAMES
    newest = {key: frame for body in taker.bodies for key, frame in body["frames"].items()}
    assert len(newest) == 40
    for env, told in enumerate(episodes_of(taker)):
        image = np.array(Image.open(io.BytesIO(base64.b64decode(newest[told["id"]]))))
        assert image.shape == (192, 256, 3)
        assert np.abs(image.astype(int) - picture(100 * env + 19)[0, 0]).max() < 6


def test_names_and_numbers_are_reported_as_a_gateway_takes_them(taker: Taker) -> None:
    with LiveView(taker.url, name="run" * 1000) as view:
        first_given = view.episode("\ud800", np.int64(3), np.float32(0.25))  # type: ignore[arg-type]
        first_given.add(picture(), score(0, success=math.nan))
        view.episode("stack the cups", threshold=math.inf).add(picture(), score(0))
    first, second = episodes_of(taker)
    assert (first["task"], first["env"], first["threshold"], second["threshold"]) == ("?", 3, 0.25, None)
    assert first["name"] == ("run" * 1000)[:2000]
    assert first["steps"][0]["success"] is None  # the checkpoint does not predict it


WATCHED = """
import os, sys
import numpy as np
from rfm_rl import LiveView
from rfm_client.episodes import StepScore

view = LiveView(sys.argv[1])
episode = view.episode("stack the cups")
for step in range(3):
    episode.add(np.zeros((4, 4, 3), np.uint8), StepScore(0.5, 0.25, False, step, 7.5))
if os.fork() == 0:
    view.episode("fork").add(np.zeros((4, 4, 3), np.uint8), StepScore(0.5, 0.25, False, 0, 7.5))
    os._exit(0)
os.wait()
"""


def test_the_last_steps_are_reported_before_the_process_ends_and_a_fork_says_that_it_reports_nothing(
    taker: Taker,
) -> None:
    done = subprocess.run([sys.executable, "-c", WATCHED, taker.url], check=True, timeout=60, stderr=subprocess.PIPE)
    (told,) = episodes_of(taker)
    assert (told["ended"], [each["step"] for each in told["steps"]]) == (True, [0, 1, 2])
    assert done.stderr.count(b"which forked this one: make one in each process") == 1


def test_without_a_gateway_a_warning_is_logged_once_and_steps_are_kept(
    taker: Taker, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Frames of ended episodes are dropped."""
    monkeypatch.setattr(live, "TRY_AGAIN_AFTER_S", 0.05)
    monkeypatch.setattr(live, "MOST_STEPS_KEPT", 100)
    taker.status = 503
    with caplog.at_level(logging.WARNING), LiveView(taker.url) as view:
        view.episode("stack the cups").add(picture(), score(0))
        poll(lambda: len(taker.headers) > 3)
        (record,) = caplog.records
        assert record.getMessage() == (
            f"{taker.url}: expected a gateway that takes live reports, got 503 ; episodes go on, and are not shown"
        )
        for step in range(150):
            ended = view.episode("open the drawer")
            ended.add(picture(), score(step))
            ended.end()
        refused = len(taker.headers)
        poll(lambda: len(taker.headers) > refused + 1)  # the last was made when all had ended
        taker.status = 204
        poll(lambda: len(taker.steps()) == 50)
    assert [each["step"] for each in taker.steps()] == list(range(100, 150))  # the end of each was kept, too
    shown = {key for body in taker.bodies for key in body["frames"]}
    assert shown == {told["id"] for told in episodes_of(taker) if told["task"] == "stack the cups"}


@pytest.mark.parametrize(
    ("first", "status", "warning"),
    [(picture(), 422, "got 422"), (np.zeros((4, 4, 4), np.uint8), 204, "a live report has failed, and is dropped")],
    ids=["refused", "no picture"],
)
def test_a_report_that_cannot_be_taken_is_dropped(
    taker: Taker,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    first: Any,
    status: int,
    warning: str,
) -> None:
    monkeypatch.setattr(live, "TRY_AGAIN_AFTER_S", 0.05)
    taker.status = status
    with LiveView(taker.url) as view:
        episode = view.episode("stack the cups")
        episode.add(first, score(0))
        poll(lambda: warning in caplog.text)
        taker.status = 204
        episode.add(picture(), score(1))
        poll(lambda: bool(taker.bodies))
    assert [each["step"] for each in taker.steps()] == [1]


def test_closing_does_not_wait_for_a_gateway_that_hangs(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        view = LiveView(f"http://127.0.0.1:{silent.getsockname()[1]}")
        view.episode("stack the cups").add(picture(), score(0))
        view.close()
    poll(lambda: "expected a gateway" in caplog.text)
    assert "timed out" not in caplog.text  # the end of this test's socket ended the wait


def test_a_view_that_nobody_holds_ends_its_thread(taker: Taker) -> None:
    LiveView(taker.url).episode("stack the cups").add(picture(), score(0))
    poll(lambda: len(taker.steps()) == 1)
    gc.collect()
    poll(lambda: not [each for each in threading.enumerate() if each.name == "rfm-live-view"])


def test_a_pickled_view_reports_by_itself(taker: Taker) -> None:
    with LiveView(taker.url, name="run", api_key="open") as view:
        again = pickle.loads(pickle.dumps(RewardOptions(live=view))).live
        with again:
            again.episode("stack the cups").add(picture(), score(0))
    assert taker.headers[0]["authorization"] == "Bearer open"
    assert episodes_of(taker)[0]["name"] == "run"


def test_reports_go_by_tls_to_whom_the_authority_vouches_for(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    authority, context = trustme.CA(), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("127.0.0.1").configure_cert(context)
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    with taking(context) as taker:
        with LiveView(taker.url) as view:
            view.episode("stack the cups").add(picture(), score(0))
        assert "CERTIFICATE_VERIFY_FAILED" in caplog.text
        with LiveView(taker.url, ca_file=tmp_path / "ca.pem") as view:
            view.episode("stack the cups").add(picture(), score(1))
        assert [each["step"] for each in taker.steps()] == [1]


@pytest.mark.parametrize(
    ("url", "options", "message"),
    [
        ("grpc://robot:8001", {}, r"url: expected http://host:port or https://host:port of a gateway, got 'grpc://"),
        ("http://me:key@robot:8100", {}, "url: expected http://host:port"),
        ("http://robot:99999", {}, "Port out of range"),
        ("http://robot:8100", {"ca_file": "nowhere.pem"}, "ca_file: expected certificates"),
    ],
)
def test_what_cannot_be_used_is_refused(url: str, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LiveView(url, **options)


def test_the_scores_that_add_returns_are_reported(served: Served, taker: Taker) -> None:
    video = [picture(seed) for seed in range(9)]
    rule = SuccessRule(threshold=0.0)
    with RewardClient(served.url("grpc"), model=MODEL) as client, LiveView(taker.url) as view:
        with client.episode("stack the cups", live=view, success=rule) as episode:
            alone = [episode.add(frame) for frame in video[:4]]
            episode.reset(task="open the drawer")
            again = [episode.add_nowait(frame).result() for frame in video[:3]]
        with client.episodes(2, ["first", "second"], live=view, success=rule) as episodes:
            together = [episodes.add([video[step], video[step + 4]]) for step in range(3)]
            episodes.reset([True, False])
            together.append(episodes.add(video[:2], [True, False]))
    beside = [[step.of(index) for step in together[:3]] for index in range(2)]
    expected = {("stack the cups", 0): alone, ("open the drawer", 0): again, ("first", 0): beside[0]}
    expected |= {("second", 1): beside[1]}
    told = episodes_of(taker)
    assert all(each["ended"] and each["threshold"] == 0.0 for each in told)
    for each, (about, scores) in zip(told[:4], expected.items(), strict=True):
        assert (each["task"], each["env"]) == about
        assert each["steps"] == [
            {"step": s.step, "progress": s.progress, "success": s.success, "succeeded": s.succeeded, "ms": s.ms}
            for s in scores
        ]
    assert [(each["task"], len(each["steps"])) for each in told[4:]] == [("first", 1)]


@pytest.mark.parametrize("blocking", [True, False])
def test_a_gymnasium_environment_is_reported(served: Served, taker: Taker, blocking: bool) -> None:
    with RewardClient(served.url("grpc"), model=MODEL) as client, LiveView(taker.url, name="cart") as view:
        env = RewardModelWrapper(cart_pole(), client, TASK, RewardOptions(live=view, blocking=blocking))
        episodes = [play(env, seed) for seed in range(2)]
        env.close()
    told = episodes_of(taker)
    assert [each["ended"] for each in told] == [True, True]
    for each, (rewards, infos) in zip(told, episodes, strict=True):
        assert (each["reward"], each["total_reward"]) == (rewards[-1], pytest.approx(sum(rewards)))
        reported = {step["step"]: (step["progress"], step["success"]) for step in each["steps"]}
        for info in (info["reward_model"] for info in infos):
            assert reported[info["step"]] == (info["progress"], info["success"])
        assert max(reported) == len(infos) - 1


def test_rewards_are_reported_after_the_end_too_and_only_numbers(taker: Taker) -> None:
    with LiveView(taker.url) as view:
        paid, unpaid = view.episode("go"), view.episode("go", 1)
        for episode in (paid, unpaid):
            episode.add(picture(), score(0))
        paid.pay(0.5)
        paid.end()
        paid.pay(0.25)
        unpaid.pay(float("nan"))
    first, second = episodes_of(taker)
    assert (first["reward"], first["total_reward"]) == (0.25, 0.75)
    assert not {"reward", "total_reward"} & second.keys()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_episodes_of_a_vector_environment_are_reported_and_end_with_their_last_step(
    taker: Taker, mode: AutoresetMode
) -> None:
    """Also where the answer about that step is an error."""
    makers = [partial(CodedEnv, number) for number in range(2)]  # of three steps each
    with LiveView(taker.url) as view, Recorder() as client:
        options = RewardOptions(sampling="all", live=view, frames_from="pixels")
        env = RewardModelVectorWrapper(SyncVectorEnv(makers, autoreset_mode=mode), client, TASK, options)
        env.reset()
        for _ in range(3):
            env.step(np.array([0, 1]))
        if mode is not AutoresetMode.SAME_STEP:  # which has reset them
            env.reset()
        client.server.failing = len(client.calls) + 2
        for _ in range(2):
            env.step(np.array([0, 1]))
        with pytest.raises(ServerUnavailableError):
            env.step(np.array([0, 1]))
        poll(lambda: [each["ended"] for each in episodes_of(taker)] == [True] * 4)
    told = [(each["env"], [step["step"] for step in each["steps"]]) for each in episodes_of(taker)]
    assert told == [(0, [0, 1, 2, 3]), (1, [0, 1, 2, 3]), (0, [0, 1, 2]), (1, [0, 1, 2])]
