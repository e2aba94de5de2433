# SPDX-License-Identifier: MIT
"""Measure the engine without a server.

    engine.py forward      forward passes, ours and upstream's; options; dense mode; more frames; wider networks
    engine.py preparation  CPU time to prepare frames for a vision-language checkpoint, ours and transformers'
    engine.py loading      host memory to load a vision-language checkpoint of 0.6B parameters (takes 9 GB)

Weights are random. Each round measures all ways in turn.
"""

from __future__ import annotations

import argparse
import itertools
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import random_checkpoints
import report
import torch
from contestants import DEFAULT_SIZE, VLM_BASE, VLM_CHECKPOINT
from peers.upstream_forward import UpstreamRewind, progress_of
from random_checkpoints import QWEN3_VL_4B, ROBOMETER

from rfm import families
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.engine.layers import progress_from_logits
from rfm.rewind.network import RewindBatch, RewindConfig, RewindTransformer
from rfm.rewind.predictor import RewindPredictor
from rfm_client import ProgressSample, Trajectory

FRAMES = 16
THREE_LAYERS = 3  # of the language model: 0.6B parameters

Row = dict[str, Any]


@torch.inference_mode()
def forward(arguments: argparse.Namespace) -> None:
    """The default ReWiND as varied by each row. difference: largest deviation of progress from the first way."""
    ours, original = RewindTransformer(DEFAULT_SIZE).eval(), UpstreamRewind(DEFAULT_SIZE).eval()
    original.load_state_dict(ours.state_dict())
    halved = RewindTransformer(DEFAULT_SIZE).eval()
    halved.load_state_dict(ours.state_dict())
    halved.bfloat16()
    compiled = None
    if shutil.which("c++"):
        from torch._inductor import config as inductor

        inductor.freezing = True  # weights are packed only when frozen
        torch.backends.mha.set_fastpath_enabled(False)  # the compiler cannot optimise this opaque operation
        compiled = torch.compile(original, dynamic=False)
    rows: list[Row] = []
    for batch_size in (1, 2, 4, 8, 16, 32, 64):
        text, video = torch.randn(batch_size, 384), torch.randn(batch_size, FRAMES, 768)
        lengths = np.array([(FRAMES, 0)] * batch_size)
        make = partial(RewindBatch.of, DEFAULT_SIZE, text, video.flatten(0, 1), lengths)
        ways: dict[str, Callable[[], torch.Tensor]] = {
            "the original": lambda t=text, v=video: progress_of(original(t, v).progress).flatten(),
            "ours": lambda m=make: progress_from_logits(ours(m()).progress),
            "ours, bfloat16": lambda m=make: progress_from_logits(halved(m().to("cpu", torch.bfloat16)).progress),
        }
        if compiled is not None and batch_size in (1, 8, 32):
            ways["the original, compiled"] = lambda t=text, v=video: progress_of(compiled(t, v).progress).flatten()
        rows += _timed({"what": "forward", "size": batch_size}, ways, arguments.rounds)
    trajectory = _trajectory(DEFAULT_SIZE, FRAMES)
    engine = Engine(RewindPredictor(RewindTransformer(DEFAULT_SIZE), torch.device("cpu")))
    assert trajectory.video_embeddings is not None
    videos = [trajectory.video_embeddings[np.linspace(0, t, 4).astype(int)] for t in range(FRAMES)]
    prefixes = [ProgressSample(replace(trajectory, video_embeddings=video)) for video in videos]
    ways = {
        "prefixes one by one": lambda: _last([engine.evaluate([prefix])[0] for prefix in prefixes]),
        "dense mode": lambda: torch.from_numpy(
            engine.evaluate([ProgressSample(trajectory, frame_steps=4)])[0].progress  # type: ignore[union-attr]
        ),
    }
    rows += _timed({"what": "dense", "size": FRAMES}, ways, arguments.rounds)
    for num_frames in (4, 8, 16, 32, 64, 128):
        rows += _engine("frames", num_frames, replace(DEFAULT_SIZE, max_len=128), num_frames, arguments.rounds)
    for width in (64, 128, 256, 512, 1024):
        rows += _engine("width", width, replace(DEFAULT_SIZE, hidden_dim=width), FRAMES, arguments.rounds)
    told = f"The engine without a server\n{forward.__doc__} Ratio: of ms. Batches of 8 in the last two."
    report.write("forward", told, rows, ("what", "size", "way"), "ms", arguments.output)


def _last(results: list[Any]) -> torch.Tensor:
    return torch.tensor([result.last_progress for result in results])


def _timed(of: Row, ways: Mapping[str, Callable[[], torch.Tensor]], rounds: int) -> list[Row]:
    """Return milliseconds for each way and round, after two warm-up calls, and the deviation from the first way."""
    scores = {way: call().float() for way, call in ways.items()}
    first = next(iter(scores.values()))
    rows = []
    for number in range(rounds + 1):
        for way, call in ways.items():
            before_s = time.perf_counter()
            call()
            ms = (time.perf_counter() - before_s) * 1e3
            if number:
                difference = float((scores[way] - first).abs().max())
                rows.append({**of, "way": way, "round": number, "ms": ms, "difference": difference})
    return rows


def _engine(what: str, size: int, config: RewindConfig, num_frames: int, rounds: int) -> list[Row]:
    engine = Engine(RewindPredictor(RewindTransformer(config), torch.device("cpu")))
    samples = [ProgressSample(_trajectory(config, num_frames, seed)) for seed in range(8)]
    return _timed({"what": what, "size": size}, {"ours": lambda: _last(list(engine.evaluate(samples)))}, rounds)


def _trajectory(config: RewindConfig, num_frames: int, seed: int = 0) -> Trajectory:
    random = np.random.default_rng(seed)
    return Trajectory(
        video_embeddings=random.standard_normal((num_frames, config.video_feature_dim), np.float32),
        text_embedding=random.standard_normal(config.text_feature_dim, np.float32),
    )


def preparation(arguments: argparse.Namespace) -> None:
    """CPU milliseconds of all threads to prepare 8 new frames: check, digest, resize and lay out.

    The task is known, as in an RL loop, or new. The processor also normalises frames and cuts them into patches.
    """
    from transformers import AutoImageProcessor

    checkpoint = families.load(VLM_CHECKPOINT, base_model=str(VLM_BASE))
    predictor = Engine.of(checkpoint, feature_cache_mib=ExportConfig().feature_cache_mib).predictor
    processor = AutoImageProcessor.from_pretrained(VLM_BASE, use_fast=False)
    numbers = itertools.count()

    def ours(frames: np.ndarray, task: str) -> object:
        return predictor.collate(predictor.rows(ProgressSample(Trajectory(frames=frames, task=task))))

    ways: dict[str, Callable[[np.ndarray], object]] = {
        "transformers' processor": lambda frames: processor(images=list(frames), return_tensors="pt"),
        "this server": lambda frames: ours(frames, "stack the cups"),
        "this server, a new task": lambda frames: ours(frames, f"stack {next(numbers)} cups"),
    }
    random, rows = np.random.default_rng(0), []
    for height, width in ((256, 256), (480, 640), (720, 1280)):
        for number in range(arguments.rounds + 1):
            frames = random.integers(0, 256, (8, height, width, 3), np.uint8)
            for way, prepare in ways.items():
                began_s = time.process_time()
                prepare(frames)
                if number:
                    ms = (time.process_time() - began_s) * 1e3
                    rows.append({"frames": f"{height}x{width}", "way": way, "round": number, "cpu_ms": ms})
    told = f"Preparing a sample for a vision-language checkpoint\n{preparation.__doc__}"
    report.write("preparation", told, rows, ("frames", "way"), "cpu_ms", arguments.output)


def loading(arguments: argparse.Namespace) -> None:
    """Peak memory (VmHWM) to load the checkpoint, minus that of a tiny checkpoint. share: of the weights' size."""
    if arguments.one:
        print(_peak_bytes(arguments.one, arguments.folder))
        return
    with TemporaryDirectory() as name:
        small = replace(QWEN3_VL_4B, text={**QWEN3_VL_4B.text, "num_hidden_layers": THREE_LAYERS})
        folder, rows = random_checkpoints.write(Path(name), ROBOMETER, small), []
        size = sum(file.stat().st_size for file in folder.glob("*.safetensors"))
        for what in ("bfloat16", "float32", "export"):
            words = [[sys.executable, __file__, "loading", str(of), "--one", what] for of in (folder, VLM_CHECKPOINT)]
            peaks = [int(subprocess.check_output(line, text=True).splitlines()[-1]) for line in words]
            peak = peaks[0] - peaks[1]
            rows.append({"way": what, "round": 0, "peak_mib": peak / 2**20, "share": peak / size})
    report.write("loading", f"Memory to load\n{loading.__doc__}", rows, ("way",), folder=arguments.output)


def _peak_bytes(what: str, checkpoint: Path) -> int:
    """Export or load the checkpoint; return this process's peak memory.

    what: ``export``, or the dtype to load
    """
    if what == "export":
        import rfm_export

        with TemporaryDirectory(dir=checkpoint.parent) as repository:
            settings = ExportConfig(base_model=str(VLM_BASE), num_gpus=0)
            rfm_export.export(checkpoint, Path(repository) / "repository", settings)
    else:
        loaded = families.load(checkpoint, base_model=str(VLM_BASE))
        for weights in Engine.of(loaded, dtype=getattr(torch, what)).predictor.network.parameters():
            weights.sum()  # reads the weights from the file, as a copy to a GPU does
    (peak_kib,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(peak_kib) * 1024


def main() -> None:
    """Run the chosen benchmark, then write and print its results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    programs = {each.__name__: each for each in (forward, preparation, loading)}
    parser.add_argument("what", choices=programs)
    parser.add_argument("folder", type=Path, nargs="?", help=argparse.SUPPRESS)  # of --one
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--output", type=Path, default=report.RESULTS, help="folder for the results")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # loading starts itself with this option, to print one peak
    arguments = parser.parse_args()
    programs[arguments.what](arguments)


if __name__ == "__main__":
    main()
