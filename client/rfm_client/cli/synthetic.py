# SPDX-License-Identifier: MIT
"""Synthetic samples, to check that a server answers and how fast; also as input for ``perf_analyzer``.

The file follows perf_analyzer's ``--input-data`` format (its docs/input_data.md). ``data`` has an entry for each
request. Each tensor has ``content`` in row-major order, and ``shape`` without the batch axis, which perf_analyzer adds.
Numbers are base64 of their little-endian bytes.
"""

from __future__ import annotations

import base64
import itertools
import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client.client import RewardClient
from rfm_client.contract.errors import ModelNotFoundError
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Sample, SimilaritySample, random_trajectory
from rfm_client.contract.settings import Settings, setting
from rfm_client.contract.wire import encode_samples

TASK = "put the block in the bowl"

SampleType: TypeAlias = Literal["progress", "preference", "similarity"]

_LENGTHS = re.compile(r"([1-9][0-9]{0,3})(?:-([1-9][0-9]{0,3}))?")  # longer trajectories only fill the memory


def parse_lengths(text: str) -> list[int]:
    """Return the lengths in ``8``, ``4,8,16`` or ``4-16``. Raises ValueError."""
    lengths: list[int] = []
    for part in text.split(","):
        match = _LENGTHS.fullmatch(part.strip())
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise ValueError(f"expected a length (8), several (4,8,16) or a range (4-16), got {text!r}")
        lengths += range(int(match[1]), int(match[2] or match[1]) + 1)
    return lengths


def num_samples_setting(default: int) -> Any:
    """Return a field for the option ``--num-samples``."""
    return setting(default, "Number of samples.", least=1, most=10_000)


@dataclass(frozen=True)
class SyntheticSamples(Settings):
    """Synthetic samples: type, number, and trajectory lengths."""

    TITLE: ClassVar[str] = "Samples"

    sample_type: SampleType = setting("progress", "Type of the samples.")
    num_samples: int = num_samples_setting(4)
    num_frames: Sequence[int] = setting(
        (8,),
        "Frames of a trajectory: one length, several or a range, in turn.",
        metavar="N|N,M,...|N-M",
        parse=parse_lengths,
    )
    use_frames: bool = setting(False, "Send random frames even if the model takes embeddings.")
    seed: int = setting(0, "Seed of the random numbers.", least=0)

    def samples(self, client: RewardClient) -> list[Sample]:
        """Return samples with the served checkpoint's widths. Raises ModelNotFoundError if no model takes them."""
        info = None
        if not self.use_frames:
            with suppress(ModelNotFoundError):
                info = client.model_info()
        widths = (info or client.model_info(frames=True)).widths
        random = np.random.default_rng(self.seed)
        lengths = itertools.cycle(random.permutation(self.num_frames).tolist())
        trajectories = (random_trajectory(random, length, widths, task=TASK) for length in lengths)
        if self.sample_type == "progress":
            return [ProgressSample(next(trajectories)) for _ in range(self.num_samples)]
        pair = PreferenceSample if self.sample_type == "preference" else SimilaritySample
        return [pair(next(trajectories), next(trajectories)) for _ in range(self.num_samples)]


@dataclass(frozen=True)
class BenchSamples(SyntheticSamples):
    """Synthetic samples for a benchmark."""

    num_samples: int = num_samples_setting(64)


def are_frames(samples: Sequence[Sample]) -> bool:
    """True if synthetic samples have raw frames."""
    return samples[0].trajectories[0].frames is not None


def perf_analyzer_input(samples: Sequence[Sample]) -> dict[str, Any]:
    """Return the JSON document: for each sample a request as RewardClient would send it alone."""
    requests = [encode_samples([sample]) for sample in samples]
    return {"data": [{name: _tensor(array[0]) for name, array in request.items()} for request in requests]}


def write_perf_analyzer_input(file: Path, samples: Sequence[Sample]) -> None:
    """Write the samples to ``file``, in perf_analyzer's JSON format."""
    file.write_text(json.dumps(perf_analyzer_input(samples)))


def _tensor(array: npt.NDArray[Any]) -> dict[str, Any]:
    if array.dtype == np.object_:  # BYTES: plain text
        return {"content": [element.decode() for element in array.ravel()], "shape": list(array.shape)}
    little_endian = array.astype(array.dtype.newbyteorder("<"), copy=False)
    return {"content": {"b64": base64.b64encode(little_endian.tobytes()).decode()}, "shape": list(array.shape)}
