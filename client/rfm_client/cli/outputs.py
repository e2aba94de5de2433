# SPDX-License-Identifier: MIT
"""What the commands write: JSON documents and arrays.

A score that a checkpoint does not predict is null in JSON, never a number.
"""

from __future__ import annotations

import itertools
import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import typer

from rfm_client.cli.comparing import Comparison
from rfm_client.cli.options import STANDARD_OUTPUT, Server
from rfm_client.cli.scoring import (
    COLUMNS,
    Outcome,
    Question,
    Record,
    Scored,
    Source,
    Times,
    times_of,
    unique_stems,
)
from rfm_client.cli.show import FILE_WIDTH, shortened
from rfm_client.contract.errors import RewardError
from rfm_client.contract.results import FrameScores, PreferenceResult, ProgressResult, Result
from rfm_client.transport.status import ServerStatus

GAP = "  "  # between columns
MIN_NAME_WIDTH = 10
SIDES = ("first", "second")  # of a comparison


def write_json(target: str, document: Mapping[str, Any]) -> None:
    """Writes the document to a file, or to standard output."""
    text = json.dumps(document, indent=2, allow_nan=False)
    if target == STANDARD_OUTPUT:
        typer.echo(text)
    else:
        Path(target).write_text(f"{text}\n")


def origin(server: Server) -> dict[str, Any]:
    """URLs of the servers and name of the model that gave the scores."""
    return {"servers": server.urls, "model": server.model}


def score_document(server: Server, question: Question, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """The JSON document that ``score --json`` writes."""
    parameters = {"task": question.task, "fps": question.fps, "orient": question.orient}
    parameters |= {
        "frame_steps": question.frame_steps,
        "sampling": question.sampling,
        "sampled_frames": question.sampled_frames,
    }
    return {**origin(server), **parameters, "videos": [_outcome(outcome) for outcome in outcomes]}


def comparison_document(server: Server, question: Question, comparison: Comparison) -> dict[str, Any]:
    """What ``compare --json`` writes; a ``preference`` is the probability that the first of an order is preferred.

    Of two videos it also has the answer to the order given, ``preference``, the verdict of both orders, and scores as
    ``first`` and ``second``. No verdict, rank or ranking is null.
    """
    names = [source.name for source in comparison.sources]
    videos = [
        {
            "source": source.name,
            "num_frames": source.trajectory.num_frames,
            **frame_document(scores, times_of(source, scores)),
            "wins": wins,
            "rank": rank,
        }
        for source, scores, wins, rank in zip(
            comparison.sources, comparison.scores, comparison.wins, comparison.ranks, strict=True
        )
    ]
    orders = [
        {"first": names[first], "second": names[second], "preference": result.preference}
        for (first, second), result in comparison.results.items()
    ]
    pairs = [
        {"first": names[first], "second": names[second], **_verdict(comparison.pair(first, second))}
        for first, second in comparison.couples()
    ]
    asked = comparison.results[0, 1]
    parameters = {"task": question.task, "fps": question.fps, "orient": question.orient}
    document = {**origin(server), **parameters, "model_version": asked.model_version}
    if len(videos) == len(SIDES):
        document |= {"preference": asked.preference, **_verdict(comparison.pair(0, 1))}
        document |= dict(zip(SIDES, videos, strict=True))
    best_first = comparison.ranking
    ranking = None if best_first is None else [videos[index] for index in best_first]
    return {**document, "orders": orders, "pairs": pairs, "videos": videos, "ranking": ranking}


def samples_document(server: Server, kind: str, outcomes: Sequence[Result | RewardError]) -> dict[str, Any]:
    """The JSON document that ``sample --json`` writes."""
    samples = [
        _error(outcome, str(outcome)) if isinstance(outcome, RewardError) else result_document(outcome)
        for outcome in outcomes
    ]
    return {**origin(server), "sample_type": kind, "samples": samples}


def result_document(result: Result, times_s: Sequence[Times | None] = (None, None)) -> dict[str, Any]:
    """A result of any type; times_s of the scored frames of its trajectories."""
    version = {"model_version": result.model_version}
    if isinstance(result, ProgressResult):
        return {**version, **frame_document(result, times_s[0])}
    if isinstance(result, PreferenceResult):
        answer, names = {"preference": result.preference}, SIDES
    else:
        answer, names = {"similarity": result.similarity}, ("reference", "other")
    scores = {name: frame_document(getattr(result, name), t) for name, t in zip(names, times_s, strict=True)}
    return {**version, **answer, **scores}


def frame_document(scores: FrameScores, times_s: Times | None) -> dict[str, Any]:
    """Scores of each frame; frame_indices among the frames that were read."""
    indices = np.arange(len(scores.progress)) if scores.frame_indices is None else scores.frame_indices
    return {
        "progress": _or_null(scores.progress),
        "success": _or_null(scores.success),
        "frame_indices": indices.tolist(),
        "frame_times_s": None if times_s is None else times_s.tolist(),
    }


def status_document(statuses: Sequence[ServerStatus]) -> dict[str, Any]:
    """The JSON document that ``status --json`` writes."""
    servers = []
    for status in statuses:
        models = [
            {
                **asdict(model),
                "samples_per_batch": model.samples_per_batch,
                "queue_ms_per_request": model.queue_ms_per_request,
                "compute_ms_per_batch": model.compute_ms_per_batch,
            }
            for model in status.models
        ]
        servers.append({**asdict(status), "models": models})
    return {"servers": servers}


class Arrays:
    """Writes float32 [T, 2] for each source: progress and success (NaN: not predicted).

    target: one .npy file, or a folder that gets one file for each source; None: nothing is written
    """

    def __init__(self, target: Path | None, names: Sequence[str]) -> None:
        if target is None or target.suffix == ".npy":
            self._files = [target] * len(names)
        else:
            target.mkdir(exist_ok=True)
            self._files = [target / f"{stem}.npy" for stem in unique_stems(names)]

    def write(self, number: int, scored: Scored) -> None:
        """Writes the scores of the source of this number."""
        file = self._files[number]
        if file is not None:
            np.save(file, np.stack([scored.result.progress, scored.result.success], axis=1))


@contextmanager
def recorder(file: Path | None, names: Sequence[str]) -> Iterator[Record | None]:
    """What records each source in a file of Rerun's, under its name without folder and ending; None: nothing is.

    Raises ImportError if the package is missing.
    """
    if file is None:
        yield None
        return
    from rfm_client.integrations.recording import Recording

    stems = unique_stems(names)
    with Recording(file) as recording:

        def record(number: int, source: Source, scores: FrameScores) -> None:
            frames = source.trajectory.frames
            recording.add((stems[number],), scores, {} if frames is None else {"": frames}, source.times_s)

        yield record


class Rows:
    """A table on standard output that is written row by row, as wide as the terminal. names: all that it will have."""

    def __init__(self, names: Sequence[str]) -> None:
        from rich.console import Console

        console = Console()
        self._headers = [header for header, _ in COLUMNS]
        self._widths = [width for _, width in COLUMNS]
        room = (console.width if console.is_terminal else FILE_WIDTH) - sum(self._widths) - len(GAP) * len(COLUMNS)
        self._widths[0] = max(MIN_NAME_WIDTH, min(max(map(len, names)), room))
        self._is_begun = False

    def write(self, cells: Sequence[str]) -> None:
        """Writes a row at once; before the first, the headers."""
        lines: list[Sequence[str]] = [[shortened(cells[0], self._widths[0]), *cells[1:]]]
        if not self._is_begun:
            self._is_begun = True
            headers = [textwrap.wrap(header, width) for header, width in zip(self._headers, self._widths, strict=True)]
            lines = [*itertools.zip_longest(*headers, fillvalue=""), ["-" * width for width in self._widths], *lines]
        for line in lines:
            row = GAP.join(cell.ljust(width) for cell, width in zip(line, self._widths, strict=True))
            print(f"{GAP}{row}".rstrip(), flush=True)

    def end(self, text: str) -> None:
        """Writes a line below the table."""
        print(f"\n{GAP}{text}", flush=True)


def check_arrays(npy: Path | None, videos: Sequence[str]) -> None:
    """Checks, before the first request, that arrays can be written. Raises typer.BadParameter."""
    if npy is None or npy.is_dir() or (not npy.suffix and npy.parent.is_dir()):
        return
    if npy.suffix != ".npy" or not npy.parent.is_dir():
        raise typer.BadParameter(f"expected a .npy file or a folder, got {npy}", param_hint="--npy")
    if len(videos) > 1:
        raise typer.BadParameter(f"expected a folder for {len(videos)} videos, got {npy}", param_hint="--npy")


def _outcome(outcome: Outcome) -> dict[str, Any]:
    if not isinstance(outcome, Scored):
        return {"source": outcome.name, **_error(outcome.error, outcome.message)}
    about = {"source": outcome.name, "num_frames": outcome.num_frames, "took_s": outcome.took_s}
    return {**about, **result_document(outcome.result, (outcome.times_s,))}


def _verdict(pair: PreferenceResult) -> dict[str, Any]:
    return {"verdict": pair.verdict, "orders_agree": pair.orders_agree}


def _error(error: Exception, message: str) -> dict[str, Any]:
    return {"error": message, "error_type": type(error).__name__}


def _or_null(scores: npt.NDArray[np.float32]) -> list[float] | None:
    """The scores [T] as float64 of the same value; None if the checkpoint does not predict them."""
    return None if np.isnan(scores).all() else scores.tolist()
