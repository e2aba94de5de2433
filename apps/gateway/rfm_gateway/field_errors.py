# SPDX-License-Identifier: MIT
"""Errors in request fields, as 422 lists them: ``expected X, got Y; remedy`` and the path that was sent."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError

from rfm_client import InvalidSampleError
from rfm_gateway import schema

MAX_ERRORS = 1000  # listed in one response
STEPS_FIELD = "use_frame_steps"

Path: TypeAlias = tuple[str | int, ...]  # path to a field, below the body

_EXPECTED = {  # the expected value, by pydantic's error type
    "string_type": "text",
    "dict_type": "an object",
    "model_type": "an object",
    "model_attributes_type": "an object",
    "missing": "a value",
    "extra_forbidden": "no such field",
    "union_tag_invalid": "progress, preference or similarity",
    "union_tag_not_found": "progress, preference or similarity",
}
_AROUND_EXPECTED = re.compile("^.*?should (be|have|match) | after validation.*|, unable to .*")  # in its messages
_SIDES = {  # the gateway's fields, by the client's names
    "first": "chosen_trajectory",
    "second": "rejected_trajectory",
    "reference": "ref_trajectory",
    "other": "sim_trajectory",
}
_SAMPLE_FIELDS = ("sample_type", "answer")  # fields that a model's error may name outside any trajectory
_FEWER_FRAMES = f"send fewer frames, such as some at equal distances, or {STEPS_FIELD}"
_SMALLER = "send smaller or fewer frames"


def invalid(loc: Path, message: str, kind: str = "value_error") -> RequestValidationError:
    """Return an error at a body field, in the format that FastAPI uses."""
    return RequestValidationError([{"type": kind, "loc": ["body", *loc], "msg": message}])


def field_errors(error: ValidationError) -> list[dict[str, Any]]:
    """Return pydantic's errors in the gateway's format, ``expected X, got Y`` at a path.

    Raises a RequestValidationError that gives only their count if there are more than MAX_ERRORS.
    """
    if error.error_count() > MAX_ERRORS:
        raise invalid((), f"expected no faulty fields, got {error.error_count()}")
    return [_field_error(each) for each in error.errors(include_url=False)]


def refused(
    errors: Mapping[int, InvalidSampleError], samples: Sequence[schema.Sample], paths: Sequence[Path]
) -> RequestValidationError:
    """Return an error that lists all invalid samples.

    errors: the client's errors, by sample index
    paths: each sample's path
    """
    details: list[Any] = []
    for index, error in errors.items():
        words = error.where.split(".") if error.where else []
        path, message = _placed(words, error, samples[index])
        details += invalid(path if path[:1] == (STEPS_FIELD,) else (*paths[index], *path), message).errors()
    return RequestValidationError(details)


def _placed(words: list[str], error: InvalidSampleError, sample: schema.Sample) -> tuple[Path, str]:
    """Return the path below the sample for a client's or a model's error, and the message."""
    *around, field = words or [""]
    message = error.problem
    if field == "frame_steps":
        return (STEPS_FIELD,), f"expected false with this model, got true: {message}"
    if field == "num_frames":
        message = f"expected {error.expected}, got {error.got}; {_FEWER_FRAMES}"
    elif error.remedy and not around:  # from the client, whose remedy is an option in Python
        message = f"expected {error.expected}, got {error.got}; {_SMALLER}"
    path = [int(word) if word.isdecimal() else _SIDES.get(word, word) for word in [*around, field] if word]
    if around or field in _SAMPLE_FIELDS or not path:
        return tuple(path), message
    return _of_trajectory(field, sample), message


def _of_trajectory(field: str, sample: schema.Sample) -> Path:
    """Return the path for a field that a model names without its trajectory; if ambiguous, the sample's path."""
    names = list(sample.named_trajectories)
    if field in names or _SIDES.get(field) in names:
        return (_SIDES.get(field, field),)
    if field == "second_frames":
        return (names[-1], "frames")
    if field in ("task", "text_embedding"):  # in the first trajectory, which the model reads
        names = names[:1]
    if len(names) > 1:
        return ()
    given = sample.named_trajectories[names[0]]
    if field == "num_frames":
        field = "video_embeddings" if given.frames is None else "frames"
    return (names[0], field)


def _field_error(error: Any) -> dict[str, Any]:
    kind, message, given = error["type"], error["msg"], error["input"]
    if kind == "value_error":
        message = str(error["ctx"]["error"])
    elif kind == "json_invalid":
        message = f"expected JSON, got: {error['ctx']['error']}"
    else:
        given = given.get("sample_type") if "union_tag" in kind else given
        expected = _EXPECTED.get(kind) or _AROUND_EXPECTED.sub("", message)
        got = {"missing": "none", "too_long": "more"}.get(kind) or reprlib.repr(given)
        message = f"expected {expected}, got {got}"
    return {"type": kind, "loc": ["body", *(each for each in error["loc"] if each != "[key]")], "msg": message}
