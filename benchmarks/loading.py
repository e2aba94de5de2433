# SPDX-License-Identifier: MIT
"""How much memory of the host it takes to load a vision-language checkpoint, beside the size of its weights.

    python benchmarks/loading.py            # two minutes, 9 GB of memory, 4 GB of disk

The checkpoint has random weights: a Qwen3-VL of 0.6B parameters in bfloat16. It is loaded in bfloat16, as for a GPU,
and in float32, as for the CPU (twice the bytes), and exported, with verification on the CPU. Each runs in a process of
its own. A peak is VmHWM, less that of a process that loads the tiny checkpoint of the tests. It holds the pages of the
mapped file, too, which the kernel may take back. Writes loading.json and loading.md.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from bench import RESULTS, ROOT, machine
from random_vlm_checkpoint import write
from rich.console import Console

import rfm_export
from rfm import families
from rfm.config import ExportConfig
from rfm.engine import Engine

CASE = ROOT / "tests" / "golden" / "vlm"
TINY, BASE = CASE / "q3_tok_disc10" / "checkpoint", CASE / "bases" / "q3"
LAYERS = 3
LOADS = {"bfloat16": torch.bfloat16, "float32": torch.float32}
EXPORT = "export"


def main() -> None:
    """Measures, writes and shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder for the results")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)  # what it is, and the checkpoint: prints the peak
    arguments = parser.parse_args()
    if arguments.one:
        print(_peak_bytes(arguments.one[0], Path(arguments.one[1])))
        return
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = Path(folder) / "checkpoint"
        write(checkpoint, str(BASE), LAYERS)
        size = (checkpoint / "model.safetensors").stat().st_size
        peaks = {what: _in_a_process(what, checkpoint) - _in_a_process(what, TINY) for what in (*LOADS, EXPORT)}
    results = {"machine": machine(), "weights_bytes": size, "peak_bytes": peaks}
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "loading.json").write_text(json.dumps(results, indent=1) + "\n")
    text = _markdown(size, peaks)
    (arguments.output / "loading.md").write_text(text)
    Console().print(text, highlight=False)


def _in_a_process(what: str, checkpoint: Path) -> int:
    done = subprocess.run(
        [sys.executable, __file__, "--one", what, str(checkpoint)], stdout=subprocess.PIPE, text=True, check=True
    )
    return int(done.stdout.splitlines()[-1])


def _peak_bytes(what: str, checkpoint: Path) -> int:
    """The most memory that this process has had at a time, after what it is to do."""
    if what == EXPORT:
        with tempfile.TemporaryDirectory(dir=checkpoint.parent) as repository:
            settings = ExportConfig(base_model=str(BASE), num_gpus=0)
            rfm_export.export(checkpoint, Path(repository) / "repository", settings)
    else:
        engine = Engine.of(families.load(checkpoint, base_model=str(BASE)), dtype=LOADS[what])
        for weights in engine.predictor.network.parameters():
            weights.sum()  # reads it from the file, as copying it to a GPU does
    (peak_kib,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(peak_kib) * 1024


def _markdown(size: int, peaks: dict[str, int]) -> str:
    lines = [
        "# Memory to load a vision-language checkpoint",
        "",
        f"Peak memory of the host, for weights of {size / 2**20:.0f} MiB (bfloat16).",
        "",
        "| what | peak, MiB | peak over the weights' size |",
        "|---|---|---|",
    ]
    lines += [f"| {what} | {peak / 2**20:.0f} | {peak / size:.2f} |" for what, peak in peaks.items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
