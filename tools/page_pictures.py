# SPDX-License-Identifier: MIT
"""``make pictures``: draw the pictures of the page in docs/images. Needs Chromium (``make ops-tools``).

Drives the page as tests/page does, before a Triton with the demo's checkpoint.
"""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path

import test_live_browser
import test_viewer_browser
import test_viewer_dataset_browser
from selenium.webdriver import Keys

import clip
from browsers import Browser, chromium
from gateways import Gateway, poll, running
from paths import ROOT
from rfm_client import RewardClient
from rfm_labels import ClientScorer, LabelOptions, label, open_dataset
from rfm_rl import LiveView
from servers import start_triton
from shown_datasets import copied
from toy_world import Task, make_clip

IMAGES = ROOT / "docs" / "images"
TASK = Task("red", "bowl")
SEEDS = {"success": 2_000_000, "dropped": 2_000_001, "rewound": 2_000_002}  # of clips by their kind
LAST_SEED = 2_000_003
FPS = 10
RUN = "policy 7"


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


def show_episodes(gateway: Gateway, browser: Browser, client: RewardClient) -> None:
    """Draw the tab of running episodes."""
    videos = [make_clip(kind, TASK, seed).frames for kind, seed in SEEDS.items()]
    videos.append(make_clip("success", TASK, LAST_SEED).frames)
    with LiveView(gateway.url, name=RUN) as view:
        page = test_live_browser.Page(gateway.url, browser)
        page.open()
        episodes = client.episodes(len(videos), TASK.sentence(), live=view)
        for frames in zip(*videos, strict=True):
            episodes.add(list(frames))
        episodes.reset([False, True, False, True])
        for frame in videos[0][:9]:
            episodes.add([videos[3][0], frame, frame, videos[2][0]], [False, True, False, False])
        poll(lambda: len(page.cards(RUN)) == 5 and page.cards(RUN)[1]["Step"] == "8")
        poll(lambda: len(browser.run(test_live_browser.PICTURES, RUN)) == 5)
        browser.picture(IMAGES / "page_live.png")


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
        show_episodes(gateway, browser, client)


if __name__ == "__main__":
    main()
