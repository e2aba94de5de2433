# SPDX-License-Identifier: MIT
"""Refusals of the gateway name the field."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gateway_requests import (
    BLACK,
    ENCODER_DIMS,
    FIRST,
    SECOND,
    Ask,
    Json,
    as_parts,
    ask_json,
    ask_npy,
    check_refused,
    embedded,
    failure,
    filmed,
    of_frames,
    preference,
    progress,
)
from gateways import Gateway

pytestmark = pytest.mark.triton
ROW = [1.0] * ENCODER_DIMS[0]
GOOD = progress(embedded(1, 2, ENCODER_DIMS))


def but(**fields: Any) -> Json:
    return progress({**embedded(1, 3, ENCODER_DIMS), **fields})


NUMBERS, EQUAL_ROWS = "expected numbers, got something else", "expected rows of equal length, got unequal ones"
NO_FILES = r"expected an array \(this gateway reads no files\), got the name of a file"
NO_TEXT = "expected an embedding, or a task.*, got neither"
NO_TYPE = "expected progress, preference or similarity, got "
BAD_ARRAYS: dict[str, dict[str, tuple[Any, str]]] = {
    "video_embeddings": {
        "another width": (np.ones((3, 7)), r"expected \[T, 48\], got \[3, 7\]"),
        "ragged": ([ROW, [1.0]], EQUAL_ROWS),
        "a number and a row": ([ROW, 1.0], EQUAL_ROWS),
        "NaN": ([ROW, [np.nan] * 48], r"expected finite values, got nan at \[1, 0\]"),
        "more than float32 holds": ([[1e39] * 48], r"expected finite values, got inf at \[0, 0\]"),
        "huge numbers": ([[10**30] * 48], NUMBERS),
        "words for numbers": ([["1.0"] * 48], NUMBERS),
        "nulls": ([[None] * 48], NUMBERS),
        "a word": ("1.0", "expected an array, got str"),
        "truths": ([[True] * 48], r"expected float32 \[T, D\], got bool \[1, 48\]"),
        "five axes": ([[[[ROW]]]], "expected at most 4 axes, got more"),
        "nothing": ([], r"expected float32 \[T, D\], got float64 \[0\]"),
        "an object": ({"a": 1}, r'expected an array or {"__numpy_file__": name}, got an object without it'),
        "a part, in JSON": ({"__numpy_file__": "v"}, r"expected a \.npy part named 'v', got none"),
    },
    "text_embedding": {
        "another width": (np.ones(7), r"expected \[32\], got \[7\]"),
        "NaN": ([np.nan] * 32, r"expected finite values, got nan at \[0\]"),
        "two axes": (np.ones((1, 32)), r"expected float32 \[Dt\], got float64 \[1, 32\]"),
    },
    "frames": {
        "floats in 0..1": (BLACK + 0.5, r"expected values in 0\.\.255, got values up to 0\.5: multiply by 255 first"),
        "values beyond 255": (BLACK.astype(int) + 256, r"expected values in 0\.\.255, got 256\.\.256"),
        "values below 0": (BLACK.astype(int) - 1, r"expected values in 0\.\.255, got -1\.\.-1"),
        "NaN": (BLACK + np.nan, r"expected finite values in 0\.\.255, got NaN, Inf or nothing"),
        "channels first": (
            np.ones((2, 3, 8, 8), np.uint8),
            r"expected uint8 \[T, H, W, 3\], got int64 \[2, 3, 8, 8\]; the channels come last: "
            r"transpose the axes to \(0, 2, 3, 1\)",
        ),
        "one frame, channels first": (
            np.ones((3, 8, 8), np.uint8),
            r".*, got .*; .* transpose the axes to \(1, 2, 0\)",
        ),
        "two channels": (np.ones((2, 8, 8, 2), int), r"expected uint8 \[T, H, W, 3\], got .* \[2, 8, 8, 2\]"),
        "grey levels": (np.ones((8, 8), int), r"expected uint8 \[T, H, W, 3\], got .* \[8, 8\]"),
        "no pixels": (BLACK[:, :0], "expected .*, got .*"),
        "truths": (BLACK > 0, r"expected uint8 \[T, H, W, 3\], got bool \[2, 8, 8, 3\]"),
        "words and numbers": (["0.png", 1], NUMBERS),
        "null": (None, "expected frames, got neither frames nor video_embeddings"),
    },
}
TWO_WIDE = preference(embedded(1, 2, ENCODER_DIMS), embedded(1, 2, (7, 32)))
BAD_SAMPLES: dict[str, tuple[Any, str, str]] = {
    f"{field}, {name}": (
        of_frames(value) if field == "frames" else but(**{field: value}),
        f"trajectory {field}",
        message,
    )
    for field, bad in BAD_ARRAYS.items()
    for name, (value, message) in bad.items()
} | {
    "no text, blank task": (but(text_embedding=None, task=" "), "trajectory text_embedding", NO_TEXT),
    "a task that is a number": (but(task=5), "trajectory task", "expected text, got 5"),
    "no task": (of_frames(BLACK, task=None), "trajectory task", "expected a task sentence with frames, got ''"),
    "too many frames": (
        but(video_embeddings=np.ones((17, 48))),
        "trajectory video_embeddings",
        "expected at most 16 .*, got 17; send fewer frames, such as some at equal distances, or use_frame_steps",
    ),
    "a sliver": (
        of_frames(np.ones((1, 2, 200, 3), int)),
        "trajectory frames",
        "expected frames at most 50 times as long .*",
    ),
    "a sliver in a pair": (
        preference(filmed(1, 2), {**filmed(1, 2), "frames": np.ones((1, 2, 200, 3), int)}),
        "",
        "expected frames at most 50 times as long .*",
    ),
    "names of images": (of_frames(["0.png", "1.png"]), "trajectory frames 0", NO_FILES),
    "the name of a file": (progress({"embeddings_path": "a.npz"}), "trajectory embeddings_path", NO_FILES),
    "no trajectory": ({"sample_type": "progress"}, "trajectory", "expected a value, got none"),
    "no second": ({**preference(FIRST, SECOND), "rejected_trajectory": 5}, "rejected_trajectory", ".*object, got 5"),
    "no type": ({"trajectory": FIRST}, "sample_type", f"{NO_TYPE}None"),
    "another type": ({"sample_type": "reward"}, "sample_type", f"{NO_TYPE}'reward'"),
    "a list of types": ({"sample_type": ["progress"]}, "sample_type", rf"{NO_TYPE}\['progress'\]"),
    "no sample": (5, "", "expected an object, got 5"),
    "embeddings beside frames": (
        preference(embedded(1, 2, ENCODER_DIMS), filmed(1, 2)),
        "chosen_trajectory video_embeddings",
        "expected them in both trajectories or neither, got one of two",
    ),
    "a bad second": (TWO_WIDE, "rejected_trajectory video_embeddings", r"expected \[T, 48\], got \[2, 7\]"),
}


@pytest.mark.parametrize(("sample", "path", "message"), BAD_SAMPLES.values(), ids=BAD_SAMPLES)
def test_a_bad_sample_is_refused_at_its_field(encoders: Gateway, sample: Any, path: str, message: str) -> None:
    at = [int(part) if part.isdecimal() else part for part in path.split()]
    check_refused(ask_json(encoders, [GOOD, sample, GOOD]), (["samples", 1, *at], message))


def test_all_bad_samples_are_told_at_once(encoders: Gateway, ask: Ask) -> None:
    sent = as_parts if ask is ask_npy else list
    response = ask(encoders, [but(video_embeddings=np.ones((3, 7))), GOOD, TWO_WIDE])
    first = sent(["samples", 0, "trajectory", "video_embeddings"])
    second = sent(["samples", 2, "rejected_trajectory", "video_embeddings"])
    check_refused(response, (first, r".*\[3, 7\]"), (second, r".*\[2, 7\]"))
    task = but(text_embedding=None, task="lift " * 200)
    response = ask(encoders, [task, but(text_embedding=None), task])
    at = [sent(["samples", index, "trajectory", "task"]) for index in (0, 2)]
    check_refused(response, *((path, r"expected at most \d+ tokens.*, got .*") for path in at))


NO_FRAMES = "expected embeddings, since no model for raw frames is served, got frames"
NO_EMBEDDINGS = "expected frames, since no model for embeddings is served, got embeddings"
NO_ENCODER = "expected an embedding, or a task to encode, got a task, and no encoder is served"
NO_TOKEN = r"expected text without the model's special tokens, got '<\|prog_token\|>'"
OF_MODEL: dict[str, tuple[str, Json, str, str]] = {
    "no frames": ("tiny", progress(filmed(1, 2)), "trajectory frames", NO_FRAMES),
    "no task": ("tiny", progress({**FIRST, "text_embedding": None}), "trajectory text_embedding", NO_ENCODER),
    "no embeddings": ("video", progress(FIRST), "trajectory video_embeddings", NO_EMBEDDINGS),
    "no special token": ("video", progress(filmed(1, 2, task="lift <|prog_token|>")), "trajectory task", NO_TOKEN),
}


@pytest.mark.parametrize(("model", "sample", "path", "message"), OF_MODEL.values(), ids=OF_MODEL)
def test_what_the_served_model_does_not_read_is_said(
    request: pytest.FixtureRequest, model: str, sample: Json, path: str, message: str
) -> None:
    check_refused(ask_json(request.getfixturevalue(model), [sample]), (["samples", 0, *path.split()], message))


def test_embeddings_with_which_the_network_would_overflow_are_refused(tiny: Gateway) -> None:
    too_large = progress({**FIRST, "video_embeddings": np.full((3, 2), 3e38, np.float32)})
    assert "expected values from -1e+06 to 1e+06" in failure(ask_json(tiny, [progress(FIRST), too_large]), 422)
