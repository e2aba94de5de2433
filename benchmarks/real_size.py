# SPDX-License-Identifier: MIT
"""Measure networks of a published size with random weights on a GPU, without a server.

    python benchmarks/real_size.py FILE.json

A Qwen3-VL of 4 billion parameters in bfloat16, as Robometer (8 frames, progress tokens), TOPReward and RoboReward ask
it. Random weights cost the same time and memory as trained ones. Tokenizers are the tests' small ones, which make more
tokens of text than Qwen's. RoboReward writes 6 tokens, as a trained model does ("ANSWER: 4" and its end).
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from engine import ALL_LAYERS, TEXT, VISION

from rfm import families
from rfm.engine import Engine
from rfm.engine.layers import keep_float32
from rfm.roboreward.predictor import RoboRewardPredictor
from rfm.topreward.predictor import TopRewardPredictor
from rfm.vlm.language import LanguageNetwork
from rfm.vlm.network import VlmRewardModel, build_backbone
from rfm.vlm.predictor import VlmPredictor
from rfm_client import ProgressSample, Trajectory

GOLDEN = Path(__file__).parents[1] / "tests" / "golden"
VOCABULARY = 151_936
SMALL_PX, USUAL_PX = (224, 224), (480, 640)
ROUNDS = 3
TASK = "put the red block in the bowl"


def of_real_size(config: Any, num_tokens: int) -> Any:
    """Return a small checkpoint's configuration with the sizes above."""
    text = {**config.backbone["text_config"], **TEXT, "num_hidden_layers": ALL_LAYERS, "vocab_size": num_tokens}
    vision = {**config.backbone["vision_config"], **VISION}
    return replace(config, backbone={**config.backbone, "text_config": text, "vision_config": vision}, dtype="bfloat16")


def random_network(network_class: Any, config: Any, device: torch.device) -> Any:
    """Return a network with normally distributed weights on ``device``."""
    with device:
        network = network_class(config, build_backbone(config, torch.bfloat16))
    generator = torch.Generator(device).manual_seed(0)
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(False)
        parameter.data = parameter.data.bfloat16()
        if parameter.ndim > 1:
            parameter.normal_(0, 0.02, generator=generator)
        else:
            parameter.fill_(0.0 if name.endswith("bias") else 1.0)
    return network


def measured(
    what: str, engine: Engine, device: torch.device, num_samples: int, num_frames: int, size_px: tuple[int, int]
) -> dict[str, Any]:
    """Return the time and memory of a batch of noise videos: median of ROUNDS, after one to warm up."""
    random = np.random.default_rng(0)
    shape = (num_frames, *size_px, 3)
    samples = [
        ProgressSample(Trajectory(frames=random.integers(0, 256, shape, np.uint8), task=TASK))
        for _ in range(num_samples)
    ]
    engine.evaluate(samples)
    torch.cuda.reset_peak_memory_stats(device)
    times_s = []
    for _ in range(ROUNDS):
        torch.cuda.synchronize(device)
        began_s = time.perf_counter()
        engine.evaluate(samples)
        torch.cuda.synchronize(device)
        times_s.append(time.perf_counter() - began_s)
    row = {
        "what": what,
        "samples": num_samples,
        "frames": num_frames,
        "size_px": size_px,
        "tokens": engine.prepare(samples[0]).num_tokens,
        "ms_per_sample": statistics.median(times_s) / num_samples * 1e3,
        "peak_gib": torch.cuda.max_memory_allocated(device) / 2**30,
    }
    typer.echo(row)
    return row


def robometer(device: torch.device) -> list[dict[str, Any]]:
    """Measure Robometer."""
    folder = GOLDEN / "vlm" / "q3_tok_disc10_bf16" / "checkpoint"
    small = families.load(folder, base_model=str(GOLDEN / "vlm" / "bases" / "q3"))
    config = of_real_size(small.config, len(small.collator.tokenizer))  # type: ignore[attr-defined]  # of this family
    collator = type(small.collator)(config, small.collator.tokenizer, small.collator.images)  # type: ignore[attr-defined]  # of this family
    engine = Engine(VlmPredictor(random_network(VlmRewardModel, config, device), collator, device))
    sizes = [(size_px, count) for size_px in (SMALL_PX, USUAL_PX) for count in (1, 8, 32)]
    return [measured("Robometer", engine, device, count, 8, size_px) for size_px, count in sizes]


def asked_in_words(device: torch.device) -> list[dict[str, Any]]:
    """Measure RoboReward and TOPReward, which share a network."""
    robo, top = "roboreward/rr_tied_bf16/checkpoint", "topreward/checkpoints/vlm_fp32_untied"
    network, rows = None, []
    plans: Sequence[tuple[str, str, Any, dict[str, Any], Sequence[tuple[int, int, tuple[int, int]]]]] = (
        (robo, "roboreward", RoboRewardPredictor, {"max_new_tokens": 6}, [(n, 8, USUAL_PX) for n in (1, 8, 32)]),
        (robo, "roboreward-expected", RoboRewardPredictor, {}, [(n, 8, USUAL_PX) for n in (1, 8, 32)]),
        (top, "topreward", TopRewardPredictor, {}, [(1, 16, SMALL_PX), (1, 64, SMALL_PX), (1, 16, USUAL_PX)]),
        (top, "topreward,num_prefixes=15", TopRewardPredictor, {}, [(1, 64, SMALL_PX)]),
    )
    for folder, reward_model, predictor_class, settings, sizes in plans:
        small: Any = families.load(GOLDEN / "reward_models" / folder, reward_model=reward_model)
        config = replace(of_real_size(small.config, VOCABULARY), **settings)
        if network is None:
            network = random_network(LanguageNetwork, config, device)
            network.lm_head.weight = network.model.language_model.embed_tokens.weight
        network.config = config
        scaled = replace(small, config=config)
        images = small.collator.images
        collator = scaled.make_collator(small.collator.tokenizer, VISION["patch_size"], images.normalisation)
        engine = Engine(predictor_class(network, collator, device), max_sample_tokens=10**6)
        rows += [measured(reward_model, engine, device, *size) for size in sizes]
    return rows


def main(file: Annotated[Path, typer.Argument(help="Where the results go.")], device: str = "cuda") -> None:
    """Measure all, and write FILE."""
    keep_float32()
    on = torch.device(device)
    rows = robometer(on)
    torch.cuda.empty_cache()
    rows += asked_in_words(on)
    told = {"device": torch.cuda.get_device_name(on), "torch": torch.__version__, "rows": rows}
    file.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)
