# SPDX-License-Identifier: MIT
"""The page's tab of datasets in Chromium, before a real Triton with the demo's checkpoint."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pyarrow import parquet
from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.support.select import Select

from browsers import Browser
from gateways import poll, running
from labelling import BrightnessScorer
from rfm_client import RewardClient
from rfm_labels import ClientScorer, LabelOptions, label, open_dataset, summarise
from rfm_labels.datasets import LeRobotDataset
from servers import Endpoints
from shown_datasets import CAMERAS, CODINGS, columns_of, copied, encoded_anew, large
from tolerances import SHOWN, TOLERANCE
from viewer_requests import run_line

pytestmark = [pytest.mark.triton, pytest.mark.slow]

KEY = "open sesame"
OTHER = "brightness"  # the second reward of the first dataset
NUM_LARGE = 10_000
DEMO, BRIGHT, PLAIN, *CODED = range(3 + len(CODINGS))  # labelled by the demo, by brightness, not; coded otherwise
VIDEOS = "#episode-videos video"
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
        self.show()

    def show(self) -> None:
        self.browser["dataset-tab"].click()
        self.browser.until("document.querySelector('#episodes tr')")

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
        self.browser.until(f"document.querySelectorAll('#episodes tr').length === {len(dataset.episodes)}")
        self.browser.until(f"document.getElementById('ends').hidden === {str(number >= PLAIN).lower()}")
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
        self.browser.run(
            "const slider = document.getElementById('episode-time'); slider.value = arguments[0]; "
            "slider.dispatchEvent(new Event('input'))",
            time_s,
        )
        poll(lambda: self.is_at(time_s, 0.02))
        self.browser.until(ARE_THERE)  # a seeking video reports the target and shows the old frame

    def is_at(self, time_s: float, abs_s: float) -> bool:
        return self.browser.times_s(PLAYERS) == pytest.approx([time_s] * 3, abs=abs_s)

    def is_at_one_time(self) -> bool:
        return len({round(time_s, 2) for time_s in self.browser.times_s(PLAYERS)}) == 1

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
    coded = []
    for coding, (codec, options) in CODINGS.items():
        coded.append(copied("toy_v30_many", folder / coding))
        for video in coded[-1].rglob("file-001.mp4"):
            encoded_anew(video, codec, options)
    return demo, bright, copied("toy_v21", folder / "plain"), *coded


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


def test_the_tab_opens_and_the_arrow_keys_change_tabs(page: Page) -> None:
    assert page.browser["dataset-panel"].is_displayed()
    assert not page.browser["score-panel"].is_displayed()
    page.browser["dataset-tab"].send_keys(Keys.ARROW_LEFT)
    assert page.browser["score-panel"].is_displayed()
    assert not page.browser["dataset-panel"].is_displayed()
    page.browser["score-tab"].send_keys(Keys.ARROW_LEFT)
    assert page.browser.run("return document.activeElement.id") == "dataset-tab"
    names = page.browser.run("return [...document.getElementById('dataset').options].map((option) => option.text)")
    assert names[:3] == ["toy_v30_many (v3.0)", *["toy_v21 (v2.1)"] * 2]


@pytest.mark.parametrize("number", [DEMO, BRIGHT])
def test_the_table_has_the_numbers_of_the_labels(page: Page, number: int) -> None:
    dataset = page.choose(number)
    summary = summarise(page.folders[number] / "rfm_progress.parquet")
    assert summary.best_success is not None and summary.last_success is not None
    assert summary.disagreement is not None and summary.never_succeed is not None
    for row in page.rows:
        episode = int(row[1])
        told = dataset.episodes[episode]
        assert (row[2], int(row[3])) == (told.task, told.num_frames)
        numbers = [*map(float, row[4:7]), float(row[7].removesuffix(" %")) / 100, float(row[8])]
        scores = (summary.final_progress, summary.best_success, summary.last_success)
        columns = (*scores, summary.backwards, summary.disagreement)
        assert numbers == pytest.approx([values[episode] for values in columns], abs=SHOWN)
    verb = "succeeds" if len(summary.never_succeed) == 1 else "succeed"
    assert page.browser["ends-told"].text == f"{len(summary.never_succeed)} of {len(page.rows)} episodes never {verb}."
    told = page.browser["histogram"].get_attribute("aria-label").removeprefix("Episodes by final progress: ")
    counts, _ = np.histogram(summary.final_progress, bins=20, range=(0, 1))
    assert [int(bar.split()[0]) for bar in told.split(", ")] == counts.tolist()
    good = [int(bar.split()[5]) if "which" in bar else 0 for bar in told.split(", ")]
    succeeding = summary.final_progress[summary.best_success >= 0.5]
    assert good == np.histogram(succeeding, bins=20, range=(0, 1))[0].tolist()
    assert page.browser.run("return document.querySelector('#histogram canvas').width") > 0


def episodes_by(*keys: np.ndarray[Any, Any]) -> list[int]:
    """Return the episodes' numbers, sorted by the keys."""
    return np.lexsort([np.arange(len(keys[0])), *reversed(keys)]).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize("number", [DEMO, BRIGHT])
def test_the_rows_are_sorted_by_what_one_wants_to_see_first(page: Page, number: int) -> None:
    page.choose(number)
    summary = summarise(page.folders[number] / "rfm_progress.parquet")
    assert summary.best_success is not None and summary.disagreement is not None
    assert summary.last_success is not None
    never, backwards, apart = summary.best_success < 0.5, -summary.backwards, -summary.disagreement
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
        head.text.replace("\n", " ").rstrip(" ↑↓"): head for head in page.browser.all("#episode-list thead button")
    }
    for name, episodes in expected.items():
        heads[name].click()
        assert page.episodes == episodes, name
        (marked,) = page.browser.all("#episode-list [aria-sort]")
        assert marked.text.replace("\n", " ").rstrip(" ↑↓") == name
    heads["Episode"].click()
    assert page.episodes == list(range(len(never)))[::-1]
    Select(page.browser["order"]).select_by_visible_text("worst first")
    assert page.episodes == worst


def test_the_threshold_moves_counts_and_histogram_and_is_dragged_in_the_chart(page: Page) -> None:
    page.choose(BRIGHT)
    best = summarise(page.folders[BRIGHT] / "rfm_progress.parquet").best_success
    assert best is not None
    for threshold in (0.0, float(np.float32(np.median(best))), 1.0):
        page.browser.run(
            "const slider = document.getElementById('cutoff'); slider.value = arguments[0]; "
            "slider.dispatchEvent(new Event('input'))",
            threshold,
        )
        cut = float(page.browser["cutoff"].get_attribute("value"))
        never = int((best < cut).sum())
        assert page.browser["ends-told"].text.startswith(f"{never} of {len(best)} episodes never succeed")
        assert page.browser["count-never"].text == f"{never}"
        told = page.browser["histogram"].get_attribute("aria-label")
        assert sum(int(part.split()[0]) for part in told.split("of which ")[1:]) == len(best) - never
    page.at_rest(0)
    (line,) = page.browser.all("#episode-chart .threshold")
    ActionChains(page.browser.driver).move_to_element(line).click_and_hold().move_by_offset(0, 30).release().perform()
    assert line.get_attribute("data-value") == page.browser["cutoff-told"].text
    assert float(page.browser["cutoff-told"].text) < 0.95


def tick(page: Page, name: str, number: float | None = None) -> None:
    """Set a filter and a number."""
    if number is not None:
        page.browser.write(f"number-{name}", f"{number}")
    page.browser[f"only-{name}"].click()


def test_filters_keep_what_they_say_and_tell_how_many(page: Page) -> None:
    dataset = page.choose(DEMO)
    summary = summarise(page.folders[DEMO] / "rfm_progress.parquet")
    assert summary.best_success is not None and summary.disagreement is not None
    succeeds = summary.best_success >= 0.5
    expected = {
        "never": (None, ~succeeds),
        "low": (0.992, succeeds & (summary.final_progress < 0.992)),
        "backwards": (7.5, 100 * summary.backwards >= 7.5),
        "apart": (0.018, summary.disagreement >= 0.018),
    }
    for name, (number, keep) in expected.items():
        tick(page, name, number)
        assert sorted(page.episodes) == np.flatnonzero(keep).tolist(), name
        assert 0 < keep.sum() < len(keep)
        assert page.browser[f"count-{name}"].text == f"{keep.sum()}"
        tick(page, name)
    tick(page, "never")
    tick(page, "backwards")
    assert sorted(page.episodes) == np.flatnonzero(~succeeds & (100 * summary.backwards >= 7.5)).tolist()
    tick(page, "never")
    tick(page, "backwards")
    page.browser.write("task-part", "GREEN")
    assert sorted(page.episodes) == [each.index for each in dataset.episodes if "green" in each.task]
    assert page.browser["shown-told"].text == f"{len(page.episodes)} of {len(dataset.episodes)}"


def test_selected_episodes_are_taken_along(page: Page) -> None:
    dataset = page.choose(DEMO)
    everything = list(range(len(dataset.episodes)))
    page.browser["episodes-text"].click()
    assert page.browser.saved("episodes.txt").decode().split() == [f"{number}" for number in everything]
    for episode in (7, 2):
        page.browser.all(f"#episodes tr[data-episode='{episode}'] input")[0].click()
    assert not page.browser["episode"].is_displayed()  # a tick is no click on the row
    page.browser["episodes-text"].click()
    assert page.browser.saved("episodes.txt").decode() == "2\n7\n"
    page.browser["episodes-json"].click()
    saved = json.loads(page.browser.saved("episodes.json"))
    assert (saved["dataset"], saved["labels"], saved["threshold"]) == ("toy_v30_many", "rfm_progress.parquet", 0.5)
    columns = columns_of(page.folders[DEMO], 7)
    assert [row["episode"] for row in saved["episodes"]] == [2, 7]
    assert saved["episodes"][1]["last_success"] == pytest.approx(float(columns["success"][-1]))
    assert page.browser["use-words"].text == '--dataset.episodes="[2, 7]"'
    others = [number for number in everything if number not in (2, 7)]
    for use, ending, away in (("delete", "cleaned", [2, 7]), ("keep", "kept", others)):
        Select(page.browser["use"]).select_by_value(use)
        lines = page.browser["use-words"].text.splitlines()
        assert [lines[0][:13], lines[2][:13]] == ["# LeRobot 0.5", "# LeRobot 0.4"]
        home, *older = shlex.split(lines[3].removeprefix("# "))
        assert home == "HF_LEROBOT_HOME=."
        target = f"toy_v30_many_{ending}"
        for words, roots in (
            (shlex.split(lines[1]), {"--root": "toy_v30_many", "--new_root": target}),
            (older, {}),
        ):
            assert words[0] == "lerobot-edit-dataset"
            options = dict(zip(words[1::2], words[2::2], strict=True))
            assert json.loads(options.pop("--operation.episode_indices")) == away
            told = {"--repo_id": "toy_v30_many", "--new_repo_id": target, "--operation.type": "delete_episodes"}
            assert options == {**told, **roots}
        assert lines[4].endswith(f"label {target} again")
    page.browser["choose-none"].click()
    page.browser.write("task-part", "green")
    page.browser["choose-shown"].click()
    green = [each.index for each in dataset.episodes if "green" in each.task]
    assert page.browser["chosen-told"].text == f"{len(green)} episodes selected"


def test_two_label_files_are_overlaid_and_their_differences_listed(page: Page) -> None:
    page.choose(DEMO)
    Select(page.browser["others"]).select_by_visible_text(f"{OTHER}_progress.parquet")
    page.browser.until("document.getElementById('filter-differ').hidden === false")
    ours, theirs = (summarise(page.folders[DEMO] / f"{name}_progress.parquet") for name in ("rfm", OTHER))
    assert ours.best_success is not None and theirs.best_success is not None
    apart = np.abs(ours.final_progress - theirs.final_progress)
    differs = (ours.best_success >= 0.5) != (theirs.best_success >= 0.5)
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
    names = ["all cameras", "front", "wrist", f"all cameras ({OTHER})"]
    assert [item.text for item in page.browser.all("#episode-legend li")] == names
    expected = [
        columns_of(page.folders[DEMO], 2, f"{name}_progress.parquet")["progress_sparse"][0] for name in ("rfm", OTHER)
    ]
    np.testing.assert_allclose([page.numbers[0][0], page.numbers[3][0]], expected, rtol=0, atol=SHOWN)


def test_the_page_tells_how_the_labels_were_made(page: Page) -> None:
    page.choose(DEMO)
    page.browser["made-box"].click()
    names, texts = ([each.text for each in page.browser.all(f"#made {tag}")] for tag in ("dt", "dd"))
    told = dict(zip(names, texts, strict=True))
    file = page.folders[DEMO] / "rfm_progress.parquet"
    provenance = json.loads(parquet.read_schema(file).metadata[b"rfm.provenance"])
    rule = f"{provenance['sampling']['rule']}, {provenance['sampling']['frames']} frames"
    assert (told["Checkpoint"], told["Sampling"]) == (provenance["checkpoint"]["source"], rule)
    assert (told["Cameras"], told["Written by"]) == ("front, wrist; mean", provenance["writer"])
    written = datetime.fromtimestamp(file.stat().st_mtime, timezone.utc)
    assert told["Written"] == f"{written:%Y-%m-%d %H:%M} UTC"


def test_ten_thousand_episodes_are_a_few_rows_of_the_document(
    demo_server: Endpoints, quiet_browser: Browser, tmp_path: Path
) -> None:
    root = large(tmp_path / "large", NUM_LARGE)
    with running(demo_server, tmp_path, "rfm", "--dataset", str(root)) as gateway:
        page = Page(gateway.url, quiet_browser, (root,))
        page.open()
        assert page.browser["shown-told"].text == f"{NUM_LARGE} of {NUM_LARGE}"
        Select(page.browser["order"]).select_by_visible_text("episode")
        assert page.episodes[:5] == [0, 1, 2, 3, 4]
        list_of = "document.getElementById('episode-list')"
        for share in (0.5, 1):
            page.browser.run(f"{list_of}.scrollTop = arguments[0] * {list_of}.scrollHeight", share)
            page.browser.draw()
            numbers = page.episodes
            assert len(numbers) < 100
            assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
            middle = numbers[len(numbers) // 2]
            assert abs(middle - share * NUM_LARGE) < 50
        assert numbers[-1] == NUM_LARGE - 1
        page.browser["choose-shown"].click()
        assert page.browser["chosen-told"].text == f"{NUM_LARGE} episodes selected"
        shown_words = page.browser["use-words"].text
        assert 390 < len(shown_words) <= 400
        for name in ("clipboard-read", "clipboard-write"):
            granted = {"origin": page.url, "permission": {"name": name}, "setting": "granted"}
            page.browser.driver.execute_cdp_cmd("Browser.setPermission", granted)
        page.browser["use-copy"].click()
        page.browser.until_text("status", "The words are copied.")
        copied_words = page.browser.driver.execute_async_script("navigator.clipboard.readText().then(arguments[0])")
        assert copied_words == f'--dataset.episodes="{list(range(NUM_LARGE))}"'
        begin, end = (part.strip(", ") for part in shown_words.split("…"))
        assert copied_words.startswith(f"{begin}, ")  # no number is cut
        assert copied_words.endswith(f", {end}")
        page.browser.all(f"#episodes tr[data-episode='{NUM_LARGE - 1}'] button")[0].click()
        page.browser.until_text("episode-title", f"Episode {NUM_LARGE - 1}")
        page.browser["episode-before"].click()
        page.browser.until_text("episode-title", f"Episode {NUM_LARGE - 2}")
        quiet_browser.driver.get("about:blank")  # before the gateway ends


@pytest.mark.parametrize("size", [(1440, 900), (1024, 700)], ids=str)
def test_an_episode_is_in_view_without_scrolling(page: Page, size: tuple[int, int]) -> None:
    with page.browser.window(*size):
        page.at_rest(3)
        for name in ("episode-videos", "episode-chart", "episode-time"):
            top, bottom, height = page.browser.run(
                "const { top, bottom, height } = document.getElementById(arguments[0]).getBoundingClientRect(); "
                "return [top, innerHeight - bottom, height / innerHeight]",
                name,
            )
            assert min(top, bottom) >= 0, name
            assert name != "episode-chart" or height >= 0.5
        page.browser["episode-close"].click()
        assert page.browser["episode-list"].is_displayed()


def test_a_click_plays_the_episode_and_the_curve_follows(page: Page) -> None:
    dataset = page.choose(BRIGHT)
    page.watch(3)
    end_s = (dataset.episodes[3].num_frames - 1) / 10
    seen = [page.browser.times_s(PLAYERS)[-1]]
    poll(lambda: seen.append(page.browser.times_s(PLAYERS)[-1]) or seen[-1] == pytest.approx(end_s, abs=0.01))  # type: ignore[func-returns-value]
    assert len(set(seen)) > 2
    assert sorted(seen) == seen
    page.browser.until_text("episode-play", "Play")
    columns = columns_of(page.folders[BRIGHT], 3)
    last = [[columns[name][-1] for name in ("progress_sparse", "success")]]
    last += [[columns[f"{name}.{camera}"][-1] for name in ("progress", "success")] for camera in CAMERAS]
    np.testing.assert_allclose(page.numbers, last, rtol=0, atol=SHOWN)


def test_keys_play_the_episode_step_to_the_next_and_close_it(page: Page) -> None:
    first, second = page.episodes[:2]
    page.at_rest(first)

    def press(key: str) -> None:
        ActionChains(page.browser.driver).send_keys(key).perform()

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


def test_each_row_has_the_first_frame_and_the_curve(page: Page) -> None:
    page.choose(BRIGHT)
    pictures = "[...document.querySelectorAll('#episodes .thumb')]"
    page.browser.until(f"{pictures}.length && {pictures}.every((each) => each.naturalWidth)")
    points = page.browser.run(
        "return [...document.querySelectorAll('#episodes tr')].map((row) => "
        "[row.dataset.episode, row.querySelector('polyline').getAttribute('points')])"
    )
    for episode, text in points:
        labels = columns_of(page.folders[BRIGHT], int(episode))["progress_sparse"]
        labels = labels[np.linspace(0, len(labels) - 1, min(32, len(labels))).round().astype(int)]
        heights = [float(point.split(",")[1]) for point in text.split()]
        assert heights == pytest.approx([1 + (1 - value) * 18 for value in labels], abs=0.06)


def test_a_number_below_the_threshold_is_seen_to_be_below(page: Page) -> None:
    script = """
    const done = arguments[0];
    import("/viewer/text.js").then(({ shownBelow }) =>
      done([[0.4996, 0.5], [0.49999, 0.5], [0.25, 0.5], [0.1, 0.1004]].map((pair) => shownBelow(...pair))));
    """
    assert page.browser.driver.execute_async_script(script) == ["0.4996", "0.49999", "0.250", "0.100"]


def test_no_column_is_cut_beside_an_episode_and_other_labels(page: Page) -> None:
    with page.browser.window(1440, 900):
        Select(page.browser["others"]).select_by_index(1)
        page.browser.until("document.querySelector('.episodes.beside')")
        for is_watching in (False, True):
            if is_watching:
                page.watch(page.episodes[0])
            beyond = "const list = document.getElementById('episode-list'); return list.scrollWidth - list.clientWidth"
            assert page.browser.run(beyond) <= 0


def test_dragging_in_the_chart_moves_the_videos_and_the_numbers(page: Page) -> None:
    page.choose(DEMO)
    page.at_rest(2)
    columns = columns_of(page.folders[DEMO], 2)
    end_s = (len(columns["index"]) - 1) / 10
    over = page.browser.all("#episode-chart .u-over")[0]
    width = over.size["width"]
    ActionChains(page.browser.driver).move_to_element_with_offset(over, -width // 4, 0).click_and_hold().perform()
    poll(lambda: page.is_at(end_s / 4, 0.05))
    ActionChains(page.browser.driver).move_by_offset(width // 2, 0).release().perform()
    poll(lambda: page.is_at(end_s * 3 / 4, 0.05))
    page.browser["episode-time"].send_keys(Keys.ARROW_LEFT)
    poll(page.is_at_one_time)
    frame = round(page.browser.times_s(PLAYERS)[-1] * 10)
    names = [("progress_sparse", "success"), *((f"progress.{each}", f"success.{each}") for each in CAMERAS)]
    expected = [[columns[name][frame] for name in pair] for pair in names]
    np.testing.assert_allclose(page.numbers, expected, rtol=0, atol=SHOWN)


@pytest.mark.parametrize("number", [DEMO, BRIGHT, *CODED], ids=["v3.0", "v2.1", *CODINGS])
def test_a_video_shows_the_frame_of_the_time(page: Page, number: int) -> None:
    dataset = page.choose(number)
    page.at_rest(5)
    videos = [np.stack(list(dataset.frames(dataset.episodes[5], each))).astype(np.float32) for each in CAMERAS]
    for t in (0, 7, len(videos[0]) // 2, len(videos[0]) - 1):
        page.move_to(t / 10)
        for frames, shown in zip(videos, page.browser.pixels(page.browser.all(VIDEOS)), strict=True):
            off = np.abs(frames - shown).mean(axis=(1, 2, 3))
            assert off[t] == off.min() < 3, (t, off)


def test_an_episode_is_put_into_the_score_tab_and_scored(page: Page) -> None:
    dataset = page.choose(DEMO)
    page.at_rest(0)
    page.score_episode()
    assert page.browser["tasks"].get_attribute("value") == dataset.episodes[0].task
    columns = columns_of(page.folders[DEMO], 0)
    names = [
        each.get_attribute("title") for each in page.browser.all("#curves th[title]")
    ]  # longer than the visible part
    for name, row, camera in zip(names, page.browser.cells("#curves tr"), CAMERAS, strict=True):
        assert name == f"toy_v30_many_episode_000000.{camera.rpartition('.')[2]}.mp4"
        assert row[4] == f"{len(columns['index'])} of {len(columns['index'])}"
        expected = [columns[f"{name}.{camera}"][-1] for name in ("progress", "success")]
        assert [float(text) for text in row[5:7]] == pytest.approx(expected, abs=2 * SHOWN)  # as the labels
    run_line(page.folders[DEMO].parent, page.browser["command"].text)
    again = columns_of(page.folders[DEMO].parent / "toy_v30_many_episode_0", 0)
    for camera in CAMERAS:
        np.testing.assert_allclose(again[f"progress.{camera}"], columns[f"progress.{camera}"], rtol=0, atol=TOLERANCE)


def test_videos_are_shown_as_they_were_for_the_labels_also_when_they_are_scored(page: Page) -> None:
    page.choose(BRIGHT)
    page.at_rest(1)
    shown = "return [...document.querySelectorAll(`#${arguments[0]} video`)].map((video) => video.className)"
    assert page.browser.run(shown, "episode-videos") == ["none rgb", "rotate180 bgr"]
    page.score_episode()
    assert page.browser.run(shown, "videos") == ["none rgb", "rotate180 bgr"]
    assert [row[3].endswith(", rotate180, bgr") for row in page.browser.cells("#curves tr")] == [False, True]


def test_episodes_without_labels_can_be_watched_and_scored(page: Page) -> None:
    page.choose(PLAIN)
    assert [row[4:] for row in page.rows] == [["-"] * 6] * 8
    assert page.episodes == list(range(8))
    page.at_rest(1)
    assert page.numbers == []
    page.browser["episode-time"].send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    poll(page.is_at_one_time)
    page.score_episode()


@pytest.mark.parametrize("size", [(1440, 900), (1024, 700), (390, 844)], ids=str)
def test_no_tab_is_wider_than_the_window_in_either_theme(page: Page, size: tuple[int, int]) -> None:
    """Leaves a picture of each tab among the downloads."""

    def fits(name: str) -> None:
        for theme in ("light", "dark"):
            file = page.browser.downloads / f"{name}_{size[0]}x{size[1]}_{theme}.png"
            with page.browser.theme(theme):
                page.browser.draw()
                assert page.browser.driver.save_screenshot(str(file))
                assert page.browser.run(BEYOND) == [0] * 3, (name, theme)

    with page.browser.window(*size):
        page.browser.run("localStorage.clear()")
        page.browser.open(page.url)
        page.browser.until("!document.getElementById('examples').hidden")
        fits("empty")
        page.browser.all("#examples > button")[0].click()
        page.browser.until_text("scored", "3 of 3 scored")
        page.browser["play"].click()
        page.browser.until("Number(document.getElementById('time').value) > 1")
        page.browser["play"].click()
        fits("score")
        page.show()
        page.choose(DEMO)
        fits("dataset")
        page.at_rest(1)
        page.move_to(1.2)
        fits("episode")


def test_axe_finds_nothing_in_either_theme(page: Page) -> None:
    page.at_rest(3)
    for theme in ("light", "dark"):
        with page.browser.theme(theme):
            assert page.browser.violations() == []


def test_the_key_opens_datasets_and_one_that_breaks_says_why(
    demo_server: Endpoints, browser: Browser, tmp_path: Path
) -> None:
    root = copied("toy_v21", tmp_path)
    with running(demo_server, tmp_path, "rfm", "--dataset", str(root), RFM_GATEWAY_API_KEY=KEY) as gateway:
        browser.driver.get(gateway.url)
        browser.until("!document.getElementById('key-form').hidden")
        assert browser.all("#episodes tr") == []
        for key, told in (("sesame", ""), (KEY, "This is not the key. Type it again.")):
            browser.until_text("key-wrong", told)
            browser.write("key", key)
            browser.all("#key-form button")[0].click()
        browser.until("document.getElementById('model').value")
        page = Page(gateway.url, browser, (root,))
        page.show()
        page.at_rest(1)
        next(root.rglob("*front/episode_000002.mp4")).write_text("no video")
        browser.run("document.querySelector('#episodes tr[data-episode=\"2\"] button').click()")
        told = browser.until("document.getElementById('episode-errors').textContent")
        assert "episode_000002.mp4: expected a whole video file, got Invalid data" in told
        assert str(tmp_path) not in told


def test_broken_episodes_are_marked_and_an_hdf5_dataset_is_watched(
    demo_server: Endpoints, browser: Browser, tmp_path: Path
) -> None:
    root, demos = copied("toy_v21", tmp_path), tmp_path / "demos.hdf5"
    dataset = LeRobotDataset(root)
    with h5py.File(demos, "w") as opened:
        for episode in dataset.episodes[:2]:
            frames = np.stack(list(dataset.frames(episode, CAMERAS[1])))
            opened[f"data/demo_{episode.index}/obs/wrist"] = frames
            opened[f"data/demo_{episode.index}"].attrs["language"] = episode.task
    label(open_dataset(root), BrightnessScorer(), LabelOptions(formats=("progress",)))
    label(open_dataset(demos), BrightnessScorer(), LabelOptions(formats=("progress",)))
    next(root.rglob("*front/episode_000002.mp4")).write_text("no video")
    words = ("--dataset", str(root), "--dataset", str(demos))
    with running(demo_server, tmp_path, "rfm", *words) as gateway:
        page = Page(gateway.url, browser, (root,))
        page.open()
        told = browser.until("document.querySelector('#episodes tr[data-episode=\"2\"] .failed')?.textContent")
        assert "episode_000002.mp4: expected a whole video file, got " in told
        assert len(browser.all("#episodes .failed")) == 1
        assert browser["ends-told"].text.startswith("1 cannot be labelled now: see their tasks.")
        Select(browser["dataset"]).select_by_value("1")
        browser.until("document.querySelectorAll('#episodes tr').length === 2")
        browser.run("document.querySelector('#episodes tr[data-episode=\"1\"] button').click()")
        browser.until(f"document.querySelectorAll('{VIDEOS}').length === 1 && {ARE_THERE}")
        assert not browser["score-episode"].is_enabled()
        assert "rfm-client label" in browser["score-episode"].get_attribute("title")
        assert not browser["use-copy"].is_enabled()
        assert browser["use-words"].text.startswith("# LeRobot does not read HDF5")
