# SPDX-License-Identifier: MIT
"""Synthetic samples of ``rfm-client sample`` and ``bench-input``, and how results become documents."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_commands import MODEL, ask, assert_scores
from engine_server import EngineServer
from rfm_client import FrameScores, ProgressResult
from rfm_client.cli.documents import frame_document
from rfm_client.cli.scoring import unique_stems
from rfm_client.cli.synthetic import SyntheticSamples, parse_lengths
from rfm_client.command_line import ExitCode, number
from rfm_client.contract.wire import encode_samples

SAMPLES = {"embeddings": ("progress", False), "pairs": ("similarity", False), "frames": ("preference", True)}


@pytest.mark.parametrize(("kind", "use_frames"), SAMPLES.values(), ids=SAMPLES)
def test_sample_and_bench_input_ask_for_the_same_samples(
    engines: EngineServer, tmp_path: Path, kind: Any, use_frames: bool
) -> None:
    words = ["--sample-type", kind, "--num-samples", 3, "--num-frames", "2,5", "--seed", 5]
    words += ["--use-frames"] if use_frames else []
    result = ask(engines, "sample", *words, "--json", "-")
    assert (result.exit_code, result.stderr) == (0, "")
    with engines.client(MODEL) as client:
        samples = SyntheticSamples(kind, 3, parse_lengths("2,5"), use_frames, seed=5).samples(client)
        expected = client.evaluate(samples)
    for answer, scores in zip(json.loads(result.stdout)["samples"], expected, strict=True):
        if isinstance(scores, ProgressResult):
            assert_scores(answer, scores)
        else:
            assert answer[kind] == pytest.approx(getattr(scores, kind), abs=1e-4)
            for name in ("first", "second") if kind == "preference" else ("reference", "other"):
                assert_scores(answer[name], getattr(scores, name))

    target = tmp_path / "input.json"
    result = ask(engines, "bench-input", *words, "--output", target)
    name = f"{MODEL}_frames" if use_frames else MODEL
    command = f"perf_analyzer -m {name} -i grpc -u {engines.url.removeprefix('grpc://')} --input-data {target}"
    assert result.stdout == f"{command} --async --concurrency-range 1:16:5\n"
    for request, sample in zip(json.loads(target.read_text())["data"], samples, strict=True):
        tensors = encode_samples([sample])
        assert request.keys() == tensors.keys()
        for tensor, array in tensors.items():  # as perf_analyzer reads them, with the batch axis that it adds
            content = request[tensor]["content"]
            if isinstance(content, list):
                flat = np.array([text.encode() for text in content], np.object_)
            else:
                flat = np.frombuffer(base64.b64decode(content["b64"], validate=True), array.dtype.newbyteorder("<"))
            np.testing.assert_array_equal(flat.reshape(1, *request[tensor]["shape"]), array)


def test_sample_shows_a_table_and_tells_of_each_that_fails(engines: EngineServer) -> None:
    result = ask(engines, "sample", "--sample-type", "preference", "--num-samples", 2, "--num-frames", "3,17")
    assert (result.exit_code, result.stdout) == (ExitCode.FAILED, "")
    for index, line in enumerate(result.stderr.splitlines()):
        assert line.startswith(f"rfm-client: samples[{index}]: num_frames: expected at most 16")
    good = ask(engines, "sample", "--sample-type", "preference", "--num-samples", 1)
    with engines.client(MODEL) as client:
        (expected,) = client.evaluate(SyntheticSamples("preference", 1).samples(client))
    assert f"P(first) = {expected.preference:.4f}" in good.stdout  # type: ignore[union-attr]


def test_a_score_that_is_not_told_is_null_and_shown_as_a_dash() -> None:
    scores = FrameScores(progress=np.float32([0.25, 0.5]), success=np.full(2, np.nan, np.float32))
    document = frame_document(scores, None)
    assert (document["progress"], document["success"]) == ([0.25, 0.5], None)
    assert [number(value) for value in (None, float("nan"), 0.5)] == ["-", "-", "0.5000"]


def test_files_about_videos_of_one_name_do_not_overwrite_each_other() -> None:
    names = ["a/clip.mp4", "b/clip.mp4", "http://host/clip.mp4?size=2", "other.tar.mp4"]
    assert unique_stems(names) == ["clip", "clip_2", "clip_3", "other.tar"]
    assert unique_stems(["x/a.mp4", "a_2.mp4", "y/a.mp4"]) == ["a", "a_2", "a_3"]
