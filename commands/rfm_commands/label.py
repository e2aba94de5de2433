# SPDX-License-Identifier: MIT
"""``rfm label``: a reward for every frame of a dataset, from a checkpoint in this process, without Triton."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from rfm.checkpoint.content import CheckpointError
from rfm_client import RewardError
from rfm_client.cli.label import Source
from rfm_client.cli.label_flags import LabelFlags, with_label_flags
from rfm_client.cli.options import missing_package
from rfm_client.labelling import Scorer
from rfm_export.errors import ExportError

EXIT_FAILED = 1


@with_label_flags
def label(
    dataset: Source,
    checkpoint: Annotated[str, typer.Option(help="Folder, or Hugging Face id org/name@tag.")],
    device: Annotated[str, typer.Option(help="Device of PyTorch: cpu, cuda, cuda:1.")] = "cpu",
    image_encoder: Annotated[str | None, typer.Option(help="Folder or id of ReWiND's image encoder.")] = None,
    text_encoder: Annotated[str | None, typer.Option(help="Folder or id of ReWiND's text encoder.")] = None,
    base_model: Annotated[
        str | None, typer.Option(help="Folder or id of a vision-language checkpoint's base model.")
    ] = None,
    *,
    flags: LabelFlags,
) -> None:
    """Label every frame of a dataset in this process, without Triton."""
    options = {"image_encoder": image_encoder, "text_encoder": text_encoder, "base_model": base_model}

    @contextmanager
    def connect() -> Iterator[Scorer]:
        from rfm_commands.engine_scorer import EngineScorer

        scorer = EngineScorer(checkpoint, device=device, **options)
        for note in scorer.notes:
            _say(note)
        yield scorer

    with _errors_on_one_line(_say):
        from rfm_client.cli.label_display import run

        status = run(dataset, flags, connect, _say)
    raise typer.Exit(status)


@contextmanager
def _errors_on_one_line(say: Callable[[str], None]) -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        say(missing_package(error))
    except (CheckpointError, ExportError, RewardError, OSError) as error:
        say(str(error))
    else:
        return
    raise typer.Exit(EXIT_FAILED)


def _say(message: str) -> None:
    typer.echo(f"rfm: {' '.join(message.split())}", err=True)
