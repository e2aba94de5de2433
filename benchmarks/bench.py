# SPDX-License-Identifier: MIT
"""This server, the bare engine and what one would take instead: same weights, same samples, one run.

    python benchmarks/bench.py            # eight minutes
    python benchmarks/bench.py --full     # all loads, half an hour

Rounds are interleaved: in each, every contestant is measured once, so that a machine that drifts hits all alike; ratios
within a round are what is compared. Writes JSON, Markdown and pictures.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory

import report
import torch
from contestants import PEER_SCRIPTS, BareEngine, Callers, Checkpoint, contestants
from load import SHARED_MEMORY, Load
from rich.console import Console

import rfm_export
from rfm.config import ExportConfig
from rfm.rewind.checkpoint import RewindCheckpoint
from rfm.rewind.network import RewindConfig, RewindTransformer
from rfm_commands.config import Config

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DEMO = ROOT / "model_repository"
BARE = "bare engine"
BARE_BATCH_SIZES = (1, 8, 32)
PEERS = tuple(PEER_SCRIPTS)
UNIFORM, MIXED, AS_LONG_AS_MIXED = (16, 16), (1, 16), (8, 9)
PACKAGES = ("torch", "numpy", "tritonclient", "nvidia-pytriton", "fastapi", "uvicorn", "litserve", "mosec")

DEFAULT_SIZE = RewindConfig(  # upstream's defaults
    video_feature_dim=768,
    text_feature_dim=384,
    hidden_dim=512,
    num_layers=4,
    num_attention_heads=8,
    max_len=16,
    causal_mask=True,
    use_per_frame_progress_token=True,
    progress_bins=10,
    has_similarity=True,
)


@dataclass(frozen=True)
class Scenario:
    """A load, and who takes it; ways: those of this server; peers: all, or none (they cannot, or it tells no more)"""

    name: str
    load: Load
    ways: tuple[str, ...] = ("gRPC",)
    with_peers: bool = False


QUICK = (
    Scenario("1 caller", Load(1, 0, UNIFORM), ("gRPC",), with_peers=True),
    Scenario("32 callers", Load(32, 0, UNIFORM), ("gRPC", "gateway"), with_peers=True),
    Scenario("32 callers, 8 or 9 frames", Load(32, 0, AS_LONG_AS_MIXED)),
    Scenario("32 callers, 1 to 16 frames, all types", Load(32, 0, MIXED, mixed=True)),
)
FULL = (
    *QUICK,
    Scenario("8 callers", Load(8, 0, UNIFORM), ("gRPC", "HTTP", SHARED_MEMORY, "gateway"), with_peers=True),
    Scenario("128 callers", Load(128, 0, UNIFORM), ("gRPC", "HTTP", SHARED_MEMORY, "gateway"), with_peers=True),
    Scenario("2 callers, 32 samples each", Load(2, 0, UNIFORM, together=32), ("gRPC", "gateway"), with_peers=True),
    Scenario("8 callers, 8 raw frames of 256 x 256", Load(8, 0, (8, 8), frame_px=256), ("gRPC", "HTTP", SHARED_MEMORY)),
    Scenario("Poisson, half of the bare engine's rate", Load(0, 0, UNIFORM, rate_per_s=0.5), with_peers=True),
)


def main() -> None:
    """Measures, writes and shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="all loads")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement")
    parser.add_argument("--sizes", nargs="+", default=["default", "small"], choices=["default", "small"])
    parser.add_argument("--threads", type=int, default=0, help="of torch, in every server; 0: torch's choice")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder for the results")
    arguments = parser.parse_args()

    threads = arguments.threads or torch.get_num_threads()
    torch.set_num_threads(threads)
    scenarios = FULL if arguments.full else QUICK
    console = Console()
    rows: list[dict[str, object]] = []
    with TemporaryDirectory(prefix="rfm-bench-") as folder:
        for size in arguments.sizes:
            measured = checkpoint(size, Path(folder), threads)
            bare = BareEngine(measured)
            with contestants(measured, bare.widths, PEERS, Path(folder) / "logs") as callers:
                for scenario in scenarios:
                    if scenario.load.frame_px and measured.encoders is None:
                        continue
                    load = replace(scenario.load, seconds=arguments.seconds)
                    rows += _rounds(size, replace(scenario, load=load), bare, callers, arguments.rounds, console)
    of_run = {"threads": threads, "rounds": arguments.rounds, "seconds": arguments.seconds}
    results = {"machine": machine(), **of_run, "measurements": rows}
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    report.write(results, arguments.output)
    console.print(f"{arguments.output}: results.json, results.md and pictures")


def _rounds(
    size: str,
    scenario: Scenario,
    bare: BareEngine,
    callers: Mapping[str, Callers],
    rounds: int,
    console: Console,
) -> list[dict[str, object]]:
    """A row a measurement."""
    ours = ("gRPC", "HTTP", SHARED_MEMORY, "gateway")
    ways = [way for way in callers if way in scenario.ways or (scenario.with_peers and way not in ours)]
    batch_sizes = (1,) if scenario.load.callers == 1 else BARE_BATCH_SIZES
    load = scenario.load
    rows = []
    for number in range(rounds):
        measured = {f"{BARE}, batch {batch}": bare.measure(replace(load, rate_per_s=0), batch) for batch in batch_sizes}
        if scenario.load.rate_per_s:  # a share of what the engine could do just now
            best = max(each.samples_per_s for each in measured.values())
            load = replace(scenario.load, rate_per_s=scenario.load.rate_per_s * best)
        measured |= {way: callers[way].measure(load) for way in ways}
        rows += [
            {"size": size, "scenario": scenario.name, "round": number, "way": way, **asdict(each)}
            for way, each in measured.items()
        ]
        told = ", ".join(f"{way} {each.samples_per_s:.0f}" for way, each in measured.items())
        console.print(f"{size}, {scenario.name}, round {number + 1}: {told} samples/s", highlight=False)
    return rows


def checkpoint(size: str, folder: Path, threads: int) -> Checkpoint:
    """The demo's, served as it is there, or one of the default size with random weights."""
    repository = folder / f"repository_{size}"
    if size == "small":
        versions = DEMO / "rfm" / "1", DEMO / "rfm_encoder" / "1"
        source, encoders = versions[0] / "checkpoint", (versions[1] / "image_encoder", versions[1] / "text_encoder")
        images, texts = map(str, encoders)
        settings = replace(Config.from_yaml(DEMO / "serve.yaml").export, image_encoder=images, text_encoder=texts)
    else:
        torch.manual_seed(0)
        source, encoders = folder / size, None
        RewindCheckpoint(DEFAULT_SIZE, RewindTransformer(DEFAULT_SIZE).state_dict()).save(source)
        settings = ExportConfig(num_gpus=0, torch_threads=threads)
    rfm_export.export(source, repository, settings)
    return Checkpoint(size, source, repository, settings.instances or 1, settings.torch_threads, encoders)


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


if __name__ == "__main__":
    main()
