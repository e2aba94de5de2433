# SPDX-License-Identifier: MIT
"""The page's tab of datasets in Chromium, before a real Triton with the demo's checkpoint."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.support.select import Select

from browsers import IMAGES_VARIABLE, Browser, chromium
from gateways import Gateway, poll, running
from labelling import BrightnessScorer
from rfm.launch.process import Endpoints
from rfm_client import RewardClient
from rfm_client.data.orientation import Orient
from rfm_client.labelling import ClientScorer, LabelOptions, Summary, label, open_dataset, summarise
from shown_datasets import CAMERAS, CODINGS, columns_of, copied, dataset, encoded_anew

pytestmark = [pytest.mark.triton, pytest.mark.slow]

SHOWN = 5e-4  # three decimals
SHOWN_SHARE = 5e-4  # a tenth of a per cent
KEY = "open sesame"
DEMO, BRIGHT, PLAIN, *CODED = range(
    3 + len(CODINGS)
)  # labelled by the demo's checkpoint, by brightness, not at all; coded otherwise


@dataclass(frozen=True)
class Stage:
    """A gateway with datasets, and a browser. folders: of the datasets, by their numbers"""

    gateway: Gateway
    browser: Browser
    folders: tuple[Path, ...]

    @property
    def rows(self) -> list[list[str]]:
        """The cells of the table of episodes."""
        return self.browser.run(  # type: ignore[no-any-return]
            "return [...document.querySelectorAll('#episodes tr')].map((row) => "
            "[...row.children].map((cell) => cell.textContent))"
        )

    @property
    def numbers(self) -> list[list[float]]:
        """The cells of numbers of the watched episode's curves."""
        return self.browser.run(  # type: ignore[no-any-return]
            "return [...document.querySelectorAll('#episode-curves tr')].map((row) => "
            "[...row.querySelectorAll('td')].map((cell) => Number(cell.textContent)))"
        )

    @property
    def times_s(self) -> list[float]:
        """Where the episode's videos and the slider are."""
        return self.browser.run(  # type: ignore[no-any-return]
            "return [...document.querySelectorAll('#episode-videos video, #episode-time')]"
            ".map((each) => Number(each.currentTime ?? each.value))"
        )

    def choose(self, number: int) -> None:
        """Shows a dataset."""
        Select(self.browser["dataset"]).select_by_value(str(number))
        count = len(dataset(self.folders[number]).episodes)
        self.browser.until(f"document.querySelectorAll('#episodes tr').length === {count}")
        self.browser.until(f"document.getElementById('ends').hidden === {str(number >= PLAIN).lower()}")

    def watch(self, episode: int) -> None:
        """Clicks an episode, and waits for its videos."""
        self.browser.run(f"document.querySelector('#episodes tr[data-episode=\"{episode}\"] button').click()")
        self.browser.until(
            f"document.getElementById('episode-title').textContent === 'Episode {episode}' && "
            "document.querySelectorAll('#episode-videos video').length === 2 && "
            "[...document.querySelectorAll('#episode-videos video')].every((video) => video.readyState >= 2)"
        )

    def at_rest(self, episode: int) -> None:
        """Watches an episode, stops it, and goes back to its begin."""
        self.watch(episode)
        self.move_to(0)
        poll(lambda: self.browser["episode-play"].text == "Play")

    def move_to(self, seconds: float) -> None:
        """Moves the slider, as a person does, and waits for the videos."""
        self.browser.run(
            "const slider = document.getElementById('episode-time'); slider.value = arguments[0]; "
            "slider.dispatchEvent(new Event('input'))",
            seconds,
        )
        poll(lambda: self.times_s == pytest.approx([seconds] * 3, abs=0.02))
        self.browser.until(  # a video that still seeks tells where it is going, and shows where it was
            "[...document.querySelectorAll('#episode-videos video')]"
            ".every((video) => !video.seeking && video.readyState >= 2)"
        )


@pytest.fixture(scope="module")
def stage(demo_server: Endpoints, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    folder = tmp_path_factory.mktemp("stage")
    demo, plain = copied("toy_v30_many", folder), folder / "plain"
    plain.mkdir()
    with RewardClient(demo_server.grpc_url) as client:
        label(open_dataset(demo), ClientScorer(client), LabelOptions())
    bright = copied("toy_v21", folder)
    label(open_dataset(bright, orient=Orient.parse(["wrist=rotate180"])), BrightnessScorer(), LabelOptions())
    folders: tuple[Path, ...] = (demo, bright, copied("toy_v21", plain))
    for number, (codec, options) in enumerate(CODINGS.values()):
        (folder / f"{number}").mkdir()
        folders += (copied("toy_v30_many", folder / f"{number}"),)
        encoded_anew(folders[-1], codec, options)
    words = [word for root in folders for word in ("--dataset", str(root))]
    with running(demo_server, folder, "rfm", *words) as gateway, chromium(folder / "downloads") as browser:
        yield Stage(gateway, browser, folders)
        asked = browser.asked()
        assert any(url.endswith("/videos/0") for url in asked)
        assert [url for url in asked if not url.startswith((gateway.url, "blob:", "data:"))] == []


@pytest.fixture
def page(stage: Stage) -> Iterator[Stage]:
    """The tab of datasets, ready."""
    stage.browser.open(stage.gateway.url)
    stage.browser.until("document.getElementById('model').value")
    stage.browser["dataset-tab"].click()
    stage.browser.until("document.querySelector('#episodes tr')")
    yield stage
    assert stage.browser.complaints() == []


def test_the_tab_opens_and_the_arrow_keys_change_tabs(page: Stage) -> None:
    assert page.browser["dataset-panel"].is_displayed()
    assert not page.browser["score-panel"].is_displayed()
    page.browser["dataset-tab"].send_keys(Keys.ARROW_LEFT)
    assert page.browser["score-panel"].is_displayed()
    assert not page.browser["dataset-panel"].is_displayed()
    names = page.browser.run("return [...document.getElementById('dataset').options].map((option) => option.text)")
    assert names[:3] == ["toy_v30_many (LeRobot v3.0)", *["toy_v21 (LeRobot v2.1)"] * 2]


def summary_of(root: Path) -> Summary:
    return summarise(root / "rfm_progress.parquet")


@pytest.mark.parametrize("number", [DEMO, BRIGHT])
def test_the_table_has_the_numbers_of_the_labels(page: Stage, number: int) -> None:
    page.choose(number)
    root = page.folders[number]
    summary = summary_of(root)
    assert summary.best_success is not None and summary.disagreement is not None and summary.never_succeed is not None
    for head, task, frames, final, best, never, backwards, apart in page.rows:
        episode = int(head.removeprefix("Watch "))
        told = dataset(root).episodes[episode]
        assert (task, int(frames)) == (told.task, told.num_frames)
        assert float(final) == pytest.approx(summary.final_progress[episode], abs=SHOWN)
        assert float(best) == pytest.approx(summary.best_success[episode], abs=SHOWN)
        assert never == ("never" if episode in summary.never_succeed else "")
        assert float(backwards.removesuffix(" %")) / 100 == pytest.approx(summary.backwards[episode], abs=SHOWN_SHARE)
        assert float(apart) == pytest.approx(summary.disagreement[episode], abs=SHOWN)
    never = len(summary.never_succeed)
    assert page.browser["ends-told"].text == (
        f"{len(page.rows)} of {len(page.rows)} episodes are labelled. "
        f"{never} never {'succeeds' if never == 1 else 'succeed'}: success stays below 0.5."
    )
    told = page.browser["histogram"].get_attribute("aria-label").removeprefix("Episodes by final progress: ")
    counts, _ = np.histogram(summary.final_progress, bins=20, range=(0, 1))
    assert [int(bar.split()[0]) for bar in told.split(", ")] == counts.tolist()
    assert page.browser.run("return document.querySelector('#histogram canvas').width") > 0


def episodes_by(*keys: np.ndarray[Any, Any]) -> list[int]:
    """The numbers of the episodes, the lowest of the first key first."""
    return np.lexsort([np.arange(len(keys[0])), *reversed(keys)]).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize("number", [DEMO, BRIGHT])
def test_the_rows_are_sorted_by_what_one_wants_to_see_first(page: Stage, number: int) -> None:
    page.choose(number)
    summary = summary_of(page.folders[number])
    assert summary.best_success is not None and summary.disagreement is not None
    never = summary.best_success < 0.5
    expected = {
        "never succeeds, then goes backwards, then cameras disagree": episodes_by(
            -never.astype(int), -summary.backwards, -summary.disagreement
        ),
        "goes backwards most": episodes_by(-summary.backwards),
        "cameras disagree most": episodes_by(-summary.disagreement),
        "lowest final progress": episodes_by(summary.final_progress),
        "lowest best success": episodes_by(summary.best_success),
        "episode number": list(range(len(never))),
    }
    assert [option.text for option in Select(page.browser["order"]).options] == list(expected)
    for name, episodes in expected.items():
        if page.browser["order"].get_attribute("value") != name:
            Select(page.browser["order"]).select_by_visible_text(name)
        assert [int(row[0].removeprefix("Watch ")) for row in page.rows] == episodes, name


@pytest.mark.parametrize(("number", "episode"), [(DEMO, 0), (DEMO, 4), (BRIGHT, 3)])
def test_a_click_plays_the_episode_and_the_curve_follows(page: Stage, number: int, episode: int) -> None:
    page.choose(number)
    page.watch(episode)
    end_s = (dataset(page.folders[number]).episodes[episode].num_frames - 1) / 10
    seen = [page.times_s[-1]]
    poll(lambda: seen.append(page.times_s[-1]) or seen[-1] == pytest.approx(end_s, abs=0.01))  # type: ignore[func-returns-value]
    assert len(set(seen)) > 2
    assert sorted(seen) == seen
    page.browser.until("document.getElementById('episode-play').textContent === 'Play'")
    columns = columns_of(page.folders[number], episode)
    last = [[columns[name][-1] for name in ("progress_sparse", "success")]]
    last += [[columns[f"{name}.{camera}"][-1] for name in ("progress", "success")] for camera in CAMERAS]
    np.testing.assert_allclose(page.numbers, [each * 2 for each in last], rtol=0, atol=SHOWN)


def test_dragging_in_the_chart_moves_the_videos_and_the_numbers(page: Stage) -> None:
    page.choose(DEMO)
    page.at_rest(2)
    columns = columns_of(page.folders[DEMO], 2)
    end_s = (len(columns["index"]) - 1) / 10
    over = page.browser.all("#episode-chart .u-over")[0]
    width = over.size["width"]
    ActionChains(page.browser.driver).move_to_element_with_offset(over, -width // 4, 0).click_and_hold().perform()
    poll(lambda: page.times_s == pytest.approx([end_s / 4] * 3, abs=0.05))
    ActionChains(page.browser.driver).move_by_offset(width // 2, 0).release().perform()
    poll(lambda: page.times_s == pytest.approx([end_s * 3 / 4] * 3, abs=0.05))
    page.browser["episode-time"].send_keys(Keys.ARROW_LEFT)
    poll(lambda: len({round(time, 2) for time in page.times_s}) == 1)
    frame = round(page.times_s[-1] * 10)
    for row, names in zip(page.numbers, [("progress_sparse", "success"), *((f"progress.{c}", f"success.{c}") for c in CAMERAS)], strict=True):  # fmt: skip
        assert row[:2] == pytest.approx([columns[name][frame] for name in names], abs=SHOWN)


def pixels(page: Stage, camera: int) -> np.ndarray[Any, Any]:
    """What a video of the episode shows now, uint8 [H, W, 3]."""
    height, width, data = page.browser.run(
        """
        const video = document.querySelectorAll("#episode-videos video")[arguments[0]];
        const canvas = new OffscreenCanvas(video.videoWidth, video.videoHeight);
        const context = canvas.getContext("2d");
        context.drawImage(video, 0, 0);
        return [canvas.height, canvas.width, [...context.getImageData(0, 0, canvas.width, canvas.height).data]];
        """,
        camera,
    )
    return np.array(data, np.uint8).reshape(height, width, 4)[..., :3]


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("number", [DEMO, BRIGHT, *CODED], ids=["v3.0", "v2.1", *CODINGS])
def test_a_video_shows_the_frame_of_the_time(page: Stage, number: int, camera: int) -> None:
    page.choose(number)
    page.at_rest(5)
    opened = dataset(page.folders[number])
    frames = np.stack(list(opened.frames(opened.episodes[5], CAMERAS[camera]))).astype(np.float32)
    for t in (0, 7, len(frames) // 2, len(frames) - 1):
        page.move_to(t / 10)
        off = np.abs(frames - pixels(page, camera)).mean(axis=(1, 2, 3))
        assert off[t] == off.min() < 3, (t, off)


def test_an_episode_is_put_into_the_score_tab_and_scored(page: Stage) -> None:
    page.choose(DEMO)
    page.at_rest(0)
    page.browser["score-episode"].click()
    assert page.browser["score-panel"].is_displayed()
    task = dataset(page.folders[DEMO]).episodes[0].task
    assert page.browser["tasks"].get_attribute("value") == task
    page.browser.until("document.getElementById('status').textContent === '2 of 2 curves are done.'")
    told = page.browser.run(
        "return [...document.querySelectorAll('#curves tr')].map((row) => "
        "[...row.children].map((cell) => cell.textContent))"
    )
    columns = columns_of(page.folders[DEMO], 0)
    for row, camera in zip(told, CAMERAS, strict=True):
        assert row[0] == f"toy_v30_many_episode_000000.{camera.rpartition('.')[2]}.mp4"
        assert row[4] == f"{len(columns['index'])} of {len(columns['index'])}"
        expected = [columns[f"{name}.{camera}"][-1] for name in ("progress", "success")]
        assert [float(text) for text in row[7:9]] == pytest.approx(expected, abs=2 * SHOWN)  # as the labels


def test_videos_are_turned_as_they_were_for_the_labels_also_when_they_are_scored(page: Stage) -> None:
    page.choose(BRIGHT)
    page.at_rest(1)
    turned = "return [...document.querySelectorAll(`#${arguments[0]} video`)].map((video) => video.className)"
    assert page.browser.run(turned, "episode-videos") == ["none", "rotate180"]
    page.browser["score-episode"].click()
    page.browser.until("document.getElementById('status').textContent === '2 of 2 curves are done.'")
    assert page.browser.run(turned, "videos") == ["none", "rotate180"]
    told = page.browser.run(
        "return [...document.querySelectorAll('#curves tr')].map((row) => row.cells[3].textContent)"
    )
    assert [text.endswith(", rotate180") for text in told] == [False, True]


def test_episodes_without_labels_can_be_watched_and_scored(page: Stage) -> None:
    page.choose(PLAIN)
    assert [row[3:] for row in page.rows] == [["-"] * 5] * 8
    assert [row[0] for row in page.rows] == [f"Watch {episode}" for episode in range(8)]
    page.at_rest(1)
    assert page.numbers == []
    page.browser["episode-time"].send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    poll(lambda: len({round(time, 2) for time in page.times_s}) == 1)
    page.browser["score-episode"].click()
    page.browser.until("document.getElementById('status').textContent === '2 of 2 curves are done.'")


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_axe_finds_nothing(page: Stage, theme: str) -> None:
    with page.browser.theme(theme):
        page.at_rest(3)
        assert page.browser.violations() == []


def test_the_key_opens_datasets_and_videos(stage: Stage, demo_server: Endpoints, tmp_path: Path) -> None:
    words = ("--dataset", str(stage.folders[DEMO]))
    keyed = running(demo_server, tmp_path, "rfm", *words, RFM_GATEWAY_API_KEY=KEY)
    with keyed as gateway, chromium(tmp_path) as browser:
        browser.open(gateway.url)
        browser.until("document.getElementById('errors').textContent")
        assert browser.all("#episodes tr") == []
        for key in ("sesame", KEY):
            browser.until("document.getElementById('errors').textContent.startsWith('key: expected X-API-Key')")
            browser.write("key", key)
            browser.all("#key-form button")[0].click()
        browser.until("document.getElementById('model').value")
        browser["dataset-tab"].click()
        browser.until("document.querySelector('#episodes tr')")
        Stage(gateway, browser, stage.folders).at_rest(1)


def test_a_dataset_that_breaks_says_why(stage: Stage, demo_server: Endpoints, tmp_path: Path) -> None:
    root = copied("toy_v21", tmp_path)
    words = ("--dataset", str(root))
    with running(demo_server, tmp_path, "rfm", *words) as gateway, chromium(tmp_path) as browser:
        next(root.rglob("*front/episode_000002.mp4")).write_text("no video")
        browser.open(gateway.url)
        browser.until("document.querySelector('#episodes tr')")
        browser["dataset-tab"].click()
        browser.run("document.querySelector('#episodes tr[data-episode=\"2\"] button').click()")
        told = browser.until("document.getElementById('errors').textContent")
        assert "episode_000002.mp4: expected a whole video file, got Invalid data" in told
        assert str(tmp_path) not in told


def test_a_picture_of_the_page(page: Stage, tmp_path: Path) -> None:
    page.choose(DEMO)
    page.at_rest(3)
    page.move_to(1.2)
    page.browser.run("document.activeElement.blur(); scrollTo(0, 0)")
    page.browser.picture(Path(os.environ.get(IMAGES_VARIABLE, tmp_path)) / "page_dataset.png")
