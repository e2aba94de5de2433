# SPDX-License-Identifier: MIT
"""The page in Chromium where something is missing or has failed: what it says, and how it goes on by itself."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from selenium.webdriver.support.select import Select

import local_hub
from browsers import Browser
from gateways import StandIn, free_port, listening, running
from labelling import LEROBOT, BrightnessScorer
from paths import ROOT
from rfm_labels import LabelOptions, label, open_dataset
from servers import Endpoints, start_triton
from shown_datasets import copied, hdf5, large

pytestmark = [pytest.mark.triton, pytest.mark.slow]

NOWHERE = Endpoints(http_port=1, grpc_port=1, metrics_port=1)
KEY = "open sesame"
THEMES = ("light", "dark")
PANEL = "return document.querySelector('.panel:not([hidden])').getBoundingClientRect().toJSON()"


def wait_for_state(browser: Browser, place: str) -> str:
    """Return the text of a state once it is shown."""
    return str(browser.until(f"document.querySelector('#{place} .state')?.innerText.replace(/\\n+/g, '\\n')"))


def without_violations(browser: Browser) -> None:
    for theme in THEMES:
        with browser.theme(theme):
            assert browser.violations() == []


def test_a_page_goes_on_without_a_reload_when_triton_a_key_and_a_broken_dataset_are_there(
    demo_server: Endpoints, browser: Browser, tmp_path: Path
) -> None:
    root, port = copied("toy_v21", tmp_path), free_port()
    label(open_dataset(root), BrightnessScorer(), LabelOptions())
    next(root.rglob("*front/episode_000002.mp4")).write_text("no video")
    with running(NOWHERE, tmp_path, port=port) as gateway:
        browser.driver.get(gateway.url)
        told = wait_for_state(browser, "served-state")
        assert told.startswith("Triton is not ready\nIt restarts automatically.")
        assert "rfm-client status --url grpc://127.0.0.1:1\nCopy" in told
        assert "Connection refused" not in told  # it stands behind Details
        browser.all("#served-state summary")[0].click()
        assert "Connection refused" in browser["served-state"].text
        assert browser["rule"].get_attribute("value")  # what needs no Triton can be chosen
        without_violations(browser)
        browser.run("window.isFirst = true")

        browser["dataset-tab"].click()
        told = wait_for_state(browser, "no-datasets")
        assert told.startswith("No dataset yet")
        assert f"rfm serve ... --gateway-port {port} --gateway-dataset my_dataset" in told
        middle = browser.run(
            "const box = document.querySelector('#no-datasets .state').getBoundingClientRect(); "
            "return (box.left + box.right) / 2 / innerWidth"
        )
        assert middle == pytest.approx(0.5, abs=0.02)  # not in the column of the settings
        without_violations(browser)
        before = browser.run(PANEL)
    assert wait_for_state(browser, "away").startswith("The server does not answer")  # the page asks on
    assert browser.run(PANEL) == before
    assert "connection refused" not in browser["away"].text.lower()
    without_violations(browser)
    with running(demo_server, tmp_path, "rfm", "--dataset", str(root), port=port, RFM_GATEWAY_API_KEY=KEY):
        browser.until("!document.getElementById('key-form').hidden")
        assert browser.all("#episodes tr") == []
        for key, told in (("sesame", ""), (KEY, "This is not the key. Type it again.")):
            browser.until_text("key-wrong", told)
            browser.write("key", key)
            browser.all("#key-form button")[0].click()
        browser.until("document.querySelectorAll('#episodes tr').length === 8")
        assert not browser.all("#no-datasets .state")
        browser.until("document.getElementById('model').value")
        browser.until("!document.querySelector('#away .state, #served-state .state')")
        assert browser.run("return window.isFirst")
        broken = "document.querySelector('#episodes tr[data-episode=\"2\"]')"
        message = "episode_000002.mp4: expected a file with a video stream, got "
        assert message in browser.until(f"{broken}.querySelector('.failed')?.textContent")
        assert len(browser.all("#episodes .failed")) == 1
        browser.run(f"{broken}.querySelector('button').click()")
        told = browser.until("document.getElementById('episode-errors').textContent")
        assert message in told
        assert str(tmp_path) not in told
        browser.write("task-part", "no task has this")
        assert wait_for_state(browser, "no-hits").startswith("No episode matches\nThe filters hide all 8 episodes.")
        without_violations(browser)
        browser.all("#no-hits button")[0].click()
        browser.until("document.querySelectorAll('#episodes tr').length === 8")
        assert browser["task-part"].get_attribute("value") == ""
        labels = (root / "rfm_progress.parquet").read_bytes()
        (root / "rfm_progress.parquet").write_text("no labels")
        browser.run("document.getElementById('labels').dispatchEvent(new Event('change'))")
        assert wait_for_state(browser, "dataset-errors").startswith("The dataset cannot be shown")
        assert not browser.all("#no-hits .state")
        without_violations(browser)
        (root / "rfm_progress.parquet").write_bytes(labels)
        browser.all("#dataset-errors .actions button")[0].click()
        browser.until("document.querySelectorAll('#episodes tr').length === 8")
        assert not browser.all("#dataset-errors .state")


def test_a_page_with_nothing_to_show_gives_a_command_to_run(browser: Browser, tmp_path: Path) -> None:
    """Of the demo's models ``rfm`` alone scores no frames; one dataset has no episodes, one no cameras, one a depth map."""
    shutil.copytree(ROOT / "model_repository" / "rfm", tmp_path / "models" / "rfm")
    empty, bare = large(tmp_path / "empty", 0), large(tmp_path / "bare", 3)
    (empty / "rfm_progress.parquet").unlink()
    options = ("--dataset", str(empty), "--dataset", str(bare), "--dataset", str(hdf5(tmp_path)))

    def check(place: str, title: str, command: str) -> None:
        told, sentence, line, *_ = wait_for_state(browser, place).split("\n")
        assert (told, sentence[-1]) == (title, ":")
        assert line.endswith(command)
        assert [button.text for button in browser.all(f"#{place} button")] == ["Copy", "Check now"]
        browser.all(f"#{place} .actions button")[0].click()
        assert wait_for_state(browser, place).startswith(title)

    with (
        start_triton(tmp_path / "models") as server,
        running(server.endpoints, tmp_path, "rfm", *options) as gateway,
    ):
        browser.driver.get(gateway.url)
        check("served-state", "No model is served", "rfm export my_checkpoint --repository my_models")
        browser["dataset-tab"].click()
        check("no-hits", "No episodes", "-dataset my_dataset")
        Select(browser["dataset"]).select_by_value("1")
        browser.until("document.querySelectorAll('#episodes tr').length === 3")
        browser.all("#episodes button")[0].click()
        check("episode-errors", "No videos", "-dataset my_dataset")
        without_violations(browser)
        Select(browser["dataset"]).select_by_value("2")
        browser.until("!document.getElementById('left-out').hidden")
        assert browser["left-out"].text.startswith("range is left out: uint16 [12, 63, 81], a depth map, a mask")


def test_an_episode_on_the_hub_opens_once_it_is_downloaded_and_a_large_download_needs_a_click(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repositories = {"org/name": {"main": LEROBOT / "toy_v21"}}
    with (
        local_hub.hub(repositories, "datasets") as endpoint,
        local_hub.asked(endpoint, tmp_path),
        listening(StandIn(), dataset=("org/name",)) as gateway,
    ):
        browser.driver.get(f"{gateway.url}/#tab=dataset&episode=3")
        browser.until("document.querySelectorAll('#episode-videos video').length === 2")
        monkeypatch.setattr("rfm_labels.datasets.hub.ASK_BYTES", 10)
        browser.run("document.querySelector('#episodes tr[data-episode=\"5\"] button').click()")
        pictures = "document.querySelectorAll('#episodes tr[data-episode=\"5\"] .thumb[src]').length"
        assert browser.run(f"return {pictures}") == 0
        told = wait_for_state(browser, "episode-errors")
        assert re.fullmatch(r"A large download\nEpisode 5 needs 0\.\d MB in 3 files from the Hub\.\nDownload", told)
        without_violations(browser)
        browser.all("#episode-errors button")[0].click()
        browser.until("document.querySelectorAll('#episode-videos video').length === 2")
        assert browser["episode-errors"].text == ""
        browser.until(f"{pictures} === 2")
