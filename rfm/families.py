# SPDX-License-Identifier: MIT
"""Find a checkpoint's family by name or by the checkpoint's files, and load the checkpoint."""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module
from pathlib import Path

from rfm.checkpoint.content import WEIGHTS, CheckpointError
from rfm.checkpoint.hub import find as find
from rfm.checkpoint.provenance import told
from rfm.checkpoint.run_config import HEADS, SIMILARITY, constant_heads, training_notes
from rfm.checkpoint.weights import check_values
from rfm.family import NETWORK, Checkpoint, Family, FrameEncoders, Options, VideoPrompt, Weights

__all__ = [
    "FAMILIES",
    "CheckpointError",
    "choose",
    "encoders_of",
    "find",
    "load",
    "load_from",
    "named",
    "notes",
]

# Packages in the order in which they are tried. ReWiND comes last: its first checkpoints do not name their network.
FAMILIES = (
    "rfm.topreward",
    "rfm.roboreward",
    "rfm.robodopamine",
    "rfm.rynnvalue",
    "rfm.vlm",
    "rfm.rewind",
)


def named(package: str) -> Family:
    """Return a package's ``FAMILY``. Raises CheckpointError if there is none."""
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


def choose(folder: Path, package: str | None = None, options: Options | None = None) -> Family:
    """Return the family ``package``, or of the reward model in ``options``, else the first that reads the folder.

    Raises CheckpointError.
    """
    if package:
        return named(package)
    known = [named(name) for name in FAMILIES]
    if options is not None and options.reward_model is not None:
        wanted, _ = options.named()
        if (found := next((family for family in known if wanted in family.reward_models), None)) is not None:
            return found
        names = [name for family in known for name in family.reward_models]
        raise CheckpointError.at("--as", f"one of {', '.join(names)}", repr(wanted))
    return next((family for family in known if family.reads(folder)), known[-1])  # its load explains the fault


def load(
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
) -> Checkpoint:
    """Load the checkpoint of a local folder or Hugging Face id. Raises CheckpointError.

    family: package of its family; None: the family that reads the folder's files
    others: as in ``rfm.family.Options``
    """
    folder = find(source)
    options = Options(
        base_model, image_encoder, text_encoder, reward_model, video_prompt, strict_answers, weights,
        robot_description, camera_description,
    )  # fmt: skip
    return load_from(folder, choose(folder, family, options), options)


def load_from(folder: Path, family: Family, options: Options) -> Checkpoint:
    """Load the checkpoint of a local folder. Raises CheckpointError, also for weights of NaN or zeros."""
    checkpoint = family.load(folder, options)
    options.check_used(checkpoint.config)
    for weights in checkpoint.parts.values():
        check_values(weights)
    return checkpoint


def notes(folder: Path, checkpoint: Checkpoint, answered: Collection[str] = HEADS) -> list[str]:
    """Return a line for the user about each doubtful setting or head that the checkpoint's scores depend on.

    answered: heads that the model serves; of a missing head, only its absence is noted
    Raises CheckpointError for a config.yaml that cannot be read.
    """
    lacks = checkpoint.description.lacks
    heads = [head for head in answered if head not in lacks]
    expected = set() if checkpoint.description.asks_in_words else {*answered} - {SIMILARITY}  # which most lack
    missing = [head for head in answered if head in expected and head in lacks]
    without = [f"{WEIGHTS}: there is no head of {' and '.join(missing)}: served without"] if missing else []
    of_weights = constant_heads(checkpoint.parts[NETWORK], heads)
    of_run = training_notes(folder, heads)
    return [*without, *of_run, *of_weights, *checkpoint.notes, *told(checkpoint.assumptions)]
