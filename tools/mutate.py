# SPDX-License-Identifier: MIT
"""``make mutate``: test whether the tests catch small faults in the code that computes scores. Uses cosmic-ray.

Tries the same random share of each part's mutants, in a clone of the last commit. Ends with status 1 if the tests
catch fewer than 95 %: some mutants are equivalent.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import WorkerOutcome, WorkItem, WorkResult

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
CAUGHT = 0.95
VISION_LANGUAGE = (
    "families/test_vlm*.py families/test_rounded.py families/test_adapters.py"
    " families/test_refused_checkpoints.py families/test_wrong_inputs.py families/test_tree.py families/test_shot_cache.py"
    " families/test_frame_threads.py families/test_rynnvalue.py families/test_topreward.py families/test_roboreward.py"
    " families/test_lerobot_robometer.py export/test_provenance.py"
)
# Files to mutate, and their tests: at least one test must fail.
PARTS = {
    "client/rfm_client/contract/wire/*.py": "contract/test_*.py families/test_properties.py",
    "rfm/engine/layers.py": "families/test_layers.py families/test_rewind.py families/test_encoders.py",
    "rfm/families/rewind/*.py": "families/test_rewind.py families/test_*encoders.py families/test_checkpoint.py"
    " families/test_missing_heads.py families/test_adapters.py families/test_refused_checkpoints.py"
    " families/test_wrong_inputs.py export/test_provenance.py",
    "rfm/qwen/*.py": VISION_LANGUAGE,
    "rfm/families/robometer/*.py": VISION_LANGUAGE,
    "rfm/published/*.py": f"{VISION_LANGUAGE} families/test_checkpoint.py families/test_missing_heads.py"
    " families/test_robodopamine.py families/test_hub.py families/test_usual_encoders.py export/test_export.py",
    "rfm/triton_model/batch_model.py": "triton/test_batch_model.py triton/test_pipeline.py",
    "rfm/triton_model/pipeline.py": "triton/test_pipeline.py",
    "client/rfm_client/scoring/batching.py": "contract/test_samples.py client/test_client_servers.py",
}
CONFIG = """
[cosmic-ray]
module-path = {modules}
timeout = 900.0
excluded-modules = []
test-command = "{pytest} -x -q -p no:cacheprovider -m 'not triton and not slow and not gpu and not nightly' {tests}"

[cosmic-ray.distributor]
name = "local"

[cosmic-ray.filters.operators-filter]
exclude-operators = ["core/ReplaceBinaryOperator_BitOr_.*", "core/RemoveDecorator", "core/ExceptionReplacer"]
"""  # "|" occurs in annotations


def start(pattern: str, folder: Path) -> Path:
    """Clone the repository, with a cosmic-ray session for a part's mutants. Raises RuntimeError if no file matches."""
    subprocess.run(["git", "clone", "--quiet", "--shared", ROOT, folder], check=True)
    modules = [str(file.relative_to(folder)) for file in sorted(folder.glob(pattern)) if file.name != "__init__.py"]
    if not modules:
        raise RuntimeError(f"{pattern}: expected files, got none")
    pytest = ROOT / ".venv" / "bin" / "pytest"
    tests = (str(file) for name in PARTS[pattern].split() for file in sorted((folder / "tests").glob(name)))
    (folder / "mutate.toml").write_text(CONFIG.format(modules=modules, pytest=pytest, tests=" ".join(tests)))
    run(folder, "cosmic-ray", "init", "mutate.toml", "mutants.sqlite")
    run(folder, "cr-filter-operators", "mutants.sqlite", "mutate.toml")
    return folder


def run(folder: Path, program: str, *words: str) -> str:
    """Run a cosmic-ray program, and return its output. Tests import packages from the clone."""
    imported = [
        folder / name
        for name in (".", "client", "apps/gateway", "apps/labels", "apps/page", "apps/rl", "export", "commands")
    ]
    own = {"PYTHONPATH": os.pathsep.join(map(str, imported)), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    words = (str(BIN / program), *words)
    return subprocess.run(
        words, cwd=folder, env={**os.environ, **own}, check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def sample(folder: Path, database: WorkDB, share: float, seed: int) -> None:
    """Skip mutants in assert and raise statements, and all but a random share of the rest."""
    pending: list[WorkItem] = list(database.pending_work_items)
    sources = {
        path: (folder / path).read_text().splitlines() for path in {one.mutations[0].module_path for one in pending}
    }
    chosen = {
        one.job_id
        for one in pending
        if not sources[(mutation := one.mutations[0]).module_path][mutation.start_pos[0] - 1]
        .lstrip()
        .startswith(("assert ", "raise "))
    }
    chosen = set(random.Random(seed).sample(sorted(chosen), max(1, round(share * len(chosen)))))
    skipped = WorkResult(output="not chosen", worker_outcome=WorkerOutcome.SKIPPED)
    database.set_multiple_results([one.job_id for one in pending if one.job_id not in chosen], skipped)


def main() -> int:
    """Print surviving mutants. Returns 1 if too many survive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="mutants to try")
    parser.add_argument("--seed", type=int, default=0, help="which ones")
    parser.add_argument("--part", choices=PARTS, help="of this part alone")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rfm-mutate-") as name, ThreadPoolExecutor(2) as pool:
        patterns = [arguments.part] if arguments.part else list(PARTS)
        folders = [start(pattern, Path(name) / str(number)) for number, pattern in enumerate(patterns)]
        databases = [folder / "mutants.sqlite" for folder in folders]
        counts = []
        for database in databases:
            with use_db(str(database)) as work:
                counts.append(len(list(work.pending_work_items)))
        for folder, database in zip(folders, databases, strict=True):
            with use_db(str(database)) as work:
                sample(folder, work, arguments.count / sum(counts), arguments.seed)
        list(pool.map(lambda folder: run(folder, "cosmic-ray", "exec", "mutate.toml", "mutants.sqlite"), folders))
        tried = survived = 0
        for pattern, folder, database in zip(patterns, folders, databases, strict=True):
            print(
                f"# {pattern}", run(folder, "cr-report", "--surviving-only", "--show-diff", "mutants.sqlite"), sep="\n"
            )
            with use_db(str(database)) as work:
                results = [result for _, result in work.results if result.worker_outcome != WorkerOutcome.SKIPPED]
            tried += len(results)
            survived += sum(not result.is_killed for result in results)
    print(f"{tried} mutants, {tried - survived} caught")
    return int(tried - survived < CAUGHT * tried)


if __name__ == "__main__":
    sys.exit(main())
