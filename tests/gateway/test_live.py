# SPDX-License-Identifier: MIT
"""Running episodes at the gateway: what is kept of them, what is told, what is refused. No Triton is needed for that."""

from __future__ import annotations

import base64
import io
import json
import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import requests
from fastapi import HTTPException
from PIL import Image

from gateway_requests import failure
from gateways import Gateway, running
from live_reports import Json, episode, identity, jpeg, picture, report, step
from rfm.launch.process import Endpoints
from rfm_client import LiveView
from rfm_client.episodes import StepScore, live
from rfm_gateway.memory import Memory
from rfm_gateway.viewer import live_report
from rfm_gateway.viewer.live import FORGOTTEN_AFTER_S, MOST_EPISODES, MOST_POINTS, LiveEpisodes
from rfm_gateway.viewer.live_report import read_report

KEY = "open sesame"


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    with running(Endpoints.free(), tmp_path_factory.mktemp("live")) as started:
        yield started


def post(gateway: Gateway, body: Any, **headers: str) -> requests.Response:
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    headers = {"content-type": "application/json", **headers}
    return requests.post(f"{gateway.url}/live/reports", data=data, headers=headers, timeout=60)


def told(gateway: Gateway, after: str = "", **headers: str) -> Json:
    response = requests.get(f"{gateway.url}/viewer/live", params={"after": after}, headers=headers, timeout=60)
    assert (response.status_code, response.headers["cache-control"]) == (200, "no-store"), response.text
    return response.json()  # type: ignore[no-any-return]


def of(answer: Json, number: int) -> Json:
    return next(each for each in answer["episodes"] if each["id"] == identity(number))


def frame_of(gateway: Gateway, key: str, **headers: str) -> requests.Response:
    return requests.get(f"{gateway.url}/viewer/live/{key}/frame", headers=headers, timeout=60)


def taken(episodes: LiveEpisodes, body: Json) -> None:
    with Memory(2**20).share() as share:
        episodes.take(*read_report(json.dumps(body).encode(), share))


def test_an_answer_has_everything_and_the_next_one_what_is_new(gateway: Gateway) -> None:
    assert post(gateway, report(episode(1, step(0, 0.1), step(1, 0.2)))).status_code == 204
    first = told(gateway)
    assert first["is_whole"]
    known = of(first, 1)
    assert (known["steps"], known["progress"], known["success"]) == ([0, 1], [0.1, 0.2], [0.5, 0.5])
    assert (known["name"], known["env"], known["task"], known["threshold"]) == ("run", 0, "stack the cups", 0.5)
    assert (known["newest"]["ms"], known["has_ended"], known["frame"]) == (12.5, False, None)
    assert 0 <= known["age_s"] < 60
    post(gateway, report(episode(1, step(2, None, None))))
    second = told(gateway, first["cursor"])
    assert not second["is_whole"]
    assert (of(second, 1)["steps"], of(second, 1)["progress"], of(second, 1)["success"]) == ([2], [None], [None])
    assert of(told(gateway, second["cursor"]), 1).keys() == {"id", "age_s"}
    post(gateway, report(episode(1, ended=True)))
    assert of(told(gateway, second["cursor"]), 1)["has_ended"]


@pytest.mark.parametrize("after", ["", "0.5", "nonsense", "." * 100, "²", f"{'0' * 16}.12", "1e9"])
def test_a_cursor_of_nobody_gets_everything(gateway: Gateway, after: str) -> None:
    post(gateway, report(episode(2, step(0))))
    answer = told(gateway, after)
    assert answer["is_whole"]
    assert 0 in of(answer, 2)["steps"]


def test_a_cursor_of_too_many_digits_gets_everything(gateway: Gateway) -> None:
    life = told(gateway)["cursor"].partition(".")[0]
    assert told(gateway, f"{life}.{'9' * 5000}")["is_whole"]


def test_a_report_that_comes_twice_counts_once(gateway: Gateway) -> None:
    for _ in range(2):
        post(gateway, report(episode(3, step(0, 0.1), step(1, 0.2))))
    post(gateway, report(episode(3, step(1, 0.9), step(5, 0.3))))
    assert of(told(gateway), 3)["steps"] == [0, 1, 5]
    assert of(told(gateway), 3)["progress"] == [0.1, 0.2, 0.3]


def test_an_end_stays_an_end(gateway: Gateway) -> None:
    post(gateway, report(episode(4, step(0), ended=True)))
    post(gateway, report(episode(4, step(1))))  # the last question may be answered after the end
    assert (of(told(gateway), 4)["steps"], of(told(gateway), 4)["has_ended"]) == ([0, 1], True)


def test_the_newest_frame_has_an_address_of_its_own(gateway: Gateway) -> None:
    key = identity(5)
    post(gateway, report(episode(5, step(0)), **{key: jpeg(picture(1))}))
    first = frame_of(gateway, key)
    assert (first.status_code, first.headers["content-type"], first.headers["cache-control"]) == (
        200, "image/jpeg", "no-store",
    )  # fmt: skip
    assert first.headers["x-content-type-options"] == "nosniff"
    pixels = np.array(Image.open(io.BytesIO(first.content)))
    assert np.abs(pixels.astype(int) - picture(1)).max() < 6
    known = told(gateway)
    post(gateway, report(**{key: jpeg(picture(2))}))
    assert of(told(gateway, known["cursor"]), 5)["steps"] == []
    assert of(told(gateway, known["cursor"]), 5)["frame"] > of(known, 5)["frame"]
    assert frame_of(gateway, key).content != first.content


@pytest.mark.parametrize(
    "key", [identity(404), "..", "%2e%2e%2f%2e%2e%2fetc%2fpasswd", "..%2f..%2fapp.py", "%00", "a" * 5000, "*"]
)
def test_no_other_name_gives_a_frame(gateway: Gateway, key: str) -> None:
    response = frame_of(gateway, key)
    assert response.status_code == 404
    assert "detail" in response.json()


def with_field(**fields: Any) -> Json:
    return report(episode(6, step(0), **fields))


NO_IMAGE = base64.b64encode(b"<svg onload='alert(1)'/>").decode()
PNG = io.BytesIO()
Image.fromarray(picture()).save(PNG, "PNG")
REFUSED: dict[str, tuple[Any, list[Any], str]] = {
    "no JSON": (b"no json", [], "expected JSON, got: expected ident at line 1 column 2"),
    "nothing": (b"", [], "expected JSON, got: EOF while parsing a value at line 1 column 0"),
    "a list": ([], [], "expected an object, got []"),
    "no frames": ({"episodes": []}, ["frames"], "expected a value, got none"),
    "another field": ({**report(), "more": 1}, ["more"], "expected no such field, got 1"),
    "an id with a path": (with_field(id="../../etc/passwd"), ["episodes", 0, "id"], "expected pattern '^[0-9a-f]{32}$', got '../../etc/passwd'"),
    "an id and a line": (with_field(id=identity(6) + "\n"), ["episodes", 0, "id"], "expected pattern '^[0-9a-f]{32}$', got '000000000000...00000000006\\n'"),
    "a number as task": (with_field(task=3), ["episodes", 0, "task"], "expected a valid string, got 3"),
    "a long task": (with_field(task="a" * 2001), ["episodes", 0, "task"], "expected at most 2000 characters, got 'aaaaaaaaaaaa...aaaaaaaaaaaaa'"),
    "no environment": (with_field(env=-1), ["episodes", 0, "env"], "expected greater than or equal to 0, got -1"),
    "a threshold that is none": (with_field(threshold=float("nan")), ["episodes", 0, "threshold"], "expected a finite number, got nan"),
    "an end that is none": (with_field(ended="yes"), ["episodes", 0, "ended"], "expected a valid boolean, got 'yes'"),
    "half a step": (report(episode(6, step(0.5))), ["episodes", 0, "steps", 0, "step"], "expected a valid integer, got 0.5"),  # type: ignore[arg-type]
    "a step before the first": (report(episode(6, step(-1))), ["episodes", 0, "steps", 0, "step"], "expected greater than or equal to 0, got -1"),
    "a step that no chart can show": (report(episode(6, step(10**9 + 1))), ["episodes", 0, "steps", 0, "step"], "expected less than or equal to 1000000000, got 1000000001"),
    "NaN": (report(episode(6, step(0, float("nan")))), ["episodes", 0, "steps", 0, "progress"], "expected a finite number, got nan"),
    "infinity": (report(episode(6, step(0, 0.5, float("inf")))), ["episodes", 0, "steps", 0, "success"], "expected a finite number, got inf"),
    "a text as score": (report(episode(6, step(0, "1"))), ["episodes", 0, "steps", 0, "progress"], "expected a valid number, got '1'"),  # type: ignore[arg-type]
    "a time before": (report(episode(6, step(0, ms=-1.0))), ["episodes", 0, "steps", 0, "ms"], "expected greater than or equal to 0, got -1.0"),
    "no base64": (report(**{identity(6): "%%%"}), ["frames", identity(6)], "expected base64, got other text"),
    "a number as frame": (report(**{identity(6): 3}), ["frames", identity(6)], "expected base64, got int"),  # type: ignore[arg-type]
    "another file as frame": (report(**{identity(6): NO_IMAGE}), ["frames", identity(6)], "expected a JPEG file of at most 1024x1024 pixels, got another file"),
    "a PNG": (report(**{identity(6): base64.b64encode(PNG.getvalue()).decode()}), ["frames", identity(6)], "expected a JPEG file of at most 1024x1024 pixels, got another file"),
    "a wide frame": (report(**{identity(6): jpeg(picture(0, (4, 1025)))}), ["frames", identity(6)], "expected a JPEG file of at most 1024x1024 pixels, got 1025x4"),
    "a heavy frame": (report(**{identity(6): "A" * 200_000}), ["frames", identity(6)], "expected at most 131072 bytes, got more"),
    "a frame of a path": (report(**{"../x": jpeg(picture())}), ["frames", "../x"], "expected pattern '^[0-9a-f]{32}$', got '../x'"),
}  # fmt: skip


@pytest.mark.parametrize(("body", "loc", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_report_is_refused(gateway: Gateway, body: Any, loc: list[Any], message: str) -> None:
    response = post(gateway, body)
    assert response.status_code == 422, response.text
    (detail,) = response.json()["detail"]
    assert (detail["loc"], detail["msg"]) == (["body", *loc], message)
    assert identity(6) not in {each["id"] for each in told(gateway)["episodes"]}


def test_a_number_of_many_digits_is_refused(gateway: Gateway) -> None:
    body = json.dumps(with_field(env=7)).replace('"env": 7', '"env": ' + "9" * 10_000).encode()
    assert post(gateway, body).status_code == 422


def test_many_errors_are_told_in_part(gateway: Gateway) -> None:
    response = post(gateway, {**report(), **{f"more {number}": 1 for number in range(500)}})
    assert len(response.json()["detail"]) == 20


@pytest.mark.parametrize("place", ["episodes", "steps"])
def test_a_list_of_errors_is_read_to_the_first(gateway: Gateway, place: str) -> None:
    zeros: list[Any] = [0] * 1_000_000
    (detail,) = post(gateway, report(*([episode(6, *zeros)] if place == "steps" else zeros))).json()["detail"]
    assert detail["msg"] == "expected an object, got 0"


def test_what_errors_hold_counts_as_memory() -> None:
    body = json.dumps({**report(), **{f"more {number}": 1 for number in range(1000)}}).encode()
    with Memory(2**20).share() as share, pytest.raises(HTTPException) as error:
        read_report(body, share)
    assert error.value.status_code == 413


def test_a_large_report_is_refused(gateway: Gateway) -> None:
    message = "body: expected at most 4194304 bytes, got more"
    assert failure(post(gateway, b" " * (live_report.MOST_BODY_BYTES + 1)), 413) == message
    too_many = [step(number) for number in range(2001)]
    (detail,) = post(gateway, report(episode(6, *too_many))).json()["detail"]
    assert detail["msg"].startswith("expected at most 2000 items")


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", ""])
def test_a_page_of_elsewhere_cannot_report_unasked(gateway: Gateway, kind: str) -> None:
    told_reason = failure(post(gateway, report(episode(7, step(0))), **{"content-type": kind}), 415)
    assert told_reason == f"content-type: expected application/json, got {reprlib.repr(kind)}"


def test_the_key_guards_reports_and_what_is_told(tmp_path: Path) -> None:
    with running(Endpoints.free(), tmp_path, RFM_GATEWAY_API_KEY=KEY) as gateway:
        message = "key: expected X-API-Key or Authorization: Bearer, got another or none"
        body = report(episode(1, step(0)), **{identity(1): jpeg(picture())})
        for headers in ({}, {"X-API-Key": "another"}):
            assert failure(post(gateway, body, **headers), 401) == message
            assert failure(frame_of(gateway, identity(1), **headers), 401) == message
            assert failure(requests.get(f"{gateway.url}/viewer/live", headers=headers, timeout=60), 401) == message
        assert told(gateway, **{"X-API-Key": KEY})["episodes"] == []
        with LiveView(gateway.url, api_key=KEY) as view:
            view.episode("stack the cups").add(picture(), StepScore(0.5, 0.25, False, 0, 3.0))
        (found,) = told(gateway, **{"X-API-Key": KEY})["episodes"]
        assert (found["progress"], found["success"], found["has_ended"]) == ([0.5], [0.25], True)
        assert frame_of(gateway, found["id"], **{"X-API-Key": KEY}).ok


def test_a_wrong_key_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with running(Endpoints.free(), tmp_path, RFM_GATEWAY_API_KEY=KEY) as gateway:
        with LiveView(gateway.url, api_key="another") as view:
            view.episode("stack the cups").add(picture(), StepScore(0.5, 0.25, False, 0, 3.0))
        assert "got 401" in caplog.text
        assert KEY not in caplog.text


def test_without_the_page_nothing_is_taken(tmp_path: Path) -> None:
    with running(Endpoints.free(), tmp_path, "rfm", "--no-viewer") as gateway:
        assert failure(post(gateway, report(episode(1, step(0)))), 404) == "Not Found"
        assert failure(frame_of(gateway, identity(1)), 404) == "Not Found"


def test_a_curve_keeps_its_newest_points() -> None:
    episodes = LiveEpisodes()
    taken(episodes, report(episode(1, *[step(number) for number in range(2000)])))
    taken(episodes, report(episode(1, *[step(number) for number in range(2000, 2500)])))
    (found,) = episodes.since("")["episodes"]
    assert found["steps"] == list(range(2500 - MOST_POINTS, 2500))


def test_the_episode_that_was_silent_for_longest_goes_first() -> None:
    episodes = LiveEpisodes()
    for number in range(MOST_EPISODES):
        taken(episodes, report(episode(number, step(0))))
    taken(episodes, report(episode(0, step(1))))
    taken(episodes, report(episode(1000, step(0))))
    kept = {each["id"] for each in episodes.since("")["episodes"]}
    assert len(kept) == MOST_EPISODES
    assert {identity(0), identity(2), identity(1000)} <= kept
    assert identity(1) not in kept
    taken(episodes, report(*[episode(number, step(0)) for number in range(2000, 2500)]))  # more than fit, at once
    assert len(episodes.since("")["episodes"]) == MOST_EPISODES


def test_an_episode_that_has_ended_goes_before_one_that_runs() -> None:
    episodes = LiveEpisodes()
    for number in range(MOST_EPISODES):
        taken(episodes, report(episode(number, step(0), ended=number == 7)))
    taken(episodes, report(episode(1000, step(0))))
    kept = {each["id"] for each in episodes.since("")["episodes"]}
    assert kept == {identity(number) for number in (*range(MOST_EPISODES), 1000) if number != 7}


def test_the_end_of_an_episode_that_is_not_known_makes_none() -> None:
    episodes = LiveEpisodes()
    taken(episodes, report(episode(1, ended=True)))
    assert episodes.since("")["episodes"] == []


def test_an_episode_that_is_silent_is_forgotten() -> None:
    now_s = 1000.0
    episodes = LiveEpisodes(lambda: now_s)
    taken(episodes, report(episode(1, step(0)), **{identity(1): jpeg(picture())}))
    now_s += FORGOTTEN_AFTER_S - 1
    taken(episodes, report(episode(2, step(0))))
    assert [each["age_s"] for each in episodes.since("")["episodes"]] == [FORGOTTEN_AFTER_S - 1, 0.0]
    now_s += 2
    assert [each["id"] for each in episodes.since("")["episodes"]] == [identity(2)]
    assert episodes.frame(identity(1)) is None


def test_a_frame_of_an_episode_that_is_not_known_is_left_out() -> None:
    episodes = LiveEpisodes()
    taken(episodes, report(**{identity(1): jpeg(picture())}))
    assert episodes.frame(identity(1)) is None


def test_a_whole_report_of_the_client_is_within_the_limits() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (live.LONGEST_PX, live.LONGEST_PX, 3), np.uint8)
    about = {key: value for key, value in episode(1, task="a" * 300).items() if key not in ("ended", "steps")}
    entries = [({**about, "id": identity(n % 300)}, step(n)) for n in range(live.MOST_STEPS)]
    frames = {identity(n): noise for n in range(live.MOST_FRAMES)}
    body = live.report_body(entries, frames)  # type: ignore[arg-type]
    assert len(body) < live_report.MOST_BODY_BYTES
    with Memory(2**30).share() as share:
        news, pictures = read_report(body, share)
    assert (len(news), len(pictures)) == (300, live.MOST_FRAMES)
