# SPDX-License-Identifier: MIT
"""Benchmark with Triton's perf_analyzer: several concurrencies and Poisson rates, all sample types, mixed lengths.

    python benchmarks/perf_analyzer.py --size small
    python benchmarks/perf_analyzer.py --fetch build/perf    # build/perf/perf_analyzer, for a server of your own

The default program comes from the tritonclient 2.51.0 wheel. Each round measures the bare engine in this process, and
for each load first perf_analyzer, then our own generator (load.py). Figures are compared only within a round.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import perf_input
import report
from contestants import BareEngine, Contestant, checkpoint
from load import Load, samples

from rfm.serve.installation import find_installation
from rfm.serve.triton_server import temporary_server

WHEEL = "tritonclient==2.51.0"
LIBRARIES = ("libcudart.so.12", "libb64.so.0d")  # nvidia-pytriton's wheel has them under other names
SCRIPT = """#!/bin/sh
lib=$(dirname "$(realpath "$0")")/lib
LD_LIBRARY_PATH=$lib exec "$lib/perf_analyzer" "$@"
"""
# Three one-second windows. 999 % accepts windows that disagree.
OPTIONS = ("-i", "grpc", "--async", "-p", "1000", "--max-trials", "3", "--stability-percentage", "999")
KINDS = {
    "progress, 16 frames": Load(1, 1.5, (16, 16)),
    "all types, 1 to 16 frames": Load(1, 1.5, (1, 16), mixed=True),
}


def main() -> None:
    """Measure, then write and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="small", choices=["default", "small"], help="of the checkpoint")
    parser.add_argument("--perf-analyzer", type=Path, help="program; else that of the wheel, which is fetched")
    parser.add_argument("--concurrency", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--poisson", type=float, nargs="*", default=[0.3], help="rates, as shares of the bare engine's")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--output", type=Path, default=report.OUTPUT)
    parser.add_argument("--fetch", type=Path, metavar="FOLDER", help="only get the program, and measure nothing")
    arguments = parser.parse_args()
    if arguments.fetch is not None:
        print(fetch(arguments.fetch))
        return
    rows = []
    with TemporaryDirectory(prefix="rfm-perf-") as name:
        folder = Path(name)
        program = arguments.perf_analyzer or fetch(folder / "perf")
        measured = checkpoint(arguments.size, folder)
        bare = BareEngine(measured)
        with (
            temporary_server(measured.repository, folder / "triton.log") as endpoints,
            Contestant("gRPC", nullcontext(endpoints.grpc_url), measured.widths) as callers,
        ):
            for kind, load in KINDS.items():
                perf_input.write(folder / "requests.json", samples(load, *measured.widths))
                command = [str(program), "-m", "rfm", "-u", endpoints.grpc_url.partition("://")[2], *OPTIONS]
                command += ["--input-data", str(folder / "requests.json")]
                for number in range(arguments.rounds):
                    best = max(bare.measure(load, size)["samples_per_s"] for size in (8, 32))
                    for asked, options in _loads(load, best, arguments.concurrency, arguments.poisson):
                        told = _run([*command, *options])
                        ours = callers.measure(asked)["samples_per_s"]
                        name = f"{asked.callers} at a time" if asked.callers else "Poisson"
                        rows.append({"requests": kind, "way": name, "round": number, **_figures(told, best, ours)})
    told = f"perf_analyzer, {arguments.size} checkpoint\nRates are also as shares of the bare engine's best and ours."
    report.write(f"perf_analyzer_{arguments.size}", told, rows, ("requests", "way"), folder=arguments.output)


def _loads(
    load: Load, best: float, concurrency: Sequence[int], poisson: Sequence[float]
) -> Iterator[tuple[Load, list[str]]]:
    """Yield each load for our generator, with the matching perf_analyzer options."""
    for number in concurrency:
        yield replace(load, callers=number), ["--concurrency-range", str(number)]
    for share in poisson:
        options = ["--request-rate-range", f"{share * best:.0f}", "--request-distribution", "poisson"]
        yield replace(load, callers=0, rate_per_s=share * best), options


def _run(command: Sequence[str]) -> Mapping[str, str]:
    """Run perf_analyzer, and return its CSV row. Raises RuntimeError if it fails."""
    with TemporaryDirectory(prefix="rfm-perf-run-") as folder:
        file = Path(folder) / "run.csv"
        words = [*command, "-f", str(file)]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"perf_analyzer: expected to measure, got {done.stdout[-1000:]}{done.stderr[-1000:]}")
        return next(csv.DictReader(file.read_text().splitlines()[:2]))


def _figures(told: Mapping[str, str], best: float, ours: float) -> dict[str, float]:
    rate = float(told["Inferences/Second"])
    compute_us = sum(float(told[f"Server Compute {part}"]) for part in ("Input", "Infer", "Output"))
    names = {"p50_ms": "p50 latency", "p99_ms": "p99 latency", "queue_ms": "Server Queue"}
    times_ms = {name: float(told[column]) / 1e3 for name, column in names.items()}
    rates = {"samples_per_s": rate, "of_the_bare_engine": rate / best, "of_our_generator": rate / ours}
    return {**rates, **times_ms, "compute_ms": compute_us / 1e3}


def fetch(folder: Path) -> Path:
    """Write perf_analyzer with the libraries that it needs into a folder. Return the path of a script that runs it."""
    libraries = folder.absolute() / "lib"
    libraries.mkdir(parents=True, exist_ok=True)
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    where = ["-d", str(libraries), "--only-binary=:all:", "--platform", "manylinux1_x86_64", WHEEL]
    subprocess.run([*pip, *where], check=True)
    (wheel,) = libraries.glob("tritonclient-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        name = next(entry for entry in archive.namelist() if entry.endswith("/perf_analyzer"))
        (libraries / "perf_analyzer").write_bytes(archive.read(name))
    wheel.unlink()
    installed = find_installation().wheel
    assert installed is not None  # only a wheel has the libraries
    for library in LIBRARIES:
        stem, suffix = library.split(".so", 1)
        (source,) = (installed.parents[1] / "nvidia_pytriton.libs").glob(f"{stem}-*.so{suffix}*")
        shutil.copy(source, libraries / library)
    program = libraries.parent / "perf_analyzer"
    program.write_text(SCRIPT)
    for file in (program, libraries / "perf_analyzer"):
        file.chmod(0o755)
    return program


if __name__ == "__main__":
    main()
