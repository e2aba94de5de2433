# SPDX-License-Identifier: MIT
"""The sampling rules, against the frames that the original functions took."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

import goldens
from client_commands import MODEL, TASK, ask, assert_scores
from engine_server import EngineServer
from every_score import assert_same_scores, every_score
from paths import GOLDEN
from rfm_client import FrameScores, ProgressResult, ProgressSample, Trajectory, load_trajectory
from rfm_client.frames import Rule, Sampling
from rfm_client.frames.sampling import thinned

VECTORS = GOLDEN / "sampling-vectors.json"
ELSEWHERE = goldens.ROOT.parent / VECTORS.name  # beside the further reference cases, where there are some
READINGS = {"rewind_pad16": ("rewind_pad16_online", "rewind_pad16_offline")}  # two arguments of the same function


def cases(file: Path) -> Iterator[tuple[Sampling, int, list[int]]]:
    """A rule with a number of frames, the newest frame, and the frames that the original picks."""
    for frames, lengths in json.loads(file.read_text()).items():
        for length, rules in lengths.items():
            for name, indices in rules.items():
                for rule in READINGS.get(name, (name,)):
                    yield Sampling(rule, int(frames)), int(length) - 1, indices


@pytest.mark.parametrize(
    "file",
    [
        VECTORS,
        pytest.param(
            ELSEWHERE,
            marks=[pytest.mark.reference, pytest.mark.skipif(not ELSEWHERE.exists(), reason="RFM_GOLDENS names none")],
        ),
    ],
    ids=["here", "elsewhere"],
)
def test_each_rule_shows_the_frames_that_the_original_takes(file: Path) -> None:
    seen = set()
    for sampling, t, indices in cases(file):
        prefix = sampling.prefix(t)
        assert prefix.indices.dtype == np.int64
        assert prefix.indices.tolist() == indices, (sampling, t)
        seen.add((sampling.rule, sampling.frames))
        if sampling.rule == "rint_pad":
            unpadded = Sampling("rint", sampling.frames).prefix(t).indices
            assert unpadded.tolist() == indices[: min(t + 1, sampling.frames or 0)], (sampling, t)
    assert {rule for rule, _ in seen} == set(get_args(Rule)) - {"all", "rint"}
    assert len(seen) == 3 * 6 + 2


@pytest.mark.parametrize("rule", get_args(Rule))
def test_the_scores_of_prefixes_keep_all_that_the_model_gives(rule: Rule) -> None:
    sampling = Sampling(rule, None if rule in ("all", "rewind_pad16_online", "rewind_pad16_offline") else 3)
    prefixes = [sampling.prefix(t) for t in range(20)]
    results = [every_score(t, len(prefix.indices)) for t, prefix in enumerate(prefixes)]
    whole = sampling.joined([ProgressResult(**vars(result), model_version="1") for result in results])
    newest = [result.at(np.array([prefix.read])) for result, prefix in zip(results, prefixes, strict=True)]
    assert_same_scores(whole, FrameScores.joined(newest))


READ = {
    "linspace_trunc repeats frames and pads none": (Sampling("linspace_trunc", 4), 1, [0, 0, 0, 1], 3),
    "linspace_trunc of one frame shows the first": (Sampling("linspace_trunc", 1), 9, [0], 0),
    "linspace_round rounds half to even": (Sampling("linspace_round", 3), 5, [0, 2, 5], 2),
    "rint does not pad": (Sampling("rint", 4), 1, [0, 1], 1),
    "rint of one frame shows the newest": (Sampling("rint", 1), 9, [9], 0),
    "rint_pad reads a padded slot": (Sampling("rint_pad", 4), 1, [0, 1, 1, 1], 3),
    "rewind online reads a padded slot": (Sampling("rewind_pad16_online"), 2, [0, 1, *[2] * 14], 15),
    "rewind offline reads the frame's own": (Sampling("rewind_pad16_offline"), 2, [0, 1, *[2] * 14], 2),
    "all": (Sampling("all"), 3, [0, 1, 2, 3], 3),
}


@pytest.mark.parametrize(("sampling", "t", "indices", "read"), READ.values(), ids=READ)
def test_a_rule_says_which_slot_counts(sampling: Sampling, t: int, indices: list[int], read: int) -> None:
    prefix = sampling.prefix(t)
    assert (prefix.indices.tolist(), prefix.read) == (indices, read)
    assert prefix.indices[prefix.read] == t or sampling.frames == 1
    slots = prefix.frame_slots
    assert prefix.indices[slots].tolist() == sorted(set(indices))
    assert slots[-1] == read


def test_a_long_clip_is_cut_as_in_training() -> None:
    cut = {(10, 1): [9], (10, 4): [0, 3, 6, 9], (6, 3): [0, 2, 5], (10, 10): None, (10, None): None}
    for asked, expected in cut.items():
        kept = thinned(*asked)
        assert (None if kept is None else kept.tolist()) == expected


REFUSED: dict[str, tuple[Any, ...]] = {
    "another rule": ("evenly", 4, "sampling: expected one of linspace_trunc, linspace_round, .*, all, got 'evenly'"),
    "a number with all": ("all", 4, "frames: expected none with the rule all, got 4"),
    "another number than 16": (
        "rewind_pad16_online",
        8,
        "frames: expected 16 with the rule rewind_pad16_online, got 8",
    ),
    "no number": ("rint_pad", None, "frames: expected at least 1 with the rule rint_pad, got None"),
    "no frame": ("linspace_trunc", 0, "frames: expected at least 1, got 0"),
}


@pytest.mark.parametrize(("rule", "frames", "message"), REFUSED.values(), ids=REFUSED)
def test_what_no_rule_takes_is_refused(rule: Any, frames: int | None, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        Sampling(rule, frames)


def test_the_checkpoint_says_how_many_frames_if_the_caller_does_not() -> None:
    assert Sampling.of("rint_pad", 4, 8) == Sampling("rint_pad", 4)
    assert Sampling.of("all", None, 8) == Sampling("all")
    assert Sampling.of("rewind_pad16_offline", None, 8).frames == 16
    assert Sampling.of(None, None, 8) == Sampling("rint_pad", 8)
    assert Sampling.of(None, 4, 8, trained_padding=False) == Sampling("rint", 4)
    with pytest.raises(
        ValueError, match="frames: expected how many frames the rule rint_pad shows the model, got none"
    ):
        Sampling.of("rint_pad", None, None)


@pytest.mark.parametrize("rule", ["linspace_trunc", "rewind_pad16_offline"])
def test_score_scores_each_frame_on_its_prefix(engines: EngineServer, video: Path, rule: Any) -> None:
    words = ["--frames", 4] if rule == "linspace_trunc" else []
    result = ask(engines, "score", video, "--task", TASK, "--sampling", rule, *words, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    (scored,) = json.loads(result.stdout)["videos"]
    trajectory = load_trajectory(video, task=TASK, fps=3.0)
    assert trajectory.frames is not None
    sampling = Sampling.of(rule, 4 if words else None, None)
    with engines.client(MODEL) as client:
        shown = [sampling.prefix(t) for t in range(trajectory.num_frames)]
        results = client.evaluate(
            ProgressSample(Trajectory(frames=trajectory.frames[prefix.indices], task=TASK)) for prefix in shown
        )
        if rule == "linspace_trunc":
            assert_scores(scored, client.progress(trajectory, frame_steps=4))
    for name in ("progress", "success"):
        expected = [getattr(each, name)[prefix.read] for each, prefix in zip(results, shown, strict=True)]
        np.testing.assert_allclose(scored[name], expected, rtol=0, atol=1e-5)
