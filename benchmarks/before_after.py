# SPDX-License-Identifier: MIT
"""This server beside those of other commits, and mosec: one checkpoint, one run, interleaved rounds.

    python benchmarks/before_after.py --server before=OTHER_VENV/bin/python --server after=.venv/bin/python

Each --server is a name and the interpreter of an environment in which that commit is installed; it exports and serves
by itself. All are asked by the client of this environment.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil
import torch
from bench import RESULTS, ROOT, checkpoint, machine
from contestants import PEER_SCRIPTS, BareEngine, Callers, running_peer
from load import Load
from rich.console import Console

FRAMES = (16, 16)
US_PER_S = 1e6
VLM = "vision-language"
VLM_FOLDER, VLM_BASE = (ROOT / "tests" / "golden" / "vlm" / name for name in ("q3_tok_disc10/checkpoint", "bases/q3"))
SERVE = """
import sys
from pathlib import Path
from rfm.config import ExportConfig
from rfm.launch.temporary import temporary_server
import rfm_export

checkpoint, base, threads, folder = sys.argv[1:]
config = ExportConfig(num_gpus=0, torch_threads=int(threads), base_model=base or None)
rfm_export.export(checkpoint, Path(folder) / "repository", config)
with temporary_server(Path(folder) / "repository", Path(folder) / "log") as endpoints:
    print(endpoints.grpc_url, flush=True)
    sys.stdin.readline()
"""


@dataclass(frozen=True)
class Contestant:
    """A server that runs: its callers and its processes."""

    callers: Callers
    processes: list[psutil.Process]

    def measure(self, load: Load) -> dict[str, float]:
        """One load."""
        before_s = self._cpu_s()
        measured = self.callers.measure(load)
        cpu_us = (self._cpu_s() - before_s) / max(measured.samples_per_s * measured.took_s, 1) * US_PER_S
        told = {"samples_per_s": measured.samples_per_s, "p50_ms": measured.p50_ms, "p99_ms": measured.p99_ms}
        return {**told, "failed": measured.failed, "server_us": cpu_us}

    def _cpu_s(self) -> float:
        return sum(sum(process.cpu_times()[:2]) for process in self.processes)


def main() -> None:
    """Measures, writes and shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", action="append", required=True, help="NAME=PYTHON")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement")
    parser.add_argument("--callers", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--sizes", nargs="+", default=["default", "small", VLM])
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder for the results")
    arguments = parser.parse_args()
    servers = dict(word.split("=", 1) for word in arguments.server)
    rows: list[dict[str, object]] = []
    for size in arguments.sizes:
        with (
            TemporaryDirectory(prefix="rfm-bench-") as folder,
            running(size, servers, Path(folder)) as contestants,
        ):
            frame_px = 256 if size == VLM else 0
            load = Load(1, arguments.seconds, (8, 8) if frame_px else FRAMES, frame_px=frame_px)
            for number in range(arguments.rounds):
                for callers in arguments.callers:
                    for name, contestant in contestants.items():
                        row = {"size": size, "callers": callers, "server": name, "round": number}
                        rows.append(row | contestant.measure(replace(load, callers=callers)))
                        Console().print(rows[-1], highlight=False)
    arguments.output.mkdir(parents=True, exist_ok=True)
    results = {"machine": machine(), "measurements": rows}
    (arguments.output / "before_after.json").write_text(json.dumps(results, indent=1) + "\n")
    (arguments.output / "before_after.md").write_text(table(rows))
    print(table(rows))


@contextmanager
def running(size: str, servers: dict[str, str], folder: Path) -> Iterator[dict[str, Contestant]]:
    """All servers of one checkpoint, and mosec if it can serve it."""
    with ExitStack() as stack:
        if size == VLM:
            source, base, threads, widths = VLM_FOLDER, str(VLM_BASE), torch.get_num_threads(), (0, 0)
        else:
            made = checkpoint(size, folder, torch.get_num_threads())
            source, base, threads, widths = made.folder, "", made.threads, BareEngine(made).widths
        contestants = {}
        for name, python in servers.items():
            (folder / name).mkdir()
            words = [python, "-c", SERVE, str(source), base, str(threads), str(folder / name)]
            contestants[name] = stack.enter_context(_contestant("gRPC", _served(words), widths))
        if size != VLM:
            options = {"checkpoint": source, "threads": threads, "workers": 1}
            peer = running_peer(PEER_SCRIPTS["mosec"], options, folder / "mosec.log")
            contestants["mosec"] = stack.enter_context(_contestant("mosec", _of_port(peer), widths))
        yield contestants


@contextmanager
def _contestant(way: str, server: Iterator[str], widths: tuple[int, int]) -> Iterator[Contestant]:
    before = set(psutil.Process().children(recursive=True))
    with ExitStack() as stack:
        url = stack.enter_context(server)  # type: ignore[arg-type]
        processes = list(set(psutil.Process().children(recursive=True)) - before)
        callers = Callers(way, url, widths)
        stack.callback(callers.close)
        yield Contestant(callers, processes)


@contextmanager
def _served(words: list[str]) -> Iterator[str]:
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        while not (line := process.stdout.readline()).startswith("grpc"):
            assert line, "expected a server, got its end"
        yield line.strip()
    finally:
        process.communicate("\n")


@contextmanager
def _of_port(peer: Iterator[int]) -> Iterator[str]:
    with peer as port:  # type: ignore[attr-defined]
        yield f"http://127.0.0.1:{port}"


def table(rows: list[dict[str, object]]) -> str:
    """Medians of the rounds, and the rate beside the first server's in the same round, as Markdown."""
    columns = ("samples_per_s", "p50_ms", "p99_ms", "server_us")
    lines = [
        "# Before and after",
        "",
        "Medians of interleaved rounds. us: CPU of the server's processes for a request of one sample. Ratio: of",
        "samples/s, to the first server's in the same round.",
        "",
        "| checkpoint | callers | server | samples/s | p50 ms | p99 ms | server us | ratio |",
        "|---|---|---|---|---|---|---|---|",
    ]
    first = rows[0]["server"]
    for key in dict.fromkeys((row["size"], row["callers"], row["server"]) for row in rows):
        of_key = [row for row in rows if (row["size"], row["callers"], row["server"]) == key]
        of_first = [row for row in rows if (row["size"], row["callers"], row["server"]) == (*key[:2], first)]
        ratios = [
            float(str(a["samples_per_s"])) / float(str(b["samples_per_s"]))
            for a, b in zip(of_key, of_first, strict=True)
        ]
        medians = [statistics.median(float(str(row[column])) for row in of_key) for column in columns]
        cells = [str(part) for part in key] + [f"{value:.3g}" if value < 1000 else f"{value:.0f}" for value in medians]
        lines.append(f"| {' | '.join(cells)} | {statistics.median(ratios):.2f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
