# SPDX-License-Identifier: MIT
"""What a command tells of settings that have no effect in it, a line each."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from google.protobuf.text_format import ParseError

from rfm.checkpoint.provenance import source_name
from rfm.launch.repository_folder import CONFIG_FILE
from rfm.parameters import BUDGET_PARAMETER, DTYPE_PARAMETER, SAMPLE_TOKENS_PARAMETER, THREADS_PARAMETER
from rfm_client.contract.model_info import SOURCE_PARAMETER
from rfm_client.contract.names import frames_name
from rfm_client.contract.settings import settings_of
from rfm_commands.config import LIFETIMES, Config
from rfm_export.publish import read_config
from rfm_gateway.config import GatewayConfig

TRIED = ["instances", "torch_threads", "max_batch_size"]


def notes_at_export(config: Config) -> Iterator[str]:
    """Keys that another command reads and that stand outside a section: in one, the file itself would say so."""
    for section in ("serve", "gateway"):
        keys = [key for name, key in config.file.flat.items() if name.startswith(f"{section}.")]
        if keys:
            yield f"{', '.join(keys)}: of no effect {LIFETIMES['export']}, only {LIFETIMES[section]}"
    yield from _notes_of_batch_size(config)


def notes_at_serve(config: Config, repository: Path) -> Iterator[str]:
    """Keys of the file that the repository contradicts, and settings of a gateway that does not run."""
    yield from _notes_of_repository(config, repository)
    none = GatewayConfig()
    unused = [name for name in settings_of(GatewayConfig) if getattr(config.gateway, name) != getattr(none, name)]
    if config.gateway.port is None and unused:
        yield f"{', '.join(f'gateway.{name}' for name in unused)}: of no effect without gateway.port"
    yield from _notes_of_batch_size(config)


def notes_at_tuning(config: Config, repository: Path) -> Iterator[str]:
    """Keys of the file that the repository, which is measured, contradicts, but for those that are tried."""
    yield from notes_at_export(config)
    yield from _notes_of_repository(config, repository, TRIED)


def _notes_of_repository(config: Config, repository: Path, ignored: Collection[str] = ()) -> Iterator[str]:
    """Keys of the section ``export``, but for those ignored, that the file sets to something else than was exported."""
    names = (config.export.name, frames_name(config.export.name))
    model = next((name for name in names if (repository / name / CONFIG_FILE).is_file()), None)
    if model is None:
        if "name" in config.file.values["export"]:
            yield _contradicted("name", "no such model", config.export.name)
        return
    try:
        there = exported_settings(read_config(repository, model))
    except (OSError, ParseError, ValueError):  # Triton will tell
        return
    for key in config.file.values["export"]:
        wanted = getattr(config.export, key)
        if key in there and key not in ignored and not _agrees(key, wanted, there[key]):
            yield _contradicted(key, there[key], wanted)


def _agrees(key: str, wanted: Any, there: Any) -> bool:
    """Whether what a file wants may be what was exported, which does not tell all: not where a folder lies."""
    if key == "checkpoint":
        name = source_name(wanted) if wanted else ""
        return name.endswith(there) or there.endswith(name)
    return wanted == there or (key == "num_gpus" and wanted is None)  # all, of whatever machine


def _contradicted(key: str, there: Any, wanted: Any) -> str:
    has = "null" if there is None else there
    file = "null" if wanted is None else wanted
    return f"export.{key}: takes effect {LIFETIMES['export']}; the repository has {has}, the file {file}: export again"


def _notes_of_batch_size(config: Config) -> Iterator[str]:
    if config.export.batch_size is not None:
        yield "batch_size has no effect, as in the FastAPI server; max_batch_size bounds a batch"


def exported_settings(config: Any) -> dict[str, Any]:
    """What a configuration of ``python_config`` tells of the ExportConfig that it was made from, by key.

    ``num_gpus`` is that of the machine for which it was made, ``checkpoint`` its ``source_name``. An older export tells
    less.
    """
    texts = {name: parameter.string_value for name, parameter in config.parameters.items()}
    numbers = (THREADS_PARAMETER, BUDGET_PARAMETER, SAMPLE_TOKENS_PARAMETER)
    told: dict[str, Any] = {key: int(texts[key]) for key in numbers if key in texts}
    policy = config.dynamic_batching.default_queue_policy
    told["max_queue_size"] = policy.max_queue_size or None
    told["queue_timeout_ms"] = policy.default_timeout_microseconds // 1000 or None
    if SOURCE_PARAMETER in texts:
        told["checkpoint"] = texts[SOURCE_PARAMETER]
    for group in config.instance_group:
        told |= {"num_gpus": len(group.gpus), "instances": group.count}
    return told | {"max_batch_size": config.max_batch_size, "dtype": texts.get(DTYPE_PARAMETER) or None}
