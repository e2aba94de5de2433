# SPDX-License-Identifier: MIT
"""Half an hour at half of what can be served: memory and latency at the end are those of the beginning."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console

from callers import Callers, Tally, closed_loop, through_gateway
from chaos_site import Site
from fuzz import Doors
from rfm_client.cli import show

CALLERS = 6
OF_GATEWAY = 2
CAPACITY_S = 5.0
WINDOWS = 30  # minutes, in half an hour
WARM_UP = 0.2  # of all windows
MOST_MIB_PER_MIN = 1e6 / 2**20
MOST_RISE = 0.25  # of p99 over the whole run, where it is more than chance (two standard errors)
SAMPLE_S = 2.0


@dataclass
class Course:
    """By window: when it ended, memory of all processes, p99 of answers."""

    minutes: list[float] = field(default_factory=list)
    memory_mib: list[float] = field(default_factory=list)
    p99_ms: list[float] = field(default_factory=list)

    def slope(self, values: list[float]) -> tuple[float, float]:
        """Per minute, after the warm-up, by least squares; and its standard error."""
        kept = slice(int(len(values) * WARM_UP), None)
        (slope, _), covariance = np.polyfit(self.minutes[kept], values[kept], 1, cov=True)
        return float(slope), float(np.sqrt(covariance[0, 0]))


def soak(site: Site, minutes: float) -> int:
    """Prints the course and its slopes; 1 if a bound was broken."""
    gateway = through_gateway(site.gateway_url)
    rates = [
        closed_loop(site.direct, site.mixed, CALLERS, CAPACITY_S)[1] / CALLERS,
        closed_loop(gateway, site.progress, OF_GATEWAY, CAPACITY_S)[1] / OF_GATEWAY,
    ]
    halves_s = [2 / rate * 2 for rate in rates]  # both kinds share what can be served, and half of it is asked for
    course = Course()
    with (
        Callers(site.direct, site.mixed, CALLERS, interval_s=halves_s[0]) as over_grpc,
        Callers(gateway, site.progress, OF_GATEWAY, interval_s=halves_s[1]) as of_gateway,
    ):
        _watch(site, over_grpc.tally, course, minutes)
    return _report(course, over_grpc.tally + of_gateway.tally, minutes)


def _watch(site: Site, tally: Tally, course: Course, minutes: float) -> None:
    serving = site.served
    doors = Doors(serving.endpoints, 0, (serving.process.pid,), serving.log)
    started_s = time.monotonic()
    for window in range(1, WINDOWS + 1):
        first, memory = tally.answered, []
        while (left_s := started_s + 60 * minutes * window / WINDOWS - time.monotonic()) > 0:
            time.sleep(min(SAMPLE_S, left_s))
            memory.append(doors.memory_bytes() / 2**20)
        course.minutes.append((time.monotonic() - started_s) / 60)
        course.memory_mib.append(float(np.median(memory)))
        course.p99_ms.append(1e3 * float(np.percentile(tally.latencies_s[first : tally.answered], 99)))


def _report(course: Course, tally: Tally, minutes: float) -> int:
    rows = [
        [f"{minute:.1f}", f"{memory:.1f}", f"{p99:.1f}"]
        for minute, memory, p99 in zip(course.minutes, course.memory_mib, course.p99_ms, strict=True)
    ]
    Console(width=100).print(show.table(f"soak, {minutes:g} minutes", ("minute", "memory MiB", "p99 ms"), rows))
    memory, memory_error = course.slope(course.memory_mib)
    p99, p99_error = course.slope(course.p99_ms)
    rise, most = p99 * minutes, MOST_RISE * float(np.median(course.p99_ms))
    lost, wrong = len(tally.lost) + tally.broken_off, tally.wrong
    print(f"asked {tally.asked}, answered {tally.answered}, refused {tally.refused}, lost {lost}, wrong {wrong}")
    print(f"memory: {memory:+.3f} ± {memory_error:.3f} MiB/min (allowed: {MOST_MIB_PER_MIN:.3f})")
    print(f"p99: {p99:+.3f} ± {p99_error:.3f} ms/min, {rise:+.1f} ms in all (flat: {most:.1f} ms, or chance)")
    is_flat = rise <= most or p99 <= 2 * p99_error
    is_kept = memory < MOST_MIB_PER_MIN and is_flat and not (tally.refused or lost or wrong)
    print("every bound was kept" if is_kept else "BROKEN: a bound")
    return int(not is_kept)
