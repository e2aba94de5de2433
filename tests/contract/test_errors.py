# SPDX-License-Identifier: MIT
"""Errors of invalid values carry the fields of their messages."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest

from rfm.files import CheckpointError
from rfm.serve.installation import ServerStartError
from rfm_client import InvalidSampleError
from rfm_client.contract import triton
from rfm_client.contract.errors import LocatedError
from rfm_client.options import ConfigError, InvalidValueError
from rfm_export import ExportError
from rfm_labels import DatasetError

KINDS = (
    CheckpointError,
    ConfigError,
    DatasetError,
    ExportError,
    InvalidSampleError,
    InvalidValueError,
    LocatedError,
    ServerStartError,
)


def fields(error: LocatedError) -> tuple[str, ...]:
    return error.where, error.expected, error.got, error.remedy


@pytest.mark.parametrize("kind", KINDS)
def test_an_error_keeps_its_fields_in_a_copy_and_in_another_process(kind: type[LocatedError]) -> None:
    error = kind.at("frames", "at least 1", 0, "send one")
    for same in (error, copy.copy(error), pickle.loads(pickle.dumps(error)), kind.like(error)):
        assert type(same) is kind
        assert fields(same) == ("frames", "at least 1", "0", "send one")
        assert (str(same), same.problem) == (
            "frames: expected at least 1, got 0; send one",
            "expected at least 1, got 0; send one",
        )


def test_an_invalid_sample_keeps_its_request_and_its_video_in_another_process() -> None:
    error = InvalidSampleError.like(InvalidSampleError.at("video", "frames", "none"), source="a.mp4")
    error.request_id = "id-1"
    for same in (error, pickle.loads(pickle.dumps(error))):
        assert str(same) == "video: expected frames, got none (a.mp4) (request id-1)"
        assert same.message == "video: expected frames, got none (a.mp4)"


def test_an_object_around_a_field_goes_before_it() -> None:
    inner = InvalidSampleError.at("task", "a sentence", "''")
    inner.request_id = "id-1"
    outer = inner.inside("trajectory").inside("samples[3]")
    assert str(outer) == "samples[3].trajectory.task: expected a sentence, got '' (request id-1)"
    assert (outer.where, outer.expected) == ("samples[3].trajectory.task", "a sentence")
    assert str(InvalidSampleError("no reason given").inside("samples[3]")) == "samples[3]: no reason given"


TEXTS: dict[str, tuple[str, Any]] = {
    "a field": ("samples[1].task: expected text, got 1", ("samples[1].task", "text", "1", "")),
    "too many frames": (
        "num_frames: expected at most 16, got 17",
        ("num_frames", "at most 16", "17", triton.FEWER_FRAMES),
    ),
    "other text": ("no reason given", ("", "", "", "")),
}


@pytest.mark.parametrize(("text", "wanted"), TEXTS.values(), ids=TEXTS)
def test_the_server_s_text_becomes_fields_again(text: str, wanted: Any) -> None:
    error = triton.invalid_sample(text)
    assert fields(error) == wanted
    assert str(error).startswith(text)


def test_two_settings_that_do_not_fit_are_named_as_their_reader_knows_them() -> None:
    error = ConfigError.of_two("frames", "needs", "sampling")
    assert str(error) == "frames needs sampling"
    assert str(pickle.loads(pickle.dumps(error)).named("export.{}".format)) == "export.frames needs export.sampling"
