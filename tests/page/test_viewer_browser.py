# SPDX-License-Identifier: MIT
"""The page in Chromium, before a real Triton with the demo's checkpoint."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import re
import shlex
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args
from urllib.parse import urlencode

import numpy as np
import pytest
from PIL import Image
from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.support.select import Select

import clip
from browsers import REBOUND, Browser
from gateways import Gateway, running
from paths import VIDEOS
from rfm_client.contract.description import TOY
from rfm_client.frames import ChannelOrder, Correction, Orientation
from servers import Endpoints, folder_server, wait_for
from tolerances import SHOWN, TOLERANCE
from toy_world import Task, make_clip
from viewer_requests import by_command_line

pytestmark = [pytest.mark.triton, pytest.mark.slow]

SVG = "{http://www.w3.org/2000/svg}"
TASK, OTHER_TASK = Task("red", "bowl").sentence(), Task("green", "plate").sentence()
CLIPS = {"success": ("success", 2_000_000), "failure": ("dropped", 2_000_001)}
FPS = 10
SIGNALS = ("progress", "success")
PLAYERS = "#videos video, #time"  # the videos, then the slider
VERDICT = "document.getElementById('verdict-told').textContent"


@dataclass(frozen=True)
class Page:
    """The page, ready, with a task, and the folder of videos."""

    gateway: Gateway
    browser: Browser
    videos: Path

    def drop(self, *names: str) -> None:
        self.browser.drop([self.videos / f"{name}.mp4" for name in names])

    def score(self, *names: str) -> None:
        """Drop videos and wait for the curves."""
        self.drop(*names)
        self.browser.until_text("scored", f"{len(names)} of {len(names)} scored")

    def saved(self) -> Any:
        """Return the JSON that the page saves."""
        self.browser["json"].click()
        return json.loads(self.browser.saved("curves.json"))

    def beside_the_lines(self) -> list[float]:
        """Return the numbers at the cursor: progress by curve, then success by curve."""
        return [float(text) for signal in SIGNALS for text in self.browser.values("chart", signal).values()]

    def is_at(self, time_s: float, abs_s: float = 0.005) -> bool:
        times_s = self.browser.times_s(PLAYERS)
        return times_s == pytest.approx([time_s] * len(times_s), abs=abs_s)


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("videos")
    for name, (kind, seed) in CLIPS.items():
        clip.write(folder / f"{name}.mp4", make_clip(kind, Task("red", "bowl"), seed).frames, FPS)
    (folder / "copy.mp4").write_bytes((folder / "success.mp4").read_bytes())
    (folder / "broken.mp4").write_text("no video")
    (folder / "large.mp4").write_bytes((VIDEOS / "berkeley_rpt_stack_cup.mp4").read_bytes())
    return folder


@pytest.fixture(scope="module")
def gateway(demo_server: Endpoints, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    with running(demo_server, tmp_path_factory.mktemp("gateway")) as started:
        yield started


@pytest.fixture
def page(gateway: Gateway, quiet_browser: Browser, videos: Path) -> Page:
    storage = {"origin": gateway.url, "storageTypes": "local_storage"}
    quiet_browser.driver.execute_cdp_cmd("Storage.clearDataForOrigin", storage)
    quiet_browser.open(gateway.url)
    quiet_browser.write("tasks", TASK)
    quiet_browser.run("document.getElementById('advanced').open = true")
    quiet_browser.write("fps", str(FPS))
    return Page(gateway, quiet_browser, videos)


def test_dropped_clips_get_the_curves_of_the_command_line(page: Page) -> None:
    page.score("success", "failure")
    document = page.saved()
    assert [video["source"] for video in document["videos"]] == ["success.mp4", "failure.mp4"]
    assert page.browser["warning"].text == f"{TOY}; rfm serve robometer/Robometer-4B serves a public checkpoint"
    videos = by_command_line(page.videos, page.browser["command"].text)["videos"]
    assert {video["warning"] for video in videos} == {TOY}
    for shown, video, row in zip(document["videos"], videos, page.browser.cells("#curves tr"), strict=True):
        for name in ("progress", "success", "frame_times_s"):
            np.testing.assert_allclose(shown[name], video[name], rtol=0, atol=TOLERANCE, err_msg=name)
        assert (shown["num_frames"], shown["model_version"]) == (video["num_frames"], video["model_version"])
        last = [video[name][-1] for name in ("progress", "success")]
        assert [float(text) for text in row[5:7]] == pytest.approx(last, abs=SHOWN + TOLERANCE)
    wait_for(lambda: page.is_at(1.5))
    ends = [each[name][-1] for name in SIGNALS for each in videos]
    assert page.beside_the_lines() == pytest.approx(ends, abs=2 * SHOWN)  # which stand there
    assert "success.mp4: put the red block in the bowl" in page.browser["chart"].get_attribute("aria-label")
    for threshold in (0.5, 1.0):
        page.browser.enter("#threshold", threshold)
        first = [np.flatnonzero(np.array(video["success"]) >= threshold) for video in document["videos"]]
        is_lost = [", then lost" if video["success"][-1] < threshold else "" for video in document["videos"]]
        told = [f"{at[0] / FPS:.2f} s{lost}" if len(at) else "-" for at, lost in zip(first, is_lost, strict=True)]
        assert [row[7] for row in page.browser.cells("#curves tr")] == told
    (line,) = page.browser.all("#chart .threshold")
    height = page.browser.run("return document.querySelector('#chart .u-over').clientHeight")
    drag = ActionChains(page.browser.driver).move_to_element(line).click_and_hold()
    drag.move_by_offset(0, round(0.24 * height * 0.2)).release().perform()  # the band has 0.24 of the height
    assert float(page.browser["threshold"].get_attribute("value")) == pytest.approx(0.8, abs=0.02)
    assert line.get_attribute("data-value") == f"{float(page.browser['threshold'].get_attribute('value')):.2f}"
    page.browser["dataset-tab"].click()
    assert not page.browser["warning"].is_displayed()  # labels there may be of any checkpoint


def picture(page: Page) -> Image.Image:
    """Return the picture of the only video, without the surrounding box."""
    (player,) = page.browser.all("#videos video")
    page.browser.run("arguments[0].scrollIntoView()", player)
    page.browser.draw()
    shown = Image.open(io.BytesIO(player.screenshot_as_png)).convert("RGB")
    lit = np.argwhere(np.asarray(shown).max(axis=2) > 8)  # beside a quarter turn the box is black
    (top, left), (bottom, right) = lit.min(axis=0), lit.max(axis=0)
    return shown.crop((left, top, right + 1, bottom + 1))


def test_the_page_shows_frames_corrected_as_the_model_gets_them(page: Page) -> None:
    frames = make_clip("success", Task("red", "bowl"), 2_000_000).frames[:, :40]
    clip.write(page.videos / "wide.mp4", frames, FPS)
    Select(page.browser["orient"]).select_by_value("rotate90")
    Select(page.browser["channels"]).select_by_value("bgr")
    page.score("wide")
    (told,) = page.saved()["videos"]
    (video,) = by_command_line(page.videos, page.browser["command"].text)["videos"]
    assert (told["orient"], told["channels"]) == ("rotate90", "bgr")
    np.testing.assert_allclose(told["progress"], video["progress"], rtol=0, atol=TOLERANCE)

    page.browser["time"].send_keys(Keys.HOME)
    wait_for(lambda: page.is_at(0))
    corrections = [Correction(*both) for both in itertools.product(get_args(Orientation), get_args(ChannelOrder))]
    for correction in corrections:
        Select(page.browser["orient"]).select_by_value(correction.orient)
        Select(page.browser["channels"]).select_by_value(correction.channels)
        seen = picture(page)

        def distance(other: Correction, seen: Image.Image = seen) -> float:
            expected = Image.fromarray(other.applied(frames[0]))
            return float(np.abs(np.float32(seen.resize(expected.size)) - np.float32(expected)).mean())

        assert min(corrections, key=distance) == correction


TURN = """
const { left, width, top } = arguments[0].getBoundingClientRect();
const place = { clientX: left + width / 2, clientY: top + 9, deltaY: arguments[1], ctrlKey: true };
arguments[0].dispatchEvent(new WheelEvent("wheel", place));
"""  # the wheel, with Ctrl


def test_the_pointer_the_keys_and_the_button_move_the_videos_and_the_numbers(page: Page) -> None:
    page.score("success", "failure")
    (over,) = page.browser.all(".u-over")
    width = over.size["width"]
    ActionChains(page.browser.driver).move_to_element_with_offset(over, width // 50, 0).perform()  # pointing is enough
    wait_for(lambda: page.is_at(0.8))  # the frame nearest to 0.78
    (line,) = page.browser.all("#chart .playhead")
    dots = page.browser.all("#chart .dots i")
    middles = [dot.rect["x"] + dot.rect["width"] / 2 for dot in dots]
    assert middles == pytest.approx([line.rect["x"]] * len(dots), abs=1)  # the line stands at the numbers
    ActionChains(page.browser.driver).move_to_element_with_offset(over, -width // 4, 0).click_and_hold().perform()
    wait_for(lambda: page.is_at(0.4))  # nearest to 0.375
    ActionChains(page.browser.driver).move_by_offset(width // 2, 0).release().perform()
    wait_for(lambda: page.is_at(1.1))
    page.browser.run(TURN, over, -200)  # half of the time is shown, from 0.25 on
    ActionChains(page.browser.driver).move_to_element_with_offset(over, -width // 4, 0).perform()
    wait_for(lambda: page.is_at(0.6))  # nearest to 0.5625
    ActionChains(page.browser.driver).move_to_element(over).double_click().perform()
    ActionChains(page.browser.driver).move_to_element_with_offset(over, width // 4, 0).perform()
    wait_for(lambda: page.is_at(1.1))
    expected = [video[name][11] for name in SIGNALS for video in page.saved()["videos"]]
    assert page.beside_the_lines() == pytest.approx(expected, abs=SHOWN)
    told = page.browser["time"].get_attribute("aria-valuetext")
    assert told.startswith("1.10")
    assert f"progress {expected[0]:.3f}, success {expected[2]:.3f}" in told
    right = over.rect["x"] + width
    assert min(each.rect["x"] for each in page.browser.all("#chart .values span")) >= right  # where no curve is
    page.browser.enter("#time", 0.97)
    wait_for(lambda: page.is_at(0.9))  # the frame that is shown at this time
    assert page.browser["time-told"].text == "frame 10 of 16, 0.90 / 1.50 s"
    page.browser["time"].send_keys(Keys.HOME)
    wait_for(lambda: page.is_at(0))
    for key, time_s in ((Keys.ARROW_RIGHT, 0.1), (Keys.ARROW_RIGHT, 0.2), (Keys.ARROW_LEFT, 0.1)):
        page.browser["time"].send_keys(key)
        wait_for(lambda time_s=time_s: page.is_at(time_s))  # type: ignore[misc]
    page.browser["play"].click()
    page.browser.until_text("play", "Pause")
    page.browser.until_text("play", "Play")
    assert page.browser.times_s("#time") == pytest.approx([1.5])
    page.browser["tasks"].send_keys(" ")
    assert page.browser["play"].text == "Play"
    page.browser.run("document.activeElement.blur()")
    ActionChains(page.browser.driver).send_keys(Keys.SPACE).perform()
    page.browser.until_text("play", "Pause")


LAGS = """
const done = arguments[0];
const [first, second] = document.querySelectorAll("#videos video");
const play = document.getElementById("play");
const lags = [];
const look = () => {
  lags.push(first.currentTime - second.currentTime);
  if (first.currentTime < 2.5) return requestAnimationFrame(look);
  play.click();
  done(lags);
};
first.addEventListener("seeked", () => { play.click(); look(); }, { once: true });
first.currentTime = 0.8;
"""


def test_a_video_that_lags_catches_up_while_it_plays_and_all_stop_at_one_time(page: Page) -> None:
    page.score("large", "large")
    page.browser["time"].send_keys(Keys.HOME)
    wait_for(lambda: page.is_at(0))
    lags = page.browser.driver.execute_async_script(LAGS)
    assert lags[0] > 0.7
    assert abs(lags[-1]) < 0.2
    wait_for(lambda: page.is_at(page.browser.times_s("#time")[0]))


def compared(page: Page, *names: str) -> tuple[Any, Any]:
    """Score and compare videos. Return the comparison that the page saves, and the one of its command line."""
    page.score(*names)
    page.browser["compare"].click()
    page.browser.until("document.querySelector('#pairs ol')")
    (answer,) = page.saved()["comparisons"]
    (command,) = [line for line in page.browser["command"].text.splitlines() if line.startswith("rfm-client compare")]
    told = by_command_line(page.videos, f"{command} --json ranking.json")
    for ours, theirs in zip(answer["orders"] + answer["pairs"], told["orders"] + told["pairs"], strict=True):
        assert ours.pop("preference") == pytest.approx(theirs.pop("preference"), abs=TOLERANCE)
        assert ours == theirs
    assert told["warning"] == TOY
    assert [video["rank"] for video in answer["videos"]] == [video["rank"] for video in told["videos"]]
    return page.saved()["comparisons"][0], told


def test_several_videos_are_ranked_as_by_the_command_line(page: Page) -> None:
    clip.write(page.videos / "nothing.mp4", make_clip("stopped", Task("red", "bowl"), 2_000_002).frames, FPS)
    answer, told = compared(page, "success", "failure", "nothing")
    best_first = sorted(told["videos"], key=lambda video: video["rank"] or math.inf)
    assert page.browser.run("return [...document.querySelectorAll('#pairs li')].map((item) => item.textContent)") == [
        f"#{video['rank']} {video['source']}mean preference {video['wins']:.3f}"
        if video["rank"]
        else f"{video['source']}no rank"
        for video in best_first
    ]
    widths = page.browser.run(
        "return [...document.querySelectorAll('#pairs .share')].map((bar) => bar.firstChild.offsetWidth / bar.offsetWidth)"
    )
    assert widths == pytest.approx([video["wins"] for video in best_first if video["rank"]], abs=0.02)
    assert page.browser.run("return document.querySelectorAll('#pairs details p').length") == 3
    commands = page.browser["command"].text.splitlines()
    page.drop("copy")  # which is not among those compared
    page.browser.until_text("scored", "4 of 4 scored")
    assert page.browser["command"].text.splitlines()[-1] == commands[-1]
    page.browser.all("#videos .remove")[3].click()
    assert len(page.browser.all("#pairs li")) == 3
    page.browser.all("#videos .remove")[2].click()
    assert page.browser.all("#pairs li") == []
    assert len(answer["pairs"]) == 3


def test_a_pair_is_compared_in_both_orders(page: Page) -> None:
    answer, _ = compared(page, "success", "failure")
    orders = [order["preference"] for order in answer["orders"]]
    (line,) = page.browser.all("#pairs details p")
    told = re.fullmatch(
        r"P\(success\.mp4 is better than failure\.mp4\) = ([\d.]+) shown first, ([\d.]+) shown second", line.text
    )
    assert told
    assert [float(text) for text in told.groups()] == pytest.approx([orders[0], 1 - orders[1]], abs=SHOWN + TOLERANCE)
    assert page.browser.all("#pairs h2")[0].text == "success.mp4 does the task better"
    assert page.browser.all("#pairs p")[0].text == f"{TASK}, judged by rfm. Both orders agree."
    (pair,) = answer["pairs"]
    assert (pair["verdict"], pair["orders_agree"]) == ("first", True)
    page.browser.until(f"{VERDICT} === 'success.mp4 does the task better.'")
    assert page.browser["verdict-told"].aria_role == "status"
    before = page.saved()
    page.browser["clear"].click()
    page.browser.until_text("status", "Cleared 2 videos.")
    assert page.browser.all("#videos video") == []
    page.browser["undo"].click()
    assert captions(page) == ["success.mp4", "failure.mp4"]
    assert page.saved() == before
    page.browser.all("#videos .remove")[1].click()
    page.drop("copy")
    page.browser.until_text("scored", "2 of 2 scored")
    page.browser["compare"].click()
    page.browser.until(f"{VERDICT} === 'success.mp4 and copy.mp4 are one file, so neither is better.'")
    assert page.saved()["comparisons"] == []


def test_a_missing_task_or_a_broken_video_is_named_and_the_others_are_scored(page: Page) -> None:
    submit = page.browser.all("#question .first")[0]
    assert not submit.is_enabled()
    page.browser.write("tasks", " ")
    page.drop("broken", "success")
    page.browser.until_text("task-wanted", "What is the robot to do? Type it, then press Score.")
    assert page.browser.run("return document.activeElement.id") == "tasks"
    assert not submit.is_enabled()
    assert page.browser.cells("#curves tr") == []
    page.browser.write("tasks", TASK)
    assert page.browser["task-wanted"].text == ""
    submit.click()
    page.browser.until_text("scored", "1 of 2 scored, 1 failed")
    kinds = "MP4, MOV, WebM, Matroska, Ogg or AVI"
    told = f"video: expected a file of the kind {kinds}, got another kind (broken.mp4)"
    page.browser.until_text("errors", f"broken.mp4 could not be scored\n{told}")
    assert [row[-1] for row in page.browser.cells("#curves tr")] == [told, "scored"]
    assert [each.text for each in page.browser.all("#videos .failed")] == ["failed", ""]
    told = "This browser cannot show this file, and it was not scored: see the numbers below."
    page.browser.until(f"document.querySelector('#videos figure p').textContent === '{told}'")
    assert page.browser.all("#videos figure p")[0].is_displayed()
    assert not page.browser["compare"].is_displayed()  # of two videos one has failed
    page.drop("failure")
    page.browser.until_text("scored", "2 of 3 scored, 1 failed")
    page.browser.write("fps", "5")
    submit.click()
    page.browser.until_text("scored", "4 of 6 scored, 2 failed")
    files = ("broken.mp4", "success.mp4", "failure.mp4")
    names = [f"{file}, {fps} fps" for fps in (FPS, 5) for file in files]
    assert sorted(row[0] for row in page.browser.cells("#curves tr")) == sorted(names)
    assert [each.text for each in page.browser.all("#legend .failed")] == ["1 failed"] * 2
    page.browser.all("#legend .remove")[1].click()
    page.browser["compare"].click()
    page.browser.until(f"{VERDICT} === 'success.mp4 does the task better.'")
    page.browser.all("#videos .remove")[2].click()
    page.browser.all("#videos .remove")[0].click()
    assert page.browser["errors"].text == ""
    page.browser.all("#videos .remove")[0].click()
    page.drop("broken")
    page.browser.until_text("scored", "1 of 1 failed")
    assert not page.browser["chart"].is_displayed()


def test_a_link_has_the_settings_which_fold_away_and_says_if_its_model_is_not_served(page: Page) -> None:
    asked = {"rule": "linspace_trunc", "frames": "4", "fps": "5", "orient": "rotate90", "threshold": "0.7"}
    link = f"task=go&{urlencode(asked)}"
    page.browser.driver.get("about:blank")
    page.browser.open(f"{page.gateway.url}/#{link}")
    page.browser.until("document.getElementById('advanced').open")
    assert {name: page.browser[name].get_attribute("value") for name in asked} == asked
    assert page.browser["tasks"].get_attribute("value") == "go"
    assert page.browser["errors"].text == ""
    page.browser.write("fps", "2")
    wait_for(lambda: page.browser.run("return location.hash") == f"#{link.replace('fps=5', 'fps=2')}")
    page.browser.driver.get("about:blank")
    page.browser.open(f"{page.gateway.url}/#model=gone")
    assert page.browser["errors"].text.startswith("The model gone is not served here")
    assert page.browser["fold"].text == "Hide settings"
    page.browser["fold"].click()
    page.browser.open(page.gateway.url)
    assert not page.browser["question"].is_displayed()  # stays folded
    page.drop("success")  # without a task: it is asked for
    assert page.browser.until("document.activeElement.id") == "tasks"
    assert page.browser["question"].is_displayed()


def legend(page: Page) -> list[str]:
    """Return the names of the questions."""
    return [str(name.get_attribute("textContent")) for name in page.browser.all("#legend .nameable button")]


def captions(page: Page) -> list[str]:
    """Return the names of the videos."""
    return [str(name.get_attribute("textContent")) for name in page.browser.all("#videos .nameable button")]


def figure(page: Page) -> ElementTree.Element:
    """Return the figure that the page saves."""
    page.browser["svg"].click()
    return ElementTree.fromstring(page.browser.saved("curves.svg"))


def texts(svg: ElementTree.Element) -> list[str | None]:
    return [element.text for element in svg.iter(f"{SVG}text")]


def lines(page: Page) -> set[tuple[str, str]]:
    """Return the colour and the dash of each curve in the figure."""
    curves = figure(page).iter(f"{SVG}polyline")
    return {(line.attrib["stroke"], line.attrib.get("stroke-dasharray", "")) for line in curves}


def test_twelve_videos_have_twelve_colours_and_whole_names(page: Page) -> None:
    with page.browser.window(1440, 900):
        for count in (3, 6, 9, 12):  # a busy page may lose a drop
            page.drop("success", "failure", "copy")
            page.browser.until_text("scored", f"{count} of {count} scored")
        assert captions(page)[:4] == ["success.mp4", "failure.mp4", "copy.mp4", "success.mp4 (2)"]
        assert len({colour for colour, _ in lines(page)}) == 12
        assert legend(page) == []
        names = page.browser.all("#videos .nameable button")
        assert page.browser.run("return arguments[0].every((each) => each.scrollWidth <= each.clientWidth + 1)", names)


def test_tasks_are_overlaid_colours_tell_videos_apart_and_lines_tell_tasks_apart(page: Page) -> None:
    page.browser.write("tasks", f"{TASK}\n{OTHER_TASK}\n{TASK}")
    Select(page.browser["rule"]).select_by_visible_text("linspace_trunc")
    page.browser.write("frames", "4")
    page.drop("success")
    page.browser.until_text("scored", "2 of 2 scored")
    first, second = page.saved()["videos"]
    assert (first["task"], second["task"]) == (TASK, OTHER_TASK)
    assert first["progress"] != second["progress"]
    assert len(page.browser["command"].text.splitlines()) == 2
    page.browser["csv"].click()
    rows = list(csv.DictReader(page.browser.saved("curves.csv").decode().splitlines()))
    assert [float(row["progress"]) for row in rows] == first["progress"] + second["progress"]
    assert {(row["sampling"], row["frames"]) for row in rows} == {("linspace_trunc", "4")}
    assert legend(page) == [TASK, OTHER_TASK]
    assert len({colour for colour, _ in lines(page)}) == 2  # there is only one video
    page.drop("failure")
    page.browser.until_text("scored", "4 of 4 scored")
    assert legend(page) == [TASK, OTHER_TASK]
    found = lines(page)
    assert len(found) == 4
    assert [len({line[part] for line in found}) for part in (0, 1)] == [2, 2]
    told = texts(figure(page))
    assert told[:3] == ["2 tasks", "2 videos", TOY]
    assert told[-4:] == ["success.mp4", "failure.mp4", TASK, OTHER_TASK]  # each video's colour, then each task's line
    page.browser.all("#legend .remove")[1].click()
    assert [row[1] for row in page.browser.cells("#curves tr")] == [TASK, TASK]
    assert legend(page) == []
    page.browser.all("#videos .nameable button")[0].click()
    page.browser.all("#videos .nameable input")[0].send_keys("dropped", Keys.ENTER)
    assert captions(page) == ["dropped", "failure.mp4"]
    page.browser.enter("#videos [type=color]", "#ff00ff")
    assert "#ff00ff" in {colour for colour, _ in lines(page)}
    assert [video["source"] for video in page.saved()["videos"]] == ["success.mp4", "failure.mp4"]  # the files' names


def test_a_slow_upload_shows_its_percentage_and_then_the_curve_and_a_slow_comparison_can_be_stopped(page: Page) -> None:
    link = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": 20_000}  # bytes a second
    page.browser.driver.execute_cdp_cmd("Network.enable", {})
    page.browser.driver.execute_cdp_cmd("Network.emulateNetworkConditions", link)
    try:
        page.drop("large")
        page.browser.until("/, uploading [1-9]\\d? %$/.test(document.getElementById('scored').textContent)")
        assert page.browser.cells("#curves tr")[0][-1].startswith("uploading, ")
        page.browser.until_text("scored", "1 of 1 scored")
        page.drop("success")
        page.browser.until_text("scored", "2 of 2 scored")
        page.browser["compare"].click()
        page.browser.until_text("status", "Comparing 2 videos.")
        assert (page.browser["compare"].text, page.browser["stop"].is_displayed()) == ("Comparing 2 videos…", True)
        assert not page.browser["compare"].is_enabled()
        page.browser["stop"].click()
        page.browser.until("document.getElementById('stop').disabled")
        assert (page.browser["compare"].text, page.browser["stop"].is_displayed()) == ("Compare videos", False)
        assert [page.browser[name].text for name in ("status", "errors")] == ["", ""]
        page.browser.driver.execute_cdp_cmd("Network.emulateNetworkConditions", link | {"offline": True})
        page.browser["compare"].click()
        page.browser.until("document.querySelector('#away .state')")
        assert not page.browser["score"].is_enabled()
    finally:
        page.browser.driver.execute_cdp_cmd("Network.emulateNetworkConditions", link | {"uploadThroughput": -1})
    page.browser.until("!document.querySelector('#away .state')")
    assert page.browser["score"].is_enabled()
    assert page.browser["errors"].text.startswith("The videos could not be compared")  # also when the server is back
    assert all("ERR_INTERNET_DISCONNECTED" in line for line in page.browser.complaints())


BLOCKED = """
Object.defineProperty(window, "localStorage", { get() { throw new DOMException("denied", "SecurityError"); } });
"""  # what Chromium does with cookies blocked


def test_an_example_is_scored_with_a_click_also_where_the_browser_blocks_cookies(page: Page, tmp_path: Path) -> None:
    browser = page.browser
    blocking = browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": BLOCKED})
    try:
        browser.driver.get("about:blank")
        browser.open(page.gateway.url)
        browser["fold"].click()
        assert not browser["question"].is_displayed()
        browser.all("#examples [data-example=success]")[0].click()
        browser.until_text("scored", "1 of 1 scored")
        (shown,) = page.saved()["videos"]
        assert shown["progress"][-1] > 0.9
        fetch, command = browser["command"].text.split(" && ")
        subprocess.run(shlex.split(fetch), cwd=tmp_path, check=True)
        (again,) = by_command_line(tmp_path, command)["videos"]
        assert again["progress"] == pytest.approx(shown["progress"], abs=TOLERANCE)
    finally:
        browser.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", blocking)


def test_the_figure_fits_a_column_of_a_paper_and_is_light(page: Page) -> None:
    with page.browser.theme("dark"):
        page.score("success", "failure")
        page.browser["png"].click()
        picture = Image.open(io.BytesIO(page.browser.saved("curves.png"))).convert("RGB")
        svg = figure(page)
    assert picture.width == 2100
    assert np.asarray(picture)[[0, 0, -1], [0, -1, -1]].tolist() == [[255] * 3] * 3
    assert (np.asarray(picture).std(axis=2) > 20).any()  # the coloured lines
    assert svg.attrib["width"] == "252pt"
    names = {TASK, TOY, "success.mp4", "failure.mp4", "progress", "success", "time (s)"}
    assert names <= set(texts(svg))
    lines = [
        [tuple(map(float, point.split(","))) for point in line.attrib["points"].split()]
        for line in svg.iter(f"{SVG}polyline")
    ]
    told = page.saved()["videos"]
    marks = [float(line.attrib["y1"]) for line in svg.iter(f"{SVG}line") if line.attrib["y1"] == line.attrib["y2"]]
    ends = {"progress": (marks[0], marks[2]), "success": (marks[3], marks[4])}  # where 0 and 1 lie
    of_all = [(*ends[name], video[name]) for video in told for name in SIGNALS]
    for points, (zero, one, values) in zip(lines, of_all, strict=True):
        heights = (zero - np.array([y for _, y in points])) / (zero - one)
        np.testing.assert_allclose(heights, values, rtol=0, atol=1e-3)


MODULES = """
const [named, done] = arguments;
Promise.all(["text", "takeaway", "curves", "figure", "exports", "verdicts", "chart"].map((name) => import(`/viewer/${name}.js`))).then(
  ([{ cut }, { commands, serverOption, datasetWords }, { Curve }, { svgFigure }, { lerobotWords }, { sentenceOf }, { Chart }]) => {
    const settings = { task: "lift", model: "m", rule: "all", fps: 1 };
    const curve = new Curve({ title: "a.mp4", id: 1 }, settings);
    curve.take("video", { num_frames: 7, times_s: null });
    curve.take("scores", {
      leading: "progress", success: Array(7).fill(null),
      progress: [null, 0.25, null, 0.5, null, null, -0.5], answered: [false, true, false, true, true, false, true],
    });
    const figure = svgFigure(document.getElementById("figure"), [curve], { titles: ["lift", "a.mp4"], threshold: 0.5 });
    const names = [["rollout_seed_3_checkpoint_100k.mp4", 24], ["success.mp4", 4]].map((each) => cut(...each));
    const servers = [
      ["grpc://127.0.0.1:8001", "http://localhost:8100/"], ["grpc://localhost:8001", "https://gpu-box.lan:8443/"],
      ["grpc://triton:8001", "https://gpu-box.lan:8443/", true],
    ].map((each) => serverOption(...each));
    const ways = ["LeRobot v3.0", "videos", "pattern {episode}/{camera} 1.mp4", "reader my.py:read"];
    const datasets = ways.map((kind) => datasetWords({ name: "rec", kind }));
    const words = lerobotWords("delete", { name: named, kind: "LeRobot v3.0" }, [1], [0, 1]);
    const answer = { videos: [1, null, null, 4].map((rank) => ({ rank })), pairs: [{ verdict: null }, { verdict: "first" }] };
    const circle = { videos: [{ rank: null }, { rank: null }, { rank: null }], pairs: [{ verdict: "first" }] };
    const sentences = [answer, circle].map((each) => sentenceOf({ videos: [..."abcd"].map((title) => ({ title })), answer: each }));
    const origin = { dataset: "rec", kind: "videos", episode: 3, camera: "top", task: "lift", fps: 5 };
    const given = { ...settings, rule: "rint", fps: 5, orient: "none", channels: "rgb" };
    const lines = commands("grpc://triton:8001", [4, 8].map((sampledFrames) => ({ video: { origin }, ...given, sampledFrames })), []);
    const host = document.body.appendChild(Object.assign(document.createElement("div"), { style: "width: 600px; height: 400px" }));
    const chosen = [];
    const chart = new Chart(host, () => {}, { onChosen: (labels) => chosen.push(labels) });
    chart.show([1, 1, 1, 1, 1, 1, 3].map((end, index) => ({
      label: `${index}`, colour: end === 3 ? "red" : "blue", times: [0, end], allTimes: [0, end],
      progress: [0, end === 3 ? 0 : 1], success: [null, null],
    })));
    setTimeout(() => { // uPlot draws later
      chart.moveTo(2.5);
      chosen.push([...host.querySelectorAll(".values span")].map(({ dataset }) => dataset.curve));
      host.remove();
      done([figure, names, servers, datasets, words, sentences, lines, chosen.slice(-2)]);
    });
  });
"""


def test_modules_cut_names_name_a_reachable_triton_and_lead_a_line_over_skipped_frames(page: Page) -> None:
    """Of seven frames the model skips three, and the score of one is missing."""
    dataset = "Ann's set; touch \n$(touch x)"
    markup, names, servers, datasets, words, sentences, lines, chosen = page.browser.driver.execute_async_script(
        MODULES, dataset
    )
    assert names == ["rollout_seed…100k.mp4", "success.mp4"]
    key = ["--api-key-file", "KEY_FILE"]
    assert servers == [["--url", "grpc://127.0.0.1:8001"], [], ["--url", "grpc://triton:8001", *key]]
    ways = [[], [], ["--videos", "{episode}/{camera} 1.mp4"], ["--reader", "my.py:read"]]
    assert datasets == [["rec", *way] for way in ways]
    assert shlex.split(words, comments=True)[:4] == ["lerobot-edit-dataset", "--repo_id", dataset, "--root"]
    assert sentences == [
        "a does the task best, but b and c have no rank: some answers depend on which video comes first.",
        "No best video: several win equally often.",
    ]
    folders = [re.findall(r"--frames (\d) --output (\S+)", line) for line in lines.splitlines()]
    assert folders == [[("4", "rec_episode_3")], [("8", "rec_episode_3_2")]]
    assert chosen == [["6"], ["6"]]  # of seven curves, the only one that has not ended
    svg = ElementTree.fromstring(markup)
    assert [len(line.attrib["points"].split()) for line in svg.iter(f"{SVG}polyline")] == [2, 1]
    assert "\N{MINUS SIGN}0.5" in texts(svg)  # the axis reaches the score below 0
    assert texts(svg).count("a.mp4") == 1  # a curve alone needs no legend


def test_the_documentation_of_endpoints_needs_no_network(gateway: Gateway, quiet_browser: Browser) -> None:
    quiet_browser.driver.get(f"{gateway.url}/docs")
    quiet_browser.until("document.body.textContent.includes('/evaluate_batch_npy')")


TRY = """
const [base, done] = arguments;
const textOf = async (response) => (response.type === "opaque" ? null : [response.status, await response.text()]);
const told = (path, options) => fetch(base + path, options).then(textOf).catch(() => null);
const src = base + "/viewer/examples/success.mp4";
const shown = new Promise((resolve) => {
  Object.assign(document.createElement("video"), { onloadedmetadata: () => resolve(true), onerror: () => resolve(false), src });
});
const post = told("/evaluate_batch", { method: "POST", body: "[]", mode: "no-cors" });  // no browser asks before it
Promise.all([told("/viewer/datasets"), told("/metrics"), post, shown]).then(done);
"""


def test_no_other_page_reads_or_uses_the_gateway_and_its_own_page_does(
    gateway: Gateway, browser: Browser, tmp_path: Path
) -> None:
    """By address, and by a name that leads there, as with DNS rebinding."""

    def tried(base: str) -> tuple[list[tuple[int, str]], bool]:
        """Return the answers to two reads and a post of the open page, and whether it shows the video."""
        *answers, shown = browser.driver.execute_async_script(TRY, base)
        return answers, shown

    def num_read() -> float:
        return gateway.metric("requests_total", endpoint="/evaluate_batch", code="422")

    before = num_read()
    (tmp_path / "index.html").write_text("<!doctype html><title>another page</title>")
    with folder_server(tmp_path) as other:
        for host in ("127.0.0.1", REBOUND):
            browser.driver.get(other.replace("127.0.0.1", host))
            assert browser.driver.title == "another page"
            assert tried(gateway.url) == ([None] * 3, False)
    browser.driver.get(gateway.url.replace("127.0.0.1", REBOUND))
    answers, shown = tried("")
    assert (num_read(), shown) == (before, False)
    assert [status for status, _ in answers] == [421] * 3
    assert not [text for _, text in answers if "expected localhost or an IP address" not in text]

    browser.driver.get(gateway.url)
    answers, shown = tried("")
    assert [status for status, _ in answers] == [200, 200, 422]
    assert (num_read(), shown) == (before + 1, True)
    browser.driver.get("about:blank")
    browser.asked()
