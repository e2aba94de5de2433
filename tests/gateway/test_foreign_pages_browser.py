# SPDX-License-Identifier: MIT
"""Pages of other origins in Chromium, which try to use a gateway by address and by a rebound name.
No Triton is needed.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from browsers import REBOUND, Browser
from gateway_requests import Json
from gateways import Gateway, running
from servers import Endpoints, folder_server
from shown_datasets import copied

pytestmark = pytest.mark.slow

DATASETS, VIDEO = "/viewer/datasets", "/viewer/datasets/0/episodes/0/videos/0"
READS = [DATASETS, VIDEO, "/metrics"]
TRY = """
const [base, paths, video, done] = arguments;
const told = async (request) => {
  try {
    const response = await request;
    return response.type === "opaque" ? null : [response.status, await response.text()];
  } catch { return null; }
};
const post = (options) => told(fetch(base + "/evaluate_batch", { method: "POST", body: "[]", ...options }));
const shown = (element) => new Promise((resolve) => {
  element.onloadedmetadata = () => resolve(true);
  element.onerror = () => resolve(false);
  element.src = base + video;
});
(async () => done({
  read: await Promise.all(paths.map((path) => told(fetch(base + path)))),
  shown: await shown(document.createElement("video")),
  json: await post({ headers: { "Content-Type": "application/json" } }),
  plain: await post({}),
  unread: await post({ mode: "no-cors" }),
}))();
"""
POSTS = ("json", "plain", "unread")


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


@pytest.fixture
def loud_browser(browser: Browser) -> Iterator[Browser]:
    """The browser, whose requests and complaints in this test count in no other."""
    yield browser
    browser.driver.get("about:blank")
    browser.asked()
    browser.complaints()


def tried(browser: Browser, base: str) -> Json:
    """Return the results of a script in the open page."""
    return dict(browser.driver.execute_async_script(TRY, base, READS, VIDEO))


def passed_on(gateway: Gateway) -> float:
    """Return the number of accepted requests."""
    refused = sum(gateway.metric("requests_total", code=code) for code in ("403", "421"))
    return gateway.metric("requests_total") - refused


def test_no_other_page_reads_or_uses_the_gateway_and_its_own_page_does(
    gateway: Gateway, loud_browser: Browser, other_port: int
) -> None:
    browser = loud_browser
    port, answered = int(gateway.url.rpartition(":")[2]), passed_on(gateway)
    asked: Json = {}
    for host in ("127.0.0.1", REBOUND):
        browser.driver.get(f"http://{host}:{other_port}/")
        assert browser.driver.title == "another page"
        asked[host] = tried(browser, gateway.url)
    browser.driver.get(f"http://{REBOUND}:{port}/")
    rebound = tried(browser, "")
    for found in asked.values():
        assert found == dict.fromkeys(POSTS, None) | {"read": [None] * len(READS), "shown": False}
    assert rebound.pop("shown") is False
    answers = [*rebound.pop("read"), *rebound.values()]
    assert [status for status, _ in answers] == [421] * (len(READS) + len(POSTS))
    assert not [text for _, text in answers if "expected localhost or an IP address" not in text]
    assert passed_on(gateway) == answered + 3  # reads of the metrics

    browser.driver.get(f"{gateway.url}/")
    own = tried(browser, "")
    assert [status for status, _ in own["read"]] == [200] * len(READS)
    assert own["shown"]
    assert [own[name][0] for name in POSTS] == [422] * len(POSTS)
