# SPDX-License-Identifier: MIT
"""The checkpoint families, as they are served.

Nothing here reads other people's files: that is ``rfm.published``.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from rfm.engine.family import Checkpoint, Family, FrameEncoders
from rfm.files import CheckpointError
from rfm.weights import check_values

# Packages in the order in which they are tried. ReWiND comes last: its first checkpoints do not name their network.
FAMILIES = (
    "rfm.families.topreward",
    "rfm.families.roboreward",
    "rfm.families.robodopamine",
    "rfm.families.rynnvalue",
    "rfm.families.robometer",
    "rfm.families.rewind",
)
# Package names in exports from 0.4.
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
    """Return a family's encoder class. Raises CheckpointError if the family has none."""
    encoders = named(package).encoders
    if encoders is None:
        raise CheckpointError.at("family", "one with encoders", f"{package}, whose checkpoints score raw frames")
    return encoders


def load(folder: Path, *, family: str) -> Checkpoint:
    """Load what ``Checkpoint.save`` wrote. Raises CheckpointError, also for non-finite weights or zero matrices.

    family: package of the checkpoint's family
    The model.py in exports since 0.4 calls this function.
    """
    checkpoint = named(family).restore(folder)
    for weights in checkpoint.parts.values():
        check_values(weights)
    return checkpoint
