# SPDX-License-Identifier: MIT
"""Measure the served demo checkpoint on toy-world clips unseen in training.

python examples/evaluate_demo_checkpoint.py --repository model_repository   # serves it meanwhile
python examples/evaluate_demo_checkpoint.py --url grpc://localhost:8001     # asks a running server
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from demo_evaluation.figures import Figure, figures
from demo_evaluation.questions import HeldOut, noise_samples
from rfm_client import Result, RewardClient, RewardError, Sample
from rfm_client.cli.show import print_tables, table

Evaluate: TypeAlias = Callable[[Sequence[Sample]], Sequence[Result | RewardError]]
REQUEST_SAMPLES = 64


def evaluate(
    repository: Annotated[Path | None, typer.Option(help="Model repository to serve meanwhile.")] = None,
    url: Annotated[str | None, typer.Option(help="A server that runs, instead.")] = None,
    checkpoint: Annotated[Path | None, typer.Option(help="What training wrote, without a server, instead.")] = None,
    clips: Annotated[int, typer.Option(help="Tasks, each with one clip of every sort.")] = 240,
    seed: Annotated[int, typer.Option(help="Seed of the first clip.")] = 1_000_000,
    output: Annotated[Path, typer.Option(help="Where the figures go, as JSON.")] = Path("demo_output/evaluation.json"),
) -> None:
    """Print a table of figures with their bounds, and write the figures. Status 1: a bound is missed."""
    given = [source for source in (repository, url, checkpoint) if source is not None]
    if len(given) != 1:
        raise typer.BadParameter(f"expected one of --repository, --url, --checkpoint, got {len(given)}")
    output.parent.mkdir(parents=True, exist_ok=True)
    held_out = HeldOut.of(clips, seed)
    with _evaluator(repository, url, checkpoint, output.parent) as ask:
        results, of_noise = _results(ask, held_out.samples()), _results(ask, noise_samples())
    found = figures(held_out, results, of_noise)
    print_tables(table(f"{held_out.num_clips} held-out clips", ("figure", "value", "bound", ""), _rows(found)))
    record = {"clips": held_out.num_clips, "seed": seed, "figures": {each.name: each.value for each in found}}
    output.write_text(json.dumps(record, indent=1) + "\n")
    if not all(each.holds for each in found):
        raise typer.Exit(1)


def _results(ask: Evaluate, samples: Sequence[Sample]) -> list[Result]:
    results: list[Result] = []
    for start in range(0, len(samples), REQUEST_SAMPLES):
        for result in ask(samples[start : start + REQUEST_SAMPLES]):
            if isinstance(result, RewardError):
                raise result
            results.append(result)
    return results


def _rows(found: Sequence[Figure]) -> list[tuple[str, str, str, str]]:
    return [
        (each.name, f"{each.value:.4f}", "-", "")
        if each.bound is None
        else (each.name, f"{each.value:.4f}", f">= {each.bound:g}", "holds" if each.holds else "MISSED")
        for each in found
    ]


@contextmanager
def _evaluator(
    repository: Path | None, url: str | None, checkpoint: Path | None, log_folder: Path
) -> Iterator[Evaluate]:
    if checkpoint is not None:
        yield _in_process(checkpoint)
    elif url is not None:
        with RewardClient(url) as client:
            yield client.evaluate
    else:
        from rfm.launch.temporary import temporary_server

        assert repository is not None  # one of the three is given
        with (
            temporary_server(repository, log_folder / "tritonserver.log") as endpoints,
            RewardClient(endpoints.grpc_url) as client,
        ):
            yield client.evaluate


def _in_process(folder: Path) -> Evaluate:
    """Return the evaluation function of an engine on the files of training."""
    from rfm import families
    from rfm.engine import Engine
    from rfm.rewind.encoders import Encoders

    loaded = families.load(folder / "checkpoint")
    encoders = Encoders.from_pretrained(
        folder / "image_encoder",
        folder / "text_encoder",
        image_weights=loaded.image_encoder,
        text_weights=loaded.text_encoder,
    )
    return Engine.of(loaded, encoders=encoders).evaluate


if __name__ == "__main__":
    typer.run(evaluate)
