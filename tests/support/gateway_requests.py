# SPDX-License-Identifier: MIT
"""Requests to the gateway, and the answers that the client gives to the same questions."""

from __future__ import annotations

import http.client
import io
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import pytest
import requests

from gateway_fixtures import ENCODERS as ENCODERS
from gateway_fixtures import TINY as TINY
from gateway_fixtures import VLM as VLM
from gateways import Address, Gateway, TestClient
from proxies import Proxy
from rfm_client import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory
from servers import Endpoints
from small_network import SMALL
from tolerances import TOLERANCE

Json: TypeAlias = dict[str, Any]
Array: TypeAlias = npt.NDArray[Any]
Ask: TypeAlias = Callable[..., requests.Response]
TINY_CONFIG = replace(
    SMALL, video_feature_dim=2, text_feature_dim=2, hidden_dim=8, num_layers=1, num_attention_heads=2, max_len=16,
    progress_bins=10,
)  # fmt: skip
ENCODER_DIMS = (48, 32)  # widths D and Dt of ENCODERS's encoders
FRAME_STEPS = 4
SIDES = {
    "progress": ("trajectory",),
    "preference": ("chosen_trajectory", "rejected_trajectory"),
    "similarity": ("ref_trajectory", "sim_trajectory"),
}


@dataclass(frozen=True)
class Triton:
    repository: Path
    endpoints: Endpoints
    proxies: Sequence[Proxy]  # in front of its ports


def embedded(seed: int, num_frames: int, dims: tuple[int, int] = (2, 2), **fields: Any) -> Json:
    random = np.random.default_rng(seed)
    video = random.standard_normal((num_frames, dims[0]), np.float32)
    text = random.standard_normal(dims[1], np.float32)
    return {"task": "lift", "video_embeddings": video, "text_embedding": text, **fields}


def filmed(seed: int, num_frames: int, size_px: int = 32, **fields: Any) -> Json:
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, size_px, size_px, 3), np.uint8)
    return {"task": f"lift cup {seed}", "frames": frames} | fields


def progress(trajectory: Any) -> Json:
    return {"sample_type": "progress", "trajectory": trajectory}


def preference(chosen: Json, rejected: Json) -> Json:
    return {"sample_type": "preference", "chosen_trajectory": chosen, "rejected_trajectory": rejected}


def similarity(ref: Json, sim: Json) -> Json:
    return {"sample_type": "similarity", "ref_trajectory": ref, "sim_trajectory": sim}


def dumped(document: Any) -> str:
    return json.dumps(document, default=np.ndarray.tolist)


def npy(array: Array, *, pickled: bool = False) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=pickled)
    return file.getvalue()


def ask_json(gateway: Address | TestClient, samples: Any, **fields: Any) -> requests.Response:
    return post_json(gateway, {"samples": samples, **fields})


def post_json(gateway: Address | TestClient, document: Any) -> Any:
    if isinstance(gateway, TestClient):
        return gateway.post("/evaluate_batch", content=dumped(document))
    return requests.post(f"{gateway.url}/evaluate_batch", dumped(document))


def ask_npy(gateway: Address | TestClient, samples: Sequence[Json], **fields: Any) -> Any:
    """Send every array as a part, as the evaluation server's documentation says."""
    files, form = multipart(samples, **fields)
    if isinstance(gateway, TestClient):
        return gateway.post("/evaluate_batch_npy", files=files, data=form)
    return requests.post(f"{gateway.url}/evaluate_batch_npy", files=files, data=form)


def multipart(samples: Sequence[Json], **fields: Any) -> tuple[Json, Json]:
    """Return the files and the fields of a form."""
    files, form = {}, {name: str(value).lower() for name, value in fields.items()}
    for index, sample in enumerate(samples):
        shown: Json = dict(sample)
        for side, trajectory in sample.items():
            if not isinstance(trajectory, dict):
                continue
            shown[side] = dict(trajectory)
            for name, value in trajectory.items():
                if isinstance(value, np.ndarray):
                    key = f"sample_{index}_{side}_{name}"
                    files[key] = (f"{key}.npy", io.BytesIO(npy(value)), "application/octet-stream")
                    shown[side][name] = {"__numpy_file__": key}
        form[f"sample_{index}"] = json.dumps(shown)
    return files, form


def of_client(sample: Json, frame_steps: int) -> Sample:
    """The sample as the other clients say it."""
    names = ("frames", "video_embeddings", "text_embedding", "task")
    first, *others = (
        Trajectory(**{name: sample[side][name] for name in names if sample[side].get(name) is not None})
        for side in SIDES[sample["sample_type"]]
    )
    if sample["sample_type"] == "progress":
        return ProgressSample(first, frame_steps=frame_steps)
    return (PreferenceSample if sample["sample_type"] == "preference" else SimilaritySample)(first, *others)


def expected(gateway: Gateway, samples: Sequence[Json], *, frame_steps: int = 0, group: int = 1) -> Json:
    """The FastAPI server's answer with the numbers that RewardClient gets."""
    with gateway.client() as client:
        results: list[Any] = client.evaluate([of_client(sample, frame_steps) for sample in samples])
    pairs = list(zip(samples, results, strict=True))
    of = {kind: [(s, r) for s, r in pairs if s["sample_type"] == kind] for kind in SIDES}
    told: Json = dict.fromkeys(("outputs_preference", "outputs_progress", "outputs_similarity"))
    if of["preference"]:
        chances = [float(result.preference) for _, result in of["preference"]]
        told["outputs_preference"] = {
            "predictions": [int(chance > 0.5) for chance in chances],
            "prediction_probs": chances,
            "preference_labels": [1.0] * len(chances),
        }
    if of["progress"]:
        told["outputs_progress"] = {"progress_pred": [r.progress[::group].tolist() for _, r in of["progress"]]}
        told["outputs_success"] = {"success_probs": [r.success[::group].tolist() for _, r in of["progress"]]}
    if of["similarity"]:
        references = [sample["ref_trajectory"] for sample, _ in of["similarity"]]
        told["outputs_similarity"] = {
            "sim_score_ref_sim": [float(result.similarity) for _, result in of["similarity"]],
            "task": [reference.get("task") for reference in references],
            "data_source": [reference.get("data_source") for reference in references],
            "data_gen_strategy": [sample.get("data_gen_strategy") for sample, _ in of["similarity"]],
            "metadata": [reference.get("metadata") or {} for reference in references],
        }
    return told


def numbers(answer: Any) -> Any:
    """With every float near enough to any that is equal within TOLERANCE."""
    if isinstance(answer, dict):
        return {key: numbers(value) for key, value in answer.items()}
    if isinstance(answer, list):
        return [numbers(value) for value in answer]
    return pytest.approx(answer, rel=0, abs=TOLERANCE) if isinstance(answer, float) else answer


def answered(response: requests.Response) -> Json:
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "application/json"
    return dict(response.json())


def failure(response: requests.Response, code: int) -> str:
    """The reason in an answer that is no success."""
    assert response.status_code == code, response.text
    assert response.headers["content-type"] == "application/json"
    return str(response.json()["detail"])


def seed_side(video: Any, text: Any, target: Any) -> Json:
    shown = {"task": "pick_place", "video_embeddings": video, "text_embedding": text}
    return {**shown, "target_progress": target, "frames_shape": [2, 2]}


SEED_PAYLOAD = [  # of the FastAPI evaluation server's README
    preference(
        seed_side([[0.1, 0.2], [0.3, 0.4]], [0.5, 0.6], [0.2, 0.6, 1.0]),
        seed_side([[-0.1, -0.2], [-0.3, -0.4]], [0.0, 0.1], [0.1, 0.3, 0.5]),
    )
]
FIRST, SECOND = embedded(1, 3), embedded(2, 2)


def npy_of(header: str, content: bytes = b"", version: int = 1) -> bytes:
    length = len(header).to_bytes(2 * version, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + length + header.encode() + content


def of_frames(frames: Any, **fields: Any) -> Json:
    return progress({"task": "lift", "frames": frames, **fields})


BLACK = np.zeros((2, 8, 8, 3), np.uint8)


def check_refused(response: requests.Response, *told: tuple[Sequence[Any], str]) -> None:
    """422 with exactly these fields and reasons."""
    assert response.status_code == 422, response.text
    detail = response.json()["detail"]
    assert [error["loc"] for error in detail] == [["body", *path] for path, _ in told]
    for error, (_, message) in zip(detail, told, strict=True):
        assert error.keys() == {"type", "loc", "msg"}
        assert re.fullmatch(message, error["msg"], re.DOTALL), error["msg"]


NO_KEY = (
    "key: expected it in X-API-Key, in Authorization: Bearer, or as the password of HTTP Basic "
    "(http://any:KEY@HOST, KEY percent-encoded), got another or none"
)
MULTIPART = "multipart/form-data; boundary=b"
NAMED = b'--b\r\nContent-Disposition: form-data; name="sample_0"\r\n\r\n'


def begun(gateway: Address, headers: Mapping[str, str], *parts: bytes, path: str = "/evaluate_batch") -> Any:
    """Open a connection and send the beginning of a request."""
    connection = gateway.connect()
    connection.putrequest("POST", path)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    for part in parts:
        connection.send(part)
    return connection


def post_body(
    gateway: Address, sample: Json, headers: Mapping[str, str] = MappingProxyType({})
) -> http.client.HTTPConnection:
    """A connection on which a whole request has been sent."""
    body = dumped([sample]).encode()
    connection: http.client.HTTPConnection = begun(gateway, {"Content-Length": str(len(body)), **headers}, body)
    return connection


@contextmanager
def paused(triton: Triton) -> Iterator[None]:
    """Stop all bytes to and from Triton."""
    with ExitStack() as held:
        for proxy in triton.proxies:
            held.enter_context(proxy.held())
        yield
