# SPDX-License-Identifier: MIT
"""Compare an exported model's scores with its checkpoint's, on a device with enough memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from rfm import families
from rfm.engine import Engine, Outcome
from rfm.engine.family import NETWORK, Checkpoint
from rfm.engine.graphs import PLAIN_CALLS
from rfm_client.contract import (
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract.description import Description
from rfm_client.contract.results import answer, trajectory_scores
from rfm_client.contract.samples import Widths, random_trajectory
from rfm_export.errors import ExportDiffersError, ExportError
from rfm_export.layout import Version
from rfm_export.source import Printer, Source

TOLERANCE = 1e-6  # same weights, machine and code: only rounding may differ
GRAPHS_TOLERANCE = 1e-5  # the same kernels on the same shapes; times the largest score of a kind, at least 1
PROBE_FRAMES = (1, 3, 8)
PROBE_SIZE_PX = (48, 80)
PROBE_FRAME_STEPS = 2
WORKING_ROOM = 1.5  # times the weights' bytes, for weights and a pass over a few small samples


def compare(source: Source, version: Version, staged: Path, device: torch.device, say: Printer) -> float | None:
    """Raise ExportDiffersError unless the staged weights give the checkpoint's scores.

    Return the largest difference that rounding the weights makes to the first score; None: nothing is rounded.
    device: from ``device_of``
    """
    difference = _difference(source, say)
    _compare_staged(source, version, staged, device, say)
    return difference


def _difference(source: Source, say: Printer) -> float | None:
    """Return the largest difference that rounding the weights makes to the first score; None: nothing is rounded."""
    full = None if source.full is None else source.full()
    if full is None or full.config.weights is not None:
        return None
    settings, kind = source.settings, source.checkpoint.config.weights
    device = source.device or device_for(full, settings.torch_dtype, may_use_gpu=settings.num_gpus != 0)
    engine = partial(Engine.of, device=device, dtype=settings.torch_dtype)
    samples = probes(full.description, with_encoders=False)
    with needing_room(device):
        score = full.description.scores[0]
        largest = largest_difference(partial(engine, full), partial(engine, source.checkpoint), samples, score)
    say(f"--weights {kind}: {score} differs by at most {largest:.2g} from the full checkpoint's, on noise")
    return float(f"{largest:.2g}")


def _compare_staged(source: Source, version: Version, staged: Path, device: torch.device, say: Printer) -> None:
    description, settings = source.checkpoint.description, source.settings
    engine = partial(Engine.of, device=device, dtype=_dtype(source))

    def exported(*, cuda_graphs: bool = False) -> Engine:
        checkpoint = families.load(version.checkpoint_folder(description, staged), family=source.family.name)
        if source.encoders is None:
            return engine(checkpoint, cuda_graphs=cuda_graphs)
        served_by = families.encoders_of(source.family.name)
        return engine(checkpoint, encoders=served_by.load(version.encoders_folder(staged)))

    samples = probes(description, with_encoders=source.encoders is not None)
    with needing_room(device):
        original = partial(engine, source.checkpoint, encoders=source.encoders)
        verify(original, exported, samples, may_not_answer=description.may_not_answer)
        if settings.cuda_graphs and device.type == "cuda":
            verify_graphs(partial(exported, cuda_graphs=True), description, say)
        elif settings.cuda_graphs:
            say(f"cuda_graphs: not compared with plain passes on {device}; rfm export --device names a GPU")


def _dtype(source: Source) -> torch.dtype | None:
    return source.settings.torch_dtype if source.checkpoint.description.is_large else None


def device_of(source: Source) -> torch.device:
    """Return where export and checkpoint are compared: the user's device, else the default."""
    may_use_gpu = source.settings.num_gpus != 0
    return source.device or device_for(source.checkpoint, _dtype(source), may_use_gpu=may_use_gpu)


def device_for(checkpoint: Checkpoint, dtype: torch.dtype | None, *, may_use_gpu: bool) -> torch.device:
    """Return the default device: the CPU, for a large network the GPU with most free memory, if enough.

    dtype: the network's type on the device; None: the weights' own
    """
    if not (checkpoint.description.is_large and may_use_gpu and torch.cuda.is_available()):
        return torch.device("cpu")
    free_bytes = [_free_bytes(index) for index in range(torch.cuda.device_count())]
    needed = WORKING_ROOM * sum(_bytes(each, dtype) for each in checkpoint.parts[NETWORK].values())
    roomiest = max(range(len(free_bytes)), key=free_bytes.__getitem__)
    return torch.device("cuda", roomiest) if free_bytes[roomiest] >= needed else torch.device("cpu")


def _bytes(weight: torch.Tensor, dtype: torch.dtype | None) -> int:
    """Return a weight's bytes in a network with ``dtype``; rounded weights stay as they are."""
    return weight.numel() * (dtype if dtype and weight.is_floating_point() else weight.dtype).itemsize


def _free_bytes(index: int) -> int:
    try:
        return torch.cuda.mem_get_info(index)[0]
    except RuntimeError:  # the GPU is full, or another process has it alone
        return 0


@contextmanager
def needing_room(device: torch.device) -> Iterator[None]:
    """Raise ExportError for a network that does not fit on the device."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        reason = str(error).partition("\n")[0].partition(". ")[0]
        expected = f"room on {device} to compare the export with the checkpoint"
        raise ExportError.at("device", expected, reason, "rfm export --device names another one") from error


def probes(description: Description, *, with_encoders: bool, seed: int = 0) -> list[Sample]:
    """Return random samples in several lengths for each type that the checkpoint can score.

    with_encoders: True: for a checkpoint that scores embeddings, raw frames too
    """
    random = np.random.default_rng(seed)

    def make(num_frames: int, widths: Widths) -> Trajectory:
        task = f"pick up {num_frames} red cups"
        return random_trajectory(random, num_frames, widths, task=task, size_px=PROBE_SIZE_PX)

    samples: list[Sample] = []
    for widths in (description.widths, None) if with_encoders else (description.widths,):
        for num_frames in PROBE_FRAMES:
            length = min(num_frames, description.network_frames or num_frames)
            samples.append(ProgressSample(make(length, widths)))
            if not description.needs_whole_episode:
                samples.append(ProgressSample(make(length, widths), frame_steps=PROBE_FRAME_STEPS))
            if description.has_preference:
                samples.append(PreferenceSample(make(length, widths), make(1, widths)))
            if description.has_similarity:
                samples.append(SimilaritySample(make(1, widths), make(length, widths)))
    return samples


def verify(
    original: Callable[[], Engine],
    exported: Callable[[], Engine],
    samples: Sequence[Sample],
    *,
    may_not_answer: bool = False,
) -> None:
    """Raise ExportDiffersError unless both engines give the same scores. Only one engine exists at a time.

    may_not_answer: True: both may also refuse a sample with the same text
    """
    scores = [make().evaluate(samples) for make in (original, exported)]
    for index, (before, after) in enumerate(zip(*scores, strict=True)):
        if may_not_answer and isinstance(before, InvalidSampleError) and str(before) == str(after):
            continue
        expected, got = _numbers(index, "the checkpoint", before), _numbers(index, "the export", after)
        if not np.allclose(got, expected, rtol=0, atol=TOLERANCE, equal_nan=True):
            largest = np.nanmax(np.abs(got - expected))  # NaN: success is not predicted
            raise ExportDiffersError.at(f"probe {index}", "the checkpoint's scores", f"a difference of {largest:g}")


def largest_difference(
    full: Callable[[], Engine], rounded: Callable[[], Engine], samples: Sequence[Sample], score: str = "progress"
) -> float:
    """Return the largest difference of a score between both engines. Only one engine exists at a time.

    Samples that either engine refuses do not count.
    """
    scores = [make().evaluate(samples) for make in (full, rounded)]
    pairs = [pair for pair in zip(*scores, strict=True) if not any(isinstance(each, RewardError) for each in pair)]
    scored = [map(trajectory_scores, pair) for pair in pairs]
    frames = [frame for before, after in scored for frame in zip(before.values(), after.values(), strict=True)]
    of_frames = [[getattr(each, score) for each in pair] for pair in frames]
    return max((float(np.nanmax(np.abs(after - before))) for before, after in of_frames), default=0.0)


def verify_graphs(make: Callable[[], Engine], description: Description, say: Printer) -> None:
    """Raise ExportDiffersError unless CUDA graphs give the same scores as plain passes.

    Each sample, and another with the same shapes, is scored alone: first by plain passes, then by graphs.

    make: returns an engine with CUDA graphs, which has not scored yet
    say: receives a line for the user
    """
    engine = make()
    if engine.graphs is None:
        return
    rounds = [probes(description, with_encoders=False, seed=seed) for seed in range(PLAIN_CALLS)]
    for index, samples in enumerate(zip(*rounds, strict=True)):
        engine.graphs.clear()
        plain, graphed = (
            [_arrays(index, whose, *engine.evaluate([sample])) for sample in samples]
            for whose in ("a plain pass", "a CUDA graph")
        )
        differences = [
            _scaled_difference(ours, theirs[name])
            for theirs, each in zip(plain, graphed, strict=True)
            for name, ours in each.items()
        ]
        if not (difference := max(differences)) <= GRAPHS_TOLERANCE:
            where, remedy = f"probe {index}: cuda_graphs", "leave out --cuda-graphs"
            got = f"a difference of {difference:g} times the largest"
            raise ExportDiffersError.at(where, "the scores of a plain pass", got, remedy)
    if engine.graphs.has_failed:
        say("cuda_graphs: this device cannot capture the network's passes, so the setting gains nothing here")


def _scaled_difference(got: npt.NDArray[np.float64], expected: npt.NDArray[np.float64]) -> float:
    """Return the largest difference, divided by the largest expected number if above 1; inf: NaN at other places."""
    known = np.isfinite(expected)
    if not np.array_equal(known, np.isfinite(got)):
        return np.inf
    return float(np.abs(got - expected)[known].max(initial=0) / np.abs(expected[known]).max(initial=1))


def _numbers(index: int, whose: str, outcome: Outcome) -> npt.NDArray[np.float64]:
    """Return all scores for a probe, concatenated."""
    return np.concatenate([*_arrays(index, whose, outcome).values()])


def _arrays(index: int, whose: str, outcome: Outcome) -> dict[str, npt.NDArray[np.float64]]:
    """Return all scores for a probe, by name."""
    if isinstance(outcome, RewardError):
        raise ExportDiffersError.at(f"probe {index}", f"scores of {whose}", outcome) from outcome
    answers = {name: np.array([number], np.float64) for name, number in answer(outcome).items()}
    return answers | {
        f"{role} {name}": array.ravel().astype(np.float64)
        for role, scores in trajectory_scores(outcome).items()
        for name, array in scores.arrays.items()
    }
