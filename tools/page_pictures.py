# SPDX-License-Identifier: MIT
"""``make pictures``: draw the pictures of the page in docs/images. Needs Chromium (``make ops-tools``).

Drives the page as tests/page does, before a Triton with the demo's checkpoint.
"""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path

import test_viewer_browser
import test_viewer_dataset_browser
from selenium.webdriver import Keys

import clip
from browsers import Browser, chromium
from gateways import Gateway, poll, running
from paths import ROOT
from rfm_client import RewardClient
from rfm_labels import ClientScorer, LabelOptions, label, open_dataset
from servers import start_triton
from shown_datasets import copied
from toy_world import Task, make_clip

IMAGES = ROOT / "docs" / "images"
TASK = Task("red", "bowl")
FIRST_SEED = 2_000_000  # of clips
SEEDS = {"success": FIRST_SEED, "dropped": FIRST_SEED + 1}
FPS = 10


def score(gateway: Gateway, browser: Browser, folder: Path) -> None:
    """Draw the tab that scores videos."""
    for name, kind in {"success": "success", "failure": "dropped"}.items():
        clip.write(folder / f"{name}.mp4", make_clip(kind, TASK, SEEDS[kind]).frames, FPS)
    browser.open(gateway.url)
    browser.write("tasks", TASK.sentence())
    browser.run("document.getElementById('fps').value = arguments[0]", FPS)  # it is under Advanced
    page = test_viewer_browser.Page(gateway, browser, folder)
    page.score("success", "failure")
    browser["time"].send_keys(*[Keys.ARROW_RIGHT] * 12)
    poll(lambda: page.is_at(1.2))
    page.compare()
    browser.picture(IMAGES / "page.png")


def show_dataset(gateway: Gateway, browser: Browser, dataset: Path) -> None:
    """Draw the tab of datasets."""
    page = test_viewer_dataset_browser.Page(gateway.url, browser, (dataset,))
    page.open()
    page.choose(0)
    page.at_rest(3)
    page.move_to(1.2)
    browser.picture(IMAGES / "page_dataset.png")


def main() -> None:
    """Start a server, a gateway and a browser, and draw each tab."""
    with tempfile.TemporaryDirectory(prefix="rfm-pictures-") as name, ExitStack() as stack:
        folder = Path(name)
        repository = Path(shutil.copytree(ROOT / "model_repository", folder / "model_repository"))
        endpoints = stack.enter_context(start_triton(repository)).endpoints
        client = stack.enter_context(RewardClient(endpoints.grpc_url))
        client.wait_ready(60)
        dataset = copied("toy_v30_many", folder)
        label(open_dataset(dataset), ClientScorer(client), LabelOptions())
        gateway = stack.enter_context(running(endpoints, folder, "rfm", "--dataset", str(dataset)))
        browser = stack.enter_context(chromium(folder))
        score(gateway, browser, folder)
        show_dataset(gateway, browser, dataset)


if __name__ == "__main__":
    main()
