# SPDX-License-Identifier: MIT
"""Complete the description of a checkpoint with its origin, network and digests."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from tritonclient.grpc import model_config_pb2 as pb

from rfm.checkpoint.content import read_run_config
from rfm.checkpoint.hub import commit_of
from rfm.checkpoint.provenance import is_folder, license_of, settings_digest, source_name, weights_digest
from rfm.checkpoint.run_config import find_run_config
from rfm.checkpoint.weights import num_values
from rfm.family import NETWORK, Checkpoint, config_fields
from rfm.parameters import DTYPE_PARAMETER
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description, Origin

_SECRET = re.compile(r"(^|_)(token|secret|password|key)$", re.IGNORECASE)  # for example hub_token, wandb_api_key


def origin_of(source: str | Path, folder: Path, computation: str) -> Origin:
    """Return the checkpoint's origin: source, commit, training run's config.yaml, licence.

    The source of a folder is the end of its path. config.yaml becomes JSON without secrets.

    source: as the user named it
    folder: the checkpoint's files, from the Hub in a snapshot named by its commit
    computation: as in ``Origin``
    """
    file = find_run_config(folder)
    return Origin(
        source=source_name(source),
        revision=None if is_folder(source) else commit_of(folder),
        license=license_of(folder),
        run_config={} if file is None else _public(read_run_config(file)),
        computation=computation,
    )


def origin_in(description: Description) -> Origin:
    """Return the origin in an exported description."""
    return Origin(**{each.name: getattr(description, each.name) for each in fields(Origin)})


def described(checkpoint: Checkpoint, origin: Origin) -> Description:
    """Return the checkpoint's description without the digests of weights and settings, whose files do not exist yet."""
    return replace(checkpoint.description, **vars(origin), network=_network(checkpoint))


def described_encoders(encoders: Description, origin: Origin) -> Description:
    """Return the description of encoders, exported with a scorer of this origin."""
    return replace(encoders, source=origin.source, revision=origin.revision)


def description_in(config: pb.ModelConfig) -> Description:
    """Return the description in an exported configuration. Raises ValueError."""
    return Description.parse(config.parameters[DESCRIPTION_PARAMETER].string_value)


def record_digests(config: pb.ModelConfig, version: int, repository: Path) -> None:
    """Set the digests of a version's weights and settings in ``repository``; an ensemble has those of its parts."""
    parts = [step.model_name for step in config.ensemble_scheduling.step] or [config.name]
    folders = [repository / part / str(version) for part in parts]
    kinds = [pb.ModelInstanceGroup.Kind.Name(group.kind) for group in config.instance_group]
    told = {"dtype": config.parameters[DTYPE_PARAMETER].string_value, "kinds": kinds} if kinds else {}
    found = replace(
        description_in(config), weights_digest=weights_digest(folders), settings_digest=settings_digest(folders, told)
    )
    config.parameters[DESCRIPTION_PARAMETER].string_value = found.to_json()


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
        **checkpoint.description.network,
        "config": config_fields(checkpoint.config),
        "parameters": dict(sorted(parameters.items())),  # as in the exported file, whose tensors are in another order
    }
