# SPDX-License-Identifier: MIT
"""Faults of ``make chaos`` that a running ``rfm serve`` must survive while callers ask."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from callers import Callers, direct, through_gateway
from chaos_site import CALLERS, HANG_S, HEALED_S, KEY, OTHER, Row, Site, wait_healthy
from commands import is_alive
from rfm.launch.repository_api import RepositoryApi
from rfm.supervise.status import NO_REASON
from rfm.supervise.watch import TRITON
from rfm.triton_model.guard import FAILED_BATCHES
from rfm_serve import MODEL, children, wait_for

SILENT_S = 10.0  # as rfm serve has it by default
STOPPED_S = 5.0
LOOP_S = 120.0  # six starts of Triton and more, with back-off
SLOW_CONNECTIONS = 100
SLOW_CALLERS = 8
SLOW_S = 10.0


def _healed(
    site: Site, name: str, fault: Callable[[], object], what: str, *, noticed_s: float = 0.0, may_lose: int = 0
) -> list[Row]:
    """A fault because of which Triton is restarted once.

    what: is to blame; noticed_s: until it can be noticed; may_lose: so many calls, which are told that they failed
    """
    before = site.restarts(what)
    with site.callers() as callers:
        fault()
        healed_s = wait_for(lambda: site.restarts(what) > before) + site.served.wait_ready()
        callers.wait_for_all()
    row = Row.of(name, callers.tally, healed_s, may_lose=may_lose)
    most_s = noticed_s + HEALED_S + site.start_s
    row.expect(healed_s <= most_s, f"healed after {healed_s:.1f} s; allowed: {most_s:.0f} s")
    row.expect(site.restarts(what) == before + 1, f"{site.restarts(what) - before:.0f} restarts")
    row.expect(row.broken_off + row.refused == 0, "calls were broken off or refused")
    return [row]


def kill_model_process(site: Site) -> list[Row]:
    pid = site.served.model_processes()[0]
    return _healed(site, "kill -9 of a model process", lambda: os.kill(pid, signal.SIGKILL), MODEL)


def stop_model_process(site: Site) -> list[Row]:
    pid = site.served.model_processes()[0]
    return _healed(site, "SIGSTOP of a model process", lambda: os.kill(pid, signal.SIGSTOP), MODEL)


def kill_triton(site: Site) -> list[Row]:
    return _healed(site, "kill -9 of Triton", lambda: os.kill(site.served.triton, signal.SIGKILL), TRITON)


def stop_triton(site: Site) -> list[Row]:
    pid = site.served.triton
    return _healed(site, "SIGSTOP of Triton", lambda: os.kill(pid, signal.SIGSTOP), TRITON, noticed_s=SILENT_S)


def hang_batch(site: Site) -> list[Row]:
    return _healed(
        site, f"a batch hangs (hang_s: {HANG_S})", lambda: site.trigger("hang"), MODEL, noticed_s=1.1 * HANG_S
    )


def break_instance(site: Site) -> list[Row]:
    """The callers of its first batches are told that they failed."""
    may_lose = (FAILED_BATCHES - 1) * CALLERS
    return _healed(site, "a broken context (simulated)", lambda: site.trigger("break"), MODEL, may_lose=may_lose)


def crash_loop(site: Site) -> list[Row]:
    """One model of two ends Triton again and again: it is left out, and a person takes it in again."""
    before = site.restarts(OTHER)
    with site.callers() as callers:
        trigger = site.trigger("die", OTHER)
        took_s = wait_for(lambda: site.served.reasons().get(OTHER, "").startswith("it is left out"), LOOP_S)
        took_s += wait_for(lambda: site.served.reasons().get(MODEL) == NO_REASON)
        callers.wait_for_all()
        trigger.unlink()
        with RepositoryApi(site.served.endpoints.grpc_url, KEY) as api:
            api.load(OTHER)
        site.served.wait_ready()
        callers.wait_for_all()
    told = f"callers of the other; left out after {site.restarts(OTHER) - before:.0f} restarts"
    return [Row.of("crash loop of one model of two", callers.tally, took_s, told)]


def _gateway(site: Site) -> int:
    (pid,) = [pid for pid in children(site.served.process.pid, ".") if pid != site.served.triton]
    return pid


def kill_gateway(site: Site) -> list[Row]:
    """Its callers are told by a connection that breaks; others do not notice."""
    pid = _gateway(site)
    with (
        site.callers(CALLERS // 2) as beside,
        Callers(through_gateway(site.gateway_url), site.progress, CALLERS // 2) as callers,
    ):
        os.kill(pid, signal.SIGKILL)
        healed_s = wait_for(lambda: not is_alive(pid)) + wait_healthy(site.gateway_url)
        callers.wait_for_all()
        beside.wait_for_all()
    row = Row.of("kill -9 of the gateway", callers.tally, healed_s)
    row.expect(healed_s <= HEALED_S, f"healed after {healed_s:.1f} s; allowed: {HEALED_S:g} s")
    return [row, Row.of("  callers beside it, over gRPC", beside.tally)]


def stop_gateway(site: Site) -> list[Row]:
    """Its callers wait until it goes on, which `rfm serve` leaves to others."""
    pid = _gateway(site)
    with Callers(through_gateway(site.gateway_url), site.progress, CALLERS // 2) as callers:
        os.kill(pid, signal.SIGSTOP)
        try:
            time.sleep(STOPPED_S)
        finally:
            os.kill(pid, signal.SIGCONT)
        healed_s = STOPPED_S + wait_healthy(site.gateway_url)
        callers.wait_for_all()
    row = Row.of("SIGSTOP of the gateway", callers.tally, healed_s, f"SIGCONT after {STOPPED_S:g} s")
    row.expect(row.broken_off + row.refused == 0, "calls were broken off or refused")
    return [row]


def slow_loris(site: Site) -> list[Row]:
    """Callers of the same door are served, beside many connections that send a byte a second."""
    endpoints, url = site.served.endpoints, site.gateway_url
    doors = {
        "Triton's HTTP": (endpoints.http_port, direct(endpoints.http_url), site.mixed, f"/v2/models/{MODEL}/infer"),
        "the gateway": (int(url.rpartition(":")[2]), through_gateway(url), site.progress, "/evaluate_batch"),
    }
    rows = []
    for name, (port, connect, exam, path) in doors.items():
        with Callers(connect, exam, SLOW_CALLERS) as before:
            time.sleep(SLOW_S / 5)
        with _dripping(endpoints.host, port, path), Callers(connect, exam, SLOW_CALLERS) as callers:
            time.sleep(SLOW_S)
        p99_ms = [1e3 * tally.p99_s for tally in (before.tally, callers.tally)]
        told = f"{SLOW_CONNECTIONS} connections; p99 {p99_ms[1]:.0f} ms, {p99_ms[0]:.0f} ms without them"
        row = Row.of(f"slow loris against {name}", callers.tally, told=told)
        row.expect(row.broken_off + row.refused == 0, "calls were broken off or refused")
        rows.append(row)
    return rows


@contextmanager
def _dripping(host: str, port: int, path: str) -> Iterator[None]:
    """Within it, connections send a byte a second each: half of them of the head, half of the body.

    A connection that the server resets is opened anew: of so many at once, Triton drops some now and then.
    """
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 99\r\n\r\n"
    connections: dict[int, socket.socket] = {}
    stop = threading.Event()

    def send(number: int) -> None:
        if number not in connections:
            connections[number] = socket.create_connection((host, port), 1)
            connections[number].sendall(head.encode() if number % 2 else b"POST /")
        connections[number].sendall(b"x")

    def drip() -> None:
        while not stop.is_set():
            for number in range(SLOW_CONNECTIONS):
                try:
                    send(number)
                except OSError:
                    with suppress(KeyError):
                        connections.pop(number).close()
            stop.wait(1)

    thread = threading.Thread(target=drip)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        for connection in connections.values():
            connection.close()


FAULTS = (
    kill_model_process,
    stop_model_process,
    kill_triton,
    stop_triton,
    hang_batch,
    break_instance,
    kill_gateway,
    stop_gateway,
    slow_loris,
    crash_loop,
)
