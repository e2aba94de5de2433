# SPDX-License-Identifier: MIT
"""Running episodes at the gateway: storage, answers, refusals. No Triton is needed."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gateway_requests import failure
from gateways import TestClient, inside, running
from live_reports import Json, episode, identity, jpeg, picture, report, step
from rfm_client.episodes import StepScore
from rfm_page.live import FORGOTTEN_AFTER_S, MOST_BODY_BYTES, MOST_ENDED, MOST_EPISODES, LiveEpisodes, LiveReport
from rfm_rl import LiveView, live
from servers import Endpoints

KEY = "open sesame"


@pytest.fixture(scope="module")
def gateway() -> Iterator[TestClient]:
    with inside() as client:
        yield client


def post(gateway: TestClient, body: Any) -> Any:
    return gateway.post("/live/reports", content=body if isinstance(body, bytes) else json.dumps(body).encode())


def told(gateway: TestClient, after: str = "") -> Json:
    response = gateway.get("/viewer/live", params={"after": after})
    assert (response.status_code, response.headers["cache-control"]) == (200, "no-store"), response.text
    return response.json()  # type: ignore[no-any-return]


def of(answer: Json, number: int) -> Json:
    return next(each for each in answer["episodes"] if each["id"] == identity(number))


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
    post(gateway, report(episode(1, step(3))))  # the last question may be answered after the end
    third = of(told(gateway, second["cursor"]), 1)
    assert (third["steps"], third["has_ended"]) == ([3], True)


@pytest.mark.parametrize("after", ["nonsense", "²", f"{'0' * 16}.12", "{life}.1e9", "{life}." + "9" * 5000])
def test_an_unknown_cursor_gets_everything(gateway: TestClient, after: str) -> None:
    post(gateway, report(episode(2, step(0))))
    answer = told(gateway, after.format(life=told(gateway)["cursor"].partition(".")[0]))
    assert answer["is_whole"]
    assert 0 in of(answer, 2)["steps"]


def test_what_a_model_predicts_in_place_of_progress_is_kept_and_other_scores_are_refused(gateway: TestClient) -> None:
    steps = [step(number, None, None, instead={"remaining_s": 30.0 - number}) for number in range(2)]
    assert post(gateway, report(episode(40, *steps))).status_code == 204
    assert of(told(gateway), 40)["instead"] == {"remaining_s": [30.0, 29.0]}
    assert told(gateway)["scores"] == {"remaining_s": {"short": "time remaining", "unit": "s", "bounds": [None, None]}}
    assert of(told(gateway), 40)["newest"]["instead"] == {"remaining_s": 29.0}
    answer = post(gateway, report(episode(41, step(0, instead={"log_prob": -1.0}))))
    assert "expected only remaining_s, got 'log_prob'" in failure(answer, 422)


def test_a_report_that_comes_twice_counts_once(gateway: TestClient) -> None:
    for _ in range(2):
        post(gateway, report(episode(3, step(0, 0.1), step(1, 0.2))))
    post(gateway, report(episode(3, step(1, 0.9), step(5, 0.3))))
    assert of(told(gateway), 3)["steps"] == [0, 1, 5]
    assert of(told(gateway), 3)["progress"] == [0.1, 0.2, 0.3]


def test_the_newest_frame_has_an_address_of_its_own(gateway: TestClient) -> None:
    def frame_of(key: str) -> Any:
        return gateway.get(f"/viewer/live/{key}/frame")

    key = identity(5)
    post(gateway, report(episode(5, step(0)), **{key: jpeg(picture(1))}))
    first = frame_of(key)
    assert first.status_code == 200
    headers = {"content-type": "image/jpeg", "cache-control": "no-store", "x-content-type-options": "nosniff"}
    assert headers.items() <= dict(first.headers).items()
    assert np.abs(np.array(Image.open(io.BytesIO(first.content))).astype(int) - picture(1)).max() < 6
    known = told(gateway)
    post(gateway, report(**{key: jpeg(picture(2))}))
    assert of(told(gateway, known["cursor"]), 5)["frame"] > of(known, 5)["frame"]
    assert frame_of(key).content != first.content
    for other in (identity(404), "..%2f..%2fapp.py"):
        assert failure(frame_of(other), 404)


def changed(**fields: Any) -> Json:
    return report(episode(6, step(0), **fields))


def stepped(**fields: Any) -> Json:
    return report(episode(6, {**step(0), **fields}))


def framed(frame: Any) -> Json:
    return report(**{identity(6): frame})


PNG = io.BytesIO()
Image.fromarray(picture()).save(PNG, "PNG")
EPISODE, STEP, FRAME = ["episodes", 0], ["episodes", 0, "steps", 0], ["frames", identity(6)]
NO_JPEG = "expected a JPEG file of at most 1024x1024 pixels, got "
NO_ID = "expected pattern '^[0-9a-f]{32}$', got "
LONG = "expected at most 2000 characters, got 'aaaaaaaaaaaa...aaaaaaaaaaaaa'"
REFUSED: dict[str, tuple[Any, list[Any], str]] = {
    "no JSON": (b"no json", [], "expected JSON, got: expected ident at line 1 column 2"),
    "a list": ([], [], "expected an object, got []"),
    "no frames": ({"episodes": []}, ["frames"], "expected a value, got none"),
    "another field": ({**report(), "more": 1}, ["more"], "expected no such field, got 1"),
    "an id with a path": (changed(id="../etc"), [*EPISODE, "id"], f"{NO_ID}'../etc'"),
    "a number as task": (changed(task=3), [*EPISODE, "task"], "expected text, got 3"),
    "a long task": (changed(task="a" * 2001), [*EPISODE, "task"], LONG),
    "no environment": (changed(env=-1), [*EPISODE, "env"], "expected greater than or equal to 0, got -1"),
    "no threshold": (changed(threshold=float("nan")), [*EPISODE, "threshold"], "expected a finite number, got nan"),
    "no end": (changed(ended="yes"), [*EPISODE, "ended"], "expected a valid boolean, got 'yes'"),
    "half a step": (stepped(step=0.5), [*STEP, "step"], "expected a valid integer, got 0.5"),
    "infinity": (stepped(success=float("inf")), [*STEP, "success"], "expected a finite number, got inf"),
    "a text as score": (stepped(progress="1"), [*STEP, "progress"], "expected a valid number, got '1'"),
    "too many": (
        report(episode(6, *map(step, range(2001)))),
        [*EPISODE, "steps"],
        "expected at most 2000 items, got more",
    ),
    "many wrong fields": ({f"a{n}": 1 for n in range(999)}, [], "expected no faulty fields, got 1001"),
    "no base64": (framed("%%%"), FRAME, "expected base64, got other text"),
    "a number as frame": (framed(3), FRAME, "expected base64, got int"),
    "another file": (framed(base64.b64encode(PNG.getvalue()).decode()), FRAME, f"{NO_JPEG}another file"),
    "a wide frame": (framed(jpeg(picture(0, (4, 1025)))), FRAME, f"{NO_JPEG}1025x4"),
    "a heavy frame": (framed("A" * 200_000), FRAME, "expected at most 131072 bytes, got more"),
    "a frame of a path": (report(**{"../x": jpeg(picture())}), ["frames", "../x"], f"{NO_ID}'../x'"),
}


@pytest.mark.parametrize(("body", "loc", "message"), REFUSED.values(), ids=REFUSED)
def test_a_wrong_report_is_refused(gateway: TestClient, body: Any, loc: list[Any], message: str) -> None:
    response = post(gateway, body)
    assert response.status_code == 422, response.text
    (detail,) = response.json()["detail"]
    assert (detail["loc"], detail["msg"]) == (["body", *loc], message)
    assert identity(6) not in {each["id"] for each in told(gateway)["episodes"]}


def test_a_large_report_is_refused(gateway: TestClient) -> None:
    response = post(gateway, b" " * (MOST_BODY_BYTES + 1))
    assert failure(response, 413) == "body: expected at most 4194304 bytes, got more; send less in one request"


def test_a_view_reports_with_the_key_and_is_warned_of_a_wrong_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with running(Endpoints.free(), tmp_path, RFM_GATEWAY_API_KEY=KEY) as gateway:
        for key in ("another", KEY):
            with LiveView(gateway.url, api_key=key) as view:
                view.episode("stack the cups").add(picture(), StepScore(0.5, 0.25, False, 0, 3.0))
        (found,) = gateway.get("/viewer/live", headers={"X-API-Key": KEY}).json()["episodes"]
        assert (found["progress"], found["success"], found["has_ended"]) == ([0.5], [0.25], True)
        assert gateway.get(f"/viewer/live/{found['id']}/frame", headers={"X-API-Key": KEY}).ok
    assert "got 401" in caplog.text
    assert KEY not in caplog.text


def test_those_that_have_ended_go_first_then_those_that_were_silent_for_longest() -> None:
    episodes = LiveEpisodes()
    for number in range(MOST_EPISODES):
        taken(episodes, report(episode(number, step(0), ended=number == 7)))
    taken(episodes, report(episode(0, step(1))))
    for number in (1000, 1001):
        taken(episodes, report(episode(number, step(0))))
    kept = {each["id"] for each in episodes.since("")["episodes"]}
    assert kept == {identity(number) for number in (*range(MOST_EPISODES), 1000, 1001) if number not in (1, 7)}


def test_a_silent_episode_is_forgotten_and_an_end_or_a_frame_makes_none() -> None:
    now_s = 1000.0
    episodes = LiveEpisodes(lambda: now_s)
    taken(episodes, report(episode(1, step(0)), **{identity(1): jpeg(picture())}))
    now_s += FORGOTTEN_AFTER_S - 1
    taken(episodes, report(episode(2, step(0))))
    assert [each["age_s"] for each in episodes.since("")["episodes"]] == [FORGOTTEN_AFTER_S - 1, 0.0]
    now_s += 2
    taken(episodes, report(episode(3, ended=True), **{identity(3): jpeg(picture())}))
    assert [each["id"] for each in episodes.since("")["episodes"]] == [identity(2)]
    assert episodes.frame(identity(1)) is episodes.frame(identity(3)) is None


def test_how_episodes_ended_is_kept_by_run_and_changes_with_late_rewards() -> None:
    episodes = LiveEpisodes()
    taken(episodes, report(episode(1, step(0, 0.5), step(1, 0.75, succeeded=True), ended=True)))
    first = episodes.since("")
    result = {"id": identity(1), "run": "run", "number": 1, "total_reward": None, "leading": "progress", "value": 0.75}
    assert first["ended"] == [{**result, "success": 0.5, "succeeded": True, "num_steps": 2}]
    taken(episodes, report(episode(2, step(0, None, instead={"remaining_s": 3.0}), name="other", ended=True)))
    taken(episodes, report(episode(3, step(0), ended=True)))
    second = episodes.since(first["cursor"])
    found = [(end["run"], end["number"], end["leading"], end["value"]) for end in second["ended"]]
    assert found == [("other", 1, "remaining_s", 3.0), ("run", 2, "progress", 0.25)]
    taken(episodes, report(episode(1, reward=0.5, total_reward=1.5)))
    third = episodes.since(second["cursor"])
    assert [(end["number"], end["total_reward"]) for end in third["ended"]] == [(1, 1.5)]
    assert (of(third, 1)["reward"], of(third, 1)["total_reward"]) == (0.5, 1.5)


def test_more_episodes_end_than_are_kept_and_their_numbers_go_on() -> None:
    episodes = LiveEpisodes()
    for number in range(MOST_ENDED + 2):
        taken(episodes, report(episode(number, step(0), ended=True)))
    answer = episodes.since("")
    assert len(answer["episodes"]) == MOST_EPISODES
    assert [end["number"] for end in answer["ended"]] == list(range(3, MOST_ENDED + 3))


def test_a_whole_report_of_the_client_is_within_the_limits() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (live.LONGEST_PX, live.LONGEST_PX, 3), np.uint8)
    about = {key: value for key, value in episode(1, task="a" * 300).items() if key not in ("ended", "steps")}
    entries = [({**about, "id": identity(n % 300)}, step(n)) for n in range(live.MOST_STEPS)]
    body = live.report_body(entries, {identity(n): noise for n in range(live.MOST_FRAMES)})  # type: ignore[arg-type]
    assert len(body) < MOST_BODY_BYTES
    read = LiveReport.read(body)
    assert (len(read.episodes), len(read.frames)) == (300, live.MOST_FRAMES)
