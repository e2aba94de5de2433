# SPDX-License-Identifier: MIT
"""The endpoints of the FastAPI evaluation server: the same numbers as the client's."""

from __future__ import annotations

import json
import signal
import socket
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import requests

from gateway_requests import (
    ENCODER_DIMS,
    FIRST,
    FRAME_STEPS,
    SECOND,
    SEED_PAYLOAD,
    TINY,
    Array,
    Ask,
    Json,
    Triton,
    answered,
    ask_json,
    ask_npy,
    begun,
    dumped,
    embedded,
    expected,
    filmed,
    npy,
    npy_of,
    numbers,
    of_frames,
    post_json,
    preference,
    progress,
    similarity,
)
from gateways import Gateway, running
from rfm_client import InvalidSampleError, ModelNotFoundError, Trajectory
from servers import PATIENCE_S, wait_for
from tolerances import TOLERANCE

pytestmark = pytest.mark.triton


def mixed(make: Callable[..., Json], *dims: Any) -> list[Json]:
    """Return two samples of each type, out of order, with different lengths."""
    return [
        similarity(make(1, 2, *dims), make(2, 5, *dims)),
        progress(make(3, 7, *dims)),
        preference(make(4, 1, *dims), make(5, 3, *dims)),
        progress(make(6, 1, *dims)),
        similarity(make(7, 4, *dims), make(8, 4, *dims)),
        preference(make(9, 6, *dims), make(10, 2, *dims)),
    ]


def test_the_documented_payload_is_answered(tiny: Gateway) -> None:
    answer = answered(requests.post(f"{tiny.url}/evaluate_batch", json=SEED_PAYLOAD))
    assert answer == expected(tiny, SEED_PAYLOAD)
    kinds = {key: type(values[0]) for key, values in answer["outputs_preference"].items()}
    assert kinds == {"predictions": int, "prediction_probs": float, "preference_labels": float}


def test_every_type_in_one_request_gets_the_numbers_of_the_client(encoders: Gateway, ask: Ask) -> None:
    samples = mixed(embedded, ENCODER_DIMS)
    assert answered(ask(encoders, samples)) == expected(encoders, samples)
    for sample in samples:
        assert answered(ask(encoders, [sample])) == expected(encoders, [sample])
    samples += [*mixed(filmed), progress(filmed(3, 2, size_px=40))]
    assert answered(ask(encoders, samples)) == numbers(expected(encoders, samples))


def test_pairs_of_two_frame_sizes_are_scored(encoders: Gateway, video: Gateway) -> None:
    samples = [
        preference(filmed(1, 3), filmed(2, 2, size_px=40)),
        progress(filmed(3, 2, size_px=40)),
        preference(filmed(6, 2), filmed(7, 4)),
    ]
    assert answered(ask_json(video, samples)) == numbers(expected(video, samples, group=2))
    samples.append(similarity(filmed(4, 2, size_px=40), filmed(5, 5)))
    samples.append(progress(filmed(7, 2, size_px=440)))  # more than a megabyte: read in a thread, from disk
    assert answered(ask_npy(encoders, samples)) == numbers(expected(encoders, samples))


def test_frame_steps_score_each_frame_on_its_prefix_and_leave_the_other_types_as_they_are(
    encoders: Gateway, ask: Ask
) -> None:
    for samples in (mixed(embedded, ENCODER_DIMS), mixed(filmed)):
        steps = answered(ask(encoders, samples, use_frame_steps=True))
        assert steps == numbers(expected(encoders, samples, frame_steps=FRAME_STEPS))
        assert [len(values) for values in steps["outputs_progress"]["progress_pred"]] == [7, 1]
        assert steps != numbers(answered(ask(encoders, samples, use_frame_steps=False)))


ONE = [progress(FIRST)]
ALIASES = {"reference_trajectory": FIRST, "traj_sim_trajectory": SECOND, "traj_diff_trajectory": embedded(3, 4)}
THIRD = {**similarity(FIRST, SECOND), "diff_trajectory": embedded(3, 4)}
UNKNOWN = {**progress({**FIRST, "quality": {"a": [None]}}), "resample": 3}
NULLS = {**progress({**FIRST, "frames": None, "embeddings_path": None, "metadata": None}), "data_gen_strategy": None}
BESIDE = progress({**FIRST, "frames": ["0.png"], "embeddings_path": "episode_7.pt"})
TOLD = {"data_source": "bridge", "metadata": {"fps": 3, "camera": {"name": "wrist"}}}
PAIRED = {**similarity({**FIRST, **TOLD}, SECOND), "data_gen_strategy": "paired"}
FORMS: dict[str, tuple[Any, int, list[Json]]] = {
    "a bare list": (ONE, 0, ONE),
    "a sample alone": (progress(FIRST), 0, ONE),
    "a sample alone, true": ({**progress(FIRST), "use_frame_steps": True}, FRAME_STEPS, ONE),
    "a sample alone, True as text": ({**progress(FIRST), "use_frame_steps": "True"}, FRAME_STEPS, ONE),
    "a sample alone, null": ({**progress(FIRST), "use_frame_steps": None}, 0, ONE),
    "an object with one list": ({"use_frame_steps": False, "anything": ONE}, 0, ONE),
    "an object of samples": ({"first": progress(FIRST), "use_frame_steps": "false"}, 0, ONE),
    "unknown fields": ({"samples": [UNKNOWN], "x": 1}, 0, ONE),
    "null for what is not there": ([NULLS], 0, ONE),
    "embeddings win over frames and files": ([BESIDE], 0, ONE),
    "fields that the answer repeats": ([PAIRED], 0, [PAIRED]),
    "other names": ([{"sample_type": "similarity", **ALIASES}, THIRD], 0, [similarity(FIRST, SECOND)] * 2),
}


@pytest.mark.parametrize(("document", "frame_steps", "samples"), FORMS.values(), ids=FORMS)
def test_every_form_of_a_request_is_read(tiny: Gateway, document: Any, frame_steps: int, samples: list[Json]) -> None:
    assert answered(post_json(tiny, document)) == expected(tiny, samples, frame_steps=frame_steps)


FLOATS = np.random.default_rng(0).uniform(-20, 280, (3, 32, 32, 3)).astype(np.float32)
PIXELS: Array = filmed(1, 3)["frames"]
FRAMES: dict[str, tuple[Array, Array]] = {  # as they are sent, and as they are scored
    "floats are clipped and truncated": (FLOATS, np.clip(FLOATS, 0, 255).astype(np.uint8)),
    "one frame is a video of one": (PIXELS[0], PIXELS[:1]),
    "of RGBA the colours count": (np.concatenate([PIXELS, PIXELS[..., :1]], axis=-1), PIXELS),
}


@pytest.mark.parametrize(("sent", "scored"), FRAMES.values(), ids=FRAMES)
def test_frames_of_other_kinds_are_read(encoders: Gateway, ask: Ask, sent: Array, scored: Array) -> None:
    assert answered(ask(encoders, [of_frames(sent)])) == expected(encoders, [of_frames(scored)])


ARRAYS: dict[str, Callable[[Array], bytes]] = {
    "float64": lambda array: npy(array.astype(np.float64)),
    "float16": lambda array: npy(array.astype(np.float16)),
    "big-endian": lambda array: npy(array.astype(">f4")),
    "Fortran's order": lambda array: npy(np.asfortranarray(array)),
    "version 2": lambda array: npy_of(npy(array)[10:128].decode(), array.tobytes(), version=2),
}


@pytest.mark.parametrize("written", ARRAYS.values(), ids=ARRAYS)
def test_any_npy_file_of_numbers_is_read(tiny: Gateway, written: Callable[[Array], bytes]) -> None:
    video = np.array([[0.5, -1.0], [2.0, 0.25], [1.0, 1.5]], np.float32)  # which every type holds exactly
    sample = dumped(progress({**FIRST, "video_embeddings": {"__numpy_file__": "video"}}))
    files = {"video": ("video.npy", written(video))}
    response = requests.post(f"{tiny.url}/evaluate_batch_npy", data={"sample_0": sample}, files=files)
    assert answered(response) == expected(tiny, [progress({**FIRST, "video_embeddings": video})])


def test_a_task_without_embedding_is_encoded(encoders: Gateway, tiny: Gateway) -> None:
    given = embedded(1, 3, ENCODER_DIMS, task="open the drawer")
    frames = Trajectory(frames=filmed(1, 2)["frames"], task="open the drawer")
    with encoders.client() as client:
        encoded = client.encode(frames)
        np.testing.assert_allclose(client.progress(encoded).progress, client.progress(frames).progress, atol=TOLERANCE)
        with pytest.raises(InvalidSampleError, match="trajectory: expected frames, got video_embeddings"):
            client.encode(encoded)
        with pytest.raises(InvalidSampleError, match=r"expected a model .*, got .*; leave out"):
            client.encode(replace(frames, goal=frames.positions[0]))
    with tiny.client() as client, pytest.raises(ModelNotFoundError, match="rfm_encoder"):
        client.encode(frames)
    samples = [progress({**given, "text_embedding": None}), preference({**given, "text_embedding": None}, given)]
    with_text = {**given, "text_embedding": encoded.text_embedding}
    answer = answered(ask_json(encoders, samples))
    assert answer == numbers(expected(encoders, [progress(with_text), preference(with_text, given)]))
    other = answered(ask_json(encoders, [progress({**given, "text_embedding": None, "task": "close the drawer"})]))
    assert other["outputs_progress"] != numbers({"progress_pred": answer["outputs_progress"]["progress_pred"][:1]})


def test_a_model_that_sees_a_video_gives_a_value_for_two_frames(video: Gateway) -> None:
    samples = [progress(filmed(1, 5)), preference(filmed(2, 3), filmed(3, 2)), progress(filmed(4, 1))]
    answer = answered(ask_json(video, samples))
    assert answer == numbers(expected(video, samples, group=2))
    assert [len(values) for values in answer["outputs_progress"]["progress_pred"]] == [3, 1]
    assert [len(values) for values in answer["outputs_success"]["success_probs"]] == [3, 1]
    steps = answered(ask_json(video, samples[:1], use_frame_steps=True))
    assert steps == numbers(expected(video, samples[:1], frame_steps=FRAME_STEPS))
    assert len(steps["outputs_progress"]["progress_pred"][0]) == 5


@pytest.mark.slow
def test_concurrent_callers_each_get_their_own_answer(encoders: Gateway) -> None:
    asked = [[mixed(embedded, ENCODER_DIMS)[k % 6], progress(embedded(k, 1 + k % 9, ENCODER_DIMS))] for k in range(32)]
    with ThreadPoolExecutor(len(asked)) as pool:
        answers = list(pool.map(lambda samples: answered(ask_json(encoders, samples)), asked))
    for samples, answer in zip(asked, answers, strict=True):
        assert answer == numbers(expected(encoders, samples))


def listens(gateway: Gateway) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", int(gateway.url.rpartition(":")[2]))) == 0


def test_a_gateway_asks_triton_over_http_and_answers_open_requests_before_it_stops(
    triton: Triton, tmp_path: Path
) -> None:
    body = dumped([progress(FIRST)]).encode()
    with running(triton.endpoints, tmp_path, TINY, "--triton", triton.endpoints.http_url) as gateway:
        assert answered(ask_json(gateway, mixed(embedded))) == expected(gateway, mixed(embedded))
        assert requests.get(f"{gateway.url}/health").ok
        answer = expected(gateway, [progress(FIRST)])
        connection = begun(gateway, {"Content-Length": str(len(body)), "Expect": "100-continue"}, body[:20])
        assert connection.sock.recv(1024).startswith(b"HTTP/1.1 100 ")  # reads the body
        gateway.process.terminate()
        wait_for(lambda: not listens(gateway))
        connection.send(body[20:])
        assert json.loads(connection.getresponse().read()) == answer
        connection.close()
        assert gateway.process.wait(PATIENCE_S) in (0, -signal.SIGTERM)
