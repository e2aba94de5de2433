# SPDX-License-Identifier: MIT
"""Links to what the page shows, in Chromium: Back, a reload, and the page of a colleague. No Triton is needed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from selenium.webdriver.support.select import Select

from browsers import Browser
from gateways import poll, running
from labelling import BrightnessScorer
from rfm_labels import LabelOptions, label, open_dataset
from servers import Endpoints
from shown_datasets import copied

pytestmark = [pytest.mark.triton, pytest.mark.slow]

NOWHERE = Endpoints(http_port=1, grpc_port=1, metrics_port=1)
FIRST, SECOND = "toy_v21", "toy_v21%7E2"  # two datasets of one name, as addresses have them


@dataclass(frozen=True)
class Page:
    url: str
    browser: Browser

    def open(self, address: str = "") -> None:
        """Load the page anew."""
        self.browser.driver.get("about:blank")
        self.browser.driver.get(f"{self.url}/{address}")

    def has(self, address: str) -> None:
        """Wait until the page has this address."""
        poll(lambda: self.browser.run("return location.hash") == address)

    def watches(self, title: str) -> None:
        self.browser.until_text("episode-title", title)

    def watch(self, episode: int) -> None:
        self.browser.run(f"document.querySelector('#episodes tr[data-episode=\"{episode}\"] button').click()")


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("datasets")
    roots = [copied(FIRST, folder / name) for name in ("one", "other")]
    label(open_dataset(roots[1]), BrightnessScorer(), LabelOptions())
    options = [word for root in roots for word in ("--dataset", str(root))]
    with running(NOWHERE, folder, "rfm", *options) as gateway:
        yield gateway.url


@pytest.fixture
def page(url: str, browser: Browser) -> Page:
    page = Page(url, browser)
    page.open()
    return page


def test_back_and_forward_go_through_tabs_datasets_and_episodes(page: Page) -> None:
    browser = page.browser
    browser["dataset-tab"].click()
    page.has(f"#tab=dataset&dataset={FIRST}")
    Select(browser["dataset"]).select_by_value("1")
    page.has(f"#tab=dataset&dataset={SECOND}")
    page.watch(2)
    page.has(f"#tab=dataset&dataset={SECOND}&episode=2")
    browser["episode-close"].click()
    page.has(f"#tab=dataset&dataset={SECOND}")
    browser.driver.back()
    page.watches("Episode 2")
    browser.driver.back()
    browser.until("document.getElementById('episode').hidden")
    browser.driver.back()
    browser.until("document.getElementById('dataset').value === '0'")
    browser.driver.back()
    browser.until("!document.getElementById('score-panel').hidden")
    for _ in range(3):
        browser.driver.forward()
    page.watches("Episode 2")
    assert browser["dataset"].get_attribute("value") == "1"


def test_a_link_shows_a_colleague_the_same_episode_and_settings(page: Page) -> None:
    browser = page.browser
    browser["dataset-tab"].click()
    page.has(f"#tab=dataset&dataset={FIRST}")
    Select(browser["dataset"]).select_by_value("1")
    page.has(f"#tab=dataset&dataset={SECOND}")
    browser["only-low"].click()
    browser.write("number-low", "0.7")
    browser.write("task-part", "block")
    Select(browser["order"]).select_by_value("task")
    page.watch(1)
    link = f"#tab=dataset&dataset={SECOND}&order=task&low=0.7&contains=block&episode=1"
    page.has(link)
    told = browser["shown-told"].text
    page.open(link)
    page.watches("Episode 1")
    assert (browser["dataset"].get_attribute("value"), browser["shown-told"].text) == ("1", told)
    assert (browser["only-low"].is_selected(), browser["order"].get_attribute("value")) == (True, "task")
    browser.driver.refresh()
    page.watches("Episode 1")
    page.has(link)


@pytest.mark.parametrize(
    ("dead", "title"),
    [
        ("dataset=gone", "The dataset gone is not shown here"),
        (f"dataset={FIRST}&episode=99", "Episode 99 is not shown here"),
    ],
)
def test_a_dead_link_says_so_and_shows_what_is_there(page: Page, dead: str, title: str) -> None:
    page.open(f"#tab=dataset&{dead}")
    told = page.browser.until("document.querySelector('#dataset-errors .state')?.innerText")
    assert told.startswith(title)
    assert len(page.browser.all("#episodes tr")) == 8
    page.watch(1)
    page.watches("Episode 1")
    assert page.browser["dataset-errors"].text == ""
