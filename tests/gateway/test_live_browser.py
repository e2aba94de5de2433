# SPDX-License-Identifier: MIT
"""The page's tab of running episodes in Chromium: a gateway, a real Triton with the demo's checkpoint, real episodes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from selenium.webdriver import Keys

from browsers import IMAGES_VARIABLE, Browser, chromium
from gateways import Gateway, poll, running
from rfm.launch.process import Endpoints
from rfm_client import LiveView, RewardClient
from rfm_client.contract.samples import UInt8Array
from rfm_client.episodes import StepScore
from toy_world import Task, make_clip

pytestmark = [pytest.mark.triton, pytest.mark.slow]

TASK = Task("red", "bowl")
KEY = "open sesame"
ATTACK = "</p><img src=x onerror=\"document.title='attacked'\"><script>document.title='attacked'</script>"
KEEP_CURVES = """
const done = arguments[0];
import("/viewer/chart.js").then(({ Chart }) => {
  const { show } = Chart.prototype;
  window.drawn = {};
  Chart.prototype.show = function (curves) {
    for (const { times, progress, success } of curves) window.drawn[curves[0].label] = { times, progress, success };
    return show.call(this, curves);
  };
  done();
});
"""


def film(kind: str = "success", seed: int = 2_000_000) -> UInt8Array:
    return make_clip(kind, TASK, seed).frames


@dataclass(frozen=True)
class Stage:
    """A gateway, the Triton behind it, and a browser."""

    gateway: Gateway
    browser: Browser

    def cards(self, run: str) -> list[dict[str, str]]:
        """What the page shows of the episodes of a run, in its order."""
        return self.browser.run(  # type: ignore[no-any-return]
            """
            const text = (card, tag) => card.querySelector(tag).textContent;
            return [...document.querySelectorAll("#live-episodes article")]
              .filter((card) => text(card, "h2").startsWith(arguments[0] + ","))
              .map((card) => ({
                title: text(card, "h2"), state: text(card, ".state"), task: card.querySelectorAll("p")[1].textContent,
                chart: card.querySelector(".chart").getAttribute("aria-label"),
                ...Object.fromEntries([...card.querySelectorAll("dl div")].map((each) => [...each.children].map((c) => c.textContent))),
              }));
            """,
            run,
        )

    def drawn(self, name: str) -> dict[str, list[float]]:
        """The curve that the chart of an episode has drawn last."""
        return self.browser.run("return window.drawn[arguments[0]]", name)  # type: ignore[no-any-return]

    def shows(self, run: str, *expected: dict[str, str]) -> None:
        """Waits until the page shows these episodes of a run."""

        def is_so() -> bool:
            cards = self.cards(run)
            return len(cards) == len(expected) and all(
                fields.items() <= card.items() for card, fields in zip(cards, expected, strict=True)
            )

        poll(is_so)

    def pixels(self, run: str) -> list[UInt8Array]:
        """The newest frame of each episode of a run, as the page shows it: uint8 [H, W, 3]."""
        found = self.browser.run(
            """
            return [...document.querySelectorAll("#live-episodes article")]
              .filter((card) => card.querySelector("h2").textContent.startsWith(arguments[0] + ","))
              .map((card) => card.querySelector("img"))
              .filter((image) => !image.hidden && image.complete && image.naturalWidth)
              .map((image) => {
                const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
                const context = canvas.getContext("2d");
                context.drawImage(image, 0, 0);
                return [canvas.height, canvas.width, [...context.getImageData(0, 0, canvas.width, canvas.height).data]];
              });
            """,
            run,
        )
        return [np.array(data, np.uint8).reshape(height, width, 4)[..., :3] for height, width, data in found]


@pytest.fixture(scope="module")
def stage(demo_server: Endpoints, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    folder = tmp_path_factory.mktemp("stage")
    with running(demo_server, folder) as gateway, chromium(folder / "downloads") as browser:
        yield Stage(gateway, browser)
        asked = browser.asked()
        assert any(url.endswith("/frame") for url in asked)
        assert [url for url in asked if not url.startswith((gateway.url, "blob:", "data:"))] == []


@pytest.fixture
def page(stage: Stage) -> Iterator[Stage]:
    """The tab of running episodes, ready."""
    stage.browser.open(stage.gateway.url)
    stage.browser.until("document.getElementById('model').value")
    stage.browser.driver.execute_async_script(KEEP_CURVES)
    stage.browser["live-tab"].click()
    yield stage
    assert stage.browser.complaints() == []


@pytest.fixture
def client(demo_server: Endpoints) -> Iterator[RewardClient]:
    with RewardClient(demo_server.grpc_url) as opened:
        yield opened


def number(value: float) -> str:
    return f"{value:.3f}"


def test_without_episodes_the_page_tells_how_to_report_them(page: Stage, client: RewardClient) -> None:
    assert page.browser["no-live"].is_displayed()
    origin = {"origin": page.gateway.url, "permission": {"name": "clipboard-write"}, "setting": "granted"}
    page.browser.driver.execute_cdp_cmd("Browser.setPermission", origin)
    page.browser["live-copy"].click()
    page.browser.until("document.getElementById('status').textContent === 'The lines are copied.'")
    code = page.browser["live-code"].text
    assert f'LiveView("{page.gateway.url}")' in code
    names: dict[str, Any] = {"client": client}
    exec(code, names)
    score = names["episode"].add(film()[0])
    page.shows("Episode", {"Step": "0", "Progress": number(score.progress), "task": "stack the cups"})
    assert not page.browser["no-live"].is_displayed()
    names["live"].close()
    page.shows("Episode", {"state": "ended"})


def test_the_arrow_keys_reach_the_tab(page: Stage) -> None:
    page.browser["live-tab"].send_keys(Keys.ARROW_RIGHT)
    assert page.browser["score-panel"].is_displayed()
    page.browser["score-tab"].send_keys(Keys.ARROW_LEFT)
    assert page.browser["live-panel"].is_displayed()
    assert page.browser.run("return document.activeElement.id") == "live-tab"


def test_a_curve_has_the_numbers_that_add_returned(page: Stage, client: RewardClient) -> None:
    frames = film()
    with (
        LiveView(page.gateway.url, name="exact") as view,
        client.episode(TASK.sentence(), live=view) as episode,
    ):
        scores: list[StepScore] = []
        for frame in frames:
            scores.append(episode.add(frame))
            if len(scores) in (1, 5, len(frames)):
                newest = scores[-1]
                page.shows(
                    "exact",
                    {
                        "state": "running, succeeded" if newest.succeeded else "running",
                        "task": TASK.sentence(),
                        "Step": f"{newest.step}",
                        "Progress": number(newest.progress),
                        "Success": number(newest.success),
                        "Lag": f"{newest.ms:.0f} ms",
                    },
                )
                drawn = page.drawn("exact, environment 0")
                assert drawn["times"] == [score.step for score in scores]
                assert drawn["progress"] == [score.progress for score in scores]
                assert drawn["success"] == [score.success for score in scores]
                poll(lambda newest_frame=frame: is_shown(page, "exact", newest_frame))  # type: ignore[misc]
    (card,) = page.cards("exact")
    assert card["chart"] == (
        f"{len(frames)} steps: last progress {number(scores[-1].progress)}, last success {number(scores[-1].success)}"
    )


def is_shown(page: Stage, run: str, *frames: UInt8Array) -> bool:
    """Whether the page shows these frames of a run, as JPEG keeps them."""
    shown = page.pixels(run)
    off = [float(np.abs(one.astype(int) - other).mean()) for one, other in zip(shown, frames, strict=False)]
    return len(shown) == len(frames) and max(off) < 2


def test_two_environments_and_a_reset(page: Stage, client: RewardClient) -> None:
    films = [film("success"), film("dropped", 2_000_001)]
    with LiveView(page.gateway.url, name="pair") as view:
        episodes = client.episodes(2, [TASK.sentence(), "open the drawer"], live=view)
        for frames in zip(*films, strict=True):
            scores = episodes.add(list(frames))
        last = str(len(films[0]) - 1)
        page.shows(
            "pair",
            *[
                {
                    "title": f"pair, environment {env}",
                    "task": task,
                    "Step": last,
                    "Progress": number(scores.progress[env]),
                }
                for env, task in enumerate([TASK.sentence(), "open the drawer"])
            ],
        )
        poll(lambda: is_shown(page, "pair", *[frames[-1] for frames in films]))
        episodes.reset([True, False])
        again = episodes.add([films[1][0], films[1][0]], [True, False])
        page.shows(
            "pair",
            {"title": "pair, environment 0", "Step": "0", "Progress": number(again.progress[0])},
            {"title": "pair, environment 1", "Step": last},
            {
                "title": "pair, environment 0",
                "state": "ended, succeeded",
                "Step": last,
                "Progress": number(scores.progress[0]),
            },
        )
    page.shows("pair", *[{"Step": step} for step in ("0", last, last)])
    poll(lambda: all(card["state"].startswith("ended") for card in page.cards("pair")))


def test_the_time_since_the_last_step_goes_on(page: Stage) -> None:
    with LiveView(page.gateway.url, name="silent") as view:
        view.episode("wait").add(film()[0], StepScore(0.5, float("nan"), False, 0, 3.0))
        page.shows("silent", {"Success": "-", "Last step": "0 s ago"})
        page.shows("silent", {"Last step": "2 s ago", "state": "running"})


def test_a_page_that_is_loaded_later_shows_the_same(page: Stage) -> None:
    with LiveView(page.gateway.url, name="before") as view:
        episode = view.episode("wait")
        for step in range(1300):
            episode.add(film()[0], StepScore(step / 1300, 0.25, False, step, 3.0))
        page.shows("before", {"Step": "1299"})
        first = page.drawn("before, environment 0")
        page.browser.driver.refresh()
        page.browser.until("document.getElementById('model').value")
        page.browser.driver.execute_async_script(KEEP_CURVES)
        page.browser["live-tab"].click()
        page.shows("before", {"Step": "1299"})
        assert page.drawn("before, environment 0") == first
        assert first["times"] == list(range(300, 1300))


@pytest.mark.parametrize("first", [1, 5, 10**9])
def test_an_episode_that_is_first_heard_of_late_is_shown(page: Stage, first: int) -> None:
    """Its one point leaves the axis of the chart no length of its own."""
    with LiveView(page.gateway.url, name=f"late {first}") as view:
        view.episode("wait").add(film()[0], StepScore(0.5, 0.25, False, first, 3.0))
        page.shows(f"late {first}", {"Step": f"{first}", "state": "running"})
        assert page.drawn(f"late {first}, environment 0")["times"] == [first]
    page.shows(f"late {first}", {"Step": f"{first}", "state": "ended"})


def test_text_of_others_is_text(page: Stage) -> None:
    with LiveView(page.gateway.url, name=ATTACK) as view:
        view.episode(ATTACK).add(film()[0], StepScore(0.5, 0.25, False, 0, 3.0))
        page.shows(ATTACK, {"task": ATTACK, "Step": "0"})
    assert page.browser.all("#live-episodes script") == []
    assert page.browser.run("return document.title") == "Rewards of robot videos"


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_axe_finds_nothing(page: Stage, theme: str) -> None:
    with page.browser.theme(theme), LiveView(page.gateway.url, name=theme) as view:
        running_one, ended = view.episode("go on", 0), view.episode("end", 1)
        for step in range(3):
            for episode in (running_one, ended):
                episode.add(film()[step], StepScore(step / 3, 0.25, step == 2, step, 3.0))
        ended.end()
        page.shows(theme, {"state": "running, succeeded"}, {"state": "ended, succeeded"})
        poll(lambda: len(page.pixels(theme)) == 2)
        assert page.browser.violations() == []


def test_the_key_opens_the_tab(demo_server: Endpoints, tmp_path: Path) -> None:
    with (
        running(demo_server, tmp_path, RFM_GATEWAY_API_KEY=KEY) as gateway,
        chromium(tmp_path) as browser,
        LiveView(gateway.url, name="keyed", api_key=KEY) as view,
    ):
        page = Stage(gateway, browser)
        view.episode("wait").add(film()[0], StepScore(0.5, 0.25, False, 0, 3.0))
        browser.open(gateway.url)
        browser["live-tab"].click()
        browser.until("!document.getElementById('key-form').hidden")
        assert page.cards("keyed") == []
        browser.write("key", KEY)
        browser.all("#key-form button")[0].click()
        page.shows("keyed", {"Step": "0"})
        poll(lambda: len(page.pixels("keyed")) == 1)
        assert "api_key=" in browser.run("return document.getElementById('live-code').textContent")


def test_a_page_goes_on_with_a_gateway_that_comes_back(
    demo_server: Endpoints, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with chromium(tmp_path) as browser:
        with running(demo_server, tmp_path) as gateway:
            port = int(gateway.url.rpartition(":")[2])
            browser.open(gateway.url)
            browser["live-tab"].click()
            browser.until("!document.getElementById('no-live').hidden")
        told = browser.until("document.getElementById('errors').textContent")
        assert told.startswith("gateway: expected an answer, got none")
        monkeypatch.setattr("gateways.free_port", lambda: port)
        with running(demo_server, tmp_path) as gateway, LiveView(gateway.url, name="again") as view:
            view.episode("wait").add(film()[0], StepScore(0.5, 0.25, False, 0, 3.0))
            Stage(gateway, browser).shows("again", {"Step": "0"})
            browser.until("document.getElementById('errors').textContent === ''")


def test_a_picture_of_the_page(demo_server: Endpoints, client: RewardClient, tmp_path: Path) -> None:
    films = [film(kind, 2_000_000 + seed) for seed, kind in enumerate(["success", "dropped", "rewound", "success"])]
    with (
        running(demo_server, tmp_path) as gateway,
        chromium(tmp_path) as browser,
        LiveView(gateway.url, name="policy 7") as view,
    ):
        page = Stage(gateway, browser)
        browser.open(gateway.url)
        browser.until("document.getElementById('model').value")
        browser["live-tab"].click()
        episodes = client.episodes(len(films), TASK.sentence(), live=view)
        for frames in zip(*films, strict=True):
            episodes.add(list(frames))
        episodes.reset([False, True, False, True])
        for frame in films[0][:9]:
            episodes.add([films[3][0], frame, frame, films[2][0]], [False, True, False, False])
        poll(lambda: len(page.pixels("policy 7")) == 5 and page.cards("policy 7")[1]["Step"] == "8")
        browser.run("document.activeElement.blur(); scrollTo(0, 0)")
        browser.picture(Path(os.environ.get(IMAGES_VARIABLE, tmp_path)) / "page_live.png")
