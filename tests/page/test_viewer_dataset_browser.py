# SPDX-License-Identifier: MIT
"""The page's tab of datasets in Chromium, before a real Triton with the demo's checkpoint."""

from __future__ import annotations

import io
import json
import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from pyarrow import parquet
from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.support.select import Select

from browsers import Browser
from gateways import running
from labelling import BrightnessScorer
from paths import ROOT
from rfm_client import RewardClient
from rfm_client.contract.description import TOY
from rfm_labels import ClientScorer, LabelOptions, label, open_dataset, summarise
from rfm_labels.datasets import LeRobotDataset
from servers import Endpoints, wait_for
from shown_datasets import CAMERAS, columns_of, copied, large
from tolerances import SHOWN, TOLERANCE
from viewer_requests import run_line

pytestmark = [pytest.mark.triton, pytest.mark.slow]

TASK = "put the red block in the bowl"  # of the clips
OTHER = "brightness"  # the second reward of the first dataset
NUM_LARGE = 10_000
DEMO, PLAIN, BRIGHT, LARGE, CLIPS = range(5)  # labelled by the demo, not, by brightness, by chance, and by the demo
VIDEOS = "#episode-videos video"
SVG = "{http://www.w3.org/2000/svg}"
PLAYERS = f"{VIDEOS}, #episode-time"  # the videos, then the slider
BEYOND = """
return [document.documentElement, ...document.querySelectorAll(".work")].map((each) => each.scrollWidth - each.clientWidth);
"""  # pixels by which the page and each tab overflow to the right
ARE_THERE = f"[...document.querySelectorAll('{VIDEOS}')].every((video) => !video.seeking && video.readyState >= 2)"


@dataclass(frozen=True)
class Page:
    """The tab of datasets. folders: by number of the dataset"""

    url: str
    browser: Browser
    folders: tuple[Path, ...]

    def open(self) -> None:
        self.browser.open(self.url)
        self.browser["dataset-tab"].click()
        self.browser.until("document.querySelector('#episodes tr')")

    def open_link(self, link: str) -> None:
        """Load the page anew."""
        self.browser.driver.get("about:blank")
        self.browser.driver.get(f"{self.url}/{link}")

    def has(self, link: str) -> None:
        """Wait until the page has this address."""
        wait_for(lambda: self.browser.run("return location.hash") == link)

    @property
    def rows(self) -> list[list[str]]:
        """Return the cells of the episodes' table."""
        return self.browser.cells("#episodes tr")

    @property
    def episodes(self) -> list[int]:
        """Return the episodes in the table's order."""
        return [int(row[1]) for row in self.rows]

    @property
    def numbers(self) -> list[list[float]]:
        """Return progress and success beside each curve of the watched episode."""
        values = [self.browser.values("episode-chart", signal) for signal in ("progress", "success")]
        return [[float(of_signal[name]) for of_signal in values] for name in values[0]]

    def choose(self, number: int) -> LeRobotDataset:
        """Shows a dataset."""
        dataset = LeRobotDataset(self.folders[number])
        Select(self.browser["dataset"]).select_by_value(str(number))
        num_rows = len(dataset.episodes) + 1
        self.browser.until(f"document.querySelector('#episode-list table').ariaRowCount === '{num_rows}'")
        self.browser.until("document.querySelector('#episodes tr')")
        self.browser.until(f"document.getElementById('ends').hidden === {str(number == PLAIN).lower()}")
        return dataset

    def watch(self, episode: int) -> None:
        """Click an episode and wait for the videos."""
        self.browser.run(f"document.querySelector('#episodes tr[data-episode=\"{episode}\"] button').click()")
        self.browser.until_text("episode-title", f"Episode {episode}")
        self.browser.until(f"document.querySelectorAll('{VIDEOS}').length === 2 && {ARE_THERE}")

    def at_rest(self, episode: int) -> None:
        """Watch an episode, stop it, and go back to the beginning."""
        self.watch(episode)
        self.move_to(0)
        self.browser.until_text("episode-play", "Play")

    def move_to(self, time_s: float) -> None:
        """Moves the slider, as a person does, and waits for the videos."""
        self.browser.enter("#episode-time", time_s)
        wait_for(lambda: self.browser.times_s(PLAYERS) == pytest.approx([time_s] * 3, abs=0.02))
        self.browser.until(ARE_THERE)  # a seeking video reports the target and shows the old frame

    def score_episode(self) -> None:
        """Put the episode into the score tab and wait for the curves."""
        self.browser["score-episode"].click()
        assert self.browser["score-panel"].is_displayed()
        self.browser.until_text("scored", "2 of 2 scored")


@pytest.fixture(scope="module")
def folders(demo_server: Endpoints, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    folder = tmp_path_factory.mktemp("datasets")
    demo, bright = copied("toy_v30_many", folder), copied("toy_v21", folder)
    with RewardClient(demo_server.grpc_url) as client:
        label(open_dataset(demo), ClientScorer(client), LabelOptions())
    label(open_dataset(demo), BrightnessScorer(), LabelOptions(name=OTHER))
    corrected = open_dataset(bright, orient={"wrist": "rotate180"}, channels={"wrist": "bgr"})
    label(corrected, BrightnessScorer(), LabelOptions())
    clips = folder / "clips"
    shutil.copytree(ROOT / "apps" / "page" / "rfm_page" / "examples", clips)
    with RewardClient(demo_server.grpc_url) as client:
        label(open_dataset(clips, task=TASK), ClientScorer(client), LabelOptions())
    return demo, copied("toy_v21", folder / "plain"), bright, large(folder / "large", NUM_LARGE), clips


@pytest.fixture(scope="module")
def url(demo_server: Endpoints, tmp_path_factory: pytest.TempPathFactory, folders: tuple[Path, ...]) -> Iterator[str]:
    words = [word for root in folders for word in ("--dataset", str(root))]
    with running(demo_server, tmp_path_factory.mktemp("gateway"), "rfm", *words) as gateway:
        yield gateway.url


@pytest.fixture
def page(url: str, quiet_browser: Browser, folders: tuple[Path, ...]) -> Page:
    page = Page(url, quiet_browser, folders)
    page.open()
    return page


def test_the_table_and_the_histogram_have_the_numbers_of_the_labels_and_the_worst_stand_first(page: Page) -> None:
    dataset = page.choose(BRIGHT)
    summary = summarise(page.folders[BRIGHT] / "rfm_progress.parquet")
    assert summary.best_success is not None and summary.last_success is not None
    assert summary.disagreement is not None and summary.voted_success is not None
    _, undone, never = summary.outcomes.values()
    scores = (summary.final_progress, summary.best_success, summary.last_success)
    columns = (*scores, summary.backwards, summary.disagreement)
    for row in page.rows:
        told = dataset.episodes[int(row[1])]
        assert (row[2], int(row[3])) == (told.task, told.num_frames)
        numbers = [*map(float, row[4:7]), float(row[7].removesuffix(" %")) / 100, float(row[8])]
        assert numbers == pytest.approx([values[int(row[1])] for values in columns], abs=SHOWN)
    assert (f" {undone.sum()} succeed" in page.browser["ends-told"].text) == (undone.sum() > 1)
    backwards, apart = -summary.backwards, -summary.disagreement
    worst = episodes_by(-never.astype(int), backwards, apart)
    assert page.episodes == worst
    expected = {
        "Backward steps": episodes_by(backwards),
        "Cameras disagree": episodes_by(apart),
        "Final progress": episodes_by(summary.final_progress),
        "Best success": episodes_by(summary.best_success),
        "Final success": episodes_by(summary.last_success),
        "Episode": list(range(len(never))),
    }
    heads = {
        each.text.replace("\n", " ").rstrip(" ↑↓"): each for each in page.browser.all("#episode-list thead button")
    }
    for name, episodes in expected.items():
        heads[name].click()
        assert page.episodes == episodes, name
        (marked,) = page.browser.all("#episode-list [aria-sort] button")
        assert marked.text.replace("\n", " ").rstrip(" ↑↓") == name
    Select(page.browser["order"]).select_by_visible_text("worst first")
    assert page.episodes == worst
    for threshold in (0.0, float(np.float32(np.median(summary.best_success))), 1.0):
        page.browser.enter("#cutoff", threshold)
        cut = float(page.browser["cutoff"].get_attribute("value"))
        num_never = (summary.best_success < cut).sum()
        assert page.browser["ends-told"].text.startswith(f"{num_never} of {len(never)} episodes never succeed")
        assert page.browser["count-never"].text == f"{num_never}"
        told = page.browser["histogram"].get_attribute("aria-label")
        bars = re.findall(r"(\d+) from [\d.]+(?: of which (\d+))?", told)
        of_good = summary.final_progress[summary.voted_success >= cut]
        for counts, progress in zip(zip(*bars, strict=True), (summary.final_progress, of_good), strict=True):
            assert [int(count or 0) for count in counts] == np.histogram(progress, 20, (0, 1))[0].tolist()


def episodes_by(*keys: np.ndarray[Any, Any]) -> list[int]:
    """Return the episodes' numbers, sorted by the keys."""
    return np.lexsort([np.arange(len(keys[0])), *reversed(keys)]).tolist()  # type: ignore[no-any-return]


def tick(page: Page, name: str, number: float | None = None) -> None:
    """Set a filter and a number."""
    if number is not None:
        page.browser.write(f"number-{name}", f"{number}")
    page.browser[f"only-{name}"].click()


def test_filters_keep_the_matching_episodes_and_show_their_number(page: Page) -> None:
    dataset = page.choose(DEMO)
    summary = summarise(page.folders[DEMO] / "rfm_progress.parquet")
    assert summary.best_success is not None and summary.disagreement is not None
    assert summary.voted_success is not None
    succeeds = summary.best_success >= 0.5
    expected = {
        "succeed": (None, summary.voted_success >= 0.5),
        "never": (None, ~succeeds),
        "backwards": (7.5, 100 * summary.backwards >= 7.5),
        "apart": (0.018, summary.disagreement >= 0.018),
    }
    for name, (number, keep) in expected.items():
        tick(page, name, number)
        assert sorted(page.episodes) == np.flatnonzero(keep).tolist(), name
        assert 0 < keep.sum() < len(keep)
        assert page.browser[f"count-{name}"].text == f"{keep.sum()}"
        tick(page, name)
    page.browser.write("task-part", "GREEN")
    assert sorted(page.episodes) == [each.index for each in dataset.episodes if "green" in each.task]
    assert page.browser["shown-told"].text == f"{len(page.episodes)} of {len(dataset.episodes)}"
    page.browser.write("task-part", " ")
    page.choose(BRIGHT)
    summary, cut = summarise(page.folders[BRIGHT] / "rfm_progress.parquet"), 0.72
    assert summary.best_success is not None and summary.voted_success is not None
    page.browser.enter("#cutoff", cut)
    tick(page, "undone")
    keep = (summary.best_success >= cut) & (summary.voted_success < cut)
    assert sorted(page.episodes) == np.flatnonzero(keep).tolist() != []
    assert page.browser["count-undone"].text == f"{keep.sum()}"


def test_selected_episodes_are_taken_along(page: Page) -> None:
    dataset = page.choose(DEMO)
    for episode in (7, 2):
        page.browser.all(f"#episodes tr[data-episode='{episode}'] input")[0].click()
    assert not page.browser["episode"].is_displayed()  # a tick is no click on the row
    page.browser["episodes-text"].click()
    assert page.browser.saved("episodes.txt").decode() == "2\n7\n"
    page.browser["episodes-json"].click()
    saved = json.loads(page.browser.saved("episodes.json"))
    assert (saved["dataset"], saved["labels"], saved["threshold"]) == ("toy_v30_many", "rfm_progress.parquet", 0.5)
    assert [row["episode"] for row in saved["episodes"]] == [2, 7]
    last = float(columns_of(page.folders[DEMO], 7)["success"][-1])
    assert saved["episodes"][1]["last_success"] == pytest.approx(last)
    assert page.browser["use-words"].text == '--dataset.episodes="[2, 7]"'
    assert page.browser["use-told"].text == ""
    others = [each.index for each in dataset.episodes if each.index not in (2, 7)]
    for use, target, away in (("delete", "toy_v30_many_cleaned", [2, 7]), ("keep", "toy_v30_many_kept", others)):
        Select(page.browser["use"]).select_by_value(use)
        words = shlex.split(page.browser["use-words"].text.splitlines()[1])
        options = dict(zip(words[1::2], words[2::2], strict=True))
        assert (words[0], options["--operation.type"]) == ("lerobot-edit-dataset", "delete_episodes")
        assert json.loads(options["--operation.episode_indices"]) == away
        assert (options["--root"], options["--new_root"]) == ("toy_v30_many", target)
    page.browser["choose-none"].click()
    page.browser.write("task-part", "green")
    page.browser["choose-shown"].click()
    green = [each.index for each in dataset.episodes if "green" in each.task]
    assert page.browser["chosen-told"].text == f"{len(green)} episodes selected"
    page.browser["choose-none"].click()
    tick(page, "never")
    Select(page.browser["use"]).select_by_value("train")
    assert page.browser["use-told"].text == "All of them never succeed."


def test_two_label_files_are_overlaid_and_their_differences_listed(page: Page) -> None:
    dataset = page.choose(DEMO)
    assert [each.text for each in Select(page.browser["others"]).options] == ["none", f"{OTHER}_progress.parquet"]
    Select(page.browser["others"]).select_by_visible_text(f"{OTHER}_progress.parquet")
    page.browser.until("document.getElementById('filter-differ').hidden === false")
    ours, theirs = (summarise(page.folders[DEMO] / f"{name}_progress.parquet") for name in ("rfm", OTHER))
    apart = np.abs(ours.final_progress - theirs.final_progress)
    differs = ours.outcomes["succeed"] != theirs.outcomes["succeed"]
    page.browser.until("document.querySelector('#episodes tr td:last-child').textContent !== '-'")
    for row in page.rows:
        episode = int(row[1])
        assert float(row[9].removesuffix(" ≠")) == pytest.approx(apart[episode], abs=SHOWN)
        assert row[9].endswith("≠") == differs[episode]
    Select(page.browser["order"]).select_by_visible_text("labels differ")
    assert page.episodes == episodes_by(-apart)
    tick(page, "differ", 0.3)
    assert sorted(page.episodes) == np.flatnonzero(differs | (apart >= 0.3)).tolist()
    tick(page, "differ")
    page.at_rest(2)
    assert page.browser["labels-warning"].text == TOY
    page.browser["made-box"].click()
    names, texts = ([each.text for each in page.browser.all(f"#made {tag}")] for tag in ("dt", "dd"))
    told = dict(zip(names, texts, strict=True))
    made = json.loads(parquet.read_schema(page.folders[DEMO] / "rfm_progress.parquet").metadata[b"rfm.provenance"])
    assert (told["Checkpoint"], told["Written by"]) == (made["checkpoint"]["source"], made["writer"])
    names = ["all cameras", "front", "wrist", f"all cameras ({OTHER})"]
    assert [item.text for item in page.browser.all("#episode-legend li")] == names
    expected = [
        columns_of(page.folders[DEMO], 2, f"{name}_progress.parquet")["progress_sparse"][0] for name in ("rfm", OTHER)
    ]
    np.testing.assert_allclose([page.numbers[0][0], page.numbers[3][0]], expected, rtol=0, atol=SHOWN)
    page.browser["episode-png"].click()
    assert Image.open(io.BytesIO(page.browser.saved("episode_2.png"))).width == 2100
    page.browser["episode-svg"].click()
    svg = ElementTree.fromstring(page.browser.saved("episode_2.svg"))
    titles = [dataset.episodes[2].task, "toy_v30_many, episode 2", TOY]
    told = [text for element in svg.iter(f"{SVG}text") if (text := element.text) in [*titles, *names]]
    assert told == [*titles, *names]
    assert len(list(svg.iter(f"{SVG}polyline"))) == len([text for pair in page.numbers for text in pair])


def test_marked_outcomes_stay_and_evaluate_reads_them(page: Page) -> None:
    browser = page.browser

    def evaluated(link: str, *lines: str) -> tuple[list[int], list[bool]]:
        """Save the outcomes after a reload, and return the episodes and outcomes that evaluate reads."""
        page.open_link(link)
        browser.until(f"document.getElementById('outcomes').textContent === 'outcomes.csv ({len(lines)} marked)'")
        browser["outcomes"].click()
        content = browser.saved("outcomes.csv")
        assert content.decode().splitlines() == ["episode,success", *lines]
        root = page.folders[CLIPS if "clips" in link else DEMO]
        (root.parent / "outcomes.csv").write_bytes(content)
        run_line(root.parent, f"rfm-client evaluate {root.name} --outcome outcomes.csv --json marked.json")
        told = json.loads((root.parent / "marked.json").read_text())
        return told["episodes"], told["is_success"]

    def watch_clip(name: str) -> None:
        browser.run(f"document.querySelector('#episodes tr:has([title^=\"{name}\"]) button').click()")
        browser.until(f"document.getElementById('episode-told').textContent.startsWith('{name}')")
        browser.until("!document.getElementById('failed').disabled")

    page.choose(DEMO)
    assert not browser["outcomes"].is_enabled()
    for episode, name in ((7, "succeeded"), (2, "failed"), (3, "failed")):
        page.watch(episode)
        assert browser[name].get_attribute("aria-pressed") == "false"
        browser[name].click()
        assert browser[name].get_attribute("aria-pressed") == "true"
    browser["failed"].click()  # no mark again
    marked = "return [...document.querySelectorAll('#episodes [data-outcome]')].filter((each) => each.dataset.outcome)"
    labels = sorted(browser.run(f"{marked}.map((each) => each.ariaLabel)"))
    assert labels == ["Watch episode 2, marked as a failure", "Watch episode 7, marked as a success"]
    assert evaluated(FIRST, "2,failure", "7,success") == ([2, 7], [False, True])
    link = "#tab=dataset&dataset=clips"
    page.open_link(link)
    browser.until("document.querySelector('#episodes tr [title^=\"failure.mp4\"]')")
    for name, key in (("failure.mp4", "s"), ("failure.mp4", "f"), ("success.mp4", "s")):
        watch_clip(name)
        ActionChains(browser.driver).send_keys(key).perform()
    assert evaluated(link, "failure.mp4,failure", "success.mp4,success") == ([0, 2], [False, True])


OTHER_NAME = """
const [ask, part] = [fetch, arguments[0]];
window.fetch = async (path, options) => {
  const answer = await ask(path, options);
  return path.includes(part) ? Response.json({ ...await answer.json(), name: "other" }) : answer;
};
"""  # what a dataset answers that has been recorded anew: here the browser pretends it


def test_an_episode_that_does_not_come_has_an_error_no_curves_and_no_marks(page: Page) -> None:
    browser = page.browser
    page.choose(DEMO)
    page.at_rest(1)
    assert page.numbers
    marked = browser["outcomes"].text
    browser.driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": ["*/episodes/2?*"]})
    browser.run("document.querySelector('#episodes tr[data-episode=\"2\"] button').click()")
    browser.until_text("episode-title", "Episode 2")
    assert page.numbers == []
    told = browser.until("document.getElementById('episode-errors').innerText")
    assert told.startswith("Episode 2 cannot be shown")
    assert (page.numbers, browser["episode-legend"].text) == ([], "")
    assert not browser["succeeded"].is_enabled()
    ActionChains(browser.driver).send_keys("s").perform()
    assert browser["outcomes"].text == marked
    browser.driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": []})
    browser.all("#episode-errors .actions button")[0].click()
    browser.until("!document.getElementById('succeeded').disabled")
    assert len(page.numbers) == 3
    assert browser["episode-errors"].text == ""
    browser.complaints()  # of the request that was blocked
    browser.run(OTHER_NAME, "/episodes/5?")
    browser.run("document.querySelector('#episodes tr[data-episode=\"5\"] button').click()")
    told = browser.until("document.getElementById('episode-errors').innerText")
    assert re.search(r"episode 5: expected (\d+) frames, got other, \1 frames: reload the page", told)


def test_ten_thousand_episodes_are_a_few_rows_of_the_document(page: Page) -> None:
    page.choose(LARGE)
    Select(page.browser["order"]).select_by_visible_text("episode")
    list_of = "document.getElementById('episode-list')"
    for share in (0, 0.5, 1):
        page.browser.run(f"{list_of}.scrollTop = arguments[0] * {list_of}.scrollHeight", share)
        page.browser.draw()
        numbers = page.episodes
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert len(numbers) < 100
        assert abs(numbers[len(numbers) // 2] - share * NUM_LARGE) < 50
    page.browser["choose-shown"].click()
    assert page.browser["chosen-told"].text == f"{NUM_LARGE} episodes selected"
    assert 390 < len(page.browser["use-words"].text) <= 400
    for name in ("clipboard-read", "clipboard-write"):
        granted = {"origin": page.url, "permission": {"name": name}, "setting": "granted"}
        page.browser.driver.execute_cdp_cmd("Browser.setPermission", granted)
    page.browser["use-copy"].click()
    page.browser.until_text("status", "The words are copied.")
    words = page.browser.driver.execute_async_script("navigator.clipboard.readText().then(arguments[0])")
    assert words == f'--dataset.episodes="{list(range(NUM_LARGE))}"'


def test_a_click_plays_the_episode_and_keys_step_through_frames_and_episodes_and_close_it(page: Page) -> None:
    dataset = page.choose(BRIGHT)
    first, second = page.episodes[:2]
    columns = columns_of(page.folders[BRIGHT], first)
    names = [("progress_sparse", "success"), *((f"progress.{each}", f"success.{each}") for each in CAMERAS)]

    def numbers_are_those_of(frame: int) -> None:
        expected = [[columns[name][frame] for name in pair] for pair in names]
        np.testing.assert_allclose(page.numbers, expected, rtol=0, atol=SHOWN)

    def press(key: str) -> None:
        ActionChains(page.browser.driver).send_keys(key).perform()

    page.watch(first)
    end_s = (dataset.episodes[first].num_frames - 1) / 10
    seen = [page.browser.times_s(PLAYERS)[-1]]
    wait_for(lambda: seen.append(page.browser.times_s(PLAYERS)[-1]) or seen[-1] == pytest.approx(end_s, abs=0.01))  # type: ignore[func-returns-value]
    assert len(set(seen)) > 2
    assert sorted(seen) == seen
    page.browser.until_text("episode-play", "Play")
    numbers_are_those_of(-1)
    for _ in range(3):
        page.browser["episode-time"].send_keys(Keys.ARROW_LEFT)
    wait_for(lambda: len({round(time_s, 2) for time_s in page.browser.times_s(PLAYERS)}) == 1)
    numbers_are_those_of(round(page.browser.times_s(PLAYERS)[-1] * 10))
    page.browser.run("document.activeElement.blur()")
    press(Keys.SPACE)
    page.browser.until_text("episode-play", "Pause")
    for key, episode in (("n", second), ("p", first)):
        press(key)
        page.browser.until_text("episode-title", f"Episode {episode}")
        page.browser.until(f"document.querySelectorAll('{VIDEOS}').length === 2 && {ARE_THERE}")
    page.browser.write("task-part", "n")
    assert page.browser["episode-title"].text == f"Episode {first}"
    page.browser.run("document.activeElement.blur()")
    press(Keys.ESCAPE)
    assert not page.browser["episode"].is_displayed()


def test_a_video_shows_the_frame_of_the_time(page: Page) -> None:
    dataset = page.choose(DEMO)
    page.at_rest(5)
    videos = [np.stack(list(dataset.frames(dataset.episodes[5], each))).astype(np.float32) for each in CAMERAS]
    for t in (0, 7, len(videos[0]) // 2, len(videos[0]) - 1):
        page.move_to(t / 10)
        for frames, shown in zip(videos, page.browser.pixels(page.browser.all(VIDEOS)), strict=True):
            off = np.abs(frames - shown).mean(axis=(1, 2, 3))
            assert off[t] == off.min() < 3, (t, off)


HAVE_PLAYHEADS = "return [...document.querySelectorAll('#episode .playhead')].map((each) => !each.hidden)"
ZOOM = """
const over = document.querySelector("#motion-chart .u-over");
const { left, width } = over.getBoundingClientRect();
over.dispatchEvent(new WheelEvent("wheel", { clientX: left + width / 2, deltaY: arguments[0], ctrlKey: true }));
"""


def test_actions_and_states_move_and_zoom_with_the_curves(page: Page) -> None:
    rows = parquet.read_table(page.choose(DEMO).root / "data" / "chunk-000" / "file-000.parquet").to_pylist()
    page.at_rest(5)
    own = [row for row in rows if row["episode_index"] == 5]
    assert [each.text for each in page.browser.all("#motion-legend li")] == ["dx", "dy", "x", "y"]
    page.move_to(0.7)
    for signal, column, names in (("action", "action", "dx dy"), ("state", "observation.state", "x y")):
        told = page.browser.values("motion-chart", signal)
        assert list(told) == names.split()
        assert [float(text) for text in told.values()] == pytest.approx(own[7][column], abs=0.006)
    page.browser.run(ZOOM, -600)  # an eighth of the time is shown, from the middle
    assert page.browser.run(HAVE_PLAYHEADS) == [False, False]
    page.browser.run(ZOOM, 600)
    assert page.browser.run(HAVE_PLAYHEADS) == [True, True]


def test_an_episode_is_scored_as_it_was_for_the_labels_and_one_without_labels_too(page: Page) -> None:
    dataset = page.choose(DEMO)
    page.at_rest(0)
    page.score_episode()
    assert page.browser["tasks"].get_attribute("value") == dataset.episodes[0].task
    columns = columns_of(page.folders[DEMO], 0)
    names = [each.get_attribute("title") for each in page.browser.all("#curves th[title]")]  # longer than what is seen
    for name, row, camera in zip(names, page.browser.cells("#curves tr"), CAMERAS, strict=True):
        assert name == f"toy_v30_many_episode_000000.{camera.rpartition('.')[2]}.mp4"
        expected = [columns[f"{name}.{camera}"][-1] for name in ("progress", "success")]
        assert [float(text) for text in row[5:7]] == pytest.approx(expected, abs=2 * SHOWN)  # as the labels
    run_line(page.folders[DEMO].parent, page.browser["command"].text)
    again = columns_of(page.folders[DEMO].parent / "toy_v30_many_episode_0", 0)
    for camera in CAMERAS:
        np.testing.assert_allclose(again[f"progress.{camera}"], columns[f"progress.{camera}"], rtol=0, atol=TOLERANCE)
    shown = "return [...document.querySelectorAll(`#${arguments[0]} video`)].map((video) => video.className)"
    page.open()
    page.choose(BRIGHT)
    page.at_rest(1)
    assert page.browser.run(shown, "episode-videos") == ["none rgb", "rotate180 bgr"]
    page.score_episode()
    assert page.browser.run(shown, "videos") == ["none rgb", "rotate180 bgr"]
    page.open()
    page.choose(PLAIN)
    assert [row[4:] for row in page.rows] == [["-"] * 6] * 8
    assert [page.browser[name].is_displayed() for name in ("only-never", "cutoff", "others")] == [False] * 3
    command, copy = page.browser["no-labels"].text.splitlines()[-2:]
    assert (command.split(" --url ")[0], copy) == ("rfm-client label toy_v21", "Copy")
    assert page.browser["warning"].text.startswith(TOY)  # of the model that would label it
    page.at_rest(1)
    assert page.numbers == []
    page.score_episode()
    page.browser["dataset-tab"].click()
    page.browser["score-episode"].click()
    question = page.browser.driver.switch_to.alert
    assert question.text == "Replace the 2 videos on the Score tab?"
    question.dismiss()
    assert page.browser["dataset-panel"].is_displayed()
    page.browser["score-episode"].click()
    page.browser.driver.switch_to.alert.accept()
    page.browser.until_text("scored", "2 of 2 scored")


def test_clear_restores_the_settings_before_an_episode_and_undo_those_of_the_episode(page: Page) -> None:
    def settings() -> list[str | None]:
        return [page.browser[name].get_attribute("value") for name in ("fps", "orient", "channels")]

    before = settings()
    dataset = page.choose(BRIGHT)
    page.at_rest(1)
    page.score_episode()
    of_episode = settings()
    assert of_episode == [f"{dataset.fps:g}", "none", "rgb"] != before
    page.browser["clear"].click()
    assert settings() == before
    page.browser["undo"].click()
    assert settings() == of_episode
    page.browser["clear"].click()
    assert settings() == before


def test_an_episode_of_a_folder_of_videos_is_scored_as_it_was_for_the_labels(page: Page) -> None:
    browser, root = page.browser, page.folders[CLIPS]
    page.open_link("#tab=dataset&dataset=clips&episode=1")
    browser.until("!document.getElementById('score-episode').disabled")
    assert browser["episode-told"].text == f"rewound.mp4: {TASK}"
    assert not browser["lerobot"].is_displayed()
    browser["score-episode"].click()
    browser.until_text("scored", "1 of 1 scored")
    columns = columns_of(root, 1)
    (row,) = browser.cells("#curves tr")
    assert (row[1], row[4]) == (TASK, f"{len(columns['index'])} of {len(columns['index'])}")
    assert [float(text) for text in row[5:7]] == pytest.approx(
        [columns[name][-1] for name in ("progress_sparse", "success")], abs=2 * SHOWN
    )
    run_line(root.parent, browser["command"].text)
    again = columns_of(root.parent / "clips_episode_1", 1)
    np.testing.assert_allclose(again["progress_sparse"], columns["progress_sparse"], rtol=0, atol=TOLERANCE)


IN_VIEW = """
return arguments[0].map((name) => {
  const { top, bottom } = document.getElementById(name).getBoundingClientRect();
  return Math.min(top, innerHeight - bottom);
});
"""
SHARE = "return document.getElementById('chart').clientHeight / innerHeight"
HEIGHTS = "return [...document.querySelectorAll('#videos video')].map((video) => video.clientHeight)"
CARDS = """
return [...document.querySelectorAll("#curves tr:first-child td")].map((cell) => getComputedStyle(cell, "::before").content);
"""


@pytest.mark.parametrize("size", [(1440, 900), (1024, 700), (820, 1180), (390, 844)], ids=str)
def test_the_tabs_fit_into_the_window_and_break_no_rule_of_axe_in_either_theme(
    page: Page, size: tuple[int, int]
) -> None:
    def fits(*, axe: bool = False) -> None:
        for theme in ("light", "dark"):
            with page.browser.theme(theme):
                page.browser.draw()
                assert max(page.browser.run(BEYOND)) == 0, theme
                assert not axe or page.browser.violations() == []

    beyond = "const list = document.getElementById('episode-list'); return list.scrollWidth - list.clientWidth"
    is_large = size[0] == 1440
    with page.browser.window(*size):
        page.choose(DEMO)
        fits()
        page.at_rest(1)
        fits(axe=is_large)
        is_phone = size[0] == 390
        assert is_phone or min(page.browser.run(IN_VIEW, ["episode-videos", "episode-chart", "episode-time"])) >= 0
        if is_large:
            Select(page.browser["others"]).select_by_index(1)
            page.browser.until("document.querySelector('.episodes.beside')")
            assert page.browser.run(beyond) <= 0
            page.watch(page.episodes[0])
            assert page.browser.run(beyond) <= 0
        page.browser["score-tab"].click()
        fits()
        page.browser.all("#examples > button")[0].click()
        page.browser.until_text("scored", "3 of 3 scored")
        fits(axe=is_large)
        if is_phone:
            assert page.browser.run(CARDS)[-2:] == ['"Success at"', '"State"']
        else:
            assert min(page.browser.run(IN_VIEW, ["videos", "chart", "time"])) >= 0
            assert page.browser.run(SHARE) >= 0.5
            assert min(page.browser.run(HEIGHTS)) >= 96


UNSEEN = """
return [...document.querySelectorAll(arguments[0])].filter((name) => {
  const [{ top, bottom, left, right }, box] = [name, name.closest(arguments[1])].map((each) => each.getBoundingClientRect());
  return !(right > left && top >= box.top - 1 && bottom <= box.bottom + 1 && right <= Math.min(box.right, innerWidth) + 1);
}).map((name) => name.textContent);
"""  # names that their boxes clip, or the window


@pytest.mark.parametrize("size", [(390, 844), (430, 932), (600, 900)], ids=str)
def test_each_tab_opened_fresh_on_a_phone_shows_its_content_and_no_settings(page: Page, size: tuple[int, int]) -> None:
    browser = page.browser
    with browser.window(*size):
        page.open_link(FIRST)
        browser.until("document.querySelectorAll('#episodes tr').length === 10")
        assert not browser["shelf"].is_displayed()
        browser.draw()
        assert browser.run(IN_VIEW, ["episodes-title"])[0] > 0
        assert browser["order-told"].text == "No success, then most backward steps, then differing cameras"
        rows = browser.run("return document.getElementById('episodes').getBoundingClientRect()")
        assert rows["top"] + 2 * 132 < size[1]
        assert rows["height"] == 10 * 132
        assert browser.run(UNSEEN, "#episodes th button, #episodes .task", "tr") == []
        page.open_link("")
        browser.until("document.getElementById('model').value")
        assert [browser[name].is_displayed() for name in ("tasks", "score", "model")] == [True, True, False]
        browser["fold"].click()
        browser.write("tasks", "put the red block in the bowl")
        browser.all("#examples > button")[0].click()
        browser.until_text("scored", "3 of 3 scored")
        assert not browser["advanced"].is_displayed()  # the settings make way for the curves
        assert min(browser.run(IN_VIEW, ["tasks", "score"])) > 0
        assert browser["compare"].is_displayed()
        browser.draw()
        assert browser.run(UNSEEN, "#videos .nameable button", "figcaption") == []
        assert browser.run(IN_VIEW, ["videos"])[0] > 0
        assert browser["time-told"].text == "frame 16 of 16, 5.00 / 5.00 s"
        page.open_link("")
        browser.until("document.getElementById('model').value")
        assert not browser["advanced"].is_displayed()


FIRST, SECOND = "#tab=dataset&dataset=toy_v30_many", "#tab=dataset&dataset=toy_v21%7E2"  # the second of one name


def test_back_and_forward_go_through_tabs_datasets_and_episodes(page: Page) -> None:
    browser = page.browser
    page.has(FIRST)
    page.choose(BRIGHT)
    page.has(SECOND)
    page.watch(2)
    page.has(f"{SECOND}&episode=2")
    browser["episode-close"].click()
    page.has(SECOND)
    browser.driver.back()
    browser.until_text("episode-title", "Episode 2")
    browser.driver.back()
    browser.until("document.getElementById('episode').hidden")
    browser.driver.back()
    browser.until("document.getElementById('dataset').value === '0'")
    browser.driver.back()
    browser.until("!document.getElementById('score-panel').hidden")
    for _ in range(3):
        browser.driver.forward()
    browser.until_text("episode-title", "Episode 2")
    assert browser["dataset"].get_attribute("value") == f"{BRIGHT}"


def test_a_link_shows_a_colleague_the_same_episode_and_settings(page: Page) -> None:
    browser = page.browser
    page.choose(BRIGHT)
    tick(page, "backwards", 0)
    browser.write("task-part", "block")
    Select(browser["order"]).select_by_value("task")
    page.watch(1)
    link = f"{SECOND}&order=task&backwards=0&contains=block&episode=1"
    page.has(link)
    told = browser["shown-told"].text
    page.open_link(link)
    browser.until_text("episode-title", "Episode 1")
    assert (browser["dataset"].get_attribute("value"), browser["shown-told"].text) == (f"{BRIGHT}", told)
    assert (browser["only-backwards"].is_selected(), browser["order"].get_attribute("value")) == (True, "task")
    browser.driver.refresh()
    browser.until_text("episode-title", "Episode 1")
    page.has(link)


def test_a_dead_link_shows_a_message_and_other_episodes_can_still_be_watched(page: Page) -> None:
    for link, title in (
        ("#tab=dataset&dataset=gone", "The dataset gone is not shown here"),
        (f"{FIRST}&episode=99", "Episode 99 is not shown here"),
    ):
        page.open_link(link)
        assert page.browser.until("document.querySelector('#dataset-errors .state')?.innerText").startswith(title)
        page.watch(1)
        assert page.browser["dataset-errors"].text == ""
