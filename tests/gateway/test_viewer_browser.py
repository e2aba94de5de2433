# SPDX-License-Identifier: MIT
"""The page in Chromium, before a real Triton with the demo's checkpoint."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.support.select import Select

import clip
from browsers import IMAGES_VARIABLE, Browser, chromium
from gateway_requests import TOLERANCE
from gateways import Gateway, poll, running
from rfm.launch.process import Endpoints
from rfm_client.data.orientation import ORIENTATIONS, Orientation, turned
from toy_world import Task, make_clip
from toy_world.video import write_video
from viewer_requests import by_command_line

pytestmark = [pytest.mark.triton, pytest.mark.slow]

TASK, OTHER_TASK = Task("red", "bowl").sentence(), Task("green", "plate").sentence()
CLIPS = {"success": ("success", 2_000_000), "failure": ("dropped", 2_000_001), "rewound": ("rewound", 2_000_002)}
FPS = 10
SHOWN = 5e-4  # three decimals


@dataclass(frozen=True)
class Stage:
    """A gateway, a browser, and the folders of videos and of what is downloaded."""

    gateway: Gateway
    browser: Browser
    videos: Path
    downloads: Path

    def video(self, name: str) -> Path:
        return self.videos / f"{name}.mp4"

    def saved(self, name: str) -> bytes:
        """A file that the page has just let the browser save."""
        file = self.downloads / name
        poll(lambda: file.exists() and file.stat().st_size > 0)
        content = file.read_bytes()
        file.unlink()
        return content


@pytest.fixture(scope="module")
def stage(demo_server: Endpoints, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    folder = tmp_path_factory.mktemp("stage")
    videos, downloads = folder / "videos", folder / "downloads"
    videos.mkdir()
    for name, (kind, seed) in CLIPS.items():
        write_video(videos / f"{name}.mp4", make_clip(kind, Task("red", "bowl"), seed).frames, FPS)  # as the demo does
    (videos / "broken.mp4").write_text("no video")
    with running(demo_server, folder) as gateway, chromium(downloads) as browser:
        yield Stage(gateway, browser, videos, downloads)
        asked = browser.asked()
        assert f"{gateway.url}/viewer/score" in asked
        assert [url for url in asked if not url.startswith((gateway.url, "blob:", "data:"))] == []


@pytest.fixture
def page(stage: Stage) -> Iterator[Stage]:
    """The page, ready, with a task."""
    browser = stage.browser
    browser.open(stage.gateway.url)
    browser.until("document.getElementById('model').value")
    browser.write("tasks", TASK)
    browser.write("fps", str(FPS))
    yield stage
    complaints = [line for line in browser.complaints() if "viewer/score" not in line]  # those of refused requests
    assert complaints == []


def scored(page: Stage, *names: str) -> None:
    """Drops videos, and waits for their curves."""
    page.browser.drop([page.video(name) for name in names])
    is_done = "[...document.querySelectorAll('#curves td:last-child')].filter((cell) => cell.textContent === 'done')"
    page.browser.until(f"{is_done}.length === {len(names)}")


def taken_along(page: Stage) -> Any:
    page.browser["json"].click()
    return json.loads(page.saved("curves.json"))


def rows(page: Stage) -> list[list[str]]:
    return page.browser.run(
        "return [...document.querySelectorAll('#curves tr')].map((row) => [...row.cells].map((cell) => cell.textContent))"
    )


def times_s(page: Stage) -> list[float]:
    """Where the videos are, then where the slider is."""
    return page.browser.run(
        "return [...document.querySelectorAll('video, #time')].map((each) => Number(each.currentTime ?? each.value))"
    )


def test_dropped_clips_get_the_curves_of_the_command_line(page: Stage) -> None:
    scored(page, "success", "failure")
    document = taken_along(page)
    assert [video["source"] for video in document["videos"]] == ["success.mp4", "failure.mp4"]
    by_command_line(page.videos, page.browser["command"].text)
    videos = json.loads((page.videos / "scores.json").read_text())["videos"]
    for shown, video, row in zip(document["videos"], videos, rows(page), strict=True):
        for name in ("progress", "success", "frame_times_s"):
            np.testing.assert_allclose(shown[name], video[name], rtol=0, atol=TOLERANCE, err_msg=name)
        assert (shown["num_frames"], shown["model_version"]) == (video["num_frames"], video["model_version"])
        numbers = [float(text) for text in row[5:9]]
        expected = [video[name][index] for index in (0, -1) for name in ("progress", "success")]
        assert numbers == pytest.approx(expected, abs=SHOWN + TOLERANCE)
    assert "success.mp4: put the red block in the bowl" in page.browser["chart"].get_attribute("aria-label")


def picture(page: Stage) -> Image.Image:
    """What the page shows of its one video, without the box around it."""
    (player,) = page.browser.all("video")
    shown = Image.open(io.BytesIO(player.screenshot_as_png)).convert("RGB")
    lit = np.argwhere(np.asarray(shown).max(axis=2) > 8)  # beside a quarter turn the box is black
    (top, left), (bottom, right) = lit.min(axis=0), lit.max(axis=0)
    return shown.crop((left, top, right + 1, bottom + 1))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_person_sees_what_the_model_sees(page: Stage, orientation: Orientation) -> None:
    frames = make_clip("success", Task("red", "bowl"), 2_000_000).frames[:, :40]
    clip.write(page.videos / "wide.mp4", frames, FPS)
    Select(page.browser["orient"]).select_by_value(orientation)
    scored(page, "wide")
    (told,) = taken_along(page)["videos"]
    by_command_line(page.videos, page.browser["command"].text)
    (video,) = json.loads((page.videos / "scores.json").read_text())["videos"]
    assert told["orient"] == orientation
    np.testing.assert_allclose(told["progress"], video["progress"], rtol=0, atol=TOLERANCE)

    def distance(other: Orientation) -> float:
        expected = Image.fromarray(turned(frames[0], other))
        return float(np.abs(np.float32(picture(page).resize(expected.size)) - np.float32(expected)).mean())

    page.browser["time"].send_keys(Keys.HOME)
    poll(lambda: times_s(page)[0] == pytest.approx(0, abs=0.01))
    assert min(ORIENTATIONS, key=distance) == orientation


def test_tasks_are_overlaid_and_taken_along(page: Stage) -> None:
    page.browser.write("tasks", f"{TASK}\n{OTHER_TASK}\n{TASK}")
    Select(page.browser["rule"]).select_by_visible_text("linspace_trunc")
    page.browser.write("frames", "4")
    page.browser.drop([page.video("success")])
    page.browser.until("document.getElementById('status').textContent === '2 of 2 curves are done.'")
    first, second = taken_along(page)["videos"]
    assert (first["task"], second["task"]) == (TASK, OTHER_TASK)
    assert first["progress"] != second["progress"]
    assert len(page.browser["command"].text.splitlines()) == 2
    page.browser["csv"].click()
    lines = list(csv.DictReader(page.saved("curves.csv").decode().splitlines()))
    assert len(lines) == first["num_frames"] + second["num_frames"]
    assert [float(line["progress"]) for line in lines] == first["progress"] + second["progress"]
    assert {(line["sampling"], line["frames"]) for line in lines} == {("linspace_trunc", "4")}
    page.browser["png"].click()
    assert page.saved("curves.png").startswith(b"\x89PNG\r\n")


def test_dragging_in_the_chart_moves_the_videos_and_the_numbers(page: Stage) -> None:
    scored(page, "success", "failure")
    (over,) = page.browser.all(".u-over")
    width = over.size["width"]
    ActionChains(page.browser.driver).move_to_element(over).perform()  # pointing is enough
    poll(lambda: times_s(page) == pytest.approx([1.5 / 2] * 3, abs=0.02))
    ActionChains(page.browser.driver).move_to_element_with_offset(over, -width // 4, 0).click_and_hold().perform()
    poll(lambda: times_s(page) == pytest.approx([1.5 / 4] * 3, abs=0.02))
    ActionChains(page.browser.driver).move_by_offset(width // 2, 0).release().perform()
    poll(lambda: times_s(page) == pytest.approx([1.5 * 3 / 4] * 3, abs=0.02))
    for row, video in zip(rows(page), taken_along(page)["videos"], strict=True):
        assert [float(text) for text in row[5:7]] == pytest.approx(
            [video[name][11] for name in ("progress", "success")], abs=SHOWN
        )


def test_the_keys_move_from_point_to_point(page: Stage) -> None:
    scored(page, "success")
    for key, time in ((Keys.ARROW_RIGHT, 0.1), (Keys.ARROW_RIGHT, 0.2), (Keys.ARROW_LEFT, 0.1), (Keys.ARROW_LEFT, 0.0)):
        page.browser["time"].send_keys(key)
        poll(lambda time=time: times_s(page) == pytest.approx([time] * 2, abs=0.005))


def test_playing_moves_the_cursor(page: Stage) -> None:
    scored(page, "success")
    page.browser["play"].click()
    page.browser.until("document.getElementById('play').textContent === 'Pause'")
    seen = [times_s(page)[-1]]
    poll(lambda: seen.append(times_s(page)[-1]) or seen[-1] == pytest.approx(1.5))  # type: ignore[func-returns-value]
    assert len(set(seen)) > 2
    assert sorted(seen) == seen
    page.browser.until("document.getElementById('play').textContent === 'Play'")


def test_a_pair_is_compared_in_both_orders(page: Stage) -> None:
    scored(page, "success", "failure")
    page.browser["compare"].click()
    page.browser.until("document.querySelector('#pairs p')")
    (answer,) = taken_along(page)["comparisons"]
    commands = [line for line in page.browser["command"].text.splitlines() if line.startswith("rfm-client compare")]
    shown = [item.text for item in page.browser.all("#pairs li")]
    for order, command, line in zip(answer["orders"], commands, shown, strict=True):
        by_command_line(page.videos, f"{command} --json pair.json")
        preference = json.loads((page.videos / "pair.json").read_text())["preference"]
        assert order["preference"] == pytest.approx(preference, abs=TOLERANCE)
        assert float(line.rpartition(" ")[2]) == pytest.approx(preference, abs=SHOWN + TOLERANCE)
    assert page.browser.all("#pairs p")[0].text == "Both orders agree: success.mp4 is better."
    assert (answer["verdict"], answer["orders_agree"]) == ("first", True)


def test_a_video_is_no_better_than_its_copy(page: Stage) -> None:
    (page.videos / "copy.mp4").write_bytes((page.videos / "success.mp4").read_bytes())
    scored(page, "success", "copy")
    page.browser["compare"].click()
    page.browser.until("document.querySelector('#pairs p')")
    (answer,) = taken_along(page)["comparisons"]
    assert answer["verdict"] is None
    why = "both are exactly 0.5" if answer["orders_agree"] else "the orders disagree"
    assert page.browser.all("#pairs p")[0].text == f"No answer: {why}."


def test_the_threshold_says_when_success_is_reached(page: Stage) -> None:
    scored(page, "success", "rewound")
    success = [np.array(video["success"]) for video in taken_along(page)["videos"]]
    for threshold in (0.5, 0.999, 1.0):
        page.browser.write("threshold", str(threshold))
        first = [np.flatnonzero(values >= threshold) for values in success]
        assert [row[9] for row in rows(page)] == [f"{index[0] / FPS:.2f} s" if len(index) else "-" for index in first]


def test_a_broken_video_says_why_and_the_others_are_scored(page: Stage) -> None:
    page.browser.drop([page.video("broken"), page.video("success")])
    page.browser.until("document.getElementById('status').textContent === '1 of 2 curves are done.'")
    kinds = "MP4, MOV, WebM, Matroska, Ogg or AVI"
    told = f"video: expected a file of the kind {kinds}, got another kind (broken.mp4)"
    page.browser.until("document.getElementById('errors').textContent")
    assert page.browser["errors"].text == f"broken.mp4: {told}"
    assert [row[-1] for row in rows(page)] == [told, "done"]


def test_what_is_missing_is_named_before_anything_is_asked(page: Stage) -> None:
    submit = page.browser.all("#question .first")[0]
    submit.click()
    assert page.browser["errors"].text == "video: expected a file, got none: drop one"
    page.browser.write("tasks", " ")
    page.browser.drop([page.video("success")])
    submit.click()
    assert page.browser["errors"].text == "task: expected what is to be done, as a sentence, got none"
    assert rows(page) == []


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_axe_finds_nothing(page: Stage, theme: str) -> None:
    with page.browser.theme(theme):
        scored(page, "success", "failure")
        page.browser["compare"].click()
        page.browser.until("document.querySelector('#pairs p')")
        assert page.browser.violations() == []


def test_the_documentation_of_endpoints_needs_no_network(stage: Stage) -> None:
    stage.browser.open(f"{stage.gateway.url}/docs")
    stage.browser.until("document.body.textContent.includes('/evaluate_batch_npy')")
    assert stage.browser.complaints() == []


def test_a_picture_of_the_page(page: Stage, tmp_path: Path) -> None:
    scored(page, "success", "failure")
    page.browser["time"].send_keys(*[Keys.ARROW_RIGHT] * 12)
    poll(lambda: times_s(page) == pytest.approx([1.2] * 3, abs=0.005))
    page.browser["compare"].click()
    page.browser.until("document.querySelector('#pairs p')")
    page.browser.run("document.activeElement.blur()")
    page.browser.picture(Path(os.environ.get(IMAGES_VARIABLE, tmp_path)) / "page.png")
