# SPDX-License-Identifier: MIT
"""Everything that an export needs: read a checkpoint, check the user's settings, and record the checkpoint's origin.

``max_batch_size`` is the largest batch that still makes a GPU score more samples a second. Small batches leave a GPU
idle while the CPU launches kernels. From about SATURATING_FLOP on, each further sample adds its full time: on an H200,
8 samples of a Robometer-4B take 16 ms each, and so do 32. A larger batch gains nothing, makes every caller wait for the
whole batch, and leaves nothing to the other GPUs.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from google.protobuf.text_format import ParseError

from rfm import published
from rfm.config import ExportConfig
from rfm.engine.device import computation
from rfm.engine.family import NETWORK, Checkpoint, Family, FrameEncoders, config_fields
from rfm.parameters import CHECKPOINT_FOLDER
from rfm.published.hub import check_links
from rfm.published.provenance import Assumption
from rfm.published.run_config import find_run_config
from rfm.serve.repository import CONFIG_FILE
from rfm.weights import num_values
from rfm_client.contract import ProgressSample
from rfm_client.contract.description import Description, Origin
from rfm_client.contract.samples import random_trajectory
from rfm_export.errors import ExportError
from rfm_export.layout import description_in
from rfm_export.pbtxt import parse

Printer: TypeAlias = Callable[[str], object]  # receives a line for the user

SATURATING_FLOP = 20e12  # in matrix products
MOST_SAMPLES = 64  # small networks hardly gain from more
TYPICAL_FRAMES, TYPICAL_PX = 8, 224
TYPICAL_TASK = "put the red block in the bowl"
_TERA = 1e12


@dataclass(frozen=True)
class Source:
    """The checked input for an export.

    description, of_encoders: describe the checkpoint and its encoders, without digests: the files do not exist yet
    settings: with a ``max_batch_size``
    num_gpus: GPUs that serve the export; 0: the CPU
    device: where scores are compared, as the user names it; None: the default
    full: loads the checkpoint with full weights; None: the settings round nothing
    """

    family: Family
    checkpoint: Checkpoint
    assumptions: tuple[Assumption, ...]
    encoders: FrameEncoders | None
    description: Description
    of_encoders: Description | None
    settings: ExportConfig
    num_gpus: int
    device: torch.device | None = None
    full: Callable[[], Checkpoint] | None = None


def read_for_export(
    source: str | Path,
    settings: ExportConfig,
    family: str | None,
    device: str | None,
    say: Printer,
    *,
    other_machine: bool,
) -> Source:
    """Read and check all that an export needs, before it writes; report doubts to ``say``.

    Parameters and errors: see ``export``.
    """
    if not other_machine:
        check_gpus(settings.num_gpus)
    named = None if device is None else device_named(device)
    folder = published.find(source, say)
    kind = published.choose(folder, family, settings)
    loaded = published.read_from(folder, kind, settings)
    checkpoint, encoders = loaded.checkpoint, loaded.encoders()
    check_links(folder)
    if (run_config := find_run_config(folder)) is not None:
        say(f"{run_config}: read as the settings of the training run")
    for note in published.notes(folder, loaded):
        say(note)
    gpus = num_gpus(settings)
    origin = published.origin_of(source, folder, computation(checkpoint, settings.torch_dtype, on_gpu=gpus > 0))
    origin = replace(origin, weights_difference=_earlier_difference(folder))
    _check_graphs(settings, checkpoint.description)
    return Source(
        kind,
        checkpoint,
        tuple(loaded.assumptions),
        encoders,
        described(checkpoint, origin),
        None if encoders is None else described_encoders(encoders.description, origin),
        with_batch_size(settings, checkpoint, say),
        gpus,
        named,
        None if settings.weights is None else partial(_full, folder, kind, settings),
    )


def _full(folder: Path, family: Family, settings: ExportConfig) -> Checkpoint:
    return published.read_from(folder, family, replace(settings, weights=None)).checkpoint


def device_named(name: str) -> torch.device:
    """Return the device with this name. Raises ExportError if this machine does not have it."""
    there, why = ["cpu"], f": PyTorch {torch.__version__} finds no GPU; --device cpu"
    if torch.cuda.is_available():
        there, why = ["cpu", "cuda", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))], ""
    if name not in there:
        raise ExportError.at("device", f"one of {', '.join(there)}", f"{name}{why}")
    return torch.device(name)


def check_gpus(num_gpus: int | None) -> None:
    """Raise ExportError for more GPUs than this machine has: Triton would refuse to load the models."""
    there = torch.cuda.device_count()
    if num_gpus is not None and num_gpus > there:
        remedy = "--other-machine exports for a machine with more, --num-gpus 0 for the CPU"
        raise ExportError.at("num_gpus", f"at most {there}", num_gpus, remedy)


def _check_graphs(settings: ExportConfig, description: Description) -> None:
    """Raise ExportError if CUDA graphs are on but nothing would use them."""
    if settings.cuda_graphs and not description.uses_graphs:
        expected = "an RFM, Robometer or RoboReward checkpoint (its expected score) on a Qwen backbone"
        raise ExportError.at("cuda_graphs", expected, "another", "leave out --cuda-graphs")
    if settings.cuda_graphs and not num_gpus(settings):
        remedy = "leave out --cuda-graphs, or name --num-gpus with --other-machine"
        raise ExportError.at("cuda_graphs", "an export for GPUs", "one for the CPU", remedy)


def num_gpus(settings: ExportConfig) -> int:
    """Return how many GPUs serve the export; 0: the CPU."""
    return torch.cuda.device_count() if settings.num_gpus is None else settings.num_gpus


def with_batch_size(settings: ExportConfig, checkpoint: Checkpoint, say: Printer) -> ExportConfig:
    """Return the settings with a ``max_batch_size``: the user's, else the saturating one.

    say: receives a line for the user about a number below MOST_SAMPLES
    Raises CheckpointError.
    """
    if settings.max_batch_size is not None:
        return settings
    sample = typical_sample(checkpoint)
    flop = checkpoint.flop(sample)
    number = saturating_samples(flop)
    if number < MOST_SAMPLES:
        (trajectory,) = sample.trajectories
        shown = f"{trajectory.num_frames} frames of {TYPICAL_PX}x{TYPICAL_PX}"
        why = f"one sample of {shown} takes {flop / _TERA:.1f} TFLOP, and a GPU is saturated at about"
        say(f"max_batch_size is {number}: {why} {SATURATING_FLOP / _TERA:.0f} (--max-batch-size sets another number)")
    return replace(settings, max_batch_size=number)


def saturating_samples(flop: float) -> int:
    """Return the power of two, 1 to MOST_SAMPLES, that comes nearest to SATURATING_FLOP. flop: per sample"""
    power = round(math.log2(SATURATING_FLOP / max(flop, 1.0)))
    return int(2 ** min(max(power, 0), math.log2(MOST_SAMPLES)))


def typical_sample(checkpoint: Checkpoint) -> ProgressSample:
    """Return a progress sample with as many frames as in training, else TYPICAL_FRAMES."""
    description = checkpoint.description
    num_frames = description.trained_frames or TYPICAL_FRAMES
    if description.network_frames is not None:
        num_frames = min(num_frames, description.network_frames)
    size_px = (TYPICAL_PX, TYPICAL_PX)
    random = np.random.default_rng(0)
    return ProgressSample(random_trajectory(random, num_frames, description.widths, task=TYPICAL_TASK, size_px=size_px))


def _earlier_difference(folder: Path) -> float | None:
    """Return the difference that an export measured when it wrote this folder; None: not measured, or no export."""
    kept = folder.parent / CONFIG_FILE  # in the version folder
    if folder.name != CHECKPOINT_FOLDER or not kept.is_file():
        return None
    try:
        return description_in(parse(kept.read_text())).weights_difference
    except (ParseError, ValueError):  # exports from before descriptions existed measured nothing
        return None


def origin_in(description: Description) -> Origin:
    """Return the origin in an exported description."""
    return Origin(**{each.name: getattr(description, each.name) for each in fields(Origin)})


def described(checkpoint: Checkpoint, origin: Origin) -> Description:
    """Return the checkpoint's description without digests for weights and settings: those files do not exist yet."""
    return replace(checkpoint.description, **vars(origin), network=_network(checkpoint))


def described_encoders(encoders: Description, origin: Origin) -> Description:
    """Return the description for encoders that are exported with a scorer from this origin."""
    return replace(encoders, source=origin.source, revision=origin.revision)


def _network(checkpoint: Checkpoint) -> dict[str, Any]:
    parameters: Counter[str] = Counter()
    for name, count in num_values(checkpoint.parts[NETWORK]).items():
        parameters[name.partition(".")[0]] += count
    skeleton = checkpoint.skeleton()
    tops = dict((*skeleton.named_parameters(recurse=False), *skeleton.named_children()))
    return {
        **checkpoint.description.network,
        "module": type(skeleton).__module__,
        "types": {name: type(tops[name]).__name__ for name in sorted(parameters) if name in tops},
        "config": config_fields(checkpoint.config),
        "parameters": dict(sorted(parameters.items())),  # as in the exported file, whose tensors are in another order
    }
