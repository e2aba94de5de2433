# SPDX-License-Identifier: MIT
"""JSON documents that the commands print. A score that a checkpoint does not predict is null."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.cli.comparing import Comparison
from rfm_client.cli.options import PrefixOptions, ServerOptions, VideoOptions
from rfm_client.cli.scoring import Outcome, Scored, Times, checkpoint_name
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import RewardError
from rfm_client.contract.results import (
    FRAME_SCORES,
    FrameScores,
    Result,
    answer,
    trajectory_scores,
)
from rfm_client.transport.status import ServerStatus

SIDES = ("first", "second")  # the JSON names of the two videos, if two are compared


def score_document(
    server: ServerOptions, video: VideoOptions, prefix: PrefixOptions, outcomes: Sequence[Outcome]
) -> dict[str, Any]:
    """Return the document for ``score --json``."""
    asked = {"sampling": prefix.sampling, "sampled_frames": prefix.frames}
    return {**server.origin, **_asked(video), **asked, "videos": [_outcome(outcome) for outcome in outcomes]}


def comparison_document(server: ServerOptions, video: VideoOptions, comparison: Comparison) -> dict[str, Any]:
    """Return the document for ``compare --json``, with ``orders`` and ``pairs`` as in ``Ranking.document``.

    For two videos, the top level also has what their pair has, and scores as ``first`` and ``second``. Scores are those
    from ``score``. A missing verdict, rank or ranking is null.
    """
    videos = [
        {
            "source": source.name,
            "num_frames": source.trajectory.num_frames,
            **frame_document(scores, source.times_of(scores)),
            "wins": wins,
            "rank": rank,
        }
        for source, scores, wins, rank in zip(
            comparison.sources, comparison.scores, comparison.wins, comparison.ranks, strict=True
        )
    ]
    answers = comparison.document([source.name for source in comparison.sources])
    document = {**server.origin, **_asked(video), "model_version": comparison.model_version}
    document |= _checkpoint(comparison.info)
    if len(videos) == len(SIDES):
        document |= {**answers["pairs"][0], **dict(zip(SIDES, videos, strict=True))}
    best_first = comparison.ranking
    ranking = None if best_first is None else [videos[index] for index in best_first]
    return {**document, **answers, "videos": videos, "ranking": ranking}


def samples_document(server: ServerOptions, kind: str, outcomes: Sequence[Result | RewardError]) -> dict[str, Any]:
    """Return the document for ``sample --json``."""
    samples = [
        _error(outcome, str(outcome)) if isinstance(outcome, RewardError) else result_document(outcome)
        for outcome in outcomes
    ]
    return {**server.origin, "sample_type": kind, "samples": samples}


def result_document(result: Result) -> dict[str, Any]:
    """Return the document for a result."""
    shown = {name: frame_document(scores, None) for name, scores in trajectory_scores(result).items()}
    return {"model_version": result.model_version, **answer(result), **shown.pop("", {}), **shown}


def frame_document(scores: FrameScores, times_s: Times | None) -> dict[str, Any]:
    """Return each frame's scores; ``frame_indices`` count the frames that were read."""
    return {
        **{name: _or_null(each) for name, each in scores.arrays.items() if not FRAME_SCORES[name].is_per_bin},
        "frame_indices": scores.scored_frames.tolist(),
        "frame_times_s": None if times_s is None else times_s.tolist(),
    }


def status_document(statuses: Sequence[ServerStatus]) -> dict[str, Any]:
    """Return the document for ``status --json``."""
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


def _asked(video: VideoOptions) -> dict[str, Any]:
    asked = {"task": video.task, "fps": video.fps, "orient": video.orient, "channels": video.channels}
    return {**asked, **{name: value for name, value in video.more.items() if value}}


def _outcome(outcome: Outcome) -> dict[str, Any]:
    if not isinstance(outcome, Scored):
        return {"source": outcome.name, **_error(outcome.error, outcome.message)}
    about = {"source": outcome.name, "num_frames": outcome.num_frames, "took_s": outcome.took_s}
    scores = frame_document(outcome.result, outcome.times_s)
    return {**about, "model_version": outcome.result.model_version, **_checkpoint(outcome.info), **scores}


def _checkpoint(info: ModelInfo) -> dict[str, Any]:
    return {"checkpoint": checkpoint_name(info), "warning": info.warning}


def _error(error: Exception, message: str) -> dict[str, Any]:
    return {"error": message, "error_type": type(error).__name__}


def _or_null(scores: npt.NDArray[Any]) -> list[Any] | None:
    """Return the marks, or the numbers as float64 with the same values; None for a NaN, or for all if all are NaN."""
    missing = np.isnan(scores)
    if missing.all():
        return None
    return [None if is_missing else score for score, is_missing in zip(scores.tolist(), missing, strict=True)]
