# SPDX-License-Identifier: MIT
"""``rfm label``: label every frame of a dataset with a checkpoint in this process, without Triton."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

import typer

from rfm.config import CheckpointConfig
from rfm_client.cli.command import OptionValues, with_options
from rfm_client.contract.settings import setting
from rfm_commands.command import say
from rfm_labels import LabelOptions, RayOptions, Scorer
from rfm_labels.commands import DatasetArgument, EpisodeTexts, LabelCommand, RunOptions

_ALWAYS_RECORDED = ("image_encoder", "text_encoder", "base_model", "reward_model")  # in the recipe even if not given


@dataclass(frozen=True)
class LabellingCheckpoint(CheckpointConfig):
    """The checkpoint that labels."""

    checkpoint: str = setting(..., "Folder, or Hugging Face id org/name[/subfolder][@tag].")


@with_options
def label(
    dataset: DatasetArgument,
    given: OptionValues[LabellingCheckpoint],
    texts: EpisodeTexts,
    labels: LabelOptions,
    run: RunOptions,
    ray: RayOptions,
    device: Annotated[str, typer.Option(help="Device of PyTorch: cpu, cuda, cuda:1.")] = "cpu",
) -> None:
    """Label every frame of a dataset in this process, without Triton.

    `rfm-client label` writes the same files by asking running servers.

    Example: rfm label my_dataset --checkpoint org/name --device cuda
    """
    checkpoint = LabellingCheckpoint(**given)
    options = {**dict.fromkeys(_ALWAYS_RECORDED), **given}
    del options["checkpoint"]
    options.pop("dtype", None)

    @contextmanager
    def connect() -> Iterator[Scorer]:
        from rfm_commands.engine_scorer import EngineScorer

        scorer = EngineScorer(checkpoint.checkpoint, device=device, dtype=checkpoint.torch_dtype, **options)
        for note in scorer.notes:
            say(note)
        yield scorer

    raise typer.Exit(LabelCommand(dataset, texts, labels, run, ray, connect, say).run())
