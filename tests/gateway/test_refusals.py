# SPDX-License-Identifier: MIT
"""Requests that are refused, with the field at fault. A stand-in for Triton describes the models."""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from gateway_requests import (
    BLACK,
    ENCODER_DIMS,
    FIRST,
    MULTIPART,
    NAMED,
    SECOND,
    Ask,
    Json,
    ask_json,
    ask_npy,
    check_refused,
    dumped,
    embedded,
    failure,
    filmed,
    npy,
    npy_of,
    of_frames,
    preference,
    progress,
)
from gateways import StandIn, TestClient, inside

NPY = "/evaluate_batch_npy"
SAMPLE = dumped(progress(FIRST))


@pytest.fixture(scope="module")
def gateway() -> Iterator[TestClient]:
    """A gateway before models of the widths ENCODER_DIMS."""
    with inside(triton=StandIn(dims=ENCODER_DIMS), max_body_mib=1, timeout_s=10) as client:
        yield client


NO_SAMPLE, NO_STEPS = "expected at least one sample, got none", "expected true or false, got "
BODIES: dict[str, tuple[bytes, list[Any], str]] = {
    "half an object": (b'{"samples": [', [], "expected JSON, got: .*"),
    "no UTF-8": (b'["\xff"]', [], "expected JSON, got: .*"),
    "ten thousand brackets": (b"[" * 10_000, [], "expected JSON, got: recursion limit .*"),
    "an empty list": (b"[]", ["samples"], NO_SAMPLE),
    "an empty object": (b"{}", ["samples"], NO_SAMPLE),
    "samples as an object": (b'{"samples": {}}', ["samples"], "expected a list of samples, got dict"),
    "too many": (b"[%b5]" % (b"5," * 10_000), ["samples"], "expected at most 10000 samples, got 10001"),
    "very many errors": (b"[%b5]" % (b"5," * 2000), [], "expected no faulty fields, got 2001"),
    "a sample without a type": (b'{"sample_type": null}', ["sample_type"], "expected progress, .*, got None"),
    "a list by another name": (b'{"batch": [5]}', ["batch", 0], "expected an object, got 5"),
    "an object of samples": (b'{"a": %b, "b": 6}' % SAMPLE.encode(), ["b"], "expected an object, got 6"),
    "no steps": (b'{"samples": [5], "use_frame_steps": 2}', ["use_frame_steps"], f"{NO_STEPS}2"),
}
VIDEO_AT = ["sample_0", "trajectory", "video_embeddings"]
OF_VIDEO = ("sample_0", (None, json.dumps(progress({"video_embeddings": {"__numpy_file__": "video"}}))))
HUGE = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000000, 2)}"
NO_NPY = r"expected a \.npy file, got: .*"
FILES = {
    "truncated": (npy(np.ones((3, 2)))[:-4], NO_NPY),
    "too long": (npy(np.ones((3, 2))) + b"1", r"expected a \.npy file of 48 bytes behind its header, got more"),
    "a shape of petabytes": (npy_of(HUGE), NO_NPY),
    "pickled": (npy(np.array([[1, {}]], object), pickled=True), NO_NPY),
    "text": (npy(np.array([["a", "b"]])), r"expected a \.npy file, got: <U1 instead of numbers"),
    "a negative length": (npy_of("{'descr': '<f4', 'fortran_order': False, 'shape': (-1,)}"), NO_NPY),
    "no .npy file": (b"hello world", NO_NPY),
    "an unbalanced header": (npy_of("{'descr': '<f4', ("), NO_NPY),
    "a type of nothing": (npy_of(HUGE.replace("'<f4'", "()")), NO_NPY),
    "an endless header": (npy_of("-" * 20_000), NO_NPY),
}
ZERO = ("sample_0", (None, SAMPLE))
TWICE, NO_FILE = "expected one part of this name, got several", "expected a form field, got a file"
FORMS: dict[str, tuple[list[tuple[str, Any]], list[Any], str]] = {
    "no sample": ([("use_frame_steps", (None, "true"))], ["samples"], NO_SAMPLE),
    "a gap": ([ZERO, ("sample_2", ZERO[1])], ["sample_1"], "expected a sample, got none, but sample_2"),
    "another spelling": ([("sample_01", ZERO[1])], ["sample_01"], "expected sample_0, sample_1 and so on, got .*"),
    "other steps": ([ZERO, ("use_frame_steps", (None, "yes"))], ["use_frame_steps"], f"{NO_STEPS}'yes'"),
    "no JSON": ([("sample_0", (None, "{"))], ["sample_0"], "expected JSON, got: .*"),
    "JSON in JSON": ([("sample_0", (None, '"{}"'))], ["sample_0"], "expected an object, got '{}'"),
    "no part": ([OF_VIDEO], VIDEO_AT, r"expected a \.npy part named 'video', got none"),
    "one field twice": ([ZERO] * 2, ["sample_0"], TWICE),
    "one file twice": ([ZERO, *[("a", ("a.npy", b""))] * 2], ["a"], TWICE),
    "a sample as a file": ([("sample_0", ("sample_0", b"{}"))], ["sample_0"], NO_FILE),
    "steps as a file": ([ZERO, ("use_frame_steps", ("steps", b"true"))], ["use_frame_steps"], NO_FILE),
}
UNREAD: dict[str, tuple[dict[str, Any], list[Any], str]] = {
    **{f"a body: {name}": ({"content": body}, *told) for name, (body, *told) in BODIES.items()},
    **{
        f"a file: {name}": ({"files": [OF_VIDEO, ("video", ("video.npy", file))]}, VIDEO_AT, told)
        for name, (file, told) in FILES.items()
    },
    **{f"a form: {name}": ({"files": parts}, *told) for name, (parts, *told) in FORMS.items()},
}


@pytest.mark.parametrize(("sent", "path", "message"), UNREAD.values(), ids=UNREAD)
def test_a_body_whose_samples_cannot_be_read(
    gateway: TestClient, sent: dict[str, Any], path: list[Any], message: str
) -> None:
    check_refused(gateway.post(NPY if "files" in sent else "/evaluate_batch", **sent), (path, message))


ENDLESS = b"--b\r\nContent-Disposition: "
NAMELESS = b"--b\r\nContent-Disposition: form-data\r\n\r\nx\r\n--b--\r\n"
NO_FORM = "content-type: expected multipart/form-data with a boundary, got"
NO_PARTS, NO_END = "body: expected multipart/form-data, got: ", "body: expected its last boundary"
WHOLE = NAMED + SAMPLE.encode() + b"\r\n"
UNREADABLE: dict[str, tuple[int, str, str, bytes]] = {
    "JSON": (415, f"{NO_FORM} application/json", "application/json", b"[]"),
    "no content type": (415, f"{NO_FORM} none", "", b"[]"),
    "no boundary": (415, f"{NO_FORM} multipart/form-data", "multipart/form-data", NAMED),
    "no multipart": (400, NO_PARTS, MULTIPART, b"hello"),
    "no name": (400, NO_PARTS, MULTIPART, NAMELESS),
    "an endless header": (400, NO_PARTS, MULTIPART, ENDLESS + b"a" * 2**14),
    "endless headers": (400, NO_PARTS, MULTIPART, ENDLESS + b"\r\na: b" * 2**12),
    **{
        f"charset {name}": (
            415,
            f"content-type: expected the charset utf-8, got '{name}'",
            f"{MULTIPART}; charset={name}",
            WHOLE + b"--b--\r\n",
        )
        for name in ("undefined", "latin-1")
    },
    "nothing": (400, NO_END, MULTIPART, b""),
    "cut off": (400, NO_END, MULTIPART, WHOLE + NAMED + b"{"),
}


@pytest.mark.parametrize(("code", "message", "content_type", "body"), UNREADABLE.values(), ids=UNREADABLE)
def test_a_body_that_is_no_multipart(
    gateway: TestClient, code: int, message: str, content_type: str, body: bytes
) -> None:
    assert failure(gateway.post(NPY, content=body, headers={"Content-Type": content_type}), code).startswith(message)


@pytest.mark.parametrize("path", ["/evaluate_batch", NPY, "/viewer/score"])
def test_too_large_or_compressed_a_body_is_refused(gateway: TestClient, path: str) -> None:
    remedy = "send less in one request, or start the gateway with --max-body-mib (rfm serve: --gateway-max-body-mib)"
    headers = {"Content-Type": MULTIPART}
    chunks = [b" " * 2**19] * 3
    for body in (b" " * (2**20 + 1), iter(chunks if path == "/evaluate_batch" else [NAMED, *chunks])):
        response = gateway.post(path, content=body, headers=headers)
        assert failure(response, 413) == f"body: expected at most 1048576 bytes, got more; {remedy}"
    response = gateway.post(
        path, content=gzip.compress(SAMPLE.encode()), headers=headers | {"Content-Encoding": "gzip"}
    )
    expected = "content-encoding: expected none, since the gateway unpacks no body, got 'gzip'; send the body as it is"
    assert failure(response, 415) == expected


def test_json_is_smaller_than_other_bodies_and_a_form_has_a_number_of_parts(gateway: TestClient) -> None:
    with inside() as client:
        response = client.post("/evaluate_batch", content=b" " * (32 * 2**20 + 1))
        remedy = "send arrays as .npy files, to /evaluate_batch_npy"
        assert failure(response, 413) == f"body: expected at most 33554432 bytes, got more; {remedy}"
    files = [("sample_0", (None, "{")), *((f"array_{number}", (f"{number}.npy", b"")) for number in range(2000))]
    expected = "body: expected at most 2000 parts, fields and files together, got more"
    assert failure(gateway.post(NPY, files=files), 413) == f"{expected}; send the samples in several requests"
    assert gateway.post(NPY, files=files[:-1]).status_code == 422


def test_unknown_paths_and_methods_are_answered_in_json(gateway: TestClient) -> None:
    assert failure(gateway.post("/evaluate"), 404) == "Not Found"
    assert failure(gateway.get("/evaluate_batch"), 405) == "Method Not Allowed"


ROW = [1.0] * ENCODER_DIMS[0]
GOOD = progress(embedded(1, 2, ENCODER_DIMS))


def but(**fields: Any) -> Json:
    return progress({**embedded(1, 3, ENCODER_DIMS), **fields})


NUMBERS, EQUAL_ROWS = "expected numbers, got something else", "expected rows of equal length, got unequal ones"
NO_FILES = "expected an array, since the gateway reads no files, got names of files"
NO_TEXT = "expected an embedding, or a task.*, got neither"
NO_TYPE = "expected progress, preference or similarity, got "
BAD_ARRAYS: dict[str, dict[str, tuple[Any, str]]] = {
    "video_embeddings": {
        "another width": (np.ones((3, 7)), r"expected \[T, 48\], got \[3, 7\]"),
        "ragged": ([ROW, [1.0]], EQUAL_ROWS),
        "a number and a row": ([ROW, 1.0], EQUAL_ROWS),
        "huge numbers": ([[10**30] * 48], NUMBERS),
        "NaN": ([ROW, [np.nan] * 48], r"expected finite values, got nan at \[1, 0\]"),
        "more than float32 holds": ([[1e39] * 48], r"expected finite values, got inf at \[0, 0\]"),
        "words for numbers": ([["1.0"] * 48], NUMBERS),
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
            r"expected uint8 \[T, H, W, 3\], got int64 \[2, 3, 8, 8\]",
        ),
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
    "names of images": (of_frames(["0.png", "1.png"]), "trajectory frames", NO_FILES),
    "the name of a file": (
        progress({"embeddings_path": "a.npz"}),
        "trajectory embeddings_path",
        "expected video_embeddings as an array, since the gateway reads no files, got the name of a file",
    ),
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
def test_a_bad_sample(gateway: TestClient, sample: Any, path: str, message: str) -> None:
    at = [int(part) if part.isdecimal() else part for part in path.split()]
    check_refused(ask_json(gateway, [GOOD, sample, GOOD]), (["samples", 1, *at], message))


@pytest.mark.parametrize(
    ("ask", "first", "third"), [(ask_json, ["samples", 0], ["samples", 2]), (ask_npy, ["sample_0"], ["sample_2"])]
)
def test_all_bad_samples_are_named_at_once(gateway: TestClient, ask: Ask, first: list[Any], third: list[Any]) -> None:
    response = ask(gateway, [but(video_embeddings=np.ones((3, 7))), GOOD, TWO_WIDE])
    paths = [*first, "trajectory", "video_embeddings"], [*third, "rejected_trajectory", "video_embeddings"]
    check_refused(response, (paths[0], r".*\[3, 7\]"), (paths[1], r".*\[2, 7\]"))


NO_FRAMES = "expected embeddings, since no model for raw frames is served, got frames"
NO_EMBEDDINGS = "expected frames, since no model for embeddings is served, got embeddings"
NO_ENCODER = "expected an embedding, or a task to encode, got a task, and no encoder is served"
OF_MODEL: dict[str, tuple[str, Json, str, str]] = {
    "no frames": ("rfm", progress(filmed(1, 2)), "frames", NO_FRAMES),
    "no task": ("rfm", progress({**FIRST, "text_embedding": None}), "text_embedding", NO_ENCODER),
    "no embeddings": ("rfm_frames", progress(FIRST), "video_embeddings", NO_EMBEDDINGS),
}


@pytest.mark.parametrize(("only", "sample", "field", "message"), OF_MODEL.values(), ids=OF_MODEL)
def test_a_sample_that_the_served_model_does_not_read(only: str, sample: Json, field: str, message: str) -> None:
    with inside(triton=StandIn(served=[only]), timeout_s=10) as client:
        check_refused(ask_json(client, [sample]), (["samples", 0, "trajectory", field], message))


CAST = (np.random.default_rng(0).random((6, 32, 32, 3)) * 1.2).clip(0, 1).astype(np.uint8)  # as some clients cast
BLANK = "black pictures, no value above 1 (multiply floats in 0..1 by 255 before they become uint8)"
PADDING = "frames of zeros at the end (send the real frames alone, without padding)"


def test_frames_that_show_nothing_are_scored_with_a_warning_or_refused() -> None:
    whole, blank, triton = filmed(1, 6), filmed(1, 6, frames=CAST), StandIn(served=["rfm_frames"])
    padded = filmed(1, 6, frames=np.concatenate([whole["frames"][:4], np.zeros_like(whole["frames"][:2])]))
    samples = [progress(whole), progress(padded), progress(blank)]
    triton.is_open.set()
    with inside(triton=triton) as client:
        response = ask_json(client, samples)
        assert response.status_code == 200
        warning = f"samples 2: {BLANK}: their scores mean nothing; samples 1: {PADDING}: they are scored as pictures"
        assert response.headers["X-RFM-Warning"] == warning
        assert "X-RFM-Warning" not in ask_json(client, samples[:1]).headers
    with inside(triton=triton, refuse_blank=True) as client:
        response = ask_json(client, [*samples, preference(filmed(2, 2), blank)])
    faults = {1: ("trajectory", PADDING), 2: ("trajectory", BLANK), 3: ("rejected_trajectory", BLANK)}
    refused = [
        (["samples", index, name, "frames"], re.escape(f"expected pictures that show something, got {fault}"))
        for index, (name, fault) in faults.items()
    ]
    check_refused(response, *refused)


NO_TOKEN = r"expected text without the model's special tokens, got '<\|prog_token\|>'"
LONG = but(text_embedding=None, task="lift " * 200)
LARGE = progress({**FIRST, "video_embeddings": np.full((3, 2), 3e38, np.float32)})
MORE_FRAMES = "expected at most 16 .*, got 17; send fewer frames, such as some at equal distances, or use_frame_steps"
SLIVER, TOO_LONG = np.ones((1, 2, 200, 3), int), "expected frames at most 50 times as long .*"
BY_TRITON: dict[str, tuple[str, Json, str, str]] = {
    "too many frames": (
        "encoders",
        but(video_embeddings=np.ones((17, 48))),
        "trajectory video_embeddings",
        MORE_FRAMES,
    ),
    "too many tokens": ("encoders", LONG, "trajectory task", r"expected at most \d+ tokens.*, got .*"),
    "a sliver": ("encoders", of_frames(SLIVER), "trajectory frames", TOO_LONG),
    "a sliver in a pair": ("encoders", preference(filmed(1, 2), filmed(1, 2, frames=SLIVER)), "", TOO_LONG),
    "a special token": ("video", progress(filmed(1, 2, task="lift <|prog_token|>")), "trajectory task", NO_TOKEN),
    "an overflow": ("tiny", LARGE, "trajectory video_embeddings", r"expected values from -1e\+06 to 1e\+06, got .*"),
}


@pytest.mark.triton
@pytest.mark.parametrize(("model", "sample", "path", "message"), BY_TRITON.values(), ids=BY_TRITON)
def test_a_sample_that_triton_refuses(
    request: pytest.FixtureRequest, model: str, sample: Json, path: str, message: str
) -> None:
    response = ask_json(request.getfixturevalue(model), [sample, sample])
    check_refused(response, *((["samples", index, *path.split()], message) for index in range(2)))
