# SPDX-License-Identifier: MIT
"""``rfm label``: label every frame of a dataset with a checkpoint in this process, without Triton."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from rfm.config import ExportConfig
from rfm_client.cli.command import Given, OptionsOf, with_options
from rfm_commands.command import ASKED_BY, CHECKPOINT_TITLE, OF_A_CHECKPOINT, say
from rfm_labels import LabelOptions, RayOptions, Scorer
from rfm_labels.commands import DatasetArgument, EpisodeTexts, LabelCommand, RunOptions

_OPTIONS = (*OF_A_CHECKPOINT, *ASKED_BY, "dtype")


@with_options
def label(
    dataset: DatasetArgument,
    given: Annotated[Given, OptionsOf(ExportConfig, only=_OPTIONS, required=("checkpoint",), title=CHECKPOINT_TITLE)],
    texts: EpisodeTexts,
    labels: LabelOptions,
    run: RunOptions,
    ray: RayOptions,
    device: Annotated[str, typer.Option(help="Device of PyTorch: cpu, cuda, cuda:1.")] = "cpu",
) -> None:
    """Label every frame of a dataset in this process, without Triton.

    `rfm-client label` writes the same files by asking running servers.
    """
    checkpoint, *encoders = (given.get(name) for name in OF_A_CHECKPOINT)

    @contextmanager
    def connect() -> Iterator[Scorer]:
        from rfm_commands.engine_scorer import EngineScorer

        dtype = ExportConfig(dtype=given.get("dtype")).torch_dtype
        options = dict(zip(OF_A_CHECKPOINT[1:], encoders, strict=True))
        options |= {name: given[name] for name in ASKED_BY if name in given}
        scorer = EngineScorer(str(checkpoint), device=device, dtype=dtype, **options)
        for note in scorer.notes:
            say(note)
        yield scorer

    raise typer.Exit(LabelCommand(dataset, texts, labels, run, ray, connect, say).run())
