# SPDX-License-Identifier: MIT
"""The page in Chromium where something is missing or has failed: what it says, and how it goes on by itself."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from selenium.webdriver.support.select import Select

from browsers import Browser
from gateways import free_port, running
from labelling import BrightnessScorer
from paths import ROOT
from rfm_labels import LabelOptions, label, open_dataset
from servers import Endpoints, OneModelServer
from shown_datasets import copied, large

pytestmark = [pytest.mark.triton, pytest.mark.slow]

NOWHERE = Endpoints(http_port=1, grpc_port=1, metrics_port=1)
BLOCKED = """
Object.defineProperty(window, "localStorage", { get() { throw new DOMException("denied", "SecurityError"); } });
"""  # what Chromium does with cookies blocked
THEMES = ("light", "dark")


def wait_for_state(browser: Browser, place: str) -> str:
    """Return the text of a state once it is shown."""
    return str(browser.until(f"document.querySelector('#{place} .state')?.innerText.replace(/\\n+/g, '\\n')"))


def without_violations(browser: Browser) -> None:
    for theme in THEMES:
        with browser.theme(theme):
            assert browser.violations() == []


def test_the_page_works_where_the_browser_blocks_cookies(
    demo_server: Endpoints, quiet_browser: Browser, tmp_path: Path
) -> None:
    blocking = quiet_browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": BLOCKED})
    try:
        with running(demo_server, tmp_path) as gateway:
            quiet_browser.open(gateway.url)
            quiet_browser["fold"].click()
            assert not quiet_browser["question"].is_displayed()
            quiet_browser.all("#examples [data-example=success]")[0].click()
            quiet_browser.until_text("scored", "1 of 1 scored")
            quiet_browser.driver.get("about:blank")  # before the gateway ends
    finally:
        quiet_browser.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", blocking)


def test_a_page_opened_before_triton_goes_on_when_triton_is_there(
    demo_server: Endpoints, browser: Browser, tmp_path: Path
) -> None:
    port = free_port()
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

        browser["dataset-tab"].click()  # the page asks on, and finds that the server is away
    assert wait_for_state(browser, "away").startswith("The server does not answer")
    assert "connection refused" not in browser["away"].text.lower()
    without_violations(browser)
    with running(demo_server, tmp_path, port=port):
        browser["score-tab"].click()
        browser.until("document.getElementById('model').value")
        browser.until("!document.querySelector('#away .state, #served-state .state')")
    assert browser.run("return window.isFirst")  # without a reload


def test_a_dataset_added_by_a_restart_is_shown_without_a_reload(browser: Browser, tmp_path: Path) -> None:
    root, port = copied("toy_v21", tmp_path), free_port()
    label(open_dataset(root), BrightnessScorer(), LabelOptions())
    with running(NOWHERE, tmp_path, port=port) as gateway:
        browser.driver.get(gateway.url)
        browser["dataset-tab"].click()
        told = wait_for_state(browser, "no-datasets")
        assert told.startswith("No dataset yet")
        assert f"rfm serve my_models --gateway-port {port} --gateway-dataset my_dataset" in told
        middle = browser.run(
            "const box = document.querySelector('#no-datasets .state').getBoundingClientRect(); "
            "return (box.left + box.right) / 2 / innerWidth"
        )
        assert middle == pytest.approx(0.5, abs=0.02)  # not in the column of the settings
        without_violations(browser)
    with running(NOWHERE, tmp_path, "rfm", "--dataset", str(root), port=port):
        browser.until("document.querySelectorAll('#episodes tr').length === 8")
        assert not browser.all("#no-datasets .state")
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


def test_nothing_to_show_says_what_to_do(browser: Browser, tmp_path: Path) -> None:
    """Of the demo's models ``rfm`` alone scores no frames; one dataset has no episodes, and the other no cameras."""
    shutil.copytree(ROOT / "model_repository" / "rfm", tmp_path / "models" / "rfm")
    empty, bare = large(tmp_path / "empty", 0), large(tmp_path / "bare", 3)
    (empty / "rfm_progress.parquet").unlink()
    options = ("--dataset", str(empty), "--dataset", str(bare))

    def check(place: str, title: str, command: str) -> None:
        told, sentence, line, *_ = wait_for_state(browser, place).split("\n")
        assert (told, sentence[-1]) == (title, ":")
        assert line.endswith(command)
        assert [button.text for button in browser.all(f"#{place} button")] == ["Copy", "Check now"]
        browser.all(f"#{place} .actions button")[0].click()
        assert wait_for_state(browser, place).startswith(title)

    with (
        OneModelServer(tmp_path / "models", Endpoints.free()) as server,
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
