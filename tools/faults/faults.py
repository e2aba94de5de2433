# SPDX-License-Identifier: MIT
"""Faults of ``make chaos`` that a running ``rfm serve`` must survive while callers ask."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

import httpx

import rfm_export
from callers import Callers, direct, through_gateway
from chaos_site import BACK_S, CALLERS, CHECKPOINT, Row, Site, wait_healthy
from rfm.config import ExportConfig
from rfm.proc import is_alive
from rfm_client import RewardClient
from rfm_client.transport.shared_memory import FOLDER
from rfm_export.publish import read_config
from rfm_serve import MODEL, RFM, TRUTH_S, children, wait_for

STOPPED_S = 10.0
SLOW_CONNECTIONS = 100
SLOW_CALLERS = 8
SLOW_S = 10
ROLLOUT_S = 120
SHARING = """
import sys, numpy as np
from rfm_client import ProgressSample, RewardClient, Trajectory
video, text = np.zeros((32, 64), np.float32), np.zeros(32, np.float32)
asked = [ProgressSample(Trajectory(video_embeddings=video, text_embedding=text))] * 64
with RewardClient(sys.argv[1], shared_memory=True) as client:
    for _ in range(int(sys.argv[2])):
        client.evaluate(asked)
        print("answered", flush=True)
"""  # 64 samples of 8 KiB are one input that is shared


def _survived(site: Site, name: str, fault: Callable[[], None]) -> list[Row]:
    """A fault that readiness tells, and that is healed."""
    with site.callers() as callers:
        fault()
        told_s = site.served.wait_ready(False, TRUTH_S)
        back_s = told_s + site.served.wait_ready()
        callers.wait_for_all()
    row = Row.of(name, callers.tally, back_s, f"not ready after {told_s:.1f} s; a start takes {site.start_s:.1f} s")
    most_s = BACK_S + site.start_s
    row.expect(back_s <= most_s, f"back after {back_s:.1f} s; allowed: {most_s:.1f} s")
    return [row]


def kill_model_process(site: Site) -> list[Row]:
    """Readiness is false meanwhile, and no caller notices more than a wait."""
    return _survived(site, "kill -9 of the model process", lambda: site.served.model_processes[0].kill())


def stop_model_process(site: Site) -> list[Row]:
    """It would go on after STOPPED_S; it is loaded anew before."""
    pid, stopped_s = site.served.model_processes[0].pid, time.monotonic()
    try:
        return _survived(
            site, f"SIGSTOP of the model process for {STOPPED_S:g} s", lambda: os.kill(pid, signal.SIGSTOP)
        )
    finally:
        wait_for(lambda: time.monotonic() - stopped_s > STOPPED_S or not is_alive(pid), STOPPED_S + 1)
        if is_alive(pid):
            os.kill(pid, signal.SIGCONT)


def kill_triton(site: Site) -> list[Row]:
    """It is started again."""
    return _survived(site, "kill -9 of Triton", lambda: os.kill(site.served.triton, signal.SIGKILL))


def kill_gateway(site: Site) -> list[Row]:
    """Its callers are told by a connection that breaks; others do not notice."""
    (pid,) = [pid for pid in children(site.served.process.pid, ".") if pid != site.served.triton]
    with (
        site.callers(CALLERS // 2) as beside,
        Callers(through_gateway(site.gateway_url), site.progress, CALLERS // 2) as callers,
    ):
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: not is_alive(pid))
        back_s = wait_healthy(site.gateway_url)
        callers.wait_for_all()
        beside.wait_for_all()
    told = "broken off: connections that ended, or were not to be had"
    row = Row.of("kill -9 of the gateway", callers.tally, back_s, told, breaks_off=True)
    row.expect(back_s <= BACK_S, f"back after {back_s:.1f} s; allowed: {BACK_S:g} s")
    return [row, Row.of("  callers beside it, over gRPC", beside.tally)]


def kill_client(site: Site) -> list[Row]:
    """A client that shares memory. The next one takes back what it has left."""
    http_url = site.served.endpoints.http_url

    def regions() -> set[str]:
        return {region["name"] for region in httpx.get(f"{http_url}/v2/systemsharedmemory/status").json()}

    words = [sys.executable, "-c", SHARING, site.served.endpoints.grpc_url]
    with site.callers(CALLERS // 2) as callers:
        with subprocess.Popen([*words, "1000000"], stdout=subprocess.PIPE) as client:
            assert client.stdout is not None
            client.stdout.readline()
            left = regions()
            client.kill()
        killed_s = time.monotonic()
        subprocess.run([*words, "1"], check=True, timeout=60, stdout=subprocess.DEVNULL)
        back_s = time.monotonic() - killed_s
        callers.wait_for_all()
    row = Row.of("kill -9 of a client with shared memory", callers.tally, back_s)
    owners = {name.rpartition("-")[0] for name in left}
    files = [str(file) for owner in owners for file in FOLDER.glob(f"*{owner}*")]
    row.told = f"{len(left)} regions left, and taken back by the next client"
    row.expect(len(left) > 0, "expected regions in use, got none")
    row.expect(not regions(), f"the server still has {regions()}")
    row.expect(not files, f"still there: {files}")
    return [row]


def corrupt_weights(site: Site) -> list[Row]:
    """A version whose weights are not those of its export is not rolled out; the one before goes on."""
    version = rfm_export.export(CHECKPOINT, site.repository, ExportConfig(num_gpus=0, torch_threads=1))
    (weights,) = (site.repository / MODEL / str(version)).rglob("*.safetensors")
    content = bytearray(weights.read_bytes())
    content[-1] ^= 0x40
    weights.write_bytes(content)
    url = site.served.endpoints.grpc_url
    words = ["--repository", site.repository, "--url", url, "--admin-key-file", site.key_file]
    with site.callers() as callers:
        done = subprocess.run(
            [RFM, "models", "rollout", MODEL, str(version), *words], capture_output=True, text=True, timeout=ROLLOUT_S
        )
        callers.wait_for_all()
    row = Row.of(
        "corrupted weights in a rollout", callers.tally, told="refused by their digest, the old version serves"
    )
    row.expect(done.returncode != 0 and "expected the weights that were exported" in done.stderr, done.stderr[-300:])
    with RewardClient(site.served.endpoints.grpc_url) as client:
        served = client.progress(site.progress.samples[0].trajectories[0]).model_version
    row.expect(served == str(version - 1), f"version {served} answers")
    configured = list(read_config(site.repository, MODEL).version_policy.specific.versions)
    row.expect(configured == [version - 1], f"a restart would serve {configured}")
    return [row]


def slow_loris(site: Site) -> list[Row]:
    """Callers of the same door are served, beside many connections that send a byte a second."""
    endpoints = site.served.endpoints
    doors = {
        "Triton's HTTP": (endpoints.http_port, direct(endpoints.http_url), site.mixed, "/v2/models/rfm/infer"),
        "the gateway": (
            int(site.gateway_url.rpartition(":")[2]),
            through_gateway(site.gateway_url),
            site.progress,
            "/evaluate_batch",
        ),
    }
    rows = []
    for name, (port, connect, exam, path) in doors.items():
        with Callers(connect, exam, SLOW_CALLERS) as before:
            time.sleep(SLOW_S / 5)
        head = (
            f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 99\r\n\r\n"
        )
        with _dripping(endpoints.host, port, head.encode()) as sent, Callers(connect, exam, SLOW_CALLERS) as callers:
            wait_for(lambda sent=sent: len(sent) >= SLOW_CONNECTIONS * SLOW_S, 2 * SLOW_S)  # type: ignore[misc]
        p99_ms = [1e3 * tally.p99_s for tally in (before.tally, callers.tally)]
        told = f"{SLOW_CONNECTIONS} connections; p99 {p99_ms[1]:.0f} ms, {p99_ms[0]:.0f} ms without them"
        row = Row.of(f"slow loris against {name}", callers.tally, told=told)
        row.expect(callers.tally.refused == 0, f"{callers.tally.refused} callers were refused")
        rows.append(row)
    return rows


@contextmanager
def _dripping(host: str, port: int, head: bytes) -> Iterator[list[float]]:
    """Within it, connections send a byte a second each: half of them of the head, half of the body. Gives when.

    A connection that the server resets is opened anew: of so many at once, Triton drops some now and then.
    """
    sent: list[float] = []

    async def drip(number: int) -> None:
        while True:
            with suppress(ConnectionError):
                await drip_once(number)

    async def drip_once(number: int) -> None:
        begun, rest = (head, b"{" * 99) if number % 2 else (head[:5], head[5:])
        _, writer = await asyncio.open_connection(host, port)
        try:
            writer.write(begun)
            for byte in rest:
                await asyncio.sleep(1)
                writer.write(bytes([byte]))
                await writer.drain()
                sent.append(time.monotonic())
        finally:
            writer.close()

    async def drip_all() -> None:
        await asyncio.gather(*map(drip, range(SLOW_CONNECTIONS)))

    loop = asyncio.new_event_loop()
    task = loop.create_task(drip_all())

    def run() -> None:
        with suppress(asyncio.CancelledError):
            loop.run_until_complete(task)

    with ExitStack() as stack:
        thread = threading.Thread(target=run)
        thread.start()
        stack.callback(loop.close)
        stack.callback(thread.join)
        stack.callback(loop.call_soon_threadsafe, task.cancel)
        yield sent


FAULTS: dict[str, Callable[[Site], list[Row]]] = {
    "kill -9 of the model process": kill_model_process,
    "SIGSTOP of the model process": stop_model_process,
    "kill -9 of Triton": kill_triton,
    "kill -9 of the gateway": kill_gateway,
    "kill -9 of a client with shared memory": kill_client,
    "corrupted weights in a rollout": corrupt_weights,
    "slow loris": slow_loris,
}
