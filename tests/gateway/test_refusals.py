# SPDX-License-Identifier: MIT
"""What the gateway refuses, and how it names the field."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import requests

from gateway_requests import (
    BLACK,
    FILM_DIMS,
    FIRST,
    FORM,
    FRAME_STEPS,
    FRAMES_AT,
    MULTIPART,
    NAMED,
    SECOND,
    TASK_AT,
    Ask,
    Json,
    answered,
    ask_json,
    ask_part,
    check_refused,
    dumped,
    embedded,
    expected,
    failure,
    filmed,
    npy,
    npy_of,
    of_frames,
    preference,
    progress,
)
from gateways import Gateway

pytestmark = pytest.mark.triton


ROW = [1.0] * FILM_DIMS[0]


def but(**fields: Any) -> Json:
    return progress({**embedded(1, 3, FILM_DIMS), **fields})


VIDEO_AT, TEXT_AT = ["trajectory", "video_embeddings"], ["trajectory", "text_embedding"]


NO_FILES = r"expected an array \(this gateway reads no files\), got the name of a file"


BAD_ARRAYS: dict[str, dict[str, tuple[Any, str]]] = {
    "video_embeddings": {
        "another width": (np.ones((3, 7)), r"expected \[T, 48\], got \[3, 7\]"),
        "ragged": ([ROW, [1.0]], "expected rows of equal length, got unequal ones"),
        "NaN": ([ROW, [np.nan] * 48], r"expected finite values, got nan at \[1, 0\]"),
        "more than float32 holds": ([[1e39] * 48], r"expected finite values, got inf at \[0, 0\]"),
        "huge numbers": ([[10**30] * 48], "expected numbers, got something else"),
        "words for numbers": ([["1.0"] * 48], "expected numbers, got something else"),
        "a word and a row": ([ROW, "a"], "expected numbers, got something else"),
        "a number and a row": ([ROW, 1.0], "expected rows of equal length, got unequal ones"),
        "five axes": ([[[[ROW]]]], "expected at most 4 axes, got more"),
        "nulls": ([[None] * 48], "expected numbers, got something else"),
        "a word": ("1.0", "expected an array, got str"),
        "truths": ([[True] * 48], r"expected float32 \[T, D\], got bool \[1, 48\]"),
        "one axis": (ROW, r"expected float32 \[T, D\], got float64 \[48\]"),
        "nothing": ([], r"expected float32 \[T, D\], got float64 \[0\]"),
        "an object": ({"a": 1}, r'expected an array or {"__numpy_file__": name}, got an object without it'),
        "a part, in JSON": ({"__numpy_file__": "v"}, r"expected a \.npy part named 'v', got none"),
    },
    "text_embedding": {
        "another width": (np.ones(7), r"expected \[32\], got \[7\]"),
        "NaN": ([np.nan] * 32, r"expected finite values, got nan at \[0\]"),
        "a number": (1.0, "expected an array, got float"),
        "two axes": (np.ones((1, 32)), r"expected float32 \[Dt\], got float64 \[1, 32\]"),
    },
    "frames": {
        "floats in 0..1": (BLACK + 0.5, r"expected values in 0\.\.255, got values up to 0\.5: multiply by 255 first"),
        "values beyond 255": (BLACK.astype(int) + 256, r"expected values in 0\.\.255, got 256\.\.256"),
        "NaN": (BLACK + np.nan, r"expected finite values in 0\.\.255, got NaN, Inf or nothing"),
        "ragged": ([[[[1, 2, 3]]], [[[1]]]], "expected rows of equal length, got unequal ones"),
        "values below 0": (BLACK.astype(int) - 1, r"expected values in 0\.\.255, got -1\.\.-1"),
        "two channels": (np.ones((2, 8, 8, 2), int), r"expected uint8 \[T, H, W, 3\], got .* \[2, 8, 8, 2\]"),
        "grey levels": (np.ones((8, 8), int), r"expected uint8 \[T, H, W, 3\], got .* \[8, 8\]"),
        "no pixels": (BLACK[:, :0], "expected .*, got .*"),
        "truths": (BLACK > 0, r"expected uint8 \[T, H, W, 3\].*, got bool .*"),
        "words and numbers": (["0.png", 1], "expected numbers, got something else"),
        "null": (None, "expected frames, got neither frames nor video_embeddings"),
    },
}


BAD_SAMPLES: dict[str, tuple[Any, list[Any], str]] = {
    f"{field}, {name}": (
        of_frames(value) if field == "frames" else but(**{field: value}),
        ["trajectory", field],
        message,
    )
    for field, bad in BAD_ARRAYS.items()
    for name, (value, message) in bad.items()
} | {
    "no text, no task": (
        but(text_embedding=None, task=None),
        TEXT_AT,
        "expected an embedding, or a task.*, got neither",
    ),
    "no text, blank task": (but(text_embedding=None, task=" "), TEXT_AT, "expected an embedding, or .*, got neither"),
    "too long a task": (
        but(text_embedding=None, task="lift " * 200),
        TASK_AT,
        r"expected at most \d+ tokens.*, got .*",
    ),
    "a task that is a number": (but(task=5), TASK_AT, "expected text, got int"),
    "frames without a task": (of_frames(BLACK, task=None), TASK_AT, "expected a task sentence with frames, got ''"),
    "too many frames": (
        but(video_embeddings=np.ones((17, 48))),
        ["num_frames"],
        "expected at most 16 .*, got 17: .*sampling rule",
    ),
    "a sliver": (of_frames(np.ones((1, 2, 200, 3), int)), ["frames"], "expected frames at most 50 times as long .*"),
    "names of images": (of_frames(["0.png", "1.png"]), [*FRAMES_AT, 0], NO_FILES),
    "the name of a file": (progress({"embeddings_path": "a.npz"}), ["trajectory", "embeddings_path"], NO_FILES),
    "no trajectory": ({"sample_type": "progress"}, ["trajectory"], "expected a value, got none"),
    "no second": (
        {**preference(FIRST, SECOND), "rejected_trajectory": 5},
        ["rejected_trajectory"],
        ".*object, got int",
    ),
    "null": (progress(None), ["trajectory"], "expected an object, got NoneType"),
    "no type": ({"trajectory": FIRST}, ["sample_type"], "expected progress, preference or similarity, got None"),
    "another type": ({"sample_type": "reward"}, ["sample_type"], "expected progress, .*, got 'reward'"),
    "a list of types": ({"sample_type": ["progress"]}, ["sample_type"], r"expected progress, .*, got \['progress'\]"),
    "no sample": (5, [], "expected an object, got int"),
    "embeddings beside frames": (
        preference(embedded(1, 2, FILM_DIMS), filmed(1, 2)),
        ["chosen_trajectory", "video_embeddings"],
        "expected them in both trajectories or neither, got one of two",
    ),
    "a bad second": (
        preference(embedded(1, 2, FILM_DIMS), embedded(1, 2, (7, 32))),
        ["rejected_trajectory", "video_embeddings"],
        r"expected \[T, 48\], got \[2, 7\]",
    ),
}


@pytest.mark.parametrize(("sample", "path", "message"), BAD_SAMPLES.values(), ids=BAD_SAMPLES)
def test_a_bad_sample_is_refused_at_its_field(film: Gateway, sample: Any, path: list[Any], message: str) -> None:
    check_refused(ask_json(film, [sample]), (["samples", 0, *path], message))
    good = progress(embedded(1, 2, FILM_DIMS))
    check_refused(ask_json(film, [good, sample, good]), (["samples", 1, *path], message))


def test_all_bad_samples_are_told_at_once(film: Gateway, ask: Ask) -> None:
    wide = but(video_embeddings=np.ones((3, 7)))
    both = preference(embedded(1, 2, (7, 32)), embedded(1, 2, FILM_DIMS))
    response = ask(film, [wide, progress(embedded(1, 2, FILM_DIMS)), both])
    at = ["samples", 2, "chosen_trajectory", "video_embeddings"]
    check_refused(response, (["samples", 0, *VIDEO_AT], r".*\[3, 7\]"), (at, r".*\[2, 7\]"))
    task = but(text_embedding=None, task="lift " * 200)
    response = ask(film, [task, but(text_embedding=None), task])
    check_refused(response, *((["samples", index, *TASK_AT], "expected at most .* tokens.*") for index in (0, 2)))


def test_what_the_served_model_does_not_read_is_said(tiny: Gateway, video: Gateway, ask: Ask) -> None:
    no_frames = "expected embeddings, since no model for raw frames is served, got frames"
    check_refused(ask(tiny, [progress(filmed(1, 2))]), (["samples", 0, *VIDEO_AT], no_frames))
    no_encoder = "expected an embedding, or a task to encode, got a task, and no encoder is served"
    untold = progress({**FIRST, "text_embedding": None})
    check_refused(ask(tiny, [untold]), (["samples", 0, *TEXT_AT], no_encoder))
    no_embeddings = "expected frames, got video_embeddings"
    check_refused(ask(video, [progress(FIRST)]), (["samples", 0, *FRAMES_AT], no_embeddings))


BODIES: dict[str, tuple[bytes, list[Any], str]] = {
    "nothing": (b"", [], "expected JSON, got: .*"),
    "half an object": (b'{"samples": [', [], "expected JSON, got: .*"),
    "no UTF-8": (b'["\xff"]', [], "expected JSON, got: .*"),
    "half a character": (b'["\\ud800"]', [], "expected JSON, got: .*"),
    "ten thousand brackets": (b"[" * 10_000, [], "expected JSON, got: recursion limit .*"),
    "an empty list": (b"[]", ["samples"], "expected at least one sample, got none"),
    "no samples": (b'{"samples": []}', ["samples"], "expected at least one sample, got none"),
    "an empty object": (b"{}", ["samples"], "expected at least one sample, got none"),
    "a number": (b"5", ["samples"], "expected a list of samples, got int"),
    "null samples": (b'{"samples": null}', ["samples"], "expected a list of samples, got NoneType"),
    "samples as an object": (b'{"samples": {}}', ["samples"], "expected a list of samples, got dict"),
}


@pytest.mark.parametrize(("body", "path", "message"), BODIES.values(), ids=BODIES)
def test_a_body_that_holds_no_samples_is_refused(tiny: Gateway, body: bytes, path: list[Any], message: str) -> None:
    check_refused(requests.post(f"{tiny.url}/evaluate_batch", body), (path, message))


HUGE = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 2)}"


PARTS = {
    "truncated": (npy(np.ones((3, 2)))[:-4], r"expected a \.npy file of 48 bytes behind its header, got 44"),
    "too long": (npy(np.ones((3, 2))) + b"1", r"expected a \.npy file of 48 bytes behind its header, got 49"),
    "a shape of terabytes": (npy_of(HUGE), r"expected a \.npy file of 8000000000000 bytes behind its header, got 0"),
    "a negative shape": (npy_of(HUGE.replace("1000000000000", "-1")), r"expected a \.npy file of -8 bytes .*, got 0"),
    "pickled": (npy(np.array([[1, {}]], object), pickled=True), r"expected a \.npy file of numbers, got object"),
    "text": (npy(np.array([["a", "b"]])), r"expected a \.npy file of numbers, got <U1"),
    "complex": (npy(np.ones((3, 2), complex)), r"expected a \.npy file of numbers, got complex128"),
    "no .npy file": (b"hello world", r"expected a \.npy file, got .*magic string is not correct.*"),
    "empty": (b"", r"expected a \.npy file, got EOF: .*"),
    "half a header": (npy(np.ones((3, 2)))[:40], r"expected a \.npy file, got .*"),
    "an unbalanced header": (npy_of("{'descr': '<f4', ("), r"expected a \.npy file, got a broken header: .*"),
    "a header that is no table": (npy_of("{[]: 1}"), r"expected a \.npy file, got a broken header: .*"),
    "a type of nothing": (npy_of(HUGE.replace("'<f4'", "()")), r"expected a \.npy file, got a broken header: .*"),
    "an endless header": (npy_of("-" * 9000), r"expected a \.npy file, got a broken header: .*"),
    "version 3": (npy_of(HUGE, version=3), r"expected a \.npy file of version 1\.0 or 2\.0, got \(3, 0\)"),
    "another width": (npy(np.ones((3, 7))), r"expected \[T, 2\], got \[3, 7\]"),
}


@pytest.mark.parametrize(("part", "message"), PARTS.values(), ids=PARTS)
def test_a_bad_npy_file_is_refused_at_its_field(tiny: Gateway, part: bytes, message: str) -> None:
    check_refused(ask_part(tiny, part), (["samples", 0, *VIDEO_AT], message))


FORMS_REFUSED: dict[str, tuple[dict[str, str], list[Any], str]] = {
    "no sample": ({"use_frame_steps": "true"}, ["samples"], "expected at least one sample, got none"),
    "a gap": (FORM | {"sample_2": FORM["sample_0"]}, ["sample_1"], "expected a sample, got none, but sample_2"),
    "no first": ({"sample_1": FORM["sample_0"]}, ["sample_0"], "expected a sample, got none, but sample_1"),
    "another spelling": (FORM | {"sample_01": "{}"}, ["sample_01"], "expected sample_0, sample_1 and so on, got .*"),
    "steps that are none": (
        FORM | {"use_frame_steps": "yes"},
        ["use_frame_steps"],
        "expected true or false, got 'yes'",
    ),
    "no JSON": (FORM | {"sample_1": "{"}, ["sample_1"], "expected JSON, got: .*"),
    "no object": (FORM | {"sample_1": "5"}, ["samples", 1], "expected an object, got int"),
    "JSON in JSON": (FORM | {"sample_1": json.dumps(FORM["sample_0"])}, ["samples", 1], "expected an object, got str"),
    "a part that was not sent": (
        {"sample_0": dumped(progress({**FIRST, "video_embeddings": {"__numpy_file__": "other"}}))},
        ["samples", 0, *VIDEO_AT],
        r"expected a \.npy part named 'other', got none",
    ),
}


@pytest.mark.parametrize(("form", "path", "message"), FORMS_REFUSED.values(), ids=FORMS_REFUSED)
def test_a_bad_form_is_refused(tiny: Gateway, form: dict[str, str], path: list[Any], message: str) -> None:
    response = requests.post(f"{tiny.url}/evaluate_batch_npy", data=form, files={"unused": b"1"})
    check_refused(response, (path, message))


ONE_SAMPLE = (None, FORM["sample_0"])


LOST_PARTS: dict[str, tuple[list[tuple[str, Any]], list[Any], str]] = {
    "one field twice": ([("sample_0", ONE_SAMPLE)] * 2, ["sample_0"], "expected one part of this name, got several"),
    "one file twice": (
        [("sample_0", ONE_SAMPLE), *[("a", ("a.npy", npy(np.ones((3, 2)))))] * 2],
        ["a"],
        "expected one part of this name, got several",
    ),
    "a sample as a file": (
        [("sample_0", ONE_SAMPLE), ("sample_1", ("sample_1", FORM["sample_0"]))],
        ["sample_1"],
        "expected a form field, got a file",
    ),
    "steps as a file": (
        [("sample_0", ONE_SAMPLE), ("use_frame_steps", ("use_frame_steps", "true"))],
        ["use_frame_steps"],
        "expected a form field, got a file",
    ),
}


@pytest.mark.parametrize(("parts", "path", "message"), LOST_PARTS.values(), ids=LOST_PARTS)
def test_no_part_is_lost_silently(tiny: Gateway, parts: list[tuple[str, Any]], path: list[Any], message: str) -> None:
    check_refused(requests.post(f"{tiny.url}/evaluate_batch_npy", files=parts), (path, message))


@pytest.mark.parametrize("steps", [1, "1", "True", 0, "0", None, "", "yes", 2, 0.5, []], ids=repr)
def test_steps_are_a_boolean_or_refused(tiny: Gateway, steps: Any) -> None:
    response = requests.post(
        f"{tiny.url}/evaluate_batch", dumped({"samples": [progress(FIRST)], "use_frame_steps": steps})
    )
    if steps in ("yes", 2, 0.5) or steps == []:
        check_refused(response, (["use_frame_steps"], "expected true or false, got .*"))
        return
    meant = steps is not None and str(steps).lower() in ("1", "true")
    assert answered(response) == answered(ask_json(tiny, [progress(FIRST)], use_frame_steps=meant))


@pytest.mark.parametrize(("steps", "meant"), [("true", True), ("True", True), ("1", False), ("0", False), ("", False)])
def test_steps_in_a_form_are_read_as_the_fastapi_server_reads_them(tiny: Gateway, steps: str, meant: bool) -> None:
    form = FORM | {"use_frame_steps": steps}
    response = requests.post(f"{tiny.url}/evaluate_batch_npy", data=form, files={"unused": b"1"})
    assert answered(response) == expected(tiny, [progress(FIRST)], frame_steps=FRAME_STEPS if meant else 0)


def test_a_task_with_a_special_token_is_refused(video: Gateway, ask: Ask) -> None:
    sample = progress(filmed(1, 2, task="lift <|prog_token|>"))
    message = r"expected text without the model's special tokens, got '<\|prog_token\|>'"
    check_refused(ask(video, [sample]), (["samples", 0, "task"], message))


CHARSETS = ("undefined", "punycode", "unicode_escape", "rot13", "base64", "idna", "utf-7", "nowhere", "\xfc", "")


NO_CHARSET = "content-type: expected a charset of utf-8, us-ascii or iso-8859-1, got"


@pytest.mark.parametrize("charset", CHARSETS)
def test_a_charset_that_is_none_of_text_is_a_415(tiny: Gateway, charset: str) -> None:
    content_type = f'{MULTIPART}; charset="{charset}"'.encode("latin-1")
    body = NAMED + FORM["sample_0"].encode() + b"\r\n--b--\r\n"
    response = requests.post(f"{tiny.url}/evaluate_batch_npy", body, headers={"Content-Type": content_type})
    assert failure(response, 415) == f"{NO_CHARSET} {charset!r}"


@pytest.mark.parametrize("charset", ["utf-8", "UTF8", "us-ascii", "ISO_8859-1", "latin1"])
def test_a_charset_of_text_is_read(tiny: Gateway, charset: str) -> None:
    body = NAMED + FORM["sample_0"].encode() + b"\r\n--b--\r\n"
    headers = {"Content-Type": f"{MULTIPART}; charset={charset}"}
    response = requests.post(f"{tiny.url}/evaluate_batch_npy", body, headers=headers)
    assert answered(response) == expected(tiny, [progress(FIRST)])


NAMELESS = b"--b\r\nContent-Disposition: form-data\r\n\r\nx\r\n--b--\r\n"


NO_FORM = "content-type: expected multipart/form-data with a boundary"


NO_END = "body: expected its last boundary at its end, got none"


UNREADABLE: dict[str, tuple[int, str, str | None, bytes]] = {
    "JSON": (415, f"{NO_FORM}, got application/json", "application/json", b"[]"),
    "no content type": (415, f"{NO_FORM}, got none", None, b"[]"),
    "no boundary": (415, f"{NO_FORM}, got multipart/form-data", "multipart/form-data", NAMED),
    "no multipart": (400, NO_END, MULTIPART, b"hello"),
    "nothing": (400, NO_END, MULTIPART, b""),
    "no name": (400, 'The Content-Disposition header field "name" must be provided.', MULTIPART, NAMELESS),
    "cut off": (400, NO_END, MULTIPART, NAMED + FORM["sample_0"].encode() + b"\r\n" + NAMED + b'{"sample'),
    "cut off in a boundary": (400, NO_END, MULTIPART, NAMED + FORM["sample_0"].encode() + b"\r\n--"),
}


@pytest.mark.parametrize(("code", "message", "content_type", "body"), UNREADABLE.values(), ids=UNREADABLE)
def test_what_is_no_multipart_is_refused(
    tiny: Gateway, code: int, message: str, content_type: str | None, body: bytes
) -> None:
    headers = {"Content-Type": content_type} if content_type else {}
    assert failure(requests.post(f"{tiny.url}/evaluate_batch_npy", body, headers=headers), code) == message


def test_embeddings_with_which_the_network_would_overflow_are_refused(tiny: Gateway, ask: Ask) -> None:
    too_large = progress({**FIRST, "video_embeddings": np.full((3, 2), 3e38, np.float32)})
    assert "expected values from -1e+06 to 1e+06" in failure(ask(tiny, [progress(FIRST), too_large]), 422)
