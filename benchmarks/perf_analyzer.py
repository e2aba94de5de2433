# SPDX-License-Identifier: MIT
"""Triton's own perf_analyzer on a repository: concurrency sweep and Poisson rates, all sample types, mixed lengths.

    python benchmarks/perf_analyzer.py --repository model_repository

The program is that of the tritonclient 2.51.0 wheel, unless one is named. For the ratio the bare engine is measured
before each run, in this process. In NVIDIA's SDK container the line that each run prints works as it stands, with the
input file that it names.
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from contestants import BareEngine, Checkpoint
from load import Load, samples
from rich.console import Console

from rfm.demo import served
from rfm.server.installation import find_installation
from rfm_client.perf_input import write_perf_analyzer_input
from rfm_client.show import table

ROOT = Path(__file__).parents[1]
WHEEL = "tritonclient==2.51.0"
LIBRARIES = ("libcudart.so.12", "libb64.so.0d")  # the wheel of tritonserver has them under other names
WINDOW_MS = 3000
ANY_SPREAD = 999  # per cent between windows; what is wanted is three windows, not their agreement
KINDS = {"progress, 16 frames": Load(1, 1, (16, 16)), "mixed types, 1 to 16 frames": Load(1, 1, (1, 16), mixed=True)}
US_PER_MS = 1e3


def main() -> None:
    """Measures, writes a CSV file a run, and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repository", type=Path, default=ROOT / "model_repository")
    parser.add_argument("--model", default="rfm", help="name under which the checkpoint was exported")
    parser.add_argument("--perf-analyzer", type=Path, help="program; else that of the wheel, which is fetched")
    parser.add_argument("--concurrency", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--poisson", type=float, nargs="*", default=[0.5], help="rates, as shares of the bare engine's")
    parser.add_argument("--threads", type=int, default=0, help="of torch, in the bare engine; 0: torch's choice")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results" / "perf_analyzer")
    arguments = parser.parse_args()

    arguments.output.mkdir(parents=True, exist_ok=True)
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    version = max((path for path in (arguments.repository / arguments.model).glob("[0-9]*")), key=lambda p: int(p.name))
    bare = BareEngine(Checkpoint("", version / "checkpoint", arguments.repository))
    rows = []
    with TemporaryDirectory(prefix="rfm-perf-") as folder:
        program, environment = _program(arguments.perf_analyzer, Path(folder))
        with served(arguments.repository, arguments.output / "triton.log") as endpoints:
            for kind, load in KINDS.items():
                requests = arguments.output / f"{kind.replace(', ', '_').replace(' ', '_')}.json"
                write_perf_analyzer_input(requests, samples(load, *bare.widths))
                command = [
                    str(program),
                    "-m",
                    arguments.model,
                    "-i",
                    "grpc",
                    "-u",
                    endpoints.grpc_url.partition("://")[2],
                ]
                command += ["--input-data", str(requests), "--async", "-p", str(WINDOW_MS), "--max-trials", "3"]
                command += ["--stability-percentage", str(ANY_SPREAD)]
                runs = {f"{n} at a time": ["--concurrency-range", str(n)] for n in arguments.concurrency}
                for name, options in (*runs.items(), *((f"Poisson, {s:g}", [f"{s}"]) for s in arguments.poisson)):
                    ceiling = max(bare.measure(_long(load), size).samples_per_s for size in (8, 32))
                    if name.startswith("Poisson"):
                        rate = float(options[0]) * ceiling
                        options = ["--request-rate-range", f"{rate:.0f}", "--request-distribution", "poisson"]
                    file = arguments.output / f"{requests.stem}_{name.replace(', ', '_').replace(' ', '_')}.csv"
                    rows.append((kind, name, *_run([*command, *options], file, environment, ceiling)))
    columns = ("requests", "load", "inferences/s", "of the bare engine", "p50 ms", "p99 ms", "queue ms", "compute ms")
    Console(width=140).print(table(f"perf_analyzer, {arguments.repository}", columns, rows))


def _long(load: Load) -> Load:
    return Load(load.callers, WINDOW_MS / 1e3, load.frames, load.mixed)


def _run(command: list[str], file: Path, environment: Mapping[str, str], ceiling: float) -> tuple[str, ...]:
    """A row of the table."""
    words = [*command, "-f", str(file)]
    print(shlex.join(words), file=sys.stderr)
    done = subprocess.run(words, env={**os.environ, **environment}, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"perf_analyzer: expected to measure, got {done.stdout[-1000:]}{done.stderr[-1000:]}")
    measured = next(csv.DictReader(file.open()))
    rate = float(measured["Inferences/Second"])
    compute_us = sum(float(measured[f"Server Compute {part}"]) for part in ("Input", "Infer", "Output"))
    times_us = [float(measured[name]) for name in ("p50 latency", "p99 latency", "Server Queue")]
    return (f"{rate:.0f}", f"{rate / ceiling:.2f}", *(f"{us / US_PER_MS:.1f}" for us in (*times_us, compute_us)))


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
