# SPDX-License-Identifier: MIT
"""The engine without a server: its forward beside the original's, its options, and what more work costs.

    python benchmarks/forward.py            # about four minutes

Variants of one row are measured in turn, round after round; ratios are medians of those within a round. Weights are
random. Writes forward.json, forward.md and forward.png.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
import torch
from bench import DEFAULT_SIZE, RESULTS, machine
from matplotlib.figure import Figure
from peers.upstream_forward import Scores, UpstreamRewind, progress_of
from rich.console import Console
from torch._inductor import config as inductor

from rfm.engine import Engine
from rfm.engine.layers import progress_from_logits
from rfm.rewind.network import RewindBatch, RewindConfig, RewindTransformer
from rfm.rewind.predictor import RewindPredictor
from rfm_client import ProgressResult, ProgressSample, Trajectory

BATCH_SIZES = (1, 2, 4, 8, 16, 32, 64)
LENGTHS = (4, 8, 16, 32, 64, 128)
WIDTHS = (64, 128, 256, 512, 1024)
FRAMES = 16
DENSE_STEPS = 4
WARM_UPS = 2
DOTS_PER_IN = 120

Row = dict[str, object]
Forward = Callable[[], torch.Tensor]


@torch.inference_mode()
def main() -> None:
    """Measures, writes and shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=0, help="of torch; 0: torch's choice")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder for the results")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads or torch.get_num_threads())
    tables = {
        "Beside the original's forward": _beside_upstream(arguments.rounds),
        "Options": _options(arguments.rounds),
        "Dense mode": _dense(arguments.rounds),
        "Longer trajectories": _lengths(arguments.rounds),
        "Wider networks": _widths(arguments.rounds),
    }
    results = {"machine": machine(), "threads": torch.get_num_threads(), "rounds": arguments.rounds, "tables": tables}
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "forward.json").write_text(json.dumps(results, indent=1) + "\n")
    text = _markdown(results)
    (arguments.output / "forward.md").write_text(text)
    _draw(tables, arguments.output / "forward.png")
    Console().print(text, highlight=False)


def _beside_upstream(rounds: int) -> list[Row]:
    """The same weights and rows in both."""
    network, original = RewindTransformer(DEFAULT_SIZE).eval(), UpstreamRewind(DEFAULT_SIZE).eval()
    original.load_state_dict(network.state_dict())
    rows: list[Row] = []
    for batch_size in BATCH_SIZES:
        text, video = _inputs(DEFAULT_SIZE, batch_size, FRAMES)
        ours = partial(_scores, network, text, video)
        upstream = partial(_original_scores, original, text, video)
        times_s = _times_s({"ours": ours, "original": upstream}, rounds)
        rows.append(
            {
                "batch": batch_size,
                "ours ms": _ms(times_s["ours"]),
                "original ms": _ms(times_s["original"]),
                "times as fast": _ratio(times_s["original"], times_s["ours"]),
                "largest difference": float((ours() - upstream()).abs().max()),
            }
        )
    return rows


def _scores(network: RewindTransformer, text: torch.Tensor, video: torch.Tensor) -> torch.Tensor:
    """Progress and success of all frames, packing included."""
    lengths = np.array([(video.shape[1], 0)] * len(video))
    output = network(RewindBatch.of(DEFAULT_SIZE, text, video.flatten(0, 1), lengths))
    return torch.stack([progress_from_logits(output.progress), output.success.sigmoid()])


def _original_scores(network: UpstreamRewind, text: torch.Tensor, video: torch.Tensor) -> torch.Tensor:
    scores = network(text, video)
    return torch.stack([progress_of(scores.progress).flatten(), scores.success.sigmoid().flatten()])


def _options(rounds: int) -> list[Row]:
    """What bfloat16 adds, and torch.compile (of the original, since ours calls oneDNN itself), and what they cost.

    Without the fast path of torch's encoder layer: a compiler sees one opaque operation in it, and packs nothing.
    """
    network, in_bfloat16 = RewindTransformer(DEFAULT_SIZE).eval(), RewindTransformer(DEFAULT_SIZE).eval()
    in_bfloat16.load_state_dict(network.state_dict())
    in_bfloat16.bfloat16()
    original = UpstreamRewind(DEFAULT_SIZE).eval()
    original.load_state_dict(network.state_dict())
    inductor.freezing = True  # it packs weights only then
    torch.backends.mha.set_fastpath_enabled(False)
    compiled = torch.compile(original, dynamic=False) if shutil.which("c++") else None
    rows: list[Row] = []
    for batch_size in (1, 8, 32):
        text, video = _inputs(DEFAULT_SIZE, batch_size, FRAMES)
        batch = RewindBatch.of(DEFAULT_SIZE, text, video.flatten(0, 1), np.array([(FRAMES, 0)] * batch_size))
        halved = batch.to(torch.device("cpu"), torch.bfloat16)
        forwards: dict[str, Forward] = {
            "float32": partial(_progress, network, batch),
            "bfloat16": partial(_progress, in_bfloat16, halved),
        }
        if compiled is not None:
            forwards["the original, compiled"] = partial(_original_progress, compiled, text, video)
        times_s = _times_s(forwards, rounds)
        reference = forwards["float32"]()
        rows += [
            {
                "batch": batch_size,
                "option": name,
                "ms": _ms(times_s[name]),
                "times as fast": _ratio(times_s["float32"], times_s[name]),
                "largest difference of progress": float((forward() - reference).abs().max()),
            }
            for name, forward in forwards.items()
        ]
    return rows


def _progress(network: RewindTransformer, batch: RewindBatch) -> torch.Tensor:
    return progress_from_logits(network(batch).progress)


def _original_progress(network: Callable[..., Scores], text: torch.Tensor, video: torch.Tensor) -> torch.Tensor:
    return progress_of(network(text, video).progress).flatten()


def _dense(rounds: int) -> list[Row]:
    """A trajectory in dense mode, beside its prefixes one by one, each sampled to as many frames."""
    engine = _engine(DEFAULT_SIZE)
    trajectory = _trajectory(DEFAULT_SIZE, FRAMES)
    assert trajectory.video_embeddings is not None
    picked = [np.linspace(0, t, DENSE_STEPS).astype(int) for t in range(FRAMES)]
    prefixes = [replace(trajectory, video_embeddings=trajectory.video_embeddings[frames]) for frames in picked]

    def dense() -> torch.Tensor:
        (result,) = engine.evaluate([ProgressSample(trajectory, frame_steps=DENSE_STEPS)])
        assert isinstance(result, ProgressResult)
        return torch.from_numpy(result.progress)

    def one_by_one() -> torch.Tensor:
        results = [engine.evaluate([ProgressSample(prefix)])[0] for prefix in prefixes]
        return torch.tensor([result.last_progress for result in results if isinstance(result, ProgressResult)])

    times_s = _times_s({"dense": dense, "one by one": one_by_one}, rounds)
    return [
        {
            "frames": FRAMES,
            "frame_steps": DENSE_STEPS,
            "dense, frames/s": FRAMES / statistics.median(times_s["dense"]),
            "one by one, frames/s": FRAMES / statistics.median(times_s["one by one"]),
            "times as fast": _ratio(times_s["one by one"], times_s["dense"]),
            "largest difference": float((dense() - one_by_one()).abs().max()),
        }
    ]


def _lengths(rounds: int) -> list[Row]:
    return [
        {"frames": num_frames, **_cost(replace(DEFAULT_SIZE, max_len=max(LENGTHS)), 8, num_frames, rounds)}
        for num_frames in LENGTHS
    ]


def _widths(rounds: int) -> list[Row]:
    return [{"width": width, **_cost(replace(DEFAULT_SIZE, hidden_dim=width), 8, FRAMES, rounds)} for width in WIDTHS]


def _cost(config: RewindConfig, batch_size: int, num_frames: int, rounds: int) -> Row:
    """Of one ``Engine.evaluate``, and the arithmetic of its layers (but for attention's own).

    24 D² FLOP a token and layer; in the last, keys and values (4 D²) of all tokens, the rest of those that are read.
    """
    engine = _engine(config)
    samples = [ProgressSample(_trajectory(config, num_frames, seed)) for seed in range(batch_size)]
    took_s = statistics.median(_times_s({"": lambda: torch.tensor(len(engine.evaluate(samples)))}, rounds)[""])
    tokens = batch_size * config.num_tokens(num_frames, 0)
    read = batch_size * num_frames
    flop = config.hidden_dim**2 * (24 * (config.num_layers - 1) * tokens + 4 * tokens + 20 * read)
    return {
        "batch": batch_size,
        "ms": took_s * 1e3,
        "samples/s": batch_size / took_s,
        "frames/s": batch_size * num_frames / took_s,
        "GFLOP/s": flop / took_s / 1e9,
    }


def _engine(config: RewindConfig) -> Engine:
    return Engine(RewindPredictor(RewindTransformer(config), torch.device("cpu")))


def _inputs(config: RewindConfig, batch_size: int, num_frames: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Text [B, Dt] and video [B, T, Dv]."""
    return torch.randn(batch_size, config.text_feature_dim), torch.randn(
        batch_size, num_frames, config.video_feature_dim
    )


def _trajectory(config: RewindConfig, num_frames: int, seed: int = 0) -> Trajectory:
    random = np.random.default_rng(seed)
    return Trajectory(
        video_embeddings=random.standard_normal((num_frames, config.video_feature_dim), np.float32),
        text_embedding=random.standard_normal(config.text_feature_dim, np.float32),
    )


def _times_s(forwards: Mapping[str, Forward], rounds: int) -> dict[str, list[float]]:
    """Seconds of each round of each, in turn."""
    times_s: dict[str, list[float]] = {name: [] for name in forwards}
    for number in range(WARM_UPS + rounds):
        for name, forward in forwards.items():
            before_s = time.perf_counter()
            forward()
            if number >= WARM_UPS:
                times_s[name].append(time.perf_counter() - before_s)
    return times_s


def _ms(times_s: Sequence[float]) -> float:
    return statistics.median(times_s) * 1e3


def _ratio(of_s: Sequence[float], to_s: Sequence[float]) -> float:
    return statistics.median(of / to for of, to in zip(of_s, to_s, strict=True))


def _markdown(results: Mapping[str, object]) -> str:
    told, tables = results["machine"], results["tables"]
    assert isinstance(told, dict) and isinstance(tables, dict)
    lines = [
        "# The engine without a server",
        "",
        f"{told['cpu']}, {told['cores']} cores, {results['threads']} torch threads; torch "
        f"{told['packages']['torch']}; commit {told['commit'][:12]}; {told['date']}. Medians of {results['rounds']} "
        f"interleaved rounds. The default ReWiND ({FRAMES} frames, width {DEFAULT_SIZE.hidden_dim}) but for what a "
        "table varies.",
    ]
    for title, rows in tables.items():
        lines += ["", f"## {title}", "", f"| {' | '.join(rows[0])} |", "|---" * len(rows[0]) + "|"]
        lines += [f"| {' | '.join(map(_cell, row.values()))} |" for row in rows]
    return "\n".join(lines) + "\n"


def _cell(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0e}" if 0 < value < 0.01 else f"{value:.0f}" if value >= 100 else f"{value:.2f}"


def _draw(tables: Mapping[str, Sequence[Row]], file: Path) -> None:
    """What more work costs: batch, length, width."""
    panels = (
        ("Beside the original's forward", "batch", ("ours ms", "original ms"), "ms a batch"),
        ("Longer trajectories", "frames", ("samples/s",), "samples/s, batches of 8"),
        ("Longer trajectories", "frames", ("frames/s",), "frames/s, batches of 8"),
        ("Wider networks", "width", ("samples/s",), "samples/s, batches of 8"),
    )
    with matplotlib.rc_context({"font.size": 8}):
        figure = Figure(figsize=(10, 2.6), layout="constrained")
        for axes, (title, over, names, label) in zip(figure.subplots(1, len(panels)), panels, strict=True):
            rows = tables[title]
            for name in names:
                axes.plot([row[over] for row in rows], [row[name] for row in rows], marker=".", label=name)
            axes.set(xscale="log", yscale="log", xlabel=over, title=label)
            axes.set_xticks([row[over] for row in rows], [str(row[over]) for row in rows], minor=False)
            axes.minorticks_off()
            if len(names) > 1:
                axes.legend()
        figure.savefig(file, dpi=DOTS_PER_IN)


if __name__ == "__main__":
    main()
