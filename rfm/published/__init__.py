# SPDX-License-Identifier: MIT
"""Read checkpoints as others published them, or as they were exported: at export and in tools, never in serving.

A checkpoint is a local folder or a Hugging Face id ``org/name[/subfolder][@tag]``. It holds ``model.safetensors`` (or
shards with an index, or an adapter) and ``config.json`` (the network). ``config.yaml`` (the training run) is there, in
the parent folder, or on main in the Hub repository. Nothing in a checkpoint is executed: weights are read only from
safetensors, and YAML tags construct no objects.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from rfm.config import CheckpointConfig
from rfm.engine.family import NETWORK, Checkpoint, Family
from rfm.families import FAMILIES, named
from rfm.files import WEIGHTS, CheckpointError, read_run_config
from rfm.published.hub import commit_of
from rfm.published.hub import find as find
from rfm.published.provenance import assumption_lines, is_folder, license_of, source_name
from rfm.published.reader import Loaded, Reader, asked, check_used
from rfm.published.rounding import rounded_as_asked
from rfm.published.run_config import HEADS, SIMILARITY, constant_heads, find_run_config, training_notes
from rfm.weights import check_values
from rfm_client.contract.checks import require
from rfm_client.contract.description import Origin

_SECRET = re.compile(r"(^|_)(token|secret|password|key)$", re.IGNORECASE)  # for example hub_token, wandb_api_key


def reader_of(family: Family) -> Reader:
    """Return the family's reader for published checkpoints."""
    reader = import_module(family.reader).READER
    assert isinstance(reader, Reader), family.reader
    return reader


def choose(folder: Path, package: str | None = None, options: CheckpointConfig | None = None) -> Family:
    """Return the family ``package``, or that of the reward model in ``options``, or the first that reads the folder.

    Raises CheckpointError.
    """
    if package:
        return named(package)
    readers = {family: reader_of(family) for family in map(named, FAMILIES)}
    if options is not None and options.reward_model is not None:
        wanted, _ = asked(options)
        found = next((family for family, reader in readers.items() if wanted in reader.reward_models), None)
        if found is not None:
            return found
        names = [name for reader in readers.values() for name in reader.reward_models]
        raise CheckpointError.at("--as", f"one of {', '.join(names)}", repr(wanted))
    *_, last = readers  # its load explains the fault
    return next((family for family, reader in readers.items() if reader.reads(folder)), last)


def read(source: str | Path, *, family: str | None = None, **options: Any) -> Loaded:
    """Read a checkpoint from a local folder or Hugging Face id.

    family: the family's package; None: the family that reads the folder's files
    options: fields of ``CheckpointConfig``, except ``dtype``, which ``Engine.of`` takes
    Raises CheckpointError; ConfigError for an option's wrong value, TypeError for an unknown option.
    """
    folder, settings = find(source), CheckpointConfig(checkpoint=str(source), **options)
    require("dtype", settings.dtype is None, "none, since Engine.of takes it", settings.dtype)
    return read_from(folder, choose(folder, family, settings), settings)


def load(source: str | Path, **options: Any) -> Checkpoint:
    """Load a checkpoint from a local folder or Hugging Face id. options and errors: as for ``read``."""
    return read(source, **options).checkpoint


def read_from(folder: Path, family: Family, options: CheckpointConfig) -> Loaded:
    """Read a checkpoint from a local folder. Raises CheckpointError, also for non-finite weights or zero matrices."""
    loaded = reader_of(family).load(folder, options)
    loaded = replace(loaded, checkpoint=rounded_as_asked(loaded.checkpoint, options.weights))
    check_used(options, loaded.checkpoint.config)
    for weights in loaded.checkpoint.parts.values():
        check_values(weights)
    return loaded


def notes(folder: Path, loaded: Loaded, answered: Collection[str] = HEADS) -> list[str]:
    """Return one line for the user per doubtful setting or head that the checkpoint's scores depend on.

    answered: heads that the model serves; for a missing head, only its absence is noted
    Raises CheckpointError for a config.yaml that cannot be read.
    """
    description = loaded.checkpoint.description
    heads = [head for head in answered if head not in description.lacks]
    expected = set() if description.asks_in_words else {*answered} - {SIMILARITY}  # most networks lack SIMILARITY
    missing = [head for head in answered if head in expected and head in description.lacks]
    without = [f"{WEIGHTS}: there is no head of {' and '.join(missing)}: served without"] if missing else []
    of_weights = constant_heads(loaded.checkpoint.parts[NETWORK], heads)
    of_run = training_notes(folder, heads)
    return [*without, *of_run, *of_weights, *loaded.notes(loaded.checkpoint), *assumption_lines(loaded.assumptions)]


def origin_of(source: str | Path, folder: Path, computation: str) -> Origin:
    """Return the checkpoint's origin: source, commit, training run's config.yaml, licence.

    For a folder, the source is the end of its path. config.yaml becomes JSON without secrets.

    source: as the user named it
    folder: the checkpoint's files; from the Hub, a snapshot named by its commit
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


def _public(value: Any) -> Any:
    """Return a YAML value in JSON types, without texts whose keys name a secret."""
    if isinstance(value, dict):
        kept = {str(key): inner for key, inner in value.items() if not _is_secret(str(key), inner)}
        return {key: _public(inner) for key, inner in kept.items()}
    if isinstance(value, (list, tuple, set)):
        return [_public(inner) for inner in value]
    is_plain = value is None or isinstance(value, (str, int)) or (isinstance(value, float) and math.isfinite(value))
    return value if is_plain else str(value)


def _is_secret(key: str, value: Any) -> bool:
    return isinstance(value, (str, bytes)) and _SECRET.search(key) is not None
