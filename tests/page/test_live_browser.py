# SPDX-License-Identifier: MIT
"""The page's tab of running episodes in Chromium: a gateway, a real Triton with the demo's checkpoint, real episodes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from selenium.webdriver import ActionChains

from browsers import Browser
from gateways import Gateway, free_port, poll, running
from rfm_client import RewardClient, UInt8Array
from rfm_client.episodes import StepScore
from rfm_rl import LiveView
from servers import Endpoints
from toy_world import Task, make_clip

pytestmark = [pytest.mark.triton, pytest.mark.slow]

TASK = Task("red", "bowl")
SENTENCE = TASK.sentence()
FRAMES = make_clip("success", TASK, 2_000_000).frames
DROPPED = make_clip("dropped", TASK, 2_000_001).frames
SCORE = StepScore(0.5, 0.25, False, 0, 3.0)
ROUNDING_S = 0.5  # of whole seconds
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
CARDS = """
const text = (card, tag) => card.querySelector(tag).textContent;
return [...document.querySelectorAll(".live article")]
  .filter((card) => text(card, "h2").startsWith(arguments[0] + ","))
  .map((card) => ({
    title: text(card, "h2"), state: text(card, ".state"), task: card.querySelectorAll("p")[1].textContent,
    chart: card.querySelector(".chart").getAttribute("aria-label"),
    ...Object.fromEntries([...card.querySelectorAll("dl div")].map((each) => [...each.children].map((c) => c.textContent))),
  }));
"""
PICTURES = """
return [...document.querySelectorAll(".live article")]
  .filter((card) => card.querySelector("h2").textContent.startsWith(arguments[0] + ","))
  .map((card) => card.querySelector("img"))
  .filter((image) => !image.hidden && image.complete && image.naturalWidth);
"""


@dataclass(frozen=True)
class Page:
    """The tab of running episodes."""

    url: str
    browser: Browser

    def open(self) -> None:
        self.browser.open(self.url)
        self.browser.driver.execute_async_script(KEEP_CURVES)
        self.browser["live-tab"].click()

    def cards(self, run: str) -> list[dict[str, str]]:
        """Return the cards of a run's episodes in the page's order."""
        return list(self.browser.run(CARDS, run))

    def shows(self, run: str, *expected: dict[str, str]) -> None:
        """Waits until the page shows these episodes of a run."""

        def is_so() -> bool:
            cards = self.cards(run)
            return len(cards) == len(expected) and all(
                fields.items() <= card.items() for card, fields in zip(cards, expected, strict=True)
            )

        poll(is_so)

    def has_pictures(self, run: str, *frames: UInt8Array) -> bool:
        """Return True if the page shows these frames of a run, up to JPEG's losses."""
        shown = self.browser.pixels(self.browser.run(PICTURES, run))
        off = [float(np.abs(one.astype(int) - other).mean()) for one, other in zip(shown, frames, strict=False)]
        return len(shown) == len(frames) and max(off) < 2

    def drawn(self, name: str) -> dict[str, list[float]]:
        """Return the last curve in an episode's chart."""
        return dict(self.browser.run("return window.drawn[arguments[0]]", f"{name}, environment 0"))


@pytest.fixture(scope="module")
def gateway(demo_server: Endpoints, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    with running(demo_server, tmp_path_factory.mktemp("gateway")) as started:
        yield started


@pytest.fixture
def page(gateway: Gateway, quiet_browser: Browser) -> Page:
    """The tab, open."""
    page = Page(gateway.url, quiet_browser)
    page.open()
    return page


@pytest.fixture(scope="module")
def client(demo_server: Endpoints) -> Iterator[RewardClient]:
    with RewardClient(demo_server.grpc_url) as opened:
        yield opened


def number(value: float) -> str:
    return f"{value:.3f}"


def test_without_episodes_the_page_tells_how_to_report_them(page: Page, client: RewardClient) -> None:
    assert page.browser["no-live"].is_displayed()
    origin = {"origin": page.url, "permission": {"name": "clipboard-write"}, "setting": "granted"}
    page.browser.driver.execute_cdp_cmd("Browser.setPermission", origin)
    page.browser["live-copy"].click()
    page.browser.until_text("status", "The lines are copied.")
    code = page.browser["live-code"].text
    assert f'LiveView("{page.url}")' in code
    names: dict[str, Any] = {"client": client}
    exec(code, names)
    score = names["episode"].add(FRAMES[0])
    page.shows("Episode", {"Step": "0", "Progress": number(score.progress), "task": "stack the cups"})
    assert not page.browser["no-live"].is_displayed()
    names["live"].close()
    page.shows("Episode", {"state": "ended, no success"})


def test_a_curve_has_the_numbers_that_add_returned(page: Page, client: RewardClient) -> None:
    with LiveView(page.url, name="exact") as view, client.episode(SENTENCE, live=view) as episode:
        scores: list[StepScore] = []
        for frame in FRAMES:
            newest = episode.add(frame)
            scores.append(newest)
            if len(scores) in (1, len(FRAMES)):
                told = {
                    "state": "running, succeeded ✓" if newest.succeeded else "running",
                    "task": SENTENCE,
                    "Step": f"{newest.step}",
                    "Progress": number(newest.progress),
                    "Success": number(newest.success),
                    "Lag": f"{newest.ms:.0f} ms",
                }
                page.shows("exact", told)
                drawn = page.drawn("exact")
                assert drawn["times"] == [score.step for score in scores]
                assert drawn["progress"] == [score.progress for score in scores]
                assert drawn["success"] == [score.success for score in scores]
                poll(lambda newest_frame=frame: page.has_pictures("exact", newest_frame))  # type: ignore[misc]
    (card,) = page.cards("exact")
    last = f"final progress {number(scores[-1].progress)}, final success {number(scores[-1].success)}"
    assert card["chart"] == f"{len(FRAMES)} steps: {last}"


def test_two_environments_and_a_reset(page: Page, client: RewardClient) -> None:
    tasks = [SENTENCE, "open the drawer"]
    titles = [{"title": f"pair, environment {env}"} for env in range(2)]
    last = {"Step": f"{len(FRAMES) - 1}"}
    with LiveView(page.url, name="pair") as view:
        episodes = client.episodes(2, tasks, live=view)
        for frames in zip(FRAMES, DROPPED, strict=True):
            scores = episodes.add(list(frames))
        ends = [{**last, "Progress": number(progress)} for progress in scores.progress]
        page.shows("pair", *[{**titles[env], "task": tasks[env], **ends[env]} for env in range(2)])
        poll(lambda: page.has_pictures("pair", FRAMES[-1], DROPPED[-1]))
        episodes.reset([True, False])
        again = {"Step": "0", "Progress": number(episodes.add([DROPPED[0]] * 2, [True, False]).progress[0])}
        ended = {**titles[0], "state": "ended, succeeded ✓", **ends[0]}
        page.shows("pair", {**titles[0], **again}, {**titles[1], **last}, ended)
    page.shows("pair", {"Step": "0"}, last, last)
    poll(lambda: all(card["state"].startswith("ended") for card in page.cards("pair")))


def test_the_time_since_the_last_step_goes_on(page: Page) -> None:
    with LiveView(page.url, name="silent") as view:
        before_s = time.monotonic()
        view.episode("wait").add(FRAMES[0], StepScore(0.5, float("nan"), False, 0, 3.0))
        page.shows("silent", {"Success": "-", "state": "running"})

        def shown_s() -> int:
            (card,) = page.cards("silent")
            count, *rest = card["Last step"].split(" ")
            assert (rest, card["state"]) == (["s", "ago"], "running")
            assert int(count) <= time.monotonic() - before_s + ROUNDING_S
            return int(count)

        first_s = shown_s()
        poll(lambda: shown_s() >= first_s + 2)


def test_a_page_that_is_loaded_later_shows_the_same(page: Page) -> None:
    with LiveView(page.url, name="before") as view:
        episode = view.episode("wait")
        for step in range(1300):
            episode.add(FRAMES[0], StepScore(step / 1300, 0.25, False, step, 3.0))
        page.shows("before", {"Step": "1299"})
        first = page.drawn("before")
        page.open()
        page.shows("before", {"Step": "1299"})
        assert page.drawn("before") == first
        assert first["times"] == list(range(300, 1300))


@pytest.mark.parametrize("first", [1, 10**9])
def test_an_episode_that_is_first_heard_of_late_is_shown(page: Page, first: int) -> None:
    """A single point leaves the chart's axis without a length."""
    with LiveView(page.url, name=f"late {first}") as view:
        view.episode("wait").add(FRAMES[0], StepScore(0.5, 0.25, False, first, 3.0))
        page.shows(f"late {first}", {"Step": f"{first}", "state": "running"})
        assert page.drawn(f"late {first}")["times"] == [first]


RUNS = "return [...document.querySelectorAll('#live-runs tr')].map((row) => [...row.cells].map((cell) => cell.textContent))"


def test_means_and_success_rate_over_the_last_episodes_and_all_of_them_are_reachable(page: Page) -> None:
    """Thirty episodes end; the n-th ends after n + 1 steps, and every third succeeds."""
    progress = [(number_of + 1) / 40 for number_of in range(30)]
    succeeded = [number_of % 3 == 0 for number_of in range(30)]
    with LiveView(page.url, name="means") as view:
        for n in range(30):
            episode = view.episode("go", n)
            for step in range(n + 1):
                episode.add(FRAMES[0], StepScore(progress[n], 0.25, succeeded[n], step, 3.0))
            episode.end()

        def row() -> list[str]:
            return [text for run in page.browser.run(RUNS) if run[0] == "means" for text in run[1:]]

        def expected(last: int) -> list[str]:
            rate = f"{100 * np.mean(succeeded[-last:]):.0f} %"
            steps = np.mean(np.arange(1, 31)[-last:])
            return ["0", "30", rate, "-", number(float(np.mean(progress[-last:]))), "0.250", f"{steps:.1f}"]

        poll(lambda: row() == expected(20))
        page.browser.write("live-last", "5")
        assert row() == expected(5)
        page.browser.write("live-last", "1000")
        assert row() == expected(30)
        while page.browser["live-more"].is_displayed():
            page.browser["live-more"].click()
        assert len(page.cards("means")) == 30


def test_a_chart_and_the_runs_show_returns_and_success_of_ended_episodes(page: Page) -> None:
    """Episode n of 4 pays n, and the last two succeed."""
    with LiveView(page.url, name="paid") as view:
        for n in range(4):
            episode = view.episode("go", n)
            episode.add(FRAMES[0], StepScore(0.5, 0.25, n > 1, 0, 3.0))
            episode.pay(n)
            episode.end()
        page.browser.until("document.querySelector('#live-runs tr')")
        page.browser.write("live-last", "2")
        told = "paid: return 2.500, success 1.000"
        page.browser.until(f"document.getElementById('live-history').getAttribute('aria-label')?.includes('{told}')")
        assert "paid" in page.browser["live-legend"].text.split("\n")
        row = next(row for row in page.browser.run(RUNS) if row[0] == "paid")
        assert (row[3], row[4]) == ("100 %", "2.500")


def test_an_ended_episode_is_a_small_picture_that_opens(page: Page) -> None:
    with LiveView(page.url, name="small") as view:
        episode = view.episode("go")
        episode.add(FRAMES[0], SCORE)
        episode.pay(0.5)
        page.shows("small", {"Reward": "0.500", "Return": "0.500"})
        episode.end()
        page.shows("small", {"state": "ended, no success"})
        chart = "document.querySelector('#live-ended article .chart')"
        assert page.browser.run(f"return {chart}.clientHeight") == 0
        page.browser.all("#live-ended button")[0].click()
        assert page.browser.run(f"return {chart}.clientHeight") > 0
        assert page.browser.all("#live-ended button")[0].get_attribute("aria-expanded") == "true"


def test_progress_and_success_have_the_colour_of_the_run_and_numbers_at_the_pointer(page: Page) -> None:
    with LiveView(page.url, name="colours") as view:
        view.episode("go").add(FRAMES[0], StepScore(0.5, 0.25, False, 0, 3.0))
        page.shows("colours", {"Step": "0"})
        over = (
            "[...document.querySelectorAll('#live-episodes article')].find((card) => "
            "card.querySelector('h2').textContent.startsWith('colours,')).querySelector('.u-over')"
        )
        page.browser.run(f"{over}.scrollIntoView()")
        ActionChains(page.browser.driver).move_to_element(page.browser.run(f"return {over}")).perform()
        shown = page.browser.until(
            f"{over}.querySelectorAll('.values span').length === 2 && "
            f"[...{over}.querySelectorAll('.values span')].map((each) => [each.textContent, each.style.color])"
        )
        card = f"{over}.closest('article')"
        colour = page.browser.run(f"return getComputedStyle({card}).getPropertyValue('--run')")
        assert [text for text, _ in shown] == ["0.500", "0.250"]
        assert {hex_of(each) for _, each in shown} == {colour}


def hex_of(colour: str) -> str:
    return "#" + "".join(f"{int(part):02x}" for part in colour.removeprefix("rgb(").removesuffix(")").split(","))


def test_text_of_others_is_text(page: Page) -> None:
    with LiveView(page.url, name=ATTACK) as view:
        view.episode(ATTACK).add(FRAMES[0], SCORE)
        page.shows(ATTACK, {"task": ATTACK, "Step": "0"})
    assert page.browser.all("#live-episodes script") == []
    assert page.browser.run("return document.title") == "Robot video rewards"


def test_axe_finds_nothing_in_either_theme(page: Page) -> None:
    with LiveView(page.url, name="axe") as view:
        episodes = [view.episode("go on", 0), view.episode("end", 1)]
        for episode in episodes:
            episode.add(FRAMES[0], StepScore(0.5, 0.25, True, 0, 3.0))
        episodes[1].end()
        page.shows("axe", {"state": "running, succeeded ✓"}, {"state": "ended, succeeded ✓"})
        poll(lambda: page.has_pictures("axe", FRAMES[0], FRAMES[0]))
        for theme in ("light", "dark"):
            with page.browser.theme(theme):
                assert page.browser.violations() == []


def test_a_page_without_key_asks_for_it_and_goes_on_with_a_gateway_that_comes_back(
    demo_server: Endpoints, browser: Browser, tmp_path: Path
) -> None:
    key, port = "open sesame", free_port()
    page = Page(f"http://127.0.0.1:{port}", browser)
    for name in ("before", "after"):
        with (
            running(demo_server, tmp_path, port=port, RFM_GATEWAY_API_KEY=key),
            LiveView(page.url, name=name, api_key=key) as view,
        ):
            view.episode("wait").add(FRAMES[0], SCORE)
            if name == "before":
                browser.driver.get(page.url)
                browser["live-tab"].click()
                browser.until("!document.getElementById('key-form').hidden")
                assert page.cards(name) == []
                browser.write("key", key)
                browser.all("#key-form button")[0].click()
            page.shows(name, {"Step": "0"})
            poll(lambda name=name: page.has_pictures(name, FRAMES[0]))  # type: ignore[misc]
            browser.until_text("away", "")
            assert "api_key=" in browser.run("return document.getElementById('live-code').textContent")
        told = browser.until("document.getElementById('away').textContent")
        assert told.startswith("The server does not answer")
