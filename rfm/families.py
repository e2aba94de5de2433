# SPDX-License-Identifier: MIT
"""Find a checkpoint's family by name or by the checkpoint's files, and load the checkpoint."""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module
from pathlib import Path
from typing import Any

from rfm.checkpoint.content import WEIGHTS, CheckpointError
from rfm.checkpoint.hub import find as find
from rfm.checkpoint.provenance import told
from rfm.checkpoint.run_config import HEADS, SIMILARITY, constant_heads, training_notes
from rfm.checkpoint.weights import check_values
from rfm.family import NETWORK, Checkpoint, Family, FrameEncoders, Loaded, Options, Reader, VideoPrompt, Weights

# Packages in the order in which they are tried. ReWiND comes last: its first checkpoints do not name their network.
FAMILIES = (
    "rfm.families.topreward",
    "rfm.families.roboreward",
    "rfm.families.robodopamine",
    "rfm.families.rynnvalue",
    "rfm.families.robometer",
    "rfm.families.rewind",
)
# Names of packages in exports of 0.4.
_FORMER = {f"rfm.{name.rpartition('.')[2]}": name for name in FAMILIES} | {"rfm.vlm": "rfm.families.robometer"}


def named(package: str) -> Family:
    """Return a package's ``FAMILY``. Raises CheckpointError if there is none."""
    package = _FORMER.get(package, package)
    try:
        family = getattr(import_module(package), "FAMILY", None)
    except ImportError as error:
        raise CheckpointError.at("family", "a package that can be imported", f"{package}: {error}") from error
    if not isinstance(family, Family):
        raise CheckpointError.at("family", "a package with a FAMILY", package)
    if family.name != package:
        raise CheckpointError.at("family", f"the name of its package, {package}", family.name)
    return family


def encoders_of(package: str) -> type[FrameEncoders]:
    """Return the class of a family's encoders. Raises CheckpointError if the family has none."""
    encoders = named(package).encoders
    if encoders is None:
        raise CheckpointError.at("family", "one with encoders", f"{package}, whose checkpoints score raw frames")
    return encoders


def restore(folder: Path, package: str) -> Checkpoint:
    """Load what ``Checkpoint.save`` wrote. Raises CheckpointError, also for weights of NaN or zeros.

    package: of the checkpoint's family
    """
    checkpoint = named(package).restore(folder)
    for weights in checkpoint.parts.values():
        check_values(weights)
    return checkpoint


def reader_of(family: Family) -> Reader:
    """Return the family's reader of published checkpoints."""
    reader = import_module(family.reader).READER
    assert isinstance(reader, Reader), family.reader
    return reader


def choose(folder: Path, package: str | None = None, options: Options | None = None) -> Family:
    """Return the family ``package``, or of the reward model in ``options``, else the first that reads the folder.

    Raises CheckpointError.
    """
    if package:
        return named(package)
    readers = {family: reader_of(family) for family in map(named, FAMILIES)}
    if options is not None and options.reward_model is not None:
        wanted, _ = options.named()
        found = next((family for family, reader in readers.items() if wanted in reader.reward_models), None)
        if found is not None:
            return found
        names = [name for reader in readers.values() for name in reader.reward_models]
        raise CheckpointError.at("--as", f"one of {', '.join(names)}", repr(wanted))
    *_, last = readers  # whose load explains the fault
    return next((family for family, reader in readers.items() if reader.reads(folder)), last)


def read(
    source: str | Path,
    *,
    family: str | None = None,
    base_model: str | None = None,
    image_encoder: str | None = None,
    text_encoder: str | None = None,
    reward_model: str | None = None,
    video_prompt: VideoPrompt | None = None,
    strict_answers: bool = False,
    weights: Weights | None = None,
    robot_description: str | None = None,
    camera_description: str | None = None,
) -> Loaded:
    """Read the checkpoint of a local folder or Hugging Face id. Raises CheckpointError.

    family: package of its family; None: the family that reads the folder's files
    others: as in ``rfm.published.reader.Options``
    """
    folder = find(source)
    options = Options(
        base_model, image_encoder, text_encoder, reward_model, video_prompt, strict_answers, weights,
        robot_description, camera_description,
    )  # fmt: skip
    return read_from(folder, choose(folder, family, options), options)


def load(source: str | Path, **options: Any) -> Checkpoint:
    """Load the checkpoint of a local folder or Hugging Face id. options: as of ``read``. Raises CheckpointError."""
    return read(source, **options).checkpoint


def read_from(folder: Path, family: Family, options: Options) -> Loaded:
    """Read the checkpoint of a local folder. Raises CheckpointError, also for weights of NaN or zeros."""
    loaded = reader_of(family).load(folder, options)
    options.check_used(loaded.checkpoint.config)
    for weights in loaded.checkpoint.parts.values():
        check_values(weights)
    return loaded


def notes(folder: Path, loaded: Loaded, answered: Collection[str] = HEADS) -> list[str]:
    """Return a line for the user about each doubtful setting or head that the checkpoint's scores depend on.

    answered: heads that the model serves; of a missing head, only its absence is noted
    Raises CheckpointError for a config.yaml that cannot be read.
    """
    description = loaded.checkpoint.description
    heads = [head for head in answered if head not in description.lacks]
    expected = set() if description.asks_in_words else {*answered} - {SIMILARITY}  # which most lack
    missing = [head for head in answered if head in expected and head in description.lacks]
    without = [f"{WEIGHTS}: there is no head of {' and '.join(missing)}: served without"] if missing else []
    of_weights = constant_heads(loaded.checkpoint.parts[NETWORK], heads)
    of_run = training_notes(folder, heads)
    return [*without, *of_run, *of_weights, *loaded.notes(), *told(loaded.assumptions)]
