# SPDX-License-Identifier: MIT
"""Triton's own perf_analyzer: concurrency sweep and Poisson rates, all sample types, mixed lengths.

    python benchmarks/perf_analyzer.py --size small

The program is that of the tritonclient 2.51.0 wheel, unless one is named. Each load is measured in several short
rounds. In each, the bare engine is measured in this process, then perf_analyzer runs, then our own generator (load.py).
What the table compares is compared within a round; the table has medians.
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import statistics
import subprocess
import sys
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from bench import RESULTS, checkpoint
from contestants import BareEngine, Callers
from load import Load, samples
from rich.console import Console

from rfm.launch.installation import find_installation
from rfm.launch.temporary import temporary_server
from rfm_client.cli.made_up import write_perf_analyzer_input
from rfm_client.cli.show import table

WHEEL = "tritonclient==2.51.0"
LIBRARIES = ("libcudart.so.12", "libb64.so.0d")  # the wheel of tritonserver has them under other names
ROUNDS = 3
WINDOW_MS = 1000
NUM_WINDOWS = 3  # in a run of perf_analyzer
ANY_SPREAD = 999  # per cent between windows; what is wanted is three windows, not their agreement
SECONDS = 1.5  # of each measurement of the bare engine and of our generator
KINDS = {
    "progress, 16 frames": Load(1, SECONDS, (16, 16)),
    "all types, 1 to 16 frames": Load(1, SECONDS, (1, 16), mixed=True),
}
OUTSIDE = (  # what a request spends outside the model, by the columns of perf_analyzer
    *("Client Send", "Network+Server Send/Recv", "Server Queue"),
    *("Server Compute Input", "Server Compute Output", "Client Recv"),
)
DIGITS = (0, 2, 2, 1, 1, 1, 1, 1)  # of the table's figures, behind the decimal point
US_PER_MS = 1e3
US_PER_S = 1e6


def main() -> None:
    """Measures, writes a CSV file a load, and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="small", choices=["default", "small"], help="of the checkpoint")
    parser.add_argument("--perf-analyzer", type=Path, help="program; else that of the wheel, which is fetched")
    parser.add_argument("--concurrency", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--poisson", type=float, nargs="*", default=[0.3], help="rates, as shares of the bare engine's")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--output", type=Path, default=RESULTS / "perf_analyzer")
    arguments = parser.parse_args()
    if arguments.rounds < 1:
        parser.error(f"--rounds: expected at least 1, got {arguments.rounds}")

    output = arguments.output / arguments.size
    output.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="rfm-perf-") as folder:
        program, environment = _program(arguments.perf_analyzer, Path(folder))
        measured = checkpoint(arguments.size, Path(folder), threads=0)
        bare = BareEngine(measured)
        rows = []
        with temporary_server(measured.repository, Path(folder) / "triton.log") as endpoints, ExitStack() as stack:
            callers = Callers("gRPC", endpoints.grpc_url, bare.widths)
            stack.callback(callers.close)
            for kind, load in KINDS.items():
                requests = Path(folder) / f"{_file_name(kind)}.json"
                write_perf_analyzer_input(requests, samples(load, *bare.widths))
                command = [str(program), "-m", "rfm", "-i", "grpc", "-u", endpoints.grpc_url.partition("://")[2]]
                command += ["--input-data", str(requests), "--async", "-p", str(WINDOW_MS)]
                command += ["--max-trials", str(NUM_WINDOWS), "--stability-percentage", str(ANY_SPREAD)]
                for name, options, asked in _runs(load, bare, arguments.concurrency, arguments.poisson):
                    file = output / f"{_file_name(kind)}_{_file_name(name)}.csv"
                    file.unlink(missing_ok=True)
                    rounds = []
                    for _ in range(arguments.rounds):
                        ceiling = max(bare.measure(load, size).samples_per_s for size in (8, 32))
                        of_run = _run([*command, *options], file, environment)
                        figures = _figures(of_run, ceiling, callers.measure(asked).samples_per_s)
                        rounds.append((*figures, *_over_bare(of_run, bare, asked)))
                    medians = [statistics.median(values) for values in zip(*rounds, strict=True)]
                    cells = [f"{value:.{digits}f}" for digits, value in zip(DIGITS, medians, strict=False)]
                    rows.append((kind, name, *cells, *[""] * (len(DIGITS) - len(cells))))
    columns = (
        "requests",
        "load",
        "inferences/s",
        "of the bare engine",
        "of our generator",
        *("p50 ms", "p99 ms", "queue ms", "compute ms"),
        "p50 over the bare engine's, ms",
    )
    console = Console(width=160, record=True)
    console.print(table(f"perf_analyzer, {arguments.size} checkpoint", columns, rows))
    (output / "summary.txt").write_text(console.export_text())


def _runs(
    load: Load, bare: BareEngine, concurrency: Sequence[int], poisson: Sequence[float]
) -> Iterator[tuple[str, list[str], Load]]:
    """Name, perf_analyzer's options and our generator's load of each."""
    for number in concurrency:
        yield f"{number} at a time", ["--concurrency-range", str(number)], replace(load, callers=number)
    for share in poisson:
        rate = share * max(bare.measure(load, size).samples_per_s for size in (8, 32))
        options = ["--request-rate-range", f"{rate:.0f}", "--request-distribution", "poisson"]
        yield f"Poisson, {share:g}", options, replace(load, callers=0, rate_per_s=rate)


def _file_name(text: str) -> str:
    return text.replace(", ", "_").replace(" ", "_")


def _run(command: Sequence[str], file: Path, environment: Mapping[str, str]) -> Mapping[str, str]:
    """The line of perf_analyzer's CSV file, which is added to ``file``."""
    with TemporaryDirectory(prefix="rfm-perf-run-") as folder:
        words = [*command, "-f", str(Path(folder) / "run.csv")]
        print(shlex.join(words), file=sys.stderr)
        done = subprocess.run(words, env={**os.environ, **environment}, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"perf_analyzer: expected to measure, got {done.stdout[-1000:]}{done.stderr[-1000:]}")
        header, line = (Path(folder) / "run.csv").read_text().splitlines()[:2]
    with file.open("a") as of_load:
        of_load.write(f"{line}\n" if of_load.tell() else f"{header}\n{line}\n")
    return next(csv.DictReader([header, line]))


def _figures(measured: Mapping[str, str], ceiling: float, by_our_generator: float) -> tuple[float, ...]:
    rate = float(measured["Inferences/Second"])
    compute_us = sum(float(measured[f"Server Compute {part}"]) for part in ("Input", "Infer", "Output"))
    times_us = [*(float(measured[name]) for name in ("p50 latency", "p99 latency", "Server Queue")), compute_us]
    return (rate, rate / ceiling, rate / by_our_generator, *(us / US_PER_MS for us in times_us))


def _over_bare(measured: Mapping[str, str], bare: BareEngine, load: Load) -> tuple[float, ...]:
    """Of a lone caller, in ms: how much longer it waits than the bare engine takes, with the same pauses between
    samples. Of others: nothing.
    """
    if load.callers != 1:
        return ()
    pause_us = sum(float(measured[part]) for part in OUTSIDE)
    return (float(measured["p50 latency"]) / US_PER_MS - bare.measure(load, 1, pause_us / US_PER_S).p50_ms,)


def _program(given: Path | None, folder: Path) -> tuple[Path, dict[str, str]]:
    """perf_analyzer, and what it needs in its environment."""
    if given is not None:
        return given, {}
    pip = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--disable-pip-version-check",
        "--no-deps",
        "-d",
        str(folder),
    ]
    subprocess.run([*pip, "--only-binary=:all:", "--platform", "manylinux1_x86_64", WHEEL], check=True)
    (wheel,) = folder.glob("tritonclient-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        name = next(entry for entry in archive.namelist() if entry.endswith("/perf_analyzer"))
        program = Path(archive.extract(name, folder))
    program.chmod(0o755)
    installed = find_installation().wheel
    assert installed is not None  # it brings the libraries too
    (libraries := folder / "lib").mkdir()
    for library in LIBRARIES:
        stem, suffix = library.split(".so", 1)
        (source,) = (installed.parents[1] / "nvidia_pytriton.libs").glob(f"{stem}-*.so{suffix}*")
        (libraries / library).symlink_to(source)
    return program, {"LD_LIBRARY_PATH": str(libraries)}


if __name__ == "__main__":
    main()
