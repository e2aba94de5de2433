# SPDX-License-Identifier: MIT
"""Each model's config.pbtxt, from the wire contract and the ExportConfig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from google.protobuf import text_format
from tritonclient.grpc import model_config_pb2 as pb

from rfm.config import ExportConfig
from rfm.parameters import (
    BUDGET_PARAMETER,
    DTYPE_PARAMETER,
    EXPORT_PARAMETER,
    EXPORT_VERSION,
    SAMPLE_TOKENS_PARAMETER,
    THREADS_PARAMETER,
)
from rfm.serve.repository import EXPORT_HEADER
from rfm_client.contract import wire
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description
from rfm_client.contract.wire import TensorSpec

_US_PER_MS = 1000
HEADER = f"{EXPORT_HEADER}; `rfm export --check` compares it with what would be generated.\n"


@dataclass(frozen=True)
class Interface:
    """A model's name, inputs and outputs, and the description that clients read."""

    name: str
    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    description: Description


@dataclass(frozen=True)
class Warmup:
    """A request that Triton sends before the model is ready, from files in the model's ``warmup`` folder."""

    name: str
    tensors: wire.Tensors

    def files(self) -> dict[str, bytes]:
        """Return file contents by name; Triton itself makes tensors of zeros."""
        return {f"{self.name}.{name}": _raw(array[0]) for name, array in self.tensors.items() if not _is_zero(array)}


def python_config(
    interface: Interface, settings: ExportConfig, num_gpus: int, version: int, warmups: Sequence[Warmup]
) -> pb.ModelConfig:
    """Return a Python-backend model with dynamic batching, ``settings.instances`` on each GPU, or on the CPU."""
    config = _config(interface, settings, version)
    config.backend = "python"
    for spec, tensor in zip(interface.inputs, config.input, strict=True):
        tensor.allow_ragged_batch = spec.ragged
    config.dynamic_batching.SetInParent()
    if settings.max_queue_size is not None or settings.queue_timeout_ms is not None:
        _bound_queue(config.dynamic_batching, settings)
    kind = pb.ModelInstanceGroup.KIND_GPU if num_gpus else pb.ModelInstanceGroup.KIND_CPU
    config.instance_group.add(count=settings.instances or 1, kind=kind, gpus=range(num_gpus))
    config.parameters[BUDGET_PARAMETER].string_value = str(settings.token_budget)
    config.parameters[SAMPLE_TOKENS_PARAMETER].string_value = str(settings.max_sample_tokens)
    config.parameters[THREADS_PARAMETER].string_value = str(settings.torch_threads)
    config.parameters[DTYPE_PARAMETER].string_value = settings.dtype or ""
    for warmup in warmups:
        _add_warmup(config, interface, warmup)
    return config


def ensemble_config(
    interface: Interface, settings: ExportConfig, version: int, encoder: Interface, scorer: Interface
) -> pb.ModelConfig:
    """Return an ensemble of encoder and scorer, both at their export's version."""
    config = _config(interface, settings, version)
    config.platform = "ensemble"
    own = {spec.name for spec in (*interface.inputs, *interface.outputs)}
    for step_of in (encoder, scorer):
        step = config.ensemble_scheduling.step.add(model_name=step_of.name, model_version=version)
        step.input_map.update({spec.name: spec.name for spec in step_of.inputs})
        step.output_map.update({spec.name: spec.name for spec in step_of.outputs})
    produced = {spec.name for spec in encoder.outputs}
    missing = {spec.name for spec in (*encoder.inputs, *scorer.inputs)} - own - produced
    assert not missing, missing  # the wire contract connects both models
    return config


def serving_versions(config: pb.ModelConfig, versions: Sequence[int]) -> pb.ModelConfig:
    """Return a copy of the configuration that serves ``versions``."""
    changed = pb.ModelConfig()
    changed.CopyFrom(config)
    del changed.version_policy.specific.versions[:]
    changed.version_policy.specific.versions.extend(versions)
    return changed


def render(config: pb.ModelConfig) -> str:
    """Return the configuration as config.pbtxt text."""
    return HEADER + str(text_format.MessageToString(config))


def parse(text: str) -> pb.ModelConfig:
    """Parse a config.pbtxt. Raises google.protobuf.text_format.ParseError."""
    return text_format.Parse(text, pb.ModelConfig())


def _config(interface: Interface, settings: ExportConfig, version: int) -> pb.ModelConfig:
    assert settings.max_batch_size is not None  # ``with_batch_size`` has set it
    config = pb.ModelConfig(name=interface.name, max_batch_size=settings.max_batch_size)
    config.version_policy.specific.versions.append(version)
    for spec in interface.inputs:
        config.input.add(name=spec.name, data_type=_datatype(spec), dims=spec.dims, optional=spec.optional)
    for spec in interface.outputs:
        config.output.add(name=spec.name, data_type=_datatype(spec), dims=spec.dims)
    config.parameters[EXPORT_PARAMETER].string_value = EXPORT_VERSION
    config.parameters[DESCRIPTION_PARAMETER].string_value = interface.description.to_json()
    return config


def _bound_queue(batching: pb.ModelDynamicBatching, settings: ExportConfig) -> None:
    """Limit Triton's queue. Triton answers 503 if the queue is full, or a request waits too long."""
    policy = batching.default_queue_policy
    if settings.max_queue_size is not None:
        policy.max_queue_size = settings.max_queue_size
    if settings.queue_timeout_ms is not None:
        policy.default_timeout_microseconds = settings.queue_timeout_ms * _US_PER_MS
        policy.allow_timeout_override = True  # a request may ask for a shorter timeout


def _add_warmup(config: pb.ModelConfig, interface: Interface, warmup: Warmup) -> None:
    sample = config.model_warmup.add(name=warmup.name, batch_size=1)
    for spec in [spec for spec in interface.inputs if spec.name in warmup.tensors]:
        tensor = sample.inputs[spec.name]
        tensor.data_type = _datatype(spec)
        tensor.dims.extend(warmup.tensors[spec.name].shape[1:])
        if _is_zero(warmup.tensors[spec.name]):
            tensor.zero_data = True
        else:
            tensor.input_data_file = f"{warmup.name}.{spec.name}"


def _datatype(spec: TensorSpec) -> int:
    return int(pb.DataType.Value("TYPE_STRING" if spec.datatype == "BYTES" else f"TYPE_{spec.datatype}"))


def _is_zero(array: npt.NDArray[Any]) -> bool:
    return array.dtype != np.object_ and not array.any()


def _raw(array: npt.NDArray[Any]) -> bytes:
    """Return the bytes that Triton reads; each string follows its length."""
    if array.dtype == np.object_:
        return b"".join(len(item).to_bytes(4, "little") + item for item in array.ravel())
    return array.tobytes()
