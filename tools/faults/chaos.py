# SPDX-License-Identifier: MIT
"""``make chaos``: faults of a served checkpoint, one after the other, while callers ask; what became of each call.

Everything is on loopback and this suite's own. ``make soak``: no faults, for half an hour; memory and latency stay.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from rich.console import Console

import mounts
from chaos_site import Row, Site, site
from faults import FAULTS
from rfm_client.cli import show
from soak import soak

COLUMNS = ("fault", "asked", "answered", "refused", "broken off", "lost", "wrong", "healed s", "told")


def survive(name: str, fault: Callable[[], list[Row]]) -> list[Row]:
    """The rows of a fault; if it could not even be seen to the end, one that says so."""
    print(f"{name} ...", flush=True)
    try:
        return fault()
    except Exception as error:  # noqa: BLE001  whatever broke, the other faults are tried all the same
        traceback.print_exc()
        return [Row(name, broken=[f"{type(error).__name__}: {error}"])]


def chaos(folder: Path) -> list[Row]:
    """All faults, each of a server of its own: six restarts in a row would be a crash loop."""

    def run(fault: Callable[[Site], list[Row]]) -> list[Row]:
        with site(folder / fault.__name__) as served:
            return fault(served)

    rows = []
    for fault in FAULTS:
        rows += survive(fault.__name__, partial(run, fault))
    for name in mounts.FAULTS:
        rows += survive(name, partial(mounts.run, name, folder))
    return rows


def report(rows: list[Row]) -> int:
    """Prints the table, and what was broken; 1 if something was."""
    Console(width=150).print(show.table("", COLUMNS, [row.cells for row in rows]))
    broken = [f"BROKEN: {row.name}: {why}" for row in rows for why in row.broken]
    print("\n".join(broken) or "every bound was kept")
    return int(bool(broken))


def main() -> int:
    """1 if a bound was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--soak", type=float, nargs="?", const=30.0, metavar="MINUTES", help="no faults; 30 minutes")
    parser.add_argument("--inside", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="rfm-chaos-") as name:
        folder = Path(name)
        if chosen.inside:
            return mounts.inside(chosen.inside, folder)
        if chosen.soak:
            with site(folder / "soak") as served:
                return soak(served, chosen.soak)
        status = report(chaos(folder))
    print(f"{time.monotonic() - started_s:.0f} s")
    return status


if __name__ == "__main__":
    sys.exit(main())
