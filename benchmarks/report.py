# SPDX-License-Identifier: MIT
"""Results of a benchmark as Markdown and pictures: medians, spread, and ratios within a round."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

BARE = "bare engine"
OURS = "gRPC"
DOTS_PER_IN = 120

Row = Mapping[str, Any]


def write(results: Mapping[str, Any], folder: Path) -> None:
    """results.md, and a picture for each size of checkpoint."""
    machine = results["machine"]
    versions = ", ".join(f"{name} {number}" for name, number in machine["packages"].items() if number)
    lines = [
        "# Results",
        "",
        f"{machine['cpu']}, {machine['cores']} cores; Python {machine['python']}; {versions}; "
        f"commit {machine['commit'][:12]}; {machine['date']}. {results['threads']} torch threads; medians of "
        f"{results['rounds']} interleaved rounds of {results['seconds']:g} s, with the smallest and largest. Ratios: "
        "medians of those within a round. Callers run on the same cores. LitServe and mosec run this project's engine "
        "in as many processes as Triton does, and wait up to 1 ms for a batch to fill.",
    ]
    rows: Sequence[Row] = results["measurements"]
    for size in dict.fromkeys(row["size"] for row in rows):
        of_size = [row for row in rows if row["size"] == size]
        for scenario in dict.fromkeys(row["scenario"] for row in of_size):
            lines += [
                "",
                f"## {size} checkpoint, {scenario}",
                "",
                *_table([r for r in of_size if r["scenario"] == scenario]),
            ]
        _draw(size, of_size, folder / f"{size}.png")
    (folder / "results.md").write_text("\n".join(lines) + "\n")


def _table(rows: Sequence[Row]) -> list[str]:
    lines = [
        "| | samples/s | of the bare engine's best | gRPC is ahead by | p50 ms | p99 ms | failed |",
        "|---|---|---|---|---|---|---|",
    ]
    for way, of_way in _by_way(rows).items():
        rates = [row["samples_per_s"] for row in of_way]
        best = _ratio(
            of_way, lambda number: max(r["samples_per_s"] for r in rows if _is_bare(r) and r["round"] == number)
        )
        is_other = way != OURS and not _is_bare(of_way[0])
        cells = (
            way,
            f"{statistics.median(rates):.0f} ({min(rates):.0f}..{max(rates):.0f})",
            f"{best:.2f}",
            f"{1 / _ratio(of_way, lambda number: _rate(rows, OURS, number)):.1f} x" if is_other else "",
            f"{_median(of_way, 'p50_ms'):.1f}",
            f"{_median(of_way, 'p99_ms'):.1f}",
            str(sum(row["failed"] for row in of_way)),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _by_way(rows: Sequence[Row]) -> dict[str, list[Row]]:
    return {way: [row for row in rows if row["way"] == way] for way in dict.fromkeys(row["way"] for row in rows)}


def _ratio(rows: Sequence[Row], other: Callable[[int], float]) -> float:
    return statistics.median(row["samples_per_s"] / other(row["round"]) for row in rows)


def _rate(rows: Sequence[Row], way: str, number: int) -> float:
    return next(float(row["samples_per_s"]) for row in rows if row["way"] == way and row["round"] == number)


def _median(rows: Sequence[Row], column: str) -> float:
    return statistics.median(row[column] for row in rows)


def _is_bare(row: Row) -> bool:
    return str(row["way"]).startswith(BARE)


def _draw(size: str, rows: Sequence[Row], file: Path) -> None:
    """Samples a second and p99 of each way, a panel a scenario."""
    scenarios = list(dict.fromkeys(row["scenario"] for row in rows))
    with matplotlib.rc_context({"font.size": 8}):
        figure = Figure(figsize=(10, 2.4 * len(scenarios)), layout="constrained")
        figure.suptitle(f"{size} checkpoint")
        panels = figure.subplots(len(scenarios), 2, squeeze=False)
        for (rates, tails), scenario in zip(panels, scenarios, strict=True):
            ways = _by_way([row for row in rows if row["scenario"] == scenario])
            names = list(ways)
            colours = [
                "tab:gray" if _is_bare(of[0]) else "tab:blue" if name == OURS else "tab:orange"
                for name, of in ways.items()
            ]
            rates.barh(names, [_median(of, "samples_per_s") for of in ways.values()], color=colours)
            rates.set(title=scenario, xlabel="samples/s")
            tails.barh(names, [_median(of, "p99_ms") for of in ways.values()], color=colours)
            tails.set(title=scenario, xlabel="p99, ms", xscale="log")
            for axes in (rates, tails):
                axes.invert_yaxis()
        figure.savefig(file, dpi=DOTS_PER_IN)
