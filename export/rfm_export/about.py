# SPDX-License-Identifier: MIT
"""Parameters of a model's configuration that tell clients which checkpoint it serves."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tritonclient.grpc import model_config_pb2 as pb

from rfm.checkpoint.content import read_run_config
from rfm.checkpoint.hub import commit_of
from rfm.checkpoint.provenance import is_folder, license_of, settings_digest, source_name, weights_digest
from rfm.checkpoint.run_config import find_run_config
from rfm.checkpoint.weights import num_values
from rfm.family import NETWORK, Checkpoint, EncodersDescription, config_fields
from rfm.parameters import DTYPE_PARAMETER
from rfm_client.contract.model_info import (
    COMPUTATION_PARAMETER,
    DIGEST_PARAMETER,
    LICENSE_PARAMETER,
    NETWORK_PARAMETER,
    REVISION_PARAMETER,
    RUN_CONFIG_PARAMETER,
    SETTINGS_DIGEST_PARAMETER,
    SOURCE_PARAMETER,
    WEIGHTS_DIFFERENCE_PARAMETER,
)

# Facts from the source and from measurements of the export, which the exported files lack.
_OF_ORIGIN = (
    *(SOURCE_PARAMETER, REVISION_PARAMETER, RUN_CONFIG_PARAMETER, LICENSE_PARAMETER),
    *(COMPUTATION_PARAMETER, WEIGHTS_DIFFERENCE_PARAMETER),
)
_SECRET = re.compile(r"(^|_)(token|secret|password|key)$", re.IGNORECASE)  # for example hub_token, wandb_api_key


def origin_of(source: str | Path, folder: Path) -> dict[str, str]:
    """Return the checkpoint's origin as parameters by name: source, commit, training run's config.yaml, licence.

    The source of a folder is the end of its path. config.yaml becomes JSON without secrets.

    source: as the user named it
    folder: the checkpoint's files, from the Hub in a snapshot named by its commit
    """
    revision = "" if is_folder(source) else commit_of(folder)
    file = find_run_config(folder)
    of_run = {} if file is None else {RUN_CONFIG_PARAMETER: json.dumps(_public(read_run_config(file)))}
    license = license_of(folder)
    of_card = {} if license is None else {LICENSE_PARAMETER: license}
    return {SOURCE_PARAMETER: source_name(source), REVISION_PARAMETER: revision, **of_run, **of_card}


def origin_in(config: pb.ModelConfig) -> dict[str, str]:
    """Return the origin in an exported configuration, as ``origin_of`` does."""
    told = {name: config.parameters[name].string_value for name in _OF_ORIGIN if name in config.parameters}
    return {SOURCE_PARAMETER: "", REVISION_PARAMETER: "", **told}


def about(checkpoint: Checkpoint, origin: Mapping[str, str]) -> dict[str, str]:
    """Return parameters by name, without the digests of weights and settings, whose files do not exist yet."""
    return {**origin, NETWORK_PARAMETER: json.dumps(_network(checkpoint))}


def about_encoders(encoders: EncodersDescription, of_scorer: Mapping[str, str]) -> dict[str, str]:
    """Return the parameters of encoders, exported with a scorer of these parameters."""
    return {
        **{name: of_scorer[name] for name in (SOURCE_PARAMETER, REVISION_PARAMETER)},
        NETWORK_PARAMETER: json.dumps({"class": encoders.network_class}),
    }


def record_digests(config: pb.ModelConfig, version: int, repository: Path) -> None:
    """Set the digests of a version's weights and settings in ``repository``; an ensemble has those of its parts."""
    parts = [step.model_name for step in config.ensemble_scheduling.step] or [config.name]
    folders = [repository / part / str(version) for part in parts]
    kinds = [pb.ModelInstanceGroup.Kind.Name(group.kind) for group in config.instance_group]
    told = {"dtype": config.parameters[DTYPE_PARAMETER].string_value, "kinds": kinds} if kinds else {}
    config.parameters[DIGEST_PARAMETER].string_value = weights_digest(folders)
    config.parameters[SETTINGS_DIGEST_PARAMETER].string_value = settings_digest(folders, told)


def _public(value: Any) -> Any:
    """A YAML value in JSON's types, without texts whose keys name a secret."""
    if isinstance(value, dict):
        kept = {str(key): inner for key, inner in value.items() if not _is_secret(str(key), inner)}
        return {key: _public(inner) for key, inner in kept.items()}
    if isinstance(value, (list, tuple, set)):
        return [_public(inner) for inner in value]
    is_plain = value is None or isinstance(value, (str, int)) or (isinstance(value, float) and math.isfinite(value))
    return value if is_plain else str(value)


def _is_secret(key: str, value: Any) -> bool:
    return isinstance(value, (str, bytes)) and _SECRET.search(key) is not None


def _network(checkpoint: Checkpoint) -> dict[str, Any]:
    parameters: Counter[str] = Counter()
    for name, count in num_values(checkpoint.parts[NETWORK]).items():
        parameters[name.partition(".")[0]] += count
    return {
        "class": checkpoint.description.network_class,
        "config": config_fields(checkpoint.config),
        "parameters": dict(sorted(parameters.items())),  # as in the exported file, whose tensors are in another order
    }
