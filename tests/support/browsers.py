# SPDX-License-Identifier: MIT
"""Headless Chromium that reaches only this machine, with the requests and complaints of a page."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement

from rfm_client import UInt8Array
from servers import wait_for

AXE = Path(__file__).parents[1] / "page" / "vendored" / "axe-core" / "axe.min.js"
WINDOW_PX = (1280, 1400)
REBOUND = "rebound.example"  # a foreign name that leads here, as with DNS rebinding
QUIET = (  # nothing but the page asks for anything
    "--disable-background-networking", "--disable-component-update", "--disable-default-apps", "--disable-sync",
    "--no-first-run", "--no-default-browser-check", "--disable-features=OptimizationHints,MediaRouter",
    f"--host-resolver-rules=MAP {REBOUND} 127.0.0.1 , MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)  # fmt: skip


class Browser:
    """A page in Chromium."""

    def __init__(self, driver: Chrome, downloads: Path) -> None:
        self.driver = driver
        self.downloads = downloads

    def open(self, url: str) -> None:
        """Opens the page, and waits until it offers a model."""
        self.driver.get(url)
        self.until("document.getElementById('model').value")

    def __getitem__(self, name: str) -> WebElement:
        """The element of this id."""
        return self.driver.find_element(By.ID, name)

    def all(self, selector: str) -> list[WebElement]:
        return self.driver.find_elements(By.CSS_SELECTOR, selector)

    def run(self, script: str, *arguments: Any) -> Any:
        return self.driver.execute_script(script, *arguments)

    def write(self, name: str, text: str) -> None:
        self[name].clear()
        self[name].send_keys(text)

    def enter(self, selector: str, value: float | str) -> None:
        """Give an input, such as a slider, a value, as a person does."""
        script = "const input = document.querySelector(arguments[0]); input.value = arguments[1]; "
        self.run(script + "input.dispatchEvent(new Event('input'))", selector, value)

    def drop(self, files: Sequence[Path]) -> None:
        """Drops files onto the middle of the page, as a person does with the mouse."""
        data = {"items": [], "files": [str(file) for file in files], "dragOperationsMask": 1}
        x, y = self.run("return [innerWidth / 2, innerHeight / 2]")
        for kind in ("dragEnter", "dragOver", "drop"):
            event = {"type": kind, "x": x, "y": y, "data": data}
            self.driver.execute_cdp_cmd("Input.dispatchDragEvent", event)

    def until(self, script: str) -> Any:
        """Return a script's result once it is true."""
        found: list[Any] = []

        def is_there() -> bool:
            found[:] = [self.run(f"return {script}")]
            return bool(found[0])

        wait_for(is_there)
        return found[0]

    def until_text(self, name: str, text: str) -> None:
        """Waits until the element of this id has this text."""
        wait_for(lambda: self[name].text == text)

    def cells(self, rows: str) -> list[list[str]]:
        """Return the cells' text of the table rows that match a selector."""
        script = "[...row.children].map((cell) => cell.textContent)"
        return list(self.run(f"return [...document.querySelectorAll('{rows}')].map((row) => {script})"))

    def draw(self) -> None:
        """Waits until the browser has drawn the page as it is now."""
        self.driver.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")

    def values(self, chart: str, signal: str) -> dict[str, str]:
        """Return a signal's numbers beside the lines of a chart by name of the curve."""
        spans = f"document.querySelectorAll('#{chart} .values span[data-signal={signal}]')"
        return dict(self.run(f"return [...{spans}].map((each) => [each.dataset.curve, each.textContent])"))

    def times_s(self, players: str) -> list[float]:
        """Where the videos and sliders are that a selector finds."""
        script = "Number(each.currentTime ?? each.value)"
        return list(self.run(f"return [...document.querySelectorAll('{players}')].map((each) => {script})"))

    def pixels(self, pictures: Sequence[WebElement]) -> list[UInt8Array]:
        """Return the current frames of images and videos, each uint8 [H, W, 3]."""
        found = self.run(
            """
            return arguments[0].map((picture) => {
              const width = picture.videoWidth ?? picture.naturalWidth;
              const height = picture.videoHeight ?? picture.naturalHeight;
              const context = new OffscreenCanvas(width, height).getContext("2d");
              context.drawImage(picture, 0, 0);
              return [height, width, [...context.getImageData(0, 0, width, height).data]];
            });
            """,
            pictures,
        )
        return [np.array(data, np.uint8).reshape(height, width, 4)[..., :3] for height, width, data in found]

    def saved(self, name: str) -> bytes:
        """A file that the page has just let the browser save."""
        file = self.downloads / name
        wait_for(lambda: file.exists() and file.stat().st_size > 0)
        content = file.read_bytes()
        file.unlink()
        return content

    @contextmanager
    def theme(self, name: str) -> Iterator[None]:
        """Show the page in the light or dark theme."""
        feature = {"name": "prefers-color-scheme", "value": name}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
        try:
            yield
        finally:
            self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})

    def violations(self) -> list[tuple[str, str, list[str]]]:
        """Return axe's findings: rule, impact, and the elements that break it."""
        self.run(AXE.read_text())
        found = self.driver.execute_async_script(
            "const done = arguments[0]; axe.run().then(({ violations }) => done(violations));"
        )
        return [(each["id"], each["impact"], [node["html"] for node in each["nodes"]]) for each in found]

    @contextmanager
    def window(self, width: int, height: int) -> Iterator[None]:
        """The page in a window of another size."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        try:
            yield
        finally:
            self.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})

    def complaints(self) -> list[str]:
        """Return new errors in the console, also violations of the page's policy."""
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def asked(self) -> list[str]:
        """The addresses of all requests since the last time."""
        messages = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        sent = (each["params"] for each in messages if each["method"] == "Network.requestWillBeSent")
        return [each["request"]["url"] for each in sent]


@contextmanager
def chromium(downloads: Path) -> Iterator[Browser]:
    """A browser that saves files in a folder."""
    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    assert all(programs), "expected chromium and chromedriver in PATH, got none: make ops-tools"
    chosen = ChromeOptions()
    chosen.binary_location = str(programs[0])
    width, height = WINDOW_PX
    as_root = ["--no-sandbox"] if os.geteuid() == 0 else []
    for option in ("--headless=new", f"--window-size={width},{height}", "--disable-dev-shm-usage", *as_root, *QUIET):
        chosen.add_argument(option)
    chosen.add_experimental_option("prefs", {"download.default_directory": str(downloads)})
    chosen.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = Chrome(options=chosen, service=Service(str(programs[1])))
    try:
        yield Browser(driver, downloads)
    finally:
        driver.quit()
