# SPDX-License-Identifier: MIT
"""Measure on a GPU, in under ten minutes: GPU tests, the bare engine, and served checkpoints.

    gpu.py [--parts tests engine ...] [--checkout FOLDER] [--tiny]

Networks of 4 billion parameters have random weights. Every frame is new, except in rows that say "repeated", whose
frames' features are in the cache. Each measurement is in gpu.json and gpu.md as soon as it is made. Results of earlier
parts and of another checkout stay in these files.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
import traceback
import venv
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import random_checkpoints
import report
import torch
from contestants import DEMO, DEMO_ENCODERS, Contestant, serving
from load import Load
from random_checkpoints import BASE_MODEL, DESCRIBED, QWEN, ROBOMETER, RYNNVALUE
from real_size import FRAMES, FULL, SMALLEST, Scale, described
from report import Row

from rfm.config import ExportConfig

NAME = "gpu"
LIMIT_S = 570  # the rest of ten minutes is for shutting down servers
TESTS_S = 150
SOURCES = ("", "client", "apps/gateway", "apps/labels", "export", "commands")  # package folders in a checkout
NOW, BEFORE = "now", "before"  # run names
# These packages may be installed but compiled for a newer numpy than Triton's Python backend has. transformers uses
# them where they exist, and nothing here needs them.
HIDDEN = ("scipy", "sklearn", "pandas")
KEY = ("what", "way", "graphs", "max_batch_size", "frames", "size", "callers", "repeated")
FIGURES = ("samples_per_s", "failed", "p50_ms", "p99_ms", "device_ms", "tokens", "peak_gib")


class TimeIsUpError(Exception):
    """Raised when the time limit is reached."""


@dataclass(frozen=True)
class Run:
    """Settings that all parts need.

    checkout: folder with the measured packages
    folder: for checkpoints and repositories
    """

    scale: Scale
    checkout: Path
    folder: Path

    @property
    def python(self) -> str:
        """Return a Python that prefers the checkout's packages to its own, created at first use.

        Triton's Python backend ignores PYTHONPATH, but uses the packages belonging to the first python3 in PATH.
        """
        place = self.folder / "venv"
        if not place.exists():
            venv.create(place, symlinks=True)
            (packages,) = place.glob("lib/python3*/site-packages")
            folders = [*(str(self.checkout / source) for source in SOURCES), *filter(os.path.isdir, sys.path[1:])]
            hide = f"import sys; sys.modules.update(dict.fromkeys({HIDDEN}))"
            (packages / "benchmark.pth").write_text("\n".join([hide, *folders]) + "\n")
        return str(place / "bin" / "python3")

    @property
    def num_gpus(self) -> int:
        """GPUs for each server."""
        return 0 if self.scale.device == "cpu" else 1

    def checkpoint(self, kind: str) -> Path:
        """Return a random checkpoint's folder, written at first use."""
        written = self.folder / kind
        if not written.exists():
            random_checkpoints.write(self.folder, kind, self.scale.size, self.scale.device)
        return written


def tests(run: Run) -> Iterator[Row]:
    """Run the tests that need a GPU; with --tiny only collect them."""
    folder = report.ROOT / "tests"
    files = sorted(str(file) for file in folder.rglob("test_*.py") if "@pytest.mark.gpu" in file.read_text())
    words = [run.python, "-m", "pytest", "-m", "gpu", "-n", "0", "-W", "default", *files]
    words += ["--collect-only"] if run.scale.device == "cpu" else []
    alone = {**os.environ, "PYTHONPATH": ""}
    done = subprocess.run(
        words, cwd=report.ROOT, env=alone, capture_output=True, text=True, timeout=TESTS_S, check=False
    )
    print(done.stdout[-6000:], done.stderr[-2000:], flush=True)
    yield {"what": "pytest -m gpu", "result": done.stdout.strip().splitlines()[-1], "status": done.returncode}
    if done.returncode:
        raise RuntimeError(f"pytest -m gpu: expected exit status 0, got {done.returncode}")


def engine(run: Run) -> Iterator[Row]:
    """Measure the bare engine in a separate process."""
    for kind in (ROBOMETER, QWEN, RYNNVALUE):
        run.checkpoint(kind)
    words = [run.python, str(Path(__file__).with_name("real_size.py")), str(run.folder)]
    words += ["--tiny"] if run.scale is SMALLEST else []
    environment = {**os.environ, "PYTHONPATH": ""}
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        try:
            yield from map(json.loads, process.stdout)
        finally:
            process.kill()
    if process.returncode not in (0, -signal.SIGKILL):
        raise RuntimeError(f"real_size.py: expected exit status 0, got {process.returncode}")


def robometer(run: Run, graphs: bool = False) -> Iterator[Row]:
    """Serve Robometer: different caller counts, repeated frames, large frames."""
    scale, (one, some, many) = run.scale, run.scale.callers
    settings = {"base_model": str(BASE_MODEL), **({"cuda_graphs": True} if graphs else {})}
    asked = [(n, FRAMES, scale.small_px, False) for n in (one, many, some)]
    asked += [(many, FRAMES, scale.usual_px, False)]
    asked += [] if graphs else [(one, FRAMES, scale.usual_px, False), (many, FRAMES, scale.small_px, True)]
    yield from served(run, "Robometer", run.checkpoint(ROBOMETER), settings, asked, graphs=graphs)


def graphs(run: Run) -> Iterator[Row]:
    """Serve Robometer with CUDA graphs on a GPU, if the export knows the setting."""
    if run.scale.device != "cpu" and "cuda_graphs" in {field.name for field in fields(ExportConfig)}:
        yield from robometer(run, graphs=True)


def batches(run: Run) -> Iterator[Row]:
    """Serve Robometer with larger batches than the export chooses."""
    _, some, many = run.scale.callers
    for most in (some, many):
        settings = {"base_model": str(BASE_MODEL), "max_batch_size": most}
        asked = [(n, FRAMES, run.scale.small_px, False) for n in (some, many)]
        for row in served(run, "Robometer", run.checkpoint(ROBOMETER), settings, asked):
            yield {**row, "max_batch_size": most}


def encoders(run: Run) -> Iterator[Row]:
    """Serve the demo's ReWiND with encoders on raw frames, both distinct and repeated."""
    _, some, many = run.scale.callers
    asked = [(n, FRAMES, run.scale.small_px, repeated) for repeated in (False, True) for n in (some, many)]
    checkpoint = DEMO / "rfm" / "1" / "checkpoint"
    yield from served(run, "ReWiND with encoders", checkpoint, DEMO_ENCODERS, asked)


def topreward(run: Run) -> Iterator[Row]:
    """Serve TOPReward: one caller with a long episode."""
    asked = [(run.scale.callers[0], run.scale.many_frames, run.scale.small_px, False)]
    yield from served(run, "topreward", run.checkpoint(QWEN), {"reward_model": "topreward"}, asked)


def roboreward(run: Run) -> Iterator[Row]:
    """Serve RoboReward, which writes an answer."""
    asked = [(n, FRAMES, run.scale.usual_px, False) for n in run.scale.callers[:2]]
    yield from served(run, "roboreward", run.checkpoint(QWEN), {"reward_model": "roboreward"}, asked)


def rynnvalue(run: Run) -> Iterator[Row]:
    """Serve RynnValue, if the checkout describes robots at export."""
    if "robot_description" in (run.checkout / "rfm" / "config.py").read_text():
        asked = [(n, FRAMES, run.scale.small_px, False) for n in run.scale.callers]
        yield from served(run, "rynnvalue", run.checkpoint(RYNNVALUE), DESCRIBED, asked)


def served(
    run: Run,
    what: str,
    checkpoint: Path,
    settings: Mapping[str, Any],
    asked: Sequence[tuple[int, int, tuple[int, int], bool]],
    *,
    graphs: bool = False,
) -> Iterator[Row]:
    """Export, serve and measure a checkpoint.

    asked: callers, frames, height and width, whether frames are repeated
    """
    with TemporaryDirectory(dir=run.folder) as name:
        server = _grpc_of(run, checkpoint, Path(name), {**settings, "num_gpus": run.num_gpus})
        with Contestant("gRPC", server, (0, 0)) as contestant:
            for callers, frames, px, repeated in asked:
                load = Load(callers, run.scale.seconds, (frames, frames), frame_px=px, repeated=repeated)
                told = contestant.measure(_warmed(load, run.scale))
                figures = {name: told[name] for name in FIGURES if name in told}
                of = described(px, frames, callers, repeated=repeated)
                yield {"what": what, "way": "served", "graphs": graphs, **of, **figures}


def _warmed(load: Load, scale: Scale) -> Load:
    return Load(**{**vars(load), "warm_up_s": scale.warm_up_s})


@contextmanager
def _grpc_of(run: Run, checkpoint: Path, place: Path, settings: Mapping[str, Any]) -> Iterator[str]:
    began_s = time.perf_counter()
    with serving(checkpoint, place, settings, run.python) as addresses:
        print(f"exported and ready in {time.perf_counter() - began_s:.0f} s", flush=True)
        yield addresses["grpc"]


PARTS: dict[str, Callable[[Run], Iterator[Row]]] = {
    part.__name__: part
    for part in (tests, engine, robometer, graphs, batches, encoders, topreward, roboreward, rynnvalue)
}


@dataclass(frozen=True)
class Aim:
    """A figure that should be at least, or at most, ``limit``.

    of: columns that identify the row
    beside: columns that identify the row to divide by; None: no division
    """

    title: str
    column: str
    limit: float
    of: Row
    beside: Row | None = None
    at_most: bool = False


def aims(scale: Scale) -> list[Aim]:
    """Return the aims for an H100 or H200."""
    one, some, many = scale.callers
    small, usual = (f"{px[0]}x{px[1]}" for px in (scale.small_px, scale.usual_px))
    lone = {"what": "Robometer", "way": "served", "size": small, "callers": one, "repeated": False}
    full, large = {**lone, "callers": many}, {**lone, "callers": many, "size": usual}
    encoded = {**full, "what": "ReWiND with encoders"}
    asked = {"way": "served", "callers": one}
    rate, p50 = "samples_per_s", "p50_ms"
    return [
        Aim(f"Robometer, {small}, one caller, p50 ms", p50, 25, lone, at_most=True),
        Aim(f"Robometer, {small}, {many} callers, samples/s", rate, 100, full),
        Aim(f"Robometer, {small}, {many} callers, beside the engine", rate, 0.95, full, {**full, "way": "engine"}),
        Aim(f"Robometer, {usual}, {many} callers, samples/s", rate, 20, large),
        Aim("TOPReward, 64 frames, p50 ms", p50, 300, {**asked, "what": "topreward"}, at_most=True),
        Aim("RoboReward, one caller, p50 ms", p50, 150, {**asked, "what": "roboreward"}, at_most=True),
        Aim(f"Encoders, {many} callers beside {some}", rate, 1, encoded, {**encoded, "callers": some}),
    ]


def figure(aim: Aim, rows: Sequence[Row], graphs: bool) -> float | None:
    """Return the figure for an aim; None: not measured. Without a divisor measured with graphs, use the plain one."""
    found = _row(rows, {**aim.of, "graphs": graphs})
    if found is None:
        return None
    if aim.beside is None:
        return float(found[aim.column])
    beside = _row(rows, {**aim.beside, "graphs": graphs}) or _row(rows, {**aim.beside, "graphs": False})
    return None if beside is None else float(found[aim.column] / beside[aim.column])


def _row(rows: Sequence[Row], of: Row) -> Row | None:
    of = {"max_batch_size": None, **of}
    return next((row for row in rows if all(row.get(name) == value for name, value in of.items())), None)


class Results:
    """Writes gpu.json and gpu.md to a folder. A measurement replaces an earlier one from the same run."""

    def __init__(self, folder: Path, name: str, scale: Scale) -> None:
        self._folder, self._name, self._scale = folder, name, scale
        file = folder / f"{NAME}.json"
        self._runs: dict[str, Any] = json.loads(file.read_text()).get("runs", {}) if file.exists() else {}
        self._runs.setdefault(name, {"rows": []})

    def about(self, told: Mapping[str, Any]) -> None:
        """Record the machine used in this run."""
        self._runs[self._name]["machine"] = told

    def add(self, row: Row) -> None:
        """Write a measurement into both files."""
        of = {name: row.get(name) for name in KEY}
        kept = [old for old in self._runs[self._name]["rows"] if {name: old.get(name) for name in KEY} != of]
        self._runs[self._name]["rows"] = [*kept, row]
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / f"{NAME}.json").write_text(json.dumps({"runs": self._runs}, indent=1) + "\n")
        (self._folder / f"{NAME}.md").write_text(self.text())

    def text(self) -> str:
        """Return the text for gpu.md."""
        return "\n".join(self._lines()) + "\n"

    def _lines(self) -> Iterator[str]:
        yield from ("# On a GPU", "")
        for name, run in self._runs.items():
            told = ", ".join(f"{key} {value}" for key, value in run.get("machine", {}).items())
            yield f"- **{name}**: {told}."
            yield from (f"- {row['what']}: {row['result']}" for row in run["rows"] if "result" in row)
        yield from (
            "",
            "By `make gpu`. Random weights; new frames in each call, unless repeated. RoboReward writes `ANSWER: 4`.",
            "Engine: batches of as many samples as callers, without a server.",
        )
        yield from ("", "## Aims", "", *self._aims())
        for name, run in self._runs.items():
            rows = [row for row in run["rows"] if "way" in row]
            yield from ("", f"## Measurements: {name}", "", *_table(rows))

    def _aims(self) -> Iterator[str]:
        columns = {
            f"{name}{', CUDA graphs' * graphs}": (run["rows"], graphs)
            for name, run in self._runs.items()
            for graphs in (False, True)
            if any(figure(aim, run["rows"], graphs) is not None for aim in aims(self._scale))
        }
        yield f"| figure | aim | {' | '.join(columns)} |"
        yield "|---" * (2 + len(columns)) + "|"
        for aim in aims(self._scale):
            cells = [_judged(aim, figure(aim, *column)) for column in columns.values()]
            yield f"| {aim.title} | {'<=' if aim.at_most else '>='} {aim.limit:g} | {' | '.join(cells)} |"


def _judged(aim: Aim, value: float | None) -> str:
    if value is None:
        return "not measured"
    is_met = value <= aim.limit if aim.at_most else value >= aim.limit
    return f"{value:.3g}, {'met' if is_met else 'missed'}"


def _table(rows: Sequence[Row]) -> Iterator[str]:
    yield f"| {' | '.join([*KEY, *FIGURES])} |"
    yield "|---" * (len(KEY) + len(FIGURES)) + "|"
    for row in rows:
        yield f"| {' | '.join(_cell(row.get(name)) for name in (*KEY, *FIGURES))} |"


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else ""
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def about(checkout: Path, device: str) -> dict[str, Any]:
    """Return a run's device, packages, commit and date."""
    told = report.machine()
    marked = checkout / "COMMIT" if checkout != report.ROOT else report.ROOT / "build" / "gpu" / "COMMIT"
    commit = told["commit"] if checkout == report.ROOT else ""
    commit = commit or (marked.read_text().strip() if marked.exists() else "unknown")
    name = torch.cuda.get_device_name() if device == "cuda" else told["cpu"]
    return {"device": name, "torch": torch.__version__, "cores": told["cores"], "commit": commit, "date": told["date"]}


def measure(run: Run, parts: Sequence[str], results: Results, limit_s: int) -> list[str]:
    """Run the parts until the limit, and return those that failed. The others still run."""
    failed: list[str] = []
    began_s = time.perf_counter()
    signal.signal(signal.SIGALRM, _up)
    signal.alarm(limit_s)
    for name in parts:
        try:
            for row in PARTS[name](run):
                print(f"{time.perf_counter() - began_s:4.0f} s {name}: {json.dumps(row)}", flush=True)
                results.add(row)
        except TimeIsUpError:
            return [*failed, *parts[parts.index(name) :]]
        except Exception:  # noqa: BLE001  the other parts are measured
            traceback.print_exc()
            failed.append(name)
    signal.alarm(0)
    return failed


def _up(*_: object) -> None:
    raise TimeIsUpError


def main() -> None:
    """Measure, then exit with an error that names the parts that failed or ran out of time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--checkout", type=Path, help="measure the packages of another checkout, as the run 'before'")
    parser.add_argument("--tiny", action="store_true", help="tiny networks on the CPU: shows that the program runs")
    parser.add_argument("--limit-s", type=int, default=LIMIT_S, help=f"stop after these seconds (default: {LIMIT_S})")
    parser.add_argument("--output", type=Path, default=report.OUTPUT, help="folder for the results")
    arguments = parser.parse_args()
    sys.modules.update(dict.fromkeys(HIDDEN))  # type: ignore[arg-type]  # None: an import says that there is none
    scale, checkout = SMALLEST if arguments.tiny else FULL, arguments.checkout
    if scale.device == "cuda" and not torch.cuda.is_available():
        parser.error(f"expected a GPU, got none by PyTorch {torch.__version__}; --tiny runs on the CPU")
    parts = [name for name in arguments.parts if checkout is None or name not in ("tests", "graphs")]
    results = Results(arguments.output, NOW if checkout is None else BEFORE, scale)
    checkout = (checkout or report.ROOT).resolve()
    results.about(about(checkout, scale.device))
    with TemporaryDirectory(prefix="rfm-gpu-") as folder:
        failed = measure(Run(scale, checkout, Path(folder)), parts, results, arguments.limit_s)
    print(results.text())
    if failed:
        sys.exit(f"failed or without time: {', '.join(failed)}")


if __name__ == "__main__":
    main()
