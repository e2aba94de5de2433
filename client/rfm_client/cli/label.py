# SPDX-License-Identifier: MIT
"""``rfm-client label``: a reward for every frame of a dataset, from servers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from rfm_client.async_client import DEFAULT_TIMEOUT_S
from rfm_client.cli import options
from rfm_client.cli.label_flags import LabelFlags, with_label_flags
from rfm_client.cli.options import Server
from rfm_client.contract.names import DEFAULT_MODEL
from rfm_client.labelling.scorer import ClientScorer, Scorer
from rfm_client.transport.access import Access

Source = Annotated[
    str,
    typer.Argument(
        metavar="DATASET",
        help="LeRobot folder or Hub id org/name@revision, HDF5 file, folder of videos with tasks.csv or tasks.json.",
    ),
]


@with_label_flags
def label(
    context: typer.Context,
    dataset: Source,
    urls: options.Urls,
    model: options.Model = DEFAULT_MODEL,
    timeout: options.TimeoutS = DEFAULT_TIMEOUT_S,
    *,
    flags: LabelFlags,
) -> None:
    """Write a reward for every frame where training reads it.

    The same command goes on with what is missing.
    """
    from rfm_client.cli.label_display import run

    access: Access = context.obj  # the context itself cannot travel to other machines

    @contextmanager
    def connect() -> Iterator[Scorer]:
        with Server(urls, model, timeout, access).connected() as client:
            yield ClientScorer(client)

    raise typer.Exit(run(dataset, flags, connect, options.report))
