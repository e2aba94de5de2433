# SPDX-License-Identifier: MIT
"""Pages of other origins in Chromium, which try to use a gateway by address and by a rebound name.
No Triton is needed.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from browsers import REBOUND, Browser
from gateways import Gateway, running
from servers import Endpoints, folder_server
from shown_datasets import copied

pytestmark = pytest.mark.slow

READS = ["/viewer/datasets", "/viewer/datasets/0/episodes/0/videos/0", "/metrics"]
TRY = """
const [base, paths, done] = arguments;
const told = async (request) => {
  try {
    const response = await request;
    return response.type === "opaque" ? null : [response.status, await response.text()];
  } catch { return null; }
};
const post = (options) => told(fetch(base + "/evaluate_batch", { method: "POST", body: "[]", ...options }));
const shown = new Promise((resolve) => {
  const src = base + paths[1];
  Object.assign(document.createElement("video"), { onloadedmetadata: () => resolve(true), onerror: () => resolve(false), src });
});
const asked = [...paths.map((path) => told(fetch(base + path))), post({ headers: { "Content-Type": "application/json" } })];
Promise.all([...asked, post({}), post({ mode: "no-cors" }), shown]).then(done);
"""


@pytest.fixture
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    folder = tmp_path_factory.mktemp("gateway")
    with running(Endpoints.free(), folder, "rfm", "--dataset", str(copied("toy_v30_many", folder))) as started:
        yield started


@pytest.fixture
def other_port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of another local server, which serves a page."""
    folder = tmp_path_factory.mktemp("other")
    (folder / "index.html").write_text("<!doctype html><title>another page</title>")
    with folder_server(folder) as url:
        yield int(url.rpartition(":")[2])


def tried(browser: Browser, base: str) -> tuple[list[tuple[int, str]], bool]:
    """Return the answers to a script in the open page, three reads and three posts, and whether it shows the video."""
    *answers, shown = browser.driver.execute_async_script(TRY, base, READS)
    return answers, shown


def passed_on(gateway: Gateway) -> float:
    """Return the number of accepted requests."""
    refused = sum(gateway.metric("requests_total", code=code) for code in ("403", "421"))
    return gateway.metric("requests_total") - refused


def test_no_other_page_reads_or_uses_the_gateway_and_its_own_page_does(
    gateway: Gateway, browser: Browser, other_port: int
) -> None:
    port, answered = int(gateway.url.rpartition(":")[2]), passed_on(gateway)
    for host in ("127.0.0.1", REBOUND):
        browser.driver.get(f"http://{host}:{other_port}/")
        assert browser.driver.title == "another page"
        assert tried(browser, gateway.url) == ([None] * 6, False)
    browser.driver.get(f"http://{REBOUND}:{port}/")
    answers, shown = tried(browser, "")
    assert not shown
    assert [status for status, _ in answers] == [421] * 6
    assert not [text for _, text in answers if "expected localhost or an IP address" not in text]
    assert passed_on(gateway) == answered + 3  # reads of the metrics

    browser.driver.get(f"{gateway.url}/")
    answers, shown = tried(browser, "")
    assert [status for status, _ in answers] == [200] * 3 + [422] * 3
    assert shown
    browser.driver.get("about:blank")
    browser.asked()
