# SPDX-License-Identifier: MIT
"""Compare this server with the bare engine, the FastAPI server's design and mosec: same weights, same samples, one run.

Each round measures every contestant once, so that drift of the machine affects all alike. Ratios are within a round.
Callers run on the same cores as the servers.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import report
import torch
from contestants import PEERS, BareEngine, Contestant, checkpoint, peer, running
from load import Load
from report import Row

from rfm.serve.triton_server import Endpoints, temporary_server
from rfm_gateway.command import gateway_command
from rfm_gateway.config import GatewayConfig

UNIFORM, MIXED, AS_LONG_AS_MIXED = (16, 16), (1, 16), (8, 9)
MANY = Load(32, 0, UNIFORM)
SCENARIOS = {  # name: load, ways to reach this server, True: also measure the peers
    "1 caller": (Load(1, 0, UNIFORM), ("gRPC",), True),
    "32 callers": (MANY, ("gRPC", "gateway"), True),
    "32 callers, 8 or 9 frames": (replace(MANY, frames=AS_LONG_AS_MIXED), ("gRPC",), False),
    "32 callers, 1 to 16 frames, all types": (replace(MANY, frames=MIXED, mixed=True), ("gRPC",), False),
}


def measured_rows(size: str, folder: Path, rounds: int, seconds: float) -> list[Row]:
    """Measure both ways to reach this server, the bare engine and the peers with a checkpoint of this size."""
    rows: list[Row] = []
    measured = checkpoint(size, folder)
    bare = BareEngine(measured)
    with ExitStack() as stack:
        ends = stack.enter_context(temporary_server(measured.repository, folder / f"triton_{size}.log"))
        port = Endpoints.free().http_port
        command = gateway_command(GatewayConfig(port, triton=ends.grpc_url, metrics_url=ends.metrics_url))
        stack.enter_context(running(command, port, folder / f"gateway_{size}.log"))
        options = {"checkpoint": measured.folder, "threads": measured.threads}
        addresses = {"gRPC": nullcontext(ends.grpc_url), "gateway": nullcontext(f"http://127.0.0.1:{port}")}
        addresses |= {name: peer(name, options, folder / f"{name}_{size}.log") for name in PEERS}
        made = {way: Contestant(way, server, measured.widths) for way, server in addresses.items()}
        for contestant in made.values():
            stack.enter_context(contestant)
        for name, (load, ways, with_peers) in SCENARIOS.items():
            asked = [way for way in made if way in ways or (with_peers and way in PEERS)]
            load = replace(load, seconds=seconds)
            for number in range(rounds):
                batches = (1,) if load.callers == 1 else (1, 8, 32)
                of_bare = {f"bare engine, batch {batch}": bare.measure(load, batch) for batch in batches}
                told = {way: made[way].measure(load) for way in asked}
                rows += _rows({"checkpoint": size, "load": name}, number, told | of_bare)
    return rows


def _rows(of: Row, number: int, measured: Mapping[str, Row]) -> list[Row]:
    """Return one row per way, and print the rates."""
    rows = [{**of, "way": way, "round": number, **figures} for way, figures in measured.items()]
    rates = ", ".join(f"{row['way']} {row['samples_per_s']:.0f}" for row in rows)
    print(f"{', '.join(map(str, of.values()))}, round {number + 1}: {rates} samples/s", flush=True)
    return rows


def main() -> None:
    """Run the benchmark, then write and print its results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement")
    parser.add_argument("--sizes", nargs="+", default=["default", "small"], choices=["default", "small"])
    parser.add_argument("--output", type=Path, default=report.OUTPUT, help="folder for the results")
    arguments = parser.parse_args()
    torch.set_num_threads(torch.get_num_threads())
    rows: list[Row] = []
    with TemporaryDirectory(prefix="rfm-bench-") as folder:
        for size in arguments.sizes:
            rows += measured_rows(size, Path(folder), arguments.rounds, arguments.seconds)
    about = "This server beside the bare engine and its alternatives\nRatio: of samples/s, to this server over gRPC."
    report.write("results", about, rows, ("checkpoint", "load", "way"), "samples_per_s", arguments.output)


if __name__ == "__main__":
    main()
