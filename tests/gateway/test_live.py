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
from PIL import Image

from gateway_requests import failure
from gateways import TestClient, inside, running
from live_reports import Json, episode, identity, jpeg, picture, report, step
from rfm.launch.process import Endpoints
from rfm_client import LiveView
from rfm_client.episodes import StepScore, live
from rfm_gateway.viewer.live import (
    FORGOTTEN_AFTER_S,
    MOST_BODY_BYTES,
    MOST_EPISODES,
    MOST_POINTS,
    LiveEpisodes,
    LiveReport,
)

KEY = "open sesame"


@pytest.fixture(scope="module")
def gateway() -> Iterator[TestClient]:
    with inside() as client:
        yield client


def post(gateway: TestClient, body: Any, kind: str = "application/json") -> Any:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return gateway.post("/live/reports", content=content, headers={"content-type": kind})


def told(gateway: TestClient, after: str = "") -> Json:
    response = gateway.get("/viewer/live", params={"after": after})
    assert (response.status_code, response.headers["cache-control"]) == (200, "no-store"), response.text
    return response.json()  # type: ignore[no-any-return]


def of(answer: Json, number: int) -> Json:
    return next(each for each in answer["episodes"] if each["id"] == identity(number))


def frame_of(gateway: TestClient, key: str) -> Any:
    return gateway.get(f"/viewer/live/{key}/frame")


def taken(episodes: LiveEpisodes, body: Json) -> None:
    episodes.take(LiveReport.read(json.dumps(body).encode()))


def test_an_answer_has_everything_and_the_next_one_what_is_new(gateway: TestClient) -> None:
    assert post(gateway, report(episode(1, step(0, 0.1), step(1, 0.2)))).status_code == 204
    first = told(gateway)
    assert first["is_whole"]
    known = of(first, 1)
    assert (known["steps"], known["progress"], known["success"]) == ([0, 1], [0.1, 0.2], [0.5, 0.5])
    assert (known["name"], known["env"], known["task"], known["threshold"]) == ("run", 0, "stack the cups", 0.5)
    assert (known["newest"]["ms"], known["has_ended"], known["frame"]) == (12.5, False, None)
    assert known["age_s"] >= 0
    post(gateway, report(episode(1, step(2, None, None))))
    second = told(gateway, first["cursor"])
    assert not second["is_whole"]
    assert (of(second, 1)["steps"], of(second, 1)["progress"], of(second, 1)["success"]) == ([2], [None], [None])
    assert of(told(gateway, second["cursor"]), 1).keys() == {"id", "age_s"}
    post(gateway, report(episode(1, ended=True)))
    assert of(told(gateway, second["cursor"]), 1)["has_ended"]


@pytest.mark.parametrize("after", ["", "0.5", "nonsense", "²", f"{'0' * 16}.12", "{life}.1e9", "{life}." + "9" * 5000])
def test_a_cursor_of_nobody_gets_everything(gateway: TestClient, after: str) -> None:
    post(gateway, report(episode(2, step(0))))
    answer = told(gateway, after.format(life=told(gateway)["cursor"].partition(".")[0]))
    assert answer["is_whole"]
    assert 0 in of(answer, 2)["steps"]


def test_a_report_that_comes_twice_counts_once(gateway: TestClient) -> None:
    for _ in range(2):
        post(gateway, report(episode(3, step(0, 0.1), step(1, 0.2))))
    post(gateway, report(episode(3, step(1, 0.9), step(5, 0.3))))
    assert of(told(gateway), 3)["steps"] == [0, 1, 5]
    assert of(told(gateway), 3)["progress"] == [0.1, 0.2, 0.3]


def test_an_end_stays_an_end(gateway: TestClient) -> None:
    post(gateway, report(episode(4, step(0), ended=True)))
    post(gateway, report(episode(4, step(1))))  # the last question may be answered after the end
    assert (of(told(gateway), 4)["steps"], of(told(gateway), 4)["has_ended"]) == ([0, 1], True)


def test_the_newest_frame_has_an_address_of_its_own(gateway: TestClient) -> None:
    key = identity(5)
    post(gateway, report(episode(5, step(0)), **{key: jpeg(picture(1))}))
    first = frame_of(gateway, key)
    assert first.status_code == 200
    headers = {"content-type": "image/jpeg", "cache-control": "no-store", "x-content-type-options": "nosniff"}
    assert headers.items() <= dict(first.headers).items()
    assert np.abs(np.array(Image.open(io.BytesIO(first.content))).astype(int) - picture(1)).max() < 6
    known = told(gateway)
    post(gateway, report(**{key: jpeg(picture(2))}))
    assert of(told(gateway, known["cursor"]), 5)["steps"] == []
    assert of(told(gateway, known["cursor"]), 5)["frame"] > of(known, 5)["frame"]
    assert frame_of(gateway, key).content != first.content
    for other in (identity(404), "..%2f..%2fapp.py", "%00", "a" * 5000):
        assert "detail" in frame_of(gateway, other).json()
        assert frame_of(gateway, other).status_code == 404


def with_field(**fields: Any) -> Json:
    return report(episode(6, step(0), **fields))


def in_step(**fields: Any) -> Json:
    return report(episode(6, {**step(0), **fields}))


NO_IMAGE = base64.b64encode(b"<svg onload='alert(1)'/>").decode()
PNG = io.BytesIO()
Image.fromarray(picture()).save(PNG, "PNG")
EPISODE, STEP, FRAME = ["episodes", 0], ["episodes", 0, "steps", 0], ["frames", identity(6)]
NO_JPEG = "expected a JPEG file of at most 1024x1024 pixels, got "
REFUSED: dict[str, tuple[Any, list[Any], str]] = {
    "no JSON": (b"no json", [], "expected JSON, got: expected ident at line 1 column 2"),
    "a list": ([], [], "expected an object, got []"),
    "no frames": ({"episodes": []}, ["frames"], "expected a value, got none"),
    "another field": ({**report(), "more": 1}, ["more"], "expected no such field, got 1"),
    "an id with a path": (with_field(id="../etc"), [*EPISODE, "id"], "expected pattern '^[0-9a-f]{32}$', got '../etc'"),
    "an id and a line": (with_field(id=identity(6) + "\n"), [*EPISODE, "id"], "expected pattern '^[0-9a-f]{32}$', got '000000000000...00000000006\\n'"),
    "a number as task": (with_field(task=3), [*EPISODE, "task"], "expected text, got 3"),
    "a long task": (with_field(task="a" * 2001), [*EPISODE, "task"], "expected at most 2000 characters, got 'aaaaaaaaaaaa...aaaaaaaaaaaaa'"),
    "no environment": (with_field(env=-1), [*EPISODE, "env"], "expected greater than or equal to 0, got -1"),
    "a threshold that is none": (with_field(threshold=float("nan")), [*EPISODE, "threshold"], "expected a finite number, got nan"),
    "an end that is none": (with_field(ended="yes"), [*EPISODE, "ended"], "expected a valid boolean, got 'yes'"),
    "half a step": (in_step(step=0.5), [*STEP, "step"], "expected a valid integer, got 0.5"),
    "a step that no chart can show": (in_step(step=10**9 + 1), [*STEP, "step"], "expected less than or equal to 1000000000, got 1000000001"),
    "infinity": (in_step(success=float("inf")), [*STEP, "success"], "expected a finite number, got inf"),
    "a text as score": (in_step(progress="1"), [*STEP, "progress"], "expected a valid number, got '1'"),
    "a time before": (in_step(ms=-1.0), [*STEP, "ms"], "expected greater than or equal to 0, got -1.0"),
    "too many steps": (report(episode(6, *map(step, range(2001)))), [*EPISODE, "steps"], "expected at most 2000 items, got more"),
    "many wrong episodes": (report(*[0] * 1_000_000), EPISODE, "expected an object, got 0"),  # type: ignore[list-item]
    "many wrong fields": ({**report(), **{f"more {n}": 1 for n in range(1001)}}, [], "expected no faulty fields, got 1001"),
    "no base64": (report(**{identity(6): "%%%"}), FRAME, "expected base64, got other text"),
    "a number as frame": (report(**{identity(6): 3}), FRAME, "expected base64, got int"),  # type: ignore[arg-type]
    "another file as frame": (report(**{identity(6): NO_IMAGE}), FRAME, f"{NO_JPEG}another file"),
    "a PNG": (report(**{identity(6): base64.b64encode(PNG.getvalue()).decode()}), FRAME, f"{NO_JPEG}another file"),
    "a wide frame": (report(**{identity(6): jpeg(picture(0, (4, 1025)))}), FRAME, f"{NO_JPEG}1025x4"),
    "a heavy frame": (report(**{identity(6): "A" * 200_000}), FRAME, "expected at most 131072 bytes, got more"),
    "a frame of a path": (report(**{"../x": jpeg(picture())}), ["frames", "../x"], "expected pattern '^[0-9a-f]{32}$', got '../x'"),
}  # fmt: skip


@pytest.mark.parametrize(("body", "loc", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_report_is_refused(gateway: TestClient, body: Any, loc: list[Any], message: str) -> None:
    response = post(gateway, body)
    assert response.status_code == 422, response.text
    (detail,) = response.json()["detail"]
    assert (detail["loc"], detail["msg"]) == (["body", *loc], message)
    assert identity(6) not in {each["id"] for each in told(gateway)["episodes"]}


def test_a_large_report_is_refused(gateway: TestClient) -> None:
    response = post(gateway, b" " * (MOST_BODY_BYTES + 1))
    assert failure(response, 413) == "body: expected at most 4194304 bytes, got more"


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", ""])
def test_a_page_of_elsewhere_cannot_report_unasked(gateway: TestClient, kind: str) -> None:
    expected = f"content-type: expected application/json, got {reprlib.repr(kind)}"
    assert failure(post(gateway, report(episode(7, step(0))), kind), 415) == expected


def test_a_view_reports_with_the_key_and_is_warned_of_a_wrong_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with running(Endpoints.free(), tmp_path, RFM_GATEWAY_API_KEY=KEY) as gateway:
        for key in ("another", KEY):
            with LiveView(gateway.url, api_key=key) as view:
                view.episode("stack the cups").add(picture(), StepScore(0.5, 0.25, False, 0, 3.0))
        answer = gateway.get("/viewer/live", headers={"X-API-Key": KEY}).json()
        (found,) = answer["episodes"]
        assert (found["progress"], found["success"], found["has_ended"]) == ([0.5], [0.25], True)
        assert gateway.get(f"/viewer/live/{found['id']}/frame", headers={"X-API-Key": KEY}).ok
    assert "got 401" in caplog.text
    assert KEY not in caplog.text


def test_a_curve_keeps_its_newest_points() -> None:
    episodes = LiveEpisodes()
    for first in (0, 2000):
        taken(episodes, report(episode(1, *[step(first + number) for number in range(2000)])))
    (found,) = episodes.since("")["episodes"]
    assert found["steps"] == list(range(4000 - MOST_POINTS, 4000))


def test_those_that_have_ended_go_first_then_those_that_were_silent_for_longest() -> None:
    episodes = LiveEpisodes()
    for number in range(MOST_EPISODES):
        taken(episodes, report(episode(number, step(0), ended=number == 7)))
    taken(episodes, report(episode(0, step(1))))
    for number in (1000, 1001):
        taken(episodes, report(episode(number, step(0))))
    kept = {each["id"] for each in episodes.since("")["episodes"]}
    assert kept == {identity(number) for number in (*range(MOST_EPISODES), 1000, 1001) if number not in (1, 7)}
    taken(episodes, report(*[episode(number, step(0)) for number in range(2000, 2500)]))  # more than fit, at once
    assert len(episodes.since("")["episodes"]) == MOST_EPISODES


def test_an_end_or_a_frame_of_an_episode_that_is_not_known_makes_none() -> None:
    episodes = LiveEpisodes()
    taken(episodes, report(episode(1, ended=True), **{identity(2): jpeg(picture())}))
    assert episodes.since("")["episodes"] == []
    assert episodes.frame(identity(2)) is None


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


def test_a_whole_report_of_the_client_is_within_the_limits() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (live.LONGEST_PX, live.LONGEST_PX, 3), np.uint8)
    about = {key: value for key, value in episode(1, task="a" * 300).items() if key not in ("ended", "steps")}
    entries = [({**about, "id": identity(n % 300)}, step(n)) for n in range(live.MOST_STEPS)]
    body = live.report_body(entries, {identity(n): noise for n in range(live.MOST_FRAMES)})  # type: ignore[arg-type]
    assert len(body) < MOST_BODY_BYTES
    read = LiveReport.read(body)
    assert (len(read.episodes), len(read.frames)) == (300, live.MOST_FRAMES)
