# SPDX-License-Identifier: MIT
"""What it takes to export and serve a checkpoint, estimated before a download: network, disk, memory, time."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
import torch

from rfm.config import ExportConfig
from rfm.files import HUB_FILES, HUB_WEIGHTS
from rfm.published.hub import Found, missing_bytes
from rfm.published.provenance import is_folder
from rfm_client.contract.hub_access import HubError
from rfm_export.errors import ExportError
from rfm_export.verify import WORKING_ROOM

DOWNLOAD_BYTES_PER_S = 15e6
# Host memory, as a multiple of bfloat16 weights, for a CPU as measured: benchmarks/results/results.md
EXPORT_ON_CPU, EXPORT_BESIDE_GPU = 5.7, 2.6  # beside a GPU nothing becomes float32
SERVE_ON_CPU, SERVE_ROUNDED_ON_CPU = 3.0, 1.0  # rounded weights do not become float32
EXPORT_PROCESS, SERVE_PROCESSES = 0.4e9, 0.7e9  # bytes without weights, as measured with a ReWiND's encoders
PLAINLY = 0.75  # less of this memory is too little; some networks need less than others
ROUNDED = {None: 1.0, "int8": 0.6, "nf4": 0.4}  # size of rounded weights; embeddings are not rounded
BYTES_PER_PARAMETER = 2  # bfloat16
SAMPLE_TOKENS, SAMPLE = 600, "8 frames of 224x224"  # of a Qwen3-VL
CORE_FLOP_PER_S = 50e9  # a core with AVX2, in float32
_GB, _MB, _MINUTE_S = 1e9, 1e6, 60


@dataclass(frozen=True)
class Need:
    """A line for the user, and what it needs of a resource. free: bytes of it; name, remedy: for an error"""

    line: str
    needed: float = 0
    free: float = 0
    name: str = ""
    remedy: str = ""

    def check(self) -> None:
        """Raise ExportError if there is too little of the resource."""
        if self.needed > self.free:
            raise ExportError.at(self.name, f"at least {size(self.needed)}", f"{size(self.free)} free", self.remedy)


def needs(found: Found, settings: ExportConfig, num_gpus: int, cache: Path) -> Iterator[Need]:
    """Yield what export and server need, resource by resource.

    num_gpus: 0: the CPU serves
    cache: where the export will be
    """
    download = found.missing_bytes + sum(_missing_parts(found, settings))
    seconds = download / DOWNLOAD_BYTES_PER_S
    if download:
        rate = f"{DOWNLOAD_BYTES_PER_S / _MB:.0f} MB/s"
        yield Need(f"download: {size(download)}, {_duration(seconds)} at {rate}")
    else:
        yield Need("download: nothing for the checkpoint itself")
    if found.is_adapter:
        yield Need("memory, disk: those of the adapter's base model")
        return
    loaded = found.weights_bytes - (found.float32_bytes or 0) / 2  # in bfloat16
    weights = loaded * ROUNDED[settings.weights]
    yield from _disk(download, found.weights_bytes if settings.weights is None else weights, cache)
    is_known = found.float32_bytes is not None  # else only the line says what is needed
    free = [torch.cuda.mem_get_info(index)[0] for index in range(num_gpus)]
    is_compared_on_gpu = max(free, default=0) >= WORKING_ROOM * found.weights_bytes
    export = loaded * (EXPORT_BESIDE_GPU if is_compared_on_gpu else EXPORT_ON_CPU) + EXPORT_PROCESS
    multiple = SERVE_ON_CPU if settings.weights is None else SERVE_ROUNDED_ON_CPU
    serve = 0 if free else loaded * multiple + SERVE_PROCESSES
    host = psutil.virtual_memory().available
    then = "" if free else f", then {size(serve)} to serve"
    line = f"memory: about {size(export)} to export{then}; {size(host)} are free"
    remedy = "use a machine with more, or with a GPU; rfm export tries it all the same"
    yield Need(line, is_known * PLAINLY * max(export, serve), host, "memory", remedy)
    if free:
        name = f"{'GPU' if num_gpus == 1 else f'{num_gpus} GPUs'}: {torch.cuda.get_device_name(0)}"
        line = f"{name}, on which the weights take about {size(weights)}; {size(min(free))} are free"
        smaller = {None: "--weights int8 halves them, or ", "int8": "--weights nf4 takes fewer, or "}
        remedy = f"{smaller.get(settings.weights, '')}name a GPU with more (CUDA_VISIBLE_DEVICES)"
        yield Need(line, is_known * weights, min(free), "GPU memory", remedy)
    else:
        flop = 2 * loaded / BYTES_PER_PARAMETER * SAMPLE_TOKENS
        seconds = flop / (CORE_FLOP_PER_S * len(os.sched_getaffinity(0)))
        yield Need(f"no GPU: the CPU takes {_duration(seconds)} for a sample with {SAMPLE}, by an estimate")


def _missing_parts(found: Found, settings: ExportConfig) -> Iterator[int]:
    """Yield the download size of each Hub repository that the settings name beside the checkpoint."""
    without_weights = [pattern for pattern in HUB_FILES if pattern != HUB_WEIGHTS]
    of_base = HUB_FILES if found.is_adapter else without_weights
    named = (settings.image_encoder, HUB_FILES), (settings.text_encoder, HUB_FILES), (settings.base_model, of_base)
    for source, patterns in named:
        if source is not None and not is_folder(source):
            try:
                yield missing_bytes(source, patterns)
            except HubError as error:
                raise ExportError.at(source, "a folder or Hugging Face id", error) from error


def _disk(download: float, weights: float, cache: Path) -> Iterator[Need]:
    from huggingface_hub.constants import HF_HUB_CACHE

    hub = Path(HF_HUB_CACHE)
    hub_place, place = _existing(hub), _existing(cache)
    is_shared = hub_place.stat().st_dev == place.stat().st_dev
    places = [(hub, download, "HF_HOME")] * bool(download) + [(cache, weights, "XDG_CACHE_HOME")]
    for folder, own, variable in places:
        needed = download + weights if is_shared else own
        free = shutil.disk_usage(_existing(folder)).free
        remedy = f"make room, or set {variable} to another disk"
        yield Need(f"disk: {size(own)} in {folder}; {size(free)} are free", needed, free, f"disk of {folder}", remedy)


def _existing(folder: Path) -> Path:
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())


def size(number: float) -> str:
    """Return bytes as text in GB or MB, with three digits."""
    unit, name = (_GB, "GB") if number >= _GB else (_MB, "MB")
    return f"{float(f'{number / unit:.3g}'):g} {name}"


def _duration(seconds: float) -> str:
    if seconds < 1:
        return "less than a second"
    return f"about {seconds:.0f} s" if seconds < 2 * _MINUTE_S else f"about {seconds / _MINUTE_S:.0f} minutes"
