# SPDX-License-Identifier: MIT
"""``make mutate``: do the tests see small faults? Some of all mutants of the code that scores come from are tried.

Each worker has a copy of the repository, and forks for each mutant: what the tests import from elsewhere is loaded once.
A mutant that fails a test, or takes much longer than the code as it is, is caught. Why others survive stands in
``mutants_that_survive.yaml``.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from queue import SimpleQueue

import yaml

from mutants import Mutant, mutants
from paths import ROOT

SURVIVORS = Path(__file__).with_name("mutants_that_survive.yaml")
WORKER = Path(__file__).with_name("mutation_worker.py").name
CAUGHT = 0.95  # of the mutants, at least
BASELINE_S = 1800.0  # for the tests of the code as it is
PATIENCE_S = 60.0  # beyond three times what they took
# Files whose mutants are tried, and the tests of each: the first that fails is enough.
TESTS: dict[str, tuple[str, ...]] = {
    "rfm/dense_mode.py": ("test_rewind",),
    "rfm/layers/linear.py": ("test_linear",),
    "rfm/layers/precision.py": ("test_precision",),
    "rfm/layers/*.py": ("test_rewind",),
    "rfm/rewind/collator.py": ("test_rewind", "test_properties"),
    "rfm/rewind/encoders.py": ("test_encoders", "test_feature_cache"),
    "rfm/rewind/predictor.py": ("test_rewind", "test_encoders"),
    "rfm/rewind/preprocessing.py": ("test_encoders",),
    "rfm/rewind/pretrained.py": ("test_encoders",),
    "rfm/rewind/checkpoint.py": ("test_checkpoint", "test_hostile_files", "test_properties", "test_export"),
    "rfm/rewind/*.py": ("test_rewind",),
    "rfm/vlm/images.py": ("test_vlm", "test_vlm_network", "test_frame_size", "test_encoders"),
    "rfm/vlm/checkpoint.py": ("test_vlm_checkpoint", "test_vlm", "test_hostile_files", "test_properties"),
    "rfm/vlm/lora.py": ("test_vlm", "test_vlm_checkpoint", "test_hostile_files"),
    "rfm/vlm/film.py": ("test_vlm_network", "test_shot_cache", "test_vlm"),
    "rfm/vlm/shots.py": ("test_shot_cache", "test_vlm"),
    "rfm/vlm/*.py": ("test_vlm", "test_vlm_network", "test_vlm_checkpoint", "test_shot_cache"),
    "rfm/families.py": ("test_checkpoint", "test_family", "test_vlm", "test_vlm_checkpoint"),
    "rfm/predictor.py": ("test_rewind", "test_vlm"),
    "rfm/embedding.py": ("test_encoders",),
    "rfm/feature_cache.py": ("test_feature_cache", "test_shot_cache"),
    "rfm/checkpoint/digest.py": ("test_export",),
    "rfm/checkpoint/training.py": ("test_checkpoint", "test_export"),
    "rfm/checkpoint/*.py": (
        "test_checkpoint",
        "test_hostile_files",
        "test_properties",
        "test_vlm",
        "test_vlm_checkpoint",
    ),
    "client/rfm_client/contract/wire/*.py": ("test_wire", "test_samples", "test_properties"),
    "rfm/triton_model/batch_model.py": ("test_batch_model", "test_pipeline", "test_logs"),
    "rfm/triton_model/guard.py": ("test_guard",),
    "rfm/triton_model/pipeline.py": ("test_pipeline",),
    "rfm/triton_model/request.py": ("test_batch_model", "test_pipeline"),
}


def main() -> int:
    """Prints what survives; 1 if that is too much or without a reason."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=220, help="mutants to try")
    parser.add_argument("--seed", type=int, default=0, help="which ones")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", default="*", help="of those only the ones in files of this pattern")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # and what was started is ended
    chosen = choose(list(every_mutant()), options.count, options.seed)
    chosen = [mutant for mutant in chosen if Path(mutant.file).match(options.only)]
    survivors = [mutant for mutant, is_caught in tried(chosen, options.workers) if not is_caught]
    reasons = known_reasons()
    print(f"\n{len(chosen)} mutants, {len(chosen) - len(survivors)} caught; survivors:")
    for mutant in survivors:
        print(f"{mutant}\n    {reasons.get(mutant.key, 'NO REASON KNOWN')}")
    unexplained = sum(mutant.key not in reasons for mutant in survivors)
    return int(unexplained > 0 or len(chosen) - len(survivors) < CAUGHT * len(chosen))


def every_mutant() -> Iterator[Mutant]:
    """Of all files that TESTS names."""
    files = sorted({file for pattern in TESTS for file in ROOT.glob(pattern)})
    for file in (file.relative_to(ROOT) for file in files):
        yield from mutants(str(file), (ROOT / file).read_text())


def choose(everything: Sequence[Mutant], count: int, seed: int) -> list[Mutant]:
    """As many of each file as its share, at least one."""
    files: dict[str, list[Mutant]] = {}
    for mutant in everything:
        files.setdefault(mutant.file, []).append(mutant)
    chosen = []
    for file, of_file in files.items():
        share = max(1, round(count * len(of_file) / len(everything)))
        chosen += random.Random(f"{seed} {file}").sample(of_file, min(share, len(of_file)))
    return chosen


def known_reasons() -> dict[tuple[object, ...], str]:
    """Why a mutant survives, by its key."""
    entries = yaml.safe_load(SURVIVORS.read_text()) or []
    return {(e["file"], e["in"], e["before"], e["after"], e.get("nth", 1)): e["why"] for e in entries}


def tests_of(file: str) -> list[str]:
    """Names of test files: of the first pattern that fits."""
    names = next(names for pattern, names in TESTS.items() if Path(file).match(pattern))
    return [str(file.relative_to(ROOT)) for name in names for file in ROOT.glob(f"tests/*/{name}.py")]


def tried(chosen: Sequence[Mutant], workers: int) -> Iterator[tuple[Mutant, bool]]:
    """Each mutant, and whether it was caught."""
    with tempfile.TemporaryDirectory(prefix="rfm-mutate-") as folder, ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(workers))
        idle: SimpleQueue[Worker] = SimpleQueue()
        for number in range(workers):
            worker = Worker(Path(folder, str(number)))
            stack.callback(worker.close)
            idle.put(worker)

        def baseline_s(test: str) -> float:
            with lent(idle) as worker:
                code, took_s = worker.code_of([test], None, BASELINE_S)
                print(f"{took_s:5.1f} s {test} without a mutant", flush=True)
                if code != 0:
                    raise RuntimeError(f"{test}: expected to pass without a mutant, got:\n{worker.last_words}")
            return took_s

        def is_caught(mutant: Mutant) -> bool:
            tests = tests_of(mutant.file)
            with lent(idle) as worker:
                code, took_s = worker.code_of(tests, mutant, PATIENCE_S + 3 * sum(usual_s[test] for test in tests))
            print(f"{took_s:5.1f} s {'caught' if code != 0 else 'SURVIVES'} {mutant}", flush=True)
            return code != 0

        needed = sorted({test for mutant in chosen for test in tests_of(mutant.file)})
        usual_s = dict(zip(needed, pool.map(baseline_s, needed), strict=True))
        yield from zip(chosen, pool.map(is_caught, chosen), strict=True)


@contextmanager
def lent(idle: SimpleQueue[Worker]) -> Iterator[Worker]:
    """One that has nothing to do."""
    worker = idle.get()
    try:
        yield worker
    finally:
        idle.put(worker)


class Worker:
    """A copy of the working tree with a virtual environment of its own, and a process in it that runs tests."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout
        for name in filter(None, names.decode().split("\0")):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
        python = self._virtual_environment()
        (folder / "tmp").mkdir()
        own = {"TMPDIR": str(folder / "tmp"), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [python, folder / "tools" / "mutation" / WORKER],
            cwd=folder,
            env={**os.environ, **own, "OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def _virtual_environment(self) -> Path:
        """One that imports this copy, and all else from the environment that this runs in."""
        place = self._folder / ".venv"
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", place], check=True)
        (packages,) = place.glob("lib/python*/site-packages")
        others = next(path for path in sys.path if path.endswith("site-packages"))
        own = (
            self._folder,
            *(
                self._folder / name
                for name in (
                    "client",
                    "gateway",
                    "export",
                    "commands",
                    "tests/support",
                    "tools/faults",
                    "tools/mutation",
                )
            ),
        )
        imported = (*own, others)
        (packages / "mutated.pth").write_text("".join(f"{path}\n" for path in imported))
        for script in ("rfm", "rfm-client"):
            original = Path(sys.executable).with_name(script).read_text().partition("\n")
            (place / "bin" / script).write_text(f"#!{place}/bin/python3\n{original[2]}")
            (place / "bin" / script).chmod(0o755)
        return place / "bin" / "python3"

    def code_of(self, tests: Sequence[str], mutant: Mutant | None, limit_s: float) -> tuple[int, float]:
        """What pytest says of the tests, and how long that took."""
        assert self._process.stdin is not None and self._process.stdout is not None
        started_s = time.monotonic()
        changed = {mutant.file: mutant.content} if mutant is not None else {}
        job = {"changed": changed, "tests": tests, "limit_s": limit_s}
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline()), time.monotonic() - started_s

    @property
    def last_words(self) -> str:
        """The end of what pytest printed last."""
        return (self._folder / "tmp" / "tests.log").read_text(errors="replace")[-3000:]

    def close(self) -> None:
        """Ends the process and all that its tests have started."""
        self._process.terminate()
        self._process.wait()


if __name__ == "__main__":
    sys.exit(main())
