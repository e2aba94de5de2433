# SPDX-License-Identifier: MIT
"""Check a model's files before Triton loads it, since Triton hangs, or gives no reason, if they are not whole."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from google.protobuf import text_format
from tritonclient.grpc.model_config_pb2 import ModelConfig

from rfm.launch.installation import ServerStartError
from rfm.launch.repository_folder import CONFIG_FILE, EXPORT_HEADER, MODEL_FILE
from rfm.parameters import EXPORT_PARAMETER, EXPORT_VERSION, PYTHON_PARAMETERS
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description


def check_models(repository: Path, models: Collection[str]) -> None:
    """Check the files of models. Raises ServerStartError with the fault of each model."""
    faults = {model: fault for model in models if (fault := fault_in(repository, model)) is not None}
    if faults:
        raise ServerStartError("; ".join(faults.values()), next(iter(faults)))


def fault_in(repository: Path, model: str, config: ModelConfig | None = None) -> str | None:
    """Return why a model cannot be loaded, with the remedy; None: its files are whole.

    config: configuration of an exported version that is not served yet; None: the model's file, which another program
        may have written
    """
    again = f"export again with `rfm export --checkpoint CHECKPOINT --repository {repository}`"
    folder, file = repository / model, repository / model / CONFIG_FILE
    is_exported = config is not None
    if config is None:
        try:
            text = file.read_text()
            config = text_format.Parse(text, ModelConfig(), allow_unknown_field=True)
        except (OSError, UnicodeDecodeError, text_format.ParseError) as error:
            return f"{file}: expected a model's configuration, got {error}; {again}"
        if not config.ListFields():
            return f"{file}: expected a model's configuration, got an empty file; {again}"
        is_exported = text.startswith(EXPORT_HEADER)
    if is_exported and (fault := _outdated(config)) is not None:
        return f"{file}: {fault}; {again}"
    there = sorted(int(path.name) for path in folder.glob("*/") if path.name.isdecimal())
    for version in config.version_policy.specific.versions or there[-1:] or [1]:
        if version not in there:
            return f"{folder / str(version)}: expected the folder of a version, got none; {again}"
        program = folder / str(version) / (config.default_model_filename or MODEL_FILE)
        if config.backend == "python" and not program.is_file():
            return f"{program}: expected the model's program, got none; copy the whole folder, or {again}"
    return None


def _outdated(config: ModelConfig) -> str | None:
    """Return what an exported configuration lacks; None: nothing."""
    stamp = config.parameters[EXPORT_PARAMETER].string_value
    if stamp != EXPORT_VERSION:
        is_newer = stamp.isdecimal() and int(stamp) > int(EXPORT_VERSION)
        return f"expected an export by this version of rfm, got one of {'a newer' if is_newer else 'an older'} version"
    needed = () if config.backend != "python" else PYTHON_PARAMETERS
    missing = [name for name in needed if name not in config.parameters]
    if missing:
        return f"expected the parameter {missing[0]}, got none"
    try:
        Description.parse(config.parameters[DESCRIPTION_PARAMETER].string_value)
    except ValueError as error:
        return str(error)
    return None
