# SPDX-License-Identifier: MIT
"""Compare this server with alternatives: same weights, same samples, one run.

    bench.py servers          the bare engine, the FastAPI server's design and mosec; --full: all loads
    bench.py commits --server before=OTHER_VENV/bin/python --server after=.venv/bin/python
                              this server at several commits, each from the environment where it is installed

Each round measures every contestant once, so that drift of the machine affects all alike. Ratios are within a round.
Callers run on the same cores as the servers.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import report
import torch
from contestants import (
    PEERS,
    VLM_BASE,
    BareEngine,
    Checkpoint,
    Contestant,
    checkpoint,
    peer,
    running,
    serving,
)
from load import SHARED_MEMORY, Load
from report import Row

from rfm.serve.triton_server import Endpoints, temporary_server
from rfm_gateway.command import gateway_command
from rfm_gateway.config import GatewayConfig

UNIFORM, MIXED, AS_LONG_AS_MIXED = (16, 16), (1, 16), (8, 9)
OURS = ("gRPC", "HTTP", SHARED_MEMORY, "gateway")
ONE, MANY = Load(1, 0, UNIFORM), Load(32, 0, UNIFORM)
SCENARIOS = {  # name: load, ways to reach this server, True: also measure the peers
    "1 caller": (ONE, ("gRPC",), True),
    "32 callers": (MANY, ("gRPC", "gateway"), True),
    "32 callers, 8 or 9 frames": (replace(MANY, frames=AS_LONG_AS_MIXED), ("gRPC",), False),
    "32 callers, 1 to 16 frames, all types": (replace(MANY, frames=MIXED, mixed=True), ("gRPC",), False),
}
FULL = {
    "8 callers": (replace(MANY, callers=8), OURS, True),
    "128 callers": (replace(MANY, callers=128), OURS, True),
    "2 callers, 32 samples each": (Load(2, 0, UNIFORM, together=32), ("gRPC", "gateway"), True),
    "8 callers, 8 raw frames of 256 x 256": (Load(8, 0, (8, 8), frame_px=(256, 256)), OURS[:3], False),
    "Poisson, half of the bare engine's rate": (Load(0, 0, UNIFORM, rate_per_s=0.5), ("gRPC",), True),
}


def servers(arguments: argparse.Namespace, folder: Path) -> None:
    """Measure all ways to reach this server, the bare engine and the peers, for each checkpoint size."""
    rows: list[Row] = []
    for size in arguments.sizes:
        measured = checkpoint(size, folder)
        bare = BareEngine(measured)
        with ExitStack() as stack:
            ends = stack.enter_context(temporary_server(measured.repository, folder / f"triton_{size}.log"))
            port = Endpoints.free().http_port
            command = gateway_command(GatewayConfig(port, triton=ends.grpc_url, metrics_url=ends.metrics_url))
            stack.enter_context(running(command, port, folder / f"gateway_{size}.log"))
            urls = dict.fromkeys(OURS, ends.grpc_url) | {"HTTP": ends.http_url, "gateway": f"http://127.0.0.1:{port}"}
            options = {"checkpoint": measured.folder, "threads": measured.threads}
            addresses = {way: nullcontext(url) for way, url in urls.items()}
            addresses |= {name: peer(name, options, folder / f"{name}_{size}.log") for name in PEERS}
            made = {way: Contestant(way, server, measured.widths) for way, server in addresses.items()}
            for contestant in made.values():
                stack.enter_context(contestant)
            for name, (load, ways, with_peers) in (SCENARIOS | (FULL if arguments.full else {})).items():
                if load.frame_px and size != "small":
                    continue
                asked = [way for way in made if way in ways or (with_peers and way in PEERS)]
                batches = (
                    () if load.frame_px else (1,) if load.callers == 1 else (1, 8, 32)
                )  # the engine measures only embeddings
                alone = replace(load, rate_per_s=0, seconds=arguments.seconds)
                for number in range(arguments.rounds):
                    of_bare = {f"bare engine, batch {batch}": bare.measure(alone, batch) for batch in batches}
                    best = max((told["samples_per_s"] for told in of_bare.values()), default=0.0)
                    now = replace(load, seconds=arguments.seconds, rate_per_s=load.rate_per_s * best)
                    told = {way: made[way].measure(now) for way in asked}
                    rows += _rows({"checkpoint": size, "load": name}, number, told | of_bare)
    about = "This server beside the bare engine and its alternatives\nRatio: of samples/s, to this server over gRPC."
    report.write("results", about, rows, ("checkpoint", "load", "way"), "samples_per_s", arguments.output)


def commits(arguments: argparse.Namespace, folder: Path) -> None:
    """Measure this server at several commits, and mosec for embeddings."""
    rows: list[Row] = []
    for size in arguments.sizes:
        measured = checkpoint(size, folder)
        base = str(VLM_BASE) if size == "vlm" else ""
        made = {}
        for name, python in (word.split("=", 1) for word in arguments.server):
            (place := folder / f"{size}_{name}").mkdir()
            made[name] = Contestant("gRPC", _commit(python, measured, base, place), measured.widths)
        if not base:
            options = {"checkpoint": measured.folder, "threads": measured.threads}
            made["mosec"] = Contestant("mosec", peer("mosec", options, folder / "mosec.log"), measured.widths)
        load = Load(1, arguments.seconds, (8, 8) if base else UNIFORM, frame_px=(256, 256) if base else None)
        with ExitStack() as stack:
            for contestant in made.values():
                stack.enter_context(contestant)
            for number, callers in itertools.product(range(arguments.rounds), arguments.callers):
                told = {way: one.measure(replace(load, callers=callers)) for way, one in made.items()}
                rows += _rows({"checkpoint": size, "callers": callers}, number, told)
    about = "Before and after\nRatio: of samples/s, to the first server's."
    report.write("before_after", about, rows, ("checkpoint", "callers", "way"), "samples_per_s", arguments.output)


def _rows(of: Row, number: int, measured: Mapping[str, Row]) -> list[Row]:
    """Return one row per way, and print the rates."""
    rows = [{**of, "way": way, "round": number, **figures} for way, figures in measured.items()]
    rates = ", ".join(f"{row['way']} {row['samples_per_s']:.0f}" for row in rows)
    print(f"{', '.join(map(str, of.values()))}, round {number + 1}: {rates} samples/s", flush=True)
    return rows


@contextmanager
def _commit(python: str, measured: Checkpoint, base_model: str, place: Path) -> Iterator[str]:
    settings = {"num_gpus": 0, "torch_threads": measured.threads, "base_model": base_model or None}
    with serving(measured.folder, place, settings, python) as addresses:
        yield addresses["grpc"]


def main() -> None:
    """Run the chosen benchmark, then write and print its results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    programs = {each.__name__: each for each in (servers, commits)}
    parser.add_argument("what", choices=programs, nargs="?", default="servers")
    parser.add_argument("--full", action="store_true", help="servers: all loads, half an hour instead of eight minutes")
    parser.add_argument("--server", action="append", default=[], metavar="NAME=PYTHON", help="commits: one of them")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement")
    parser.add_argument("--callers", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--sizes", nargs="+", default=["default", "small"], choices=["default", "small", "vlm"])
    parser.add_argument("--output", type=Path, default=report.OUTPUT, help="folder for the results")
    arguments = parser.parse_args()
    torch.set_num_threads(torch.get_num_threads())
    with TemporaryDirectory(prefix="rfm-bench-") as folder:
        programs[arguments.what](arguments, Path(folder))


if __name__ == "__main__":
    main()
