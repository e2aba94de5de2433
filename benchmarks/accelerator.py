# SPDX-License-Identifier: MIT
"""Does an accelerator ever wait? This server and its peers before a simulated one, whose forward passes only sleep.

    python benchmarks/accelerator.py

What it shows depends little on the machine: the share of the time in which the accelerator is busy, and what a request
costs of the CPU, in the server and in its callers. Rounds are interleaved, so a machine that drifts hits all alike.

All servers get embeddings; this one with the instances of its default export for a GPU, and with one. It gets raw
frames, too, for a tiny checkpoint on a Qwen3-VL backbone: preparing them is as real as ever.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil
from bench import DEMO, RESULTS, ROOT, machine
from contestants import PEER_SCRIPTS, Callers, running_peer
from load import Load
from rich.console import Console

import rfm_export
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.launch.temporary import temporary_server

sys.path.insert(0, str(Path(__file__).parent / "peers"))
from simulated import SIMULATION, Ledger

CHECKPOINT = DEMO / "rfm" / "1" / "checkpoint"
BATCH_S, ROW_S = 4e-3, 0.5e-3
VLM = ROOT / "tests" / "golden" / "vlm"
VLM_CHECKPOINT, VLM_BASE = VLM / "q3_tok_disc10" / "checkpoint", VLM / "bases" / "q3"
VLM_BATCH_S, VLM_ROW_S = 0.0, 30e-3
FRAMES = (16, 16)
OURS, OURS_ONE, OURS_VLM = "this server", "this server, one instance", "this server, frames"
OURS_VLM_LARGE = "this server, large frames"
VLM_LOADS = ((16, 256), (4, 256), (16, 480))  # callers, pixels
SIMULATED = """

import sys

sys.path.insert(0, {peers!r})
_load = TritonPythonModel.load


def load(self, version, device, settings):
    from pathlib import Path

    from simulated import simulate

    _load(self, version, device, settings)
    simulate(self.engine, Path({file!r}), {batch_s}, {row_s})


TritonPythonModel.load = load
"""
US_PER_S = 1e6


@dataclass(frozen=True)
class Contestant:
    """A server: its callers, what its accelerator does, and its processes."""

    callers: Callers
    ledger: Ledger
    processes: list[psutil.Process]

    def cpu_s(self) -> float:
        """Seconds of the CPU that the server has taken since its start."""
        return sum(sum(process.cpu_times()[:2]) for process in self.processes)


def main() -> None:
    """Measures, writes and shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0, help="of each measurement")
    parser.add_argument("--callers", type=int, nargs="+", default=[1, 32, 64])
    parser.add_argument("--peers", nargs="*", default=["LitServe", "mosec"], choices=["LitServe", "mosec"])
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder for the results")
    arguments = parser.parse_args()
    names = [OURS, OURS_ONE, *arguments.peers]
    loads = [(name, Load(callers, arguments.seconds, FRAMES)) for callers in arguments.callers for name in names]
    for callers, px in VLM_LOADS:
        name = OURS_VLM if px == VLM_LOADS[0][1] else OURS_VLM_LARGE
        loads.append((name, Load(callers=callers, seconds=2 * arguments.seconds, frames=(8, 8), frame_px=px)))
    rows = []
    with TemporaryDirectory(prefix="rfm-accelerator-") as folder, contestants(Path(folder), arguments.peers) as of_name:
        for number in range(arguments.rounds):
            for name, load in loads:
                row = {"way": name, "callers": load.callers, "round": number}
                rows.append(row | measure(of_name[name], load))
                Console().print(rows[-1], highlight=False)
    times_s = {"batch_s": BATCH_S, "row_s": ROW_S, "vlm_batch_s": VLM_BATCH_S, "vlm_row_s": VLM_ROW_S}
    results = {"machine": machine(), **times_s, "measurements": rows}
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "accelerator.json").write_text(json.dumps(results, indent=1) + "\n")
    (arguments.output / "accelerator.md").write_text(table(rows))
    print((arguments.output / "accelerator.md").read_text())


def measure(contestant: Contestant, load: Load) -> dict[str, float]:
    """One load of one server."""
    (busy_s, num_rows), cpu_s = contestant.ledger.read(), contestant.cpu_s()
    client = psutil.Process(contestant.callers.pid)
    client_s = sum(client.cpu_times()[:2])
    measured = contestant.callers.measure(load)
    after_s, after_rows = contestant.ledger.read()
    count = after_rows - num_rows
    return {
        "busy": (after_s - busy_s) / measured.took_s,
        "samples_per_s": measured.samples_per_s,
        "p50_ms": measured.p50_ms,
        "p99_ms": measured.p99_ms,
        "failed": measured.failed,
        "server_us": (contestant.cpu_s() - cpu_s) / count * US_PER_S,
        "client_us": (sum(client.cpu_times()[:2]) - client_s) / count * US_PER_S,
    }


@contextmanager
def contestants(folder: Path, peers: list[str]) -> Iterator[Mapping[str, Contestant]]:
    """All servers, each before an accelerator of its own."""
    network = Engine.from_checkpoint(CHECKPOINT).predictor.network.config
    widths = network.video_feature_dim, network.text_feature_dim
    config = ExportConfig(num_gpus=0, torch_threads=1)
    of_vlm = ExportConfig(num_gpus=0, torch_threads=1, base_model=str(VLM_BASE))
    servers = {
        OURS: ours(folder / "embeddings", CHECKPOINT, replace(config, instances=2), BATCH_S, ROW_S),
        OURS_ONE: ours(folder / "one", CHECKPOINT, config, BATCH_S, ROW_S),
        OURS_VLM: ours(folder / "frames", VLM_CHECKPOINT, of_vlm, VLM_BATCH_S, VLM_ROW_S),
        **{peer: theirs(folder / peer, peer) for peer in peers},
    }
    with ExitStack() as stack:
        made: dict[str, Contestant] = {}
        for name, server in servers.items():
            before = set(psutil.Process().children(recursive=True))
            url, ledger = stack.enter_context(server)
            processes = list(set(psutil.Process().children(recursive=True)) - before)
            callers = Callers(name if name in peers else "gRPC", url, widths)
            stack.callback(callers.close)
            made[name] = Contestant(callers, ledger, processes)
        made[OURS_VLM_LARGE] = made[OURS_VLM]
        yield made


@contextmanager
def ours(
    folder: Path, checkpoint: Path, config: ExportConfig, batch_s: float, row_s: float
) -> Iterator[tuple[str, Ledger]]:
    """URL and accelerator of this server."""
    repository, file = folder / "repository", folder / "ledger"
    folder.mkdir()
    rfm_export.export(checkpoint, repository, config)
    (model,) = repository.glob("*/1/model.py")
    times_s = {"batch_s": batch_s, "row_s": row_s}
    model.write_text(model.read_text() + SIMULATED.format(peers=sys.path[0], file=str(file), **times_s))
    with temporary_server(repository, folder / "triton.log") as endpoints:
        yield endpoints.grpc_url, Ledger(file)


@contextmanager
def theirs(folder: Path, peer: str) -> Iterator[tuple[str, Ledger]]:
    """URL and accelerator of a peer."""
    checkpoint, file = folder / "checkpoint", folder / "ledger"
    checkpoint.mkdir(parents=True)
    for source in CHECKPOINT.iterdir():
        (checkpoint / source.name).symlink_to(source)
    (checkpoint / SIMULATION).write_text(json.dumps([str(file), BATCH_S, ROW_S]))
    words = {"checkpoint": checkpoint, "threads": 1, "workers": 1}
    with running_peer(PEER_SCRIPTS[peer], words, folder / "log") as port:
        yield f"http://127.0.0.1:{port}", Ledger(file)


def table(rows: list[dict[str, object]]) -> str:
    """Medians of the rounds, as Markdown."""
    columns = ("busy", "samples_per_s", "p50_ms", "p99_ms", "server_us", "client_us")
    lines = [
        f"# A simulated accelerator: {1e3 * BATCH_S:g} ms a batch and {1e3 * ROW_S:g} ms a sample, asleep",
        "",
        "Medians of the rounds. busy: share of the time; us: CPU microseconds a sample, of all of the server's",
        f"processes, and of its callers' process. {OURS} has two instances.",
        "Frames: 8 of 256 x 256 a sample (large: 480 x 480), a tiny checkpoint on a Qwen3-VL backbone,",
        f"{1e3 * VLM_ROW_S:g} ms a sample, preparation included.",
        "",
        "| callers | server | busy | samples/s | p50 ms | p99 ms | server us | client us |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for callers, way in sorted({(row["callers"], row["way"]) for row in rows}, key=str):
        of_way = [row for row in rows if (row["callers"], row["way"]) == (callers, way)]
        medians = [statistics.median(float(str(row[column])) for row in of_way) for column in columns]
        lines.append(f"| {callers} | {way} | " + " | ".join(f"{value:.3g}" for value in medians) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
