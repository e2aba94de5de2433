# SPDX-License-Identifier: MIT
"""What a benchmark writes: all rows as JSON, and medians of the rounds as a Markdown table."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rich.console import Console

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PACKAGES = ("torch", "numpy", "tritonclient", "nvidia-pytriton", "fastapi", "uvicorn", "litserve", "mosec")

Row = Mapping[str, Any]


def machine() -> dict[str, object]:
    """What the results are of."""
    cpu = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), "")
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
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


def write(
    name: str, told: str, rows: Sequence[Row], by: Sequence[str], ratio: str = "", folder: Path = RESULTS
) -> None:
    """NAME.json and NAME.md, which is shown, too.

    rows: measurements, each with the number of its ``round``; by: the columns that name what was measured, the last of
    them the way; ratio: a column, of which each way is compared with the first way of the same round
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
    """Lines of Markdown: medians of the rounds of each way, and of its ratios within a round."""
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
