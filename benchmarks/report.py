# SPDX-License-Identifier: MIT
"""Benchmark results: all rows as JSON, and medians over the rounds as a Markdown table."""

from __future__ import annotations

import json
import os
import platform
import shutil
import statistics
import subprocess
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rich.console import Console

ROOT = Path(__file__).parents[1]
OUTPUT = ROOT / "build" / "benchmarks"
PACKAGES = ("torch", "numpy", "tritonclient", "nvidia-pytriton", "fastapi", "uvicorn", "mosec")

Row = Mapping[str, Any]


def machine() -> dict[str, object]:
    """Return CPU, packages, commit and date for the results."""
    cpu = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), "")
    git = shutil.which("git") or "false"  # a bare machine may have none
    commit = subprocess.run([git, "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    return {
        "cpu": cpu.partition(": ")[2],
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "commit": commit.strip(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def write(name: str, told: str, rows: Sequence[Row], by: Sequence[str], ratio: str = "", folder: Path = OUTPUT) -> None:
    """Write NAME.json and NAME.md, and print the latter.

    told: a title line, then explanatory lines
    rows: measurements, each with its ``round`` number
    by: columns that identify a measurement; the last is the way
    ratio: column whose values are divided by the first way's in the same round; empty: none
    """
    of = machine()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps({"machine": of, "measurements": list(rows)}, indent=1) + "\n")
    about = f"{of['cpu']}, {of['cores']} cores, commit {str(of['commit'])[:12]}, {of['date']}."
    text = (
        "\n".join([f"# {told.splitlines()[0]}", "", *told.splitlines()[1:], about, "", *table(rows, by, ratio)]) + "\n"
    )
    (folder / f"{name}.md").write_text(text)
    Console().print(text, highlight=False)


def table(rows: Sequence[Row], by: Sequence[str], ratio: str = "") -> list[str]:
    """Return Markdown lines: for each way, medians over the rounds, also for its ratio within a round."""
    columns = [name for name in rows[0] if name not in (*by, "round")]
    head = [*by, *columns, *(["ratio"] if ratio else [])]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    for key, of_way in groups.items():
        first = next(group for other, group in groups.items() if other[:-1] == key[:-1])
        medians = [statistics.median(row[name] for row in of_way) for name in columns]
        cells = [*map(str, key), *map(_cell, medians)]
        if ratio:
            before = {row["round"]: row[ratio] for row in first}
            cells.append(_cell(statistics.median(row[ratio] / before[row["round"]] for row in of_way)))
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _cell(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
