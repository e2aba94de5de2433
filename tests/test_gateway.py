# SPDX-License-Identifier: MIT
"""The gateway as a process of its own before a real Triton, asked over HTTP as clients of the FastAPI server ask."""

from __future__ import annotations

import asyncio
import http.client
import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import goldens
import httpx
import numpy as np
import numpy.typing as npt
import pytest
import requests
import schemathesis
import torch
from conftest import serve_config
from hypothesis import HealthCheck, given, settings
from PIL import Image
from prometheus_client.parser import text_string_to_metric_families
from typer.testing import CliRunner

import rfm_export
from rfm import families
from rfm.checkpoint.content import read_run_config
from rfm.config import ServeConfig
from rfm.rewind.network import RewindConfig, RewindTransformer
from rfm.supervise.cleanup import REGION_PREFIX
from rfm.supervise.installation import find_installation
from rfm.supervise.process import Endpoints, TritonServer
from rfm.supervise.stubs import SHARED_MEMORY
from rfm_client import (
    AsyncRewardClient,
    InvalidSampleError,
    ModelNotFoundError,
    PreferenceSample,
    ProgressSample,
    Result,
    RewardClient,
    Sample,
    ServerUnavailableError,
    SimilaritySample,
    Trajectory,
)
from rfm_client.status import read_status
from rfm_commands.cli import app
from rfm_gateway import state as gateway_state

Json: TypeAlias = dict[str, Any]
Array: TypeAlias = npt.NDArray[Any]
Ask: TypeAlias = Callable[..., requests.Response]

TINY, FILM, VIDEO = "rfm", "film", "film_video"  # models: two numbers a frame; encoders; vision-language in video mode
TINY_CONFIG = RewindConfig(
    video_feature_dim=2,
    text_feature_dim=2,
    hidden_dim=8,
    num_layers=1,
    num_attention_heads=2,
    max_len=16,
    causal_mask=True,
    use_per_frame_progress_token=True,
    progress_bins=10,
    has_similarity=True,
)
FILM_DIMS = (48, 32)  # widths D and Dt of FILM's encoders
FRAME_STEPS = 4
TOLERANCE = 1e-5  # where requests may share batches in different ways
WITHIN_S = 60
TRUTH_S = 5.0  # within which health is to tell that a server hangs
KEY = "open sesame"
ORIGIN = "http://lab.example"
SIDES = {
    "progress": ("trajectory",),
    "preference": ("chosen_trajectory", "rejected_trajectory"),
    "similarity": ("ref_trajectory", "sim_trajectory"),
}


# Servers


@dataclass(frozen=True)
class Gateway:
    """A running gateway, and the Triton behind it."""

    url: str
    model: str
    triton_url: str
    process: subprocess.Popen[bytes]
    log_file: Path

    @property
    def log(self) -> str:
        return self.log_file.read_text()

    def client(self) -> RewardClient:
        """Asks the same model without the gateway."""
        return RewardClient(self.triton_url, model=self.model)

    def connect(self) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(self.url.removeprefix("http://"), timeout=WITHIN_S)

    def metric(self, name: str, **labels: str) -> float:
        """Of the gateway's own; 0 before it is first counted."""
        families = text_string_to_metric_families(requests.get(f"{self.url}/metrics").text)
        samples = (sample for family in families for sample in family.samples)
        return sum(s.value for s in samples if s.name == f"rfm_gateway_{name}" and labels.items() <= s.labels.items())


@dataclass(frozen=True)
class Triton:
    repository: Path
    endpoints: Endpoints
    process_id: int


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as bound:
        return int(bound.getsockname()[1])


def poll(is_so: Callable[[], bool]) -> None:
    ends_s = time.monotonic() + WITHIN_S
    while not is_so():
        assert time.monotonic() < ends_s
        time.sleep(0.02)


def answers(url: str) -> bool:
    try:
        return requests.get(f"{url}/openapi.json").ok
    except requests.ConnectionError:
        return False


@contextmanager
def running(
    endpoints: Endpoints, folder: Path, model: str = TINY, *options: str, **environment: str
) -> Iterator[Gateway]:
    port = free_port()
    command = [sys.executable, "-m", "rfm_gateway", "--triton", endpoints.grpc_url, "--port", str(port)]
    command += ["--metrics-url", endpoints.metrics_url, "--model", model, *options]
    log_file = folder / f"gateway_{port}.log"
    with log_file.open("wb") as log:
        process = subprocess.Popen(command, env={**os.environ, **environment}, stdout=log, stderr=log)
    gateway = Gateway(f"http://127.0.0.1:{port}", model, endpoints.grpc_url, process, log_file)
    try:
        poll(lambda: process.poll() is not None or answers(gateway.url))
        assert process.poll() is None, gateway.log
        yield gateway
        assert "Traceback" not in gateway.log
    finally:
        process.terminate()
        process.wait(WITHIN_S)


@pytest.fixture(scope="module")
def tiny_network() -> RewindTransformer:
    torch.manual_seed(0)
    return RewindTransformer(TINY_CONFIG)


@pytest.fixture(scope="module")
def triton(tmp_path_factory: pytest.TempPathFactory, tiny_network: RewindTransformer) -> Iterator[Triton]:
    folder = tmp_path_factory.mktemp("gateway_triton")
    repository, checkpoint = folder / "model_repository", folder / "two_wide"
    families.save(families.RewindCheckpoint(TINY_CONFIG, tiny_network.state_dict()), checkpoint)
    rfm_export.export(checkpoint, repository, ServeConfig(name=TINY, num_gpus=0, torch_threads=1))
    for config, name in ((goldens.config("enc_c1_t1_disc10"), FILM), (goldens.config("q25_video_last_l2"), VIDEO)):
        rfm_export.export(config.checkpoint, repository, serve_config(config, name))
    ours = f"{REGION_PREFIX}_{os.getpid()}_*"  # others test beside us
    regions = set(SHARED_MEMORY.glob(ours))
    with (
        (folder / "tritonserver.log").open("wb") as log,
        TritonServer(repository, Endpoints.free(), find_installation(), log=log) as server,
    ):
        assert server._process is not None
        yield Triton(repository, server.endpoints, server._process.pid)
    assert set(SHARED_MEMORY.glob(ours)) <= regions


def fixture_of(model: str, *options: str) -> Any:
    @pytest.fixture(scope="module")
    def gateway(triton: Triton, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
        with running(triton.endpoints, tmp_path_factory.mktemp("gateway"), model, *options) as started:
            yield started
            assert not started.metric("requests_total", code="500")

    return gateway


tiny, film, video = fixture_of(TINY), fixture_of(FILM), fixture_of(VIDEO)
strict = fixture_of(TINY, "--timeout", "1", "--max-in-flight", "1", "--max-waiting", "0", "--max-body-mib", "1")


# Samples as clients hold them, and three ways to send them


def embedded(seed: int, num_frames: int, dims: tuple[int, int] = (2, 2), **fields: Any) -> Json:
    random = np.random.default_rng(seed)
    video = random.standard_normal((num_frames, dims[0]), np.float32)
    return {
        "task": "lift",
        "video_embeddings": video,
        "text_embedding": random.standard_normal(dims[1], np.float32),
    } | (fields)


def filmed(seed: int, num_frames: int, size_px: int = 32, **fields: Any) -> Json:
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, size_px, size_px, 3), np.uint8)
    return {"task": f"lift cup {seed}", "frames": frames} | fields


def progress(trajectory: Any) -> Json:
    return {"sample_type": "progress", "trajectory": trajectory}


def preference(chosen: Json, rejected: Json) -> Json:
    return {"sample_type": "preference", "chosen_trajectory": chosen, "rejected_trajectory": rejected}


def similarity(ref: Json, sim: Json) -> Json:
    return {"sample_type": "similarity", "ref_trajectory": ref, "sim_trajectory": sim}


def mixed(make: Callable[..., Json], *dims: Any) -> list[Json]:
    """Each type twice, out of order, lengths that differ."""
    return [
        similarity(make(1, 2, *dims), make(2, 5, *dims)),
        progress(make(3, 7, *dims)),
        preference(make(4, 1, *dims), make(5, 3, *dims)),
        progress(make(6, 1, *dims)),
        similarity(make(7, 4, *dims), make(8, 4, *dims)),
        preference(make(9, 6, *dims), make(10, 2, *dims)),
    ]


def dumped(document: Any) -> str:
    return json.dumps(document, default=np.ndarray.tolist)


def npy(array: Array, *, pickled: bool = False) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=pickled)
    return file.getvalue()


def ask_json(gateway: Gateway, samples: Any, **fields: Any) -> requests.Response:
    return post_json(gateway, {"samples": samples, **fields})


def post_json(gateway: Gateway, document: Any) -> requests.Response:
    return requests.post(f"{gateway.url}/evaluate_batch", dumped(document))


def ask_npy(gateway: Gateway, samples: Sequence[Json], **fields: Any) -> requests.Response:
    """As the evaluation server's documentation tells: every array a part, in its place the name of that part."""
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
    return requests.post(f"{gateway.url}/evaluate_batch_npy", files=files, data=form)


@pytest.fixture(params=[ask_json, ask_npy], ids=["json", "npy"])
def ask(request: pytest.FixtureRequest) -> Ask:
    function: Ask = request.param
    return function


# What the answer must be


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


def scores(gateway: Gateway, samples: Sequence[Json], frame_steps: int = 0) -> list[Any]:
    with gateway.client() as client:
        results: list[Result] = client.evaluate([of_client(sample, frame_steps) for sample in samples])
    return results


def expected(gateway: Gateway, samples: Sequence[Json], *, frame_steps: int = 0, group: int = 1) -> Json:
    """The FastAPI server's answer with the numbers that RewardClient gets."""
    pairs = list(zip(samples, scores(gateway, samples, frame_steps), strict=True))
    of = {kind: [(s, r) for s, r in pairs if s["sample_type"] == kind] for kind in SIDES}
    told: Json = dict.fromkeys(("outputs_preference", "outputs_progress", "outputs_success", "outputs_similarity"))
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


# Every form of a request that is answered

SEED_PAYLOAD = """[
  {
    "sample_type": "preference",
    "chosen_trajectory": {
      "task": "pick_place",
      "video_embeddings": [[0.1, 0.2], [0.3, 0.4]],
      "text_embedding": [0.5, 0.6],
      "target_progress": [0.2, 0.6, 1.0],
      "frames_shape": [2, 2]
    },
    "rejected_trajectory": {
      "task": "pick_place",
      "video_embeddings": [[-0.1, -0.2], [-0.3, -0.4]],
      "text_embedding": [0.0, 0.1],
      "target_progress": [0.1, 0.3, 0.5],
      "frames_shape": [2, 2]
    }
  }
]"""  # of the FastAPI evaluation server's README


def test_the_documented_payload_is_answered_to_curl_and_to_requests(tiny: Gateway, tmp_path: Path) -> None:
    (tmp_path / "sample_request.json").write_text(SEED_PAYLOAD)
    url = f"{tiny.url}/evaluate_batch"
    curl = ["curl", "-sS", "-X", "POST", url, "-H", "Content-Type: application/json", "-d", "@sample_request.json"]
    by_curl = json.loads(subprocess.run(curl, cwd=tmp_path, capture_output=True, check=True).stdout)
    assert by_curl == answered(requests.post(url, json=json.loads(SEED_PAYLOAD)))
    assert by_curl == expected(tiny, json.loads(SEED_PAYLOAD))
    outputs = by_curl["outputs_preference"]
    assert [type(outputs[key][0]) for key in ("predictions", "prediction_probs", "preference_labels")] == [
        *(int, float, float)
    ]


def test_every_type_in_one_request_gets_the_numbers_of_the_client(film: Gateway, ask: Ask) -> None:
    samples = mixed(embedded, FILM_DIMS)
    assert answered(ask(film, samples)) == expected(film, samples)
    for sample in samples:
        assert answered(ask(film, [sample])) == expected(film, [sample])


def test_frames_and_embeddings_may_be_mixed(film: Gateway, ask: Ask) -> None:
    samples = [*mixed(filmed), *mixed(embedded, FILM_DIMS), progress(filmed(3, 2, size_px=40))]
    assert answered(ask(film, samples)) == numbers(expected(film, samples))
    assert answered(ask(film, samples[:1])) == expected(film, samples[:1])


def test_pairs_of_two_frame_sizes_are_scored(film: Gateway, video: Gateway, ask: Ask) -> None:
    samples = [
        preference(filmed(1, 3), filmed(2, 2, size_px=40)),
        progress(filmed(3, 2, size_px=40)),
        preference(filmed(6, 2), filmed(7, 4)),
    ]
    assert answered(ask(video, samples)) == numbers(expected(video, samples, group=2))
    samples.append(similarity(filmed(4, 2, size_px=40), filmed(5, 5)))
    assert answered(ask(film, samples)) == numbers(expected(film, samples))


@pytest.mark.parametrize("num_frames", [1, 2, 9, 40])
def test_frame_steps_score_each_frame_on_its_prefix(tiny: Gateway, ask: Ask, num_frames: int) -> None:
    samples = [progress(embedded(num_frames, num_frames))]
    answer = answered(ask(tiny, samples, use_frame_steps=True))
    assert answer == expected(tiny, samples, frame_steps=FRAME_STEPS)
    assert len(answer["outputs_progress"]["progress_pred"][0]) == num_frames


def test_frame_steps_leave_the_other_types_as_they_are(film: Gateway, ask: Ask) -> None:
    for samples in (mixed(embedded, FILM_DIMS), mixed(filmed)):
        steps = answered(ask(film, samples, use_frame_steps=True))
        assert steps == numbers(expected(film, samples, frame_steps=FRAME_STEPS))
        assert steps != numbers(answered(ask(film, samples, use_frame_steps=False)))


FIRST, SECOND = embedded(1, 3), embedded(2, 2)
FORMS: dict[str, Any] = {
    "a bare list": [progress(FIRST)],
    "a sample alone": progress(FIRST),
    "samples": {"samples": [progress(FIRST)]},
    "an object with one list": {"use_frame_steps": False, "anything": [progress(FIRST)]},
    "an object of samples": {"first": progress(FIRST), "use_frame_steps": "false"},
    "fields that nobody knows": {"samples": [{**progress({**FIRST, "quality": {"a": [None]}}), "resample": 3}], "x": 1},
}


@pytest.mark.parametrize("document", FORMS.values(), ids=FORMS)
def test_every_form_of_a_request_is_read(tiny: Gateway, document: Any) -> None:
    assert answered(post_json(tiny, document)) == expected(tiny, [progress(FIRST)])


@pytest.mark.parametrize("steps", [True, "true", "True", False, "false", None], ids=repr)
def test_a_sample_alone_may_ask_for_frame_steps(tiny: Gateway, steps: Any) -> None:
    frame_steps = FRAME_STEPS if str(steps).lower() == "true" else 0
    document = {**progress(FIRST), "use_frame_steps": steps}
    assert answered(post_json(tiny, document)) == expected(tiny, [progress(FIRST)], frame_steps=frame_steps)


def test_other_names_of_a_similarity_samples_trajectories_are_read(tiny: Gateway, ask: Ask) -> None:
    aliases = {"reference_trajectory": FIRST, "traj_sim_trajectory": SECOND, "traj_diff_trajectory": embedded(3, 4)}
    third = {**similarity(FIRST, SECOND), "diff_trajectory": embedded(3, 4)}
    answer = answered(ask(tiny, [{"sample_type": "similarity", **aliases}, third]))
    assert answer == expected(tiny, [similarity(FIRST, SECOND)] * 2)


UPSTREAM_FIELDS: Json = {  # what the FastAPI server's clients send besides
    "id": "episode_7",
    "lang_vector": np.zeros(384, np.float32),
    "frames_shape": [3, 32, 32, 3],
    "data_source": "bridge",
    "data_gen_strategy": None,
    "quality_label": "successful",
    "is_robot": True,
    "target_progress": [0.1, 0.5, 1.0],
    "partial_success": None,
    "metadata": {"fps": 3, "camera": {"name": "wrist"}},
}
UPSTREAM_KINDS: dict[str, Callable[[int, int], Json]] = {
    "frames": lambda seed, t: filmed(
        seed,
        t,
        **UPSTREAM_FIELDS,
        video_embeddings=None,
        text_embedding=None,
        embeddings_path="episode_7/embeddings.pt",
    ),
    "embeddings": lambda seed, t: embedded(seed, t, FILM_DIMS, **UPSTREAM_FIELDS, frames=None, embeddings_path=None),
    "both": lambda seed, t: embedded(seed, t, FILM_DIMS, **UPSTREAM_FIELDS, frames=filmed(seed, t)["frames"]),
    "paths and embeddings": lambda seed, t: embedded(seed, t, FILM_DIMS, **UPSTREAM_FIELDS, frames=["0.png"] * t),
}


@pytest.mark.parametrize("make", UPSTREAM_KINDS.values(), ids=UPSTREAM_KINDS)
def test_a_client_of_the_fastapi_server_changes_nothing_but_the_url(
    film: Gateway, ask: Ask, make: Callable[[int, int], Json]
) -> None:
    samples = [
        {**progress(make(1, 3)), "data_gen_strategy": "rewound", "resample_attempts": 1},
        preference(make(2, 2), make(3, 4)),
        {**similarity(make(4, 3), make(5, 1)), "data_gen_strategy": "paired", "diff_trajectory": None},
    ]
    plain = [dict(sample) for sample in samples]
    for sample in plain:  # embeddings win, as there
        for side in SIDES[sample["sample_type"]]:
            has_embeddings = sample[side].get("video_embeddings") is not None
            sample[side] = {**sample[side], "frames": None if has_embeddings else sample[side]["frames"]}
    answer = answered(ask(film, samples))
    assert answer == numbers(expected(film, plain))
    assert answer["outputs_similarity"]["metadata"] == [UPSTREAM_FIELDS["metadata"]]
    assert answer["outputs_similarity"]["data_gen_strategy"] == ["paired"]


def test_float_frames_are_clipped_and_truncated(film: Gateway, ask: Ask) -> None:
    frames = np.random.default_rng(0).uniform(-20, 280, (3, 32, 32, 3)).astype(np.float32)
    whole = np.clip(frames, 0, 255).astype(np.uint8)
    answer = answered(ask(film, [progress({"frames": frames, "task": "lift"})]))
    assert answer == expected(film, [progress({"frames": whole, "task": "lift"})])


def test_one_frame_is_a_film_of_one_and_the_colours_of_rgba_count(film: Gateway, ask: Ask) -> None:
    whole = filmed(1, 3)
    answer = answered(ask(film, [progress({**whole, "frames": whole["frames"][0]})]))
    assert answer == expected(film, [progress({**whole, "frames": whole["frames"][:1]})])
    opacity = np.random.default_rng(1).integers(0, 256, (3, 32, 32, 1), np.uint8)
    answer = answered(ask(film, [progress({**whole, "frames": np.concatenate([whole["frames"], opacity], axis=-1)})]))
    assert answer == expected(film, [progress(whole)])


ARRAYS: dict[str, Callable[[Array], bytes]] = {
    "float64": lambda a: npy(a.astype(np.float64)),
    "float16": lambda a: npy(a.astype(np.float16)),
    "big-endian": lambda a: npy(a.astype(">f4")),
    "Fortran's order": lambda a: npy(np.asfortranarray(a)),
    "version 2": lambda a: npy_of(header_of(npy(a)), a.tobytes(), version=2),
}


@pytest.mark.parametrize("written", ARRAYS.values(), ids=ARRAYS)
def test_any_npy_file_of_numbers_is_read(tiny: Gateway, written: Callable[[Array], bytes]) -> None:
    video = np.array([[0.5, -1.0], [2.0, 0.25], [1.0, 1.5]], np.float32)  # which every type holds exactly
    sample = progress({**FIRST, "video_embeddings": video})
    assert answered(ask_part(tiny, written(video))) == expected(tiny, [sample])


def ask_part(gateway: Gateway, part: bytes) -> requests.Response:
    """FIRST with this as its embeddings' file."""
    text = FIRST["text_embedding"].tolist()
    sample = progress({"video_embeddings": {"__numpy_file__": "video"}, "text_embedding": text})
    form = {"sample_0": json.dumps(sample)}
    return requests.post(f"{gateway.url}/evaluate_batch_npy", data=form, files={"video": ("video.npy", part)})


def npy_of(header: str, content: bytes = b"", version: int = 1) -> bytes:
    length = len(header).to_bytes(2 * version, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + length + header.encode() + content


def header_of(file: bytes) -> str:
    return file[10 : 10 + int.from_bytes(file[8:10], "little")].decode()


def test_a_task_without_embedding_is_encoded(film: Gateway, ask: Ask) -> None:
    given = embedded(1, 3, FILM_DIMS, task="open the drawer")
    with film.client() as client:
        encoded = client.encode(Trajectory(frames=filmed(1, 2)["frames"], task="open the drawer"))
    samples = [progress({**given, "text_embedding": None}), preference({**given, "text_embedding": None}, given)]
    with_text = {**given, "text_embedding": encoded.text_embedding}
    answer = answered(ask(film, samples))
    assert answer == numbers(expected(film, [progress(with_text), preference(with_text, given)]))
    other = answered(ask(film, [progress({**given, "text_embedding": None, "task": "close the drawer"})]))
    assert other["outputs_progress"] != numbers({"progress_pred": answer["outputs_progress"]["progress_pred"][:1]})


def test_a_model_that_sees_a_video_gives_a_value_for_two_frames(video: Gateway, ask: Ask) -> None:
    samples = [progress(filmed(1, 5)), preference(filmed(2, 3), filmed(3, 2)), progress(filmed(4, 1))]
    answer = answered(ask(video, samples))
    assert answer == numbers(expected(video, samples, group=2))
    assert [len(values) for values in answer["outputs_progress"]["progress_pred"]] == [3, 1]
    assert [len(values) for values in answer["outputs_success"]["success_probs"]] == [3, 1]
    steps = answered(ask(video, samples[:1], use_frame_steps=True))
    assert steps == numbers(expected(video, samples[:1], frame_steps=FRAME_STEPS))
    assert len(steps["outputs_progress"]["progress_pred"][0]) == 5


def test_concurrent_callers_each_get_their_own_answer(film: Gateway) -> None:
    asked = [[mixed(embedded, FILM_DIMS)[k % 6], progress(embedded(k, 1 + k % 9, FILM_DIMS))] for k in range(64)]
    alone = [expected(film, samples) for samples in asked]
    for index in range(0, len(asked), 8):  # what is wrong with some is not the others' concern
        asked[index][1] = progress(embedded(index, 17, FILM_DIMS))
    start = threading.Barrier(len(asked))

    def call(index: int) -> requests.Response:
        start.wait()
        return (ask_json if index % 2 else ask_npy)(film, asked[index])

    with ThreadPoolExecutor(len(asked)) as pool:
        for index, response in enumerate(pool.map(call, range(len(asked)))):
            if index % 8:
                assert answered(response) == numbers(alone[index])
            else:
                check_refused(response, (["samples", 1, "num_frames"], "expected at most 16 .*, got 17"))


def test_large_frames_are_scored(film: Gateway, ask: Ask) -> None:
    samples = [progress(filmed(1, 2, size_px=440))]  # more than a megabyte: read in a thread, from disk
    assert answered(ask(film, samples)) == expected(film, samples)


def test_triton_may_be_asked_over_http(triton: Triton, tmp_path: Path, ask: Ask) -> None:
    with running(triton.endpoints, tmp_path, TINY, "--triton", triton.endpoints.http_url) as gateway:
        assert answered(ask(gateway, mixed(embedded))) == expected(gateway, mixed(embedded))
        assert requests.get(f"{gateway.url}/health").ok


def test_a_gateway_that_is_told_to_stop_answers_what_it_has_begun(triton: Triton, tmp_path: Path) -> None:
    body = dumped([progress(FIRST)]).encode()
    with running(triton.endpoints, tmp_path) as gateway:
        answer = expected(gateway, [progress(FIRST)])
        connection = begun(gateway, {"Content-Length": str(len(body))}, body[:20])
        poll(lambda: gateway.metric("requests_in_flight") == 1)
        gateway.process.terminate()
        poll(lambda: "Shutting down" in gateway.log)
        connection.send(body[20:])
        assert json.loads(connection.getresponse().read()) == answer
        connection.close()
        assert gateway.process.wait(WITHIN_S) in (0, -signal.SIGTERM)


def test_one_connection_serves_many_requests_of_httpx(tiny: Gateway) -> None:
    with httpx.Client(base_url=tiny.url) as client:
        for seed in range(5):
            sample = progress(embedded(seed, 1 + seed))
            response = client.post("/evaluate_batch", content=dumped([sample]))
            assert response.json() == expected(tiny, [sample])
            assert client.post("/evaluate_batch", content="[").status_code == 422


# What is refused

ROW = [1.0] * FILM_DIMS[0]


def but(**fields: Any) -> Json:
    return progress({**embedded(1, 3, FILM_DIMS), **fields})


def of_frames(frames: Any, **fields: Any) -> Json:
    return progress({"task": "lift", "frames": frames, **fields})


VIDEO_AT, TEXT_AT = ["trajectory", "video_embeddings"], ["trajectory", "text_embedding"]
FRAMES_AT, TASK_AT = ["trajectory", "frames"], ["trajectory", "task"]
BLACK = np.zeros((2, 8, 8, 3), np.uint8)
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
    "too many frames": (but(video_embeddings=np.ones((17, 48))), ["num_frames"], "expected at most 16 .*, got 17"),
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


def check_refused(response: requests.Response, *told: tuple[Sequence[Any], str]) -> None:
    """422 with exactly these fields and reasons."""
    assert response.status_code == 422, response.text
    detail = response.json()["detail"]
    assert [error["loc"] for error in detail] == [["body", *path] for path, _ in told]
    for error, (_, message) in zip(detail, told, strict=True):
        assert error.keys() == {"type", "loc", "msg"}
        assert re.fullmatch(message, error["msg"], re.DOTALL), error["msg"]


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


FORM = {"sample_0": dumped(progress(FIRST))}
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


MULTIPART = "multipart/form-data; boundary=b"
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


NAMED = b'--b\r\nContent-Disposition: form-data; name="sample_0"\r\n\r\n'
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


def begun(gateway: Gateway, headers: Mapping[str, str], *parts: bytes, path: str = "/evaluate_batch") -> Any:
    """A connection on which the beginning of a request has been sent."""
    connection = gateway.connect()
    connection.putrequest("POST", path)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    for part in parts:
        connection.send(part)
    return connection


def ended(connection: http.client.HTTPConnection) -> tuple[http.client.HTTPResponse, str]:
    response = connection.getresponse()
    detail = str(json.loads(response.read())["detail"])
    connection.close()
    return response, detail


HALF = ({"Content-Length": "100"}, b'{"samples": [')
MULTIPART_HALF = ({"Content-Length": "100", "Content-Type": MULTIPART}, NAMED)
HALVES = {"/evaluate_batch": HALF, "/evaluate_batch_npy": MULTIPART_HALF}


@pytest.mark.parametrize(("path", "half"), HALVES.items(), ids=HALVES)
def test_a_body_that_does_not_come_is_a_408(strict: Gateway, path: str, half: Any) -> None:
    response, detail = ended(begun(strict, *half, path=path))
    assert (response.status, detail) == (408, "body: expected all of it in time, got a part")
    assert response.getheader("Connection") == "close"


CHUNK = b"40000\r\n" + b" " * 2**18 + b"\r\n"
LARGE: dict[str, tuple[dict[str, str], list[bytes]]] = {
    "announced": ({"Content-Length": str(2**20 + 1)}, []),
    "in chunks": ({"Transfer-Encoding": "chunked"}, [CHUNK] * 5),
}


@pytest.mark.parametrize("path", HALVES)
@pytest.mark.parametrize(("headers", "parts"), LARGE.values(), ids=LARGE)
def test_too_large_a_body_is_a_413(strict: Gateway, headers: dict[str, str], parts: list[bytes], path: str) -> None:
    beginning = [b"%x\r\n%b\r\n" % (len(NAMED), NAMED)] if parts and path.endswith("npy") else []
    response, detail = ended(begun(strict, headers | {"Content-Type": MULTIPART}, *beginning, *parts, path=path))
    assert (response.status, detail) == (413, "body: expected at most 1048576 bytes, got more")
    assert answered(ask_json(strict, [progress(FIRST)]))


def test_more_requests_than_allowed_are_a_503_and_health_is_not_one(strict: Gateway) -> None:
    for path, half in HALVES.items():  # each is answered 408 in the end
        connection = begun(strict, *half, path=path)
        poll(lambda: strict.metric("requests_in_flight") == 1)
        response = ask_json(strict, [progress(FIRST)])
        assert failure(response, 503) == "expected at most 1 evaluations at a time, got more"
        assert response.headers["Retry-After"] == "1"
        assert requests.get(f"{strict.url}/health").ok
        connection.close()
        poll(lambda: strict.metric("requests_in_flight") == 0)
        assert answered(ask_json(strict, [progress(FIRST)]))


def test_a_caller_who_leaves_is_no_failure_of_the_gateway(tiny: Gateway) -> None:
    for path, half in HALVES.items():
        begun(tiny, *half, path=path).close()
        poll(lambda path=path: tiny.metric("requests_total", endpoint=path, code="400") >= 1)  # type: ignore[misc]


@contextmanager
def paused(triton: Triton) -> Iterator[None]:
    os.killpg(triton.process_id, signal.SIGSTOP)
    try:
        yield
    finally:
        os.killpg(triton.process_id, signal.SIGCONT)


def post_body(gateway: Gateway, sample: Json) -> http.client.HTTPConnection:
    """A connection on which a whole request has been sent."""
    body = dumped([sample]).encode()
    connection: http.client.HTTPConnection = begun(gateway, {"Content-Length": str(len(body))}, body)
    return connection


def test_three_hundred_callers_at_once_are_all_answered(triton: Triton, tiny: Gateway) -> None:
    """Upstream's clients do not ask again: more than are scored at a time wait."""
    answer = expected(tiny, [progress(FIRST)])
    with paused(triton):
        callers = [post_body(tiny, progress(FIRST)) for _ in range(300)]
        poll(lambda: tiny.metric("requests_in_flight") + tiny.metric("requests_waiting") == 300)
        assert tiny.metric("requests_waiting") == 300 - 256
    for caller in callers:
        response = caller.getresponse()
        assert (response.status, json.loads(response.read())) == (200, numbers(answer))
        caller.close()


def test_a_caller_who_waits_too_long_is_a_503(triton: Triton, tmp_path: Path) -> None:
    with running(triton.endpoints, tmp_path, TINY, "--timeout", "1", "--max-in-flight", "1") as gateway:
        answered(ask_json(gateway, [progress(FIRST)]))
        with paused(triton):
            first = post_body(gateway, progress(FIRST))
            poll(lambda: gateway.metric("requests_in_flight") == 1)
            second, third = (post_body(gateway, progress(FIRST)) for _ in range(2))
            codes = []
            for caller in (first, second, third):
                codes.append(caller.getresponse().status)
                caller.close()
        assert set(codes) == {503, 504}


# A model that works for as long as a test wants

CLOSED_GATE = """

_load = TritonPythonModel.load


def load(self, version, device, settings):
    _load(self, version, device, settings)
    score = self.engine.family.score

    def gated(rows, batch):
        import time

        while Path({gate!r}).exists():
            time.sleep(0.01)
        return score(rows, batch)

    self.engine.family.score = gated


TritonPythonModel.load = load
"""


@dataclass(frozen=True)
class Gated:
    """A gateway before a Triton whose model works on its batch for as long as the file ``gate`` is there."""

    gateway: Gateway
    endpoints: Endpoints
    gate: Path

    @contextmanager
    def working(self) -> Iterator[http.client.HTTPConnection]:
        """Within it, the model works on the request of the connection."""
        self.gate.touch()
        try:
            caller = post_body(self.gateway, progress(FIRST))
            poll(lambda: self.metric("rfm_batch_requests") == 1)
            yield caller
        finally:
            self.gate.unlink()

    def metric(self, name: str, **labels: str) -> float:
        families = text_string_to_metric_families(requests.get(self.endpoints.metrics_url).text)
        samples = (sample for family in families for sample in family.samples)
        return sum(s.value for s in samples if s.name == name and labels.items() <= s.labels.items())


@pytest.fixture(scope="module")
def gated(tmp_path_factory: pytest.TempPathFactory, tiny_network: RewindTransformer) -> Iterator[Gated]:
    folder = tmp_path_factory.mktemp("gated")
    repository, checkpoint, gate = folder / "model_repository", folder / "two_wide", folder / "gate"
    families.save(families.RewindCheckpoint(TINY_CONFIG, tiny_network.state_dict()), checkpoint)
    rfm_export.export(checkpoint, repository, ServeConfig(name=TINY, num_gpus=0, torch_threads=1))
    model = repository / TINY / "1" / "model.py"
    model.write_text(model.read_text() + CLOSED_GATE.format(gate=str(gate)))
    with (
        (folder / "tritonserver.log").open("wb") as log,
        TritonServer(repository, Endpoints.free(), find_installation(), log=log) as server,
        running(server.endpoints, folder) as gateway,
    ):
        yield Gated(gateway, server.endpoints, gate)


def test_callers_who_hang_up_cost_no_forward(gated: Gated) -> None:
    """Preferences are asked last: once one is counted, a moment later, so is whatever was scored before it."""

    def scored(sample_type: str) -> float:
        return gated.metric("rfm_samples_total", outcome="scored", sample_type=sample_type)

    samples = [progress(FIRST), preference(FIRST, SECOND)]
    answers = [expected(gated.gateway, [sample]) for sample in samples]
    poll(lambda: scored("preference") == 1)
    progress_before = scored("progress")
    with gated.working() as first:
        leaving = [post_body(gated.gateway, progress(FIRST)) for _ in range(12)]
        poll(lambda: gated.metric("nv_inference_pending_request_count") == len(leaving))
        for caller in leaving:
            caller.close()
        poll(lambda: gated.gateway.metric("requests_total", code="499") == len(leaving))
        last = post_body(gated.gateway, samples[1])  # behind what has told Triton that they left
        poll(lambda: gated.metric("nv_inference_pending_request_count") >= 1)
    for caller, answer in zip((first, last), answers, strict=True):
        assert json.loads(caller.getresponse().read()) == numbers(answer)
        caller.close()
    poll(lambda: scored("preference") == 2)
    assert scored("progress") == progress_before + 1
    assert gated.gateway.metric("requests_in_flight") == 0


def test_health_is_told_while_a_model_works(gated: Gated, monkeypatch: pytest.MonkeyPatch) -> None:
    with gated.working() as first:
        second = post_body(gated.gateway, progress(FIRST))
        poll(lambda: gated.metric("nv_inference_pending_request_count") == 1)
        began_s = time.monotonic()
        response = requests.get(f"{gated.gateway.url}/health")
        assert time.monotonic() - began_s < TRUTH_S
        assert answered(response) == {"status": "healthy", "available_gpus": 0, "total_gpus": 1}
        monkeypatch.setattr(gateway_state, "STALL_S", 0.0)  # nothing is finished for longer than that: it hangs

        async def ask() -> None:
            async with AsyncRewardClient(gated.endpoints.grpc_url) as client:
                await gateway_state.State(client, gated.endpoints.grpc_url, gated.endpoints.metrics_url, TINY).health()

        with pytest.raises(ServerUnavailableError, match=r"rfm: no answer within 1\.5 s, and nothing finished for 0 s"):
            asyncio.run(ask())
    for caller in (first, second):
        assert caller.getresponse().status == 200
        caller.close()


def test_no_score_in_time_is_a_504(triton: Triton, strict: Gateway, ask: Ask) -> None:
    assert answered(ask(strict, [progress(FIRST)]))
    with paused(triton):
        assert failure(ask(strict, [progress(FIRST)]), 504) == "Triton: no answer within 1 s"
    assert answered(ask(strict, [progress(FIRST)]))


def test_a_triton_that_is_down_is_a_503(tmp_path: Path, ask: Ask) -> None:
    with running(Endpoints.free(), tmp_path) as gateway:
        response = ask(gateway, [progress(FIRST)])
        assert "connect" in failure(response, 503)
        assert response.headers["Retry-After"] == "1"
        for path in ("health", "gpu_status", "model_info"):
            response = requests.get(f"{gateway.url}/{path}")
            assert "connect" in failure(response, 503)
            assert response.headers["Retry-After"] == "1"
        assert gateway.metric("rejections_total", reason="unavailable") == 1


def test_a_model_that_is_not_served_is_a_503(triton: Triton, tmp_path: Path) -> None:
    with running(triton.endpoints, tmp_path, "nowhere") as gateway:
        for response in (ask_json(gateway, [progress(FIRST)]), requests.get(f"{gateway.url}/health")):
            assert "nowhere" in failure(response, 503)


def test_unknown_paths_and_methods_are_told_as_json(tiny: Gateway) -> None:
    assert failure(requests.get(f"{tiny.url}/evaluate"), 404) == "Not Found"
    assert failure(requests.get(f"{tiny.url}/evaluate_batch"), 405) == "Method Not Allowed"


# Keys, browsers, files

KEYS: dict[str, tuple[dict[str, str], bool]] = {
    "X-API-Key": ({"X-API-Key": KEY}, True),
    "Bearer": ({"Authorization": f"Bearer {KEY}"}, True),
    "none": ({}, False),
    "another": ({"X-API-Key": "sesame"}, False),
    "another bearer": ({"Authorization": "Bearer sesame"}, False),
    "another scheme": ({"Authorization": f"Basic {KEY}"}, False),
    "no letters": ({"X-API-Key": "\xfc"}, False),
}


@pytest.fixture(scope="module", params=["file", "variable"])
def keyed(
    request: pytest.FixtureRequest, triton: Triton, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Gateway]:
    folder = tmp_path_factory.mktemp("keyed")
    (folder / "key.txt").write_text(f"{KEY}\n")
    if request.param == "file":
        options, environment = ["--api-key-file", str(folder / "key.txt")], {"RFM_GATEWAY_API_KEY": "another"}
    else:
        options, environment = [], {"RFM_GATEWAY_API_KEY": KEY}
    with running(triton.endpoints, folder, TINY, "--cors-origin", ORIGIN, *options, **environment) as started:
        yield started
        assert KEY not in started.log


@pytest.mark.parametrize(("headers", "is_right"), KEYS.values(), ids=KEYS)
def test_only_the_key_opens(keyed: Gateway, headers: dict[str, str], is_right: bool) -> None:
    responses = [
        requests.post(f"{keyed.url}/evaluate_batch", SEED_PAYLOAD, headers=headers),
        requests.post(f"{keyed.url}/evaluate_batch_npy", FORM, files={"a": b""}, headers=headers),
        *(requests.get(f"{keyed.url}/{path}", headers=headers) for path in ("gpu_status", "model_info", "metrics")),
    ]
    for response in responses:
        if is_right:
            assert response.ok
        else:
            assert failure(response, 401) == "key: expected X-API-Key or Authorization: Bearer, got another or none"


def test_health_and_documentation_need_no_key(keyed: Gateway) -> None:
    for path in ("health", "docs", "openapi.json"):
        assert requests.get(f"{keyed.url}/{path}").ok


def test_browsers_may_ask_from_the_named_origin_alone(keyed: Gateway, tiny: Gateway) -> None:
    allowed = "Access-Control-Allow-Origin"
    preflight = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "x-api-key"}
    url = f"{keyed.url}/evaluate_batch"
    response = requests.options(url, headers=preflight | {"Origin": ORIGIN})
    assert (response.status_code, response.headers[allowed]) == (200, ORIGIN)
    response = requests.post(url, SEED_PAYLOAD, headers={"Origin": ORIGIN, "X-API-Key": KEY})
    assert (response.status_code, response.headers[allowed]) == (200, ORIGIN)
    assert allowed not in requests.options(url, headers=preflight | {"Origin": "http://other.example"}).headers
    assert allowed not in requests.get(f"{keyed.url}/health", headers={"Origin": "http://other.example"}).headers
    assert allowed not in requests.get(f"{tiny.url}/health", headers={"Origin": ORIGIN}).headers


@pytest.mark.parametrize("host", ["0.0.0.0", "127.0.0.1"])
def test_an_open_address_without_a_key_is_warned_of(triton: Triton, tmp_path: Path, host: str) -> None:
    warning = "WARNING rfm_gateway: 0.0.0.0 is no loopback address, and no key is asked for"
    with running(triton.endpoints, tmp_path, TINY, "--host", host) as gateway:
        assert (warning in gateway.log) is (host == "0.0.0.0")
    with running(triton.endpoints, tmp_path, TINY, "--host", host, RFM_GATEWAY_API_KEY=KEY) as gateway:
        assert warning not in gateway.log


@pytest.fixture(scope="module")
def shelf(triton: Triton, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Gateway, Path]]:
    """A gateway that may read a folder."""
    outside = tmp_path_factory.mktemp("shelf")
    folder = outside / "allowed"
    (folder / "episode").mkdir(parents=True)
    for index, frame in enumerate(filmed(1, 3)["frames"]):
        Image.fromarray(frame).save(folder / "episode" / f"{index}.png")
    Image.fromarray(filmed(1, 1, size_px=40)["frames"][0]).save(folder / "larger.png")
    given = embedded(1, 3, FILM_DIMS)
    arrays = {name: given[name] for name in ("video_embeddings", "text_embedding")}
    for file in (folder / "episode.npz", outside / "outside.npz"):
        np.savez(file, **arrays)
    np.save(folder / "episode.npy", arrays["video_embeddings"])
    np.save(folder / "frames.npy", BLACK)
    np.save(folder / "pickled.npy", np.array([[1, {}]], object), allow_pickle=True)
    np.savez(folder / "nan.npz", **(arrays | {"video_embeddings": arrays["video_embeddings"] + np.nan}))
    (folder / "text.png").write_text("no image")
    (folder / "text.npz").write_text("no arrays")
    shutil.copy(folder / "episode" / "0.png", outside / "outside.png")
    (folder / "link.png").symlink_to("episode/0.png")
    for name in ("outside.png", "outside.npz"):
        (folder / f"link_to_{name}").symlink_to(outside / name)
    (folder / "folder_outside").symlink_to(outside)
    (folder / "circle").symlink_to("circle")
    with running(triton.endpoints, outside, FILM, "--allow-folder", str(folder)) as started:
        yield started, folder


def test_images_and_arrays_in_the_allowed_folder_are_read(shelf: tuple[Gateway, Path]) -> None:
    gateway, folder = shelf
    frames = filmed(1, 3)["frames"]
    names = ["link.png", "episode/1.png", str(folder / "episode" / "2.png")]
    assert answered(ask_json(gateway, [of_frames(names)])) == expected(gateway, [of_frames(frames)])
    given = embedded(1, 3, FILM_DIMS)
    whole = progress({"embeddings_path": "episode.npz"})
    parts = progress({"embeddings_path": "episode.npy", "text_embedding": given["text_embedding"]})
    answer = answered(ask_json(gateway, [whole, preference(parts["trajectory"], whole["trajectory"])]))
    assert answer == expected(gateway, [progress(given), preference(given, given)])


OUTSIDE = ["../outside.png", "episode/../../outside.png", "/etc/passwd", "link_to_outside.png"]
NOWHERE = ["folder_outside/outside.png", "missing.png", "episode", "", "circle", "a\0b", "a" * 5000]
BAD_IMAGES = [
    *((name, "a file in the allowed folder") for name in (*OUTSIDE, *NOWHERE)),
    *((name, "an image file") for name in ("text.png", "episode.npy")),
]
BAD_FILES = [
    *((f"{name}outside.npz", "a file in the allowed folder") for name in ("../", "link_to_", "folder_outside/")),
    *((name, "a file of embeddings [T, D]") for name in ("pickled.npy", "text.npz", "nan.npz")),
    ("larger.png", ".npy or .npz"),
]


@pytest.mark.parametrize(("name", "wanted"), BAD_IMAGES, ids=[repr(name)[:30] for name, _ in BAD_IMAGES])
def test_no_other_image_is_opened(shelf: tuple[Gateway, Path], name: str, wanted: str) -> None:
    response = ask_json(shelf[0], [of_frames(["episode/0.png", name])])
    check_refused(response, (["samples", 0, *FRAMES_AT, 1], re.escape(f"expected {wanted}, got {name}")))


@pytest.mark.parametrize(("name", "wanted"), BAD_FILES, ids=[name for name, _ in BAD_FILES])
def test_no_other_array_is_opened(shelf: tuple[Gateway, Path], name: str, wanted: str) -> None:
    response = ask_json(shelf[0], [progress({"embeddings_path": name, "task": "lift"})])
    at = ["samples", 0, "trajectory", "embeddings_path"]
    check_refused(response, (at, re.escape(f"expected {wanted}, got {name}")))


def test_files_that_do_not_fit_are_refused(shelf: tuple[Gateway, Path]) -> None:
    response = ask_json(shelf[0], [of_frames(["episode/0.png", "larger.png"])])
    check_refused(response, (["samples", 0, *FRAMES_AT], "expected images of one size, got different ones"))
    response = ask_json(shelf[0], [progress({"embeddings_path": "frames.npy", "task": "lift"})])
    check_refused(
        response, (["samples", 0, "trajectory", "embeddings_path"], "expected a file of embeddings, got frames")
    )


def test_many_images_are_refused_before_they_fill_the_memory(triton: Triton, tmp_path: Path) -> None:
    folder = tmp_path / "shelf"
    folder.mkdir()
    Image.fromarray(np.zeros((600, 600, 3), np.uint8)).save(folder / "black.png")  # a megabyte, when it is decoded
    limits = ("--allow-folder", str(folder), "--max-body-mib", "2")
    with running(triton.endpoints, tmp_path, FILM, *limits) as gateway:
        response = ask_json(gateway, [of_frames(["black.png"] * 3)])
        check_refused(
            response,
            (["samples", 0, *FRAMES_AT], "expected files of at most 2097152 bytes in one request, .*, got more"),
        )


# What is told of the server


def work_done(gateway: Gateway) -> tuple[int, float]:
    (stats,) = requests.get(f"{gateway.url}/gpu_status").json()["gpu_stats"].values()
    return stats["total_requests"], stats["total_processing_time"]


@pytest.mark.parametrize("name", ["tiny", "film", "video"])
def test_gpu_status_counts_each_request_once(request: pytest.FixtureRequest, name: str) -> None:
    gateway, *others = (request.getfixturevalue(each) for each in sorted(("tiny", "film", "video"), key=name.__ne__))
    sample = progress(FIRST if name == "tiny" else filmed(1, 2))
    (count, busy_s), of_others = work_done(gateway), [work_done(other) for other in others]
    began_s = time.time()
    for _ in range(3):
        answered(ask_json(gateway, [sample]))
    assert work_done(gateway)[0] == count + 3
    parts = {"tiny": [TINY], "film": [FILM, f"{FILM}_encoder"], "video": [f"{VIDEO}_frames"]}[name]
    status = read_status(gateway.triton_url, metrics_url=request.getfixturevalue("triton").endpoints.metrics_url)
    computed_s = sum(m.compute_ms for m in status.models if m.name in parts) / 1e3
    assert busy_s < work_done(gateway)[1] == pytest.approx(computed_s, rel=0.01)
    assert [work_done(other) for other in others] == of_others
    status = requests.get(f"{gateway.url}/gpu_status").json()
    (stats,) = status.pop("gpu_stats").values()
    assert status == {"total_gpus": 1, "available_gpus": 1, "max_workers": 1, "pool_size": 1}
    assert (stats["device"], stats["status"]) == ("CPU", "ready")
    assert began_s - 1 <= stats["last_used"] <= time.time() + 1  # Triton's clock is coarser
    assert 0 <= stats["utilization"] <= 1
    assert 0 < stats["memory_used_bytes"] < stats["memory_total_bytes"]


def test_scoring_is_healthy_without_triton_s_metrics(triton: Triton, tmp_path: Path) -> None:
    nowhere = f"http://127.0.0.1:{free_port()}/metrics"
    with running(triton.endpoints, tmp_path, TINY, "--metrics-url", nowhere) as gateway:
        healthy = {"status": "healthy", "available_gpus": None, "total_gpus": None}
        assert requests.get(f"{gateway.url}/health").json() == healthy
        assert requests.get(f"{gateway.url}/model_info").json()["num_gpus"] is None
        assert "metrics" in failure(requests.get(f"{gateway.url}/gpu_status"), 503)


def test_health_has_asked_every_model(film: Gateway) -> None:
    assert requests.get(f"{film.url}/health").json() == {"status": "healthy", "available_gpus": 1, "total_gpus": 1}


def test_a_server_that_hangs_is_unhealthy_with_the_reason(triton: Triton, strict: Gateway) -> None:
    assert requests.get(f"{strict.url}/health").ok
    with paused(triton):  # what was found before is told for a second more
        hung_s = time.monotonic()
        poll(lambda: requests.get(f"{strict.url}/health").status_code == 503)
        assert time.monotonic() - hung_s < TRUTH_S
        assert "no answer within" in failure(requests.get(f"{strict.url}/health"), 503)
    poll(lambda: requests.get(f"{strict.url}/health").ok)


def test_model_info_tells_the_checkpoint(tiny: Gateway, tiny_network: RewindTransformer) -> None:
    info = requests.get(f"{tiny.url}/model_info").json()
    total = sum(parameter.numel() for parameter in tiny_network.parameters())
    architecture = info.pop("model_architecture")
    parts = architecture.pop("architecture_summary")
    assert sum(part["parameters"] for part in parts) == total
    assert {part["name"] for part in parts} == {name.partition(".")[0] for name in tiny_network.state_dict()}
    assert architecture == {
        "model_class": "RewindTransformer",
        "total_parameters": total,
        "trainable_parameters": 0,
        "frozen_parameters": total,
        "trainable_percentage": 0.0,
    }
    config = info.pop("experiment_config")["model"]
    assert config.items() >= {"video_feature_dim": 2, "hidden_dim": 8, "causal_mask": True, "progress_bins": 10}.items()
    assert info.pop("model_path").endswith("two_wide")
    assert info == {"model_version": "1", "num_gpus": 1}


def test_model_info_has_the_whole_configuration_of_the_training_run(film: Gateway) -> None:
    run = read_run_config(goldens.config("enc_c1_t1_disc10").checkpoint / "config.yaml")
    assert requests.get(f"{film.url}/model_info").json()["experiment_config"] == json.loads(json.dumps(run))


def test_metrics_count_what_was_asked(tiny: Gateway) -> None:
    def counts() -> list[float]:
        return [
            tiny.metric("requests_total", endpoint="/evaluate_batch", code="200"),
            tiny.metric("requests_total", endpoint="/evaluate_batch_npy", code="422"),
            tiny.metric("requests_total", endpoint="other", code="404"),
            tiny.metric("rejections_total", reason="invalid"),
            tiny.metric("samples_total", sample_type="progress"),
            tiny.metric("samples_total", sample_type="preference"),
            tiny.metric("request_duration_seconds_count", endpoint="/evaluate_batch"),
        ]

    before = counts()
    answered(ask_json(tiny, [progress(FIRST), preference(FIRST, SECOND), progress(SECOND)]))
    ask_npy(tiny, [progress(filmed(1, 2))])
    requests.get(f"{tiny.url}/nowhere")
    assert [after - b for after, b in zip(counts(), before, strict=True)] == [1, 1, 1, 1, 2, 1, 1]
    assert tiny.metric("requests_in_flight") == 0


def test_the_schemas_are_told(tiny: Gateway) -> None:
    assert "swagger" in requests.get(f"{tiny.url}/docs").text
    document = requests.get(f"{tiny.url}/openapi.json").json()
    names = ("evaluate_batch", "evaluate_batch_npy", "gpu_status", "health", "model_info", "metrics")
    assert document["paths"].keys() == {f"/{name}" for name in names}
    codes = document["paths"]["/evaluate_batch"]["post"]["responses"].keys()
    assert codes == {"200", "408", "413", "422", "502", "503", "504"}


@pytest.fixture(scope="module")
def api(film: Gateway) -> Any:
    """The OpenAPI document, from which requests are made up."""
    return schemathesis.openapi.from_url(f"{film.url}/openapi.json")


@pytest.mark.parametrize("path", ["/evaluate_batch", "/evaluate_batch_npy", "/gpu_status", "/model_info", "/health"])
def test_no_request_that_the_schemas_allow_breaks_the_gateway(api: Any, path: str) -> None:
    ((_, operation),) = api[path].items()

    @settings(max_examples=25, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(case=operation.as_strategy())
    def check(case: schemathesis.Case) -> None:
        response = case.call()
        assert response.status_code < 500, response.text
        response.json()

    check()


# The commands


def children(process_id: int) -> dict[int, str]:
    """Processes that it has started, and these, with their command lines."""
    parents, commands = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            commands[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")
        except (FileNotFoundError, ProcessLookupError):  # it ended meanwhile
            continue
    found: dict[int, str] = {}
    wanted = {process_id}
    while wanted:
        wanted = {child for child, parent in parents.items() if parent in wanted}
        found |= {child: commands[child] for child in wanted if child in commands}
    return found


def test_rfm_serve_runs_a_gateway_until_a_signal_and_again_if_it_is_killed(triton: Triton, tmp_path: Path) -> None:
    repository, endpoints, port = tmp_path / "model_repository", Endpoints.free(), free_port()
    shutil.copytree(triton.repository / TINY, repository / TINY)
    ports = {"http": endpoints.http_port, "grpc": endpoints.grpc_port, "metrics": endpoints.metrics_port}
    options = [word for name, number in (ports | {"gateway": port}).items() for word in (f"--{name}-port", str(number))]
    options += ["--gateway-timeout", "90", "--gateway-max-waiting", "7"]
    rfm = [str(Path(sys.executable).parent / "rfm"), "serve", "--repository", str(repository), *options]
    log_file = tmp_path / "rfm.log"
    with log_file.open("wb") as log:
        process = subprocess.Popen(rfm, stdout=log, stderr=log)
    try:
        url = f"http://127.0.0.1:{port}"
        poll(lambda: process.poll() is not None or answers(url))
        assert process.poll() is None, log_file.read_text()
        gateway = Gateway(url, TINY, endpoints.grpc_url, process, log_file)
        assert answered(ask_json(gateway, [progress(FIRST)])) == expected(gateway, [progress(FIRST)])
        assert requests.get(f"{url}/health").json()["status"] == "healthy"
        started = children(process.pid)
        (gateway_id,) = (child for child, command in started.items() if "rfm_gateway" in command)
        assert "--timeout 90.0 --max-body-mib 512" in started[gateway_id]
        assert "--max-waiting 7" in started[gateway_id]
        os.kill(gateway_id, signal.SIGKILL)
        poll(lambda: not answers(url))
        poll(lambda: answers(url))
        assert answered(ask_json(gateway, [progress(FIRST)])) == expected(gateway, [progress(FIRST)])
        started |= children(process.pid)
        process.terminate()
        assert process.wait(WITHIN_S) == 0
    finally:
        process.terminate()
        process.wait(WITHIN_S)
    assert "rfm: gateway is started again: exit status -9" in gateway.log.splitlines()
    assert len(started) >= 4  # Triton, its stub, the first gateway and the second
    assert not [child for child in started if Path(f"/proc/{child}").exists()]
    assert not list(SHARED_MEMORY.glob(f"*_rfm_{process.pid}_*"))


BAD_OPTIONS: dict[str, tuple[list[str], str]] = {
    "no URL": (
        ["--triton", "localhost:8001"],
        "url: expected grpc://host:port or http://host:port, or grpcs:// or https://, got",
    ),
    "no folder": (["--allow-folder", "nowhere"], "No such file or directory"),
    "no key file": (["--api-key-file", "nowhere"], "--api-key-file: expected a text file, got"),
    "an empty key": (["--api-key-file", os.devnull], "key: expected at least one character, got none"),
    "less memory than a body": (
        ["--max-memory-mib", "100"],
        "max_memory_mib: expected at least max_body_mib (512), got less",
    ),
    "no port": (["--port", "0"], "Input should be greater than or equal to 1"),
}


@pytest.mark.parametrize(("options", "message"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_wrong_options_are_refused(options: list[str], message: str, tmp_path: Path) -> None:
    given = ["gateway", *([] if "--triton" in options else ["--triton", "grpc://localhost:1"]), *options]
    result = CliRunner().invoke(app, given, env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert message in result.output


# What the gateway needs of the client


def test_the_client_encodes_a_trajectory_once_for_many_questions(film: Gateway, tiny: Gateway) -> None:
    given = filmed(1, 4)
    frames = Trajectory(frames=given["frames"], task=given["task"])
    with film.client() as client:
        encoded = client.encode(frames)
        assert (encoded.positions.shape, encoded.frames, encoded.task) == ((4, FILM_DIMS[0]), None, given["task"])
        assert encoded.text_embedding is not None
        assert encoded.text_embedding.shape == (FILM_DIMS[1],)
        first, second = client.progress(frames), client.progress(encoded)
        np.testing.assert_allclose(first.progress, second.progress, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(first.success, second.success, rtol=0, atol=TOLERANCE)
        with pytest.raises(InvalidSampleError, match="trajectory: expected frames, got video_embeddings"):
            client.encode(encoded)
    with tiny.client() as client, pytest.raises(ModelNotFoundError, match="rfm_encoder"):
        client.encode(frames)
