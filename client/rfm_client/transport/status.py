# SPDX-License-Identifier: MIT
"""Triton's current status: models, work and devices. Read-only.

Where the repository index needs a key (``rfm serve``), only loaded models are listed.
"""

from __future__ import annotations

import asyncio
import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from http.client import HTTPException
from typing import Any, TypeAlias

from tritonclient.utils import InferenceServerException

from rfm_client.contract import triton
from rfm_client.contract.addresses import open_url, split_url, with_proxy
from rfm_client.contract.errors import DeadlineExceededError
from rfm_client.contract.wire import encoder_name, frames_name
from rfm_client.transport.calls import TritonTransport
from rfm_client.transport.connection import Credentials

METRICS_PORT = 8002
_PORTS = ("8000", "8001")  # Triton's defaults beside METRICS_PORT; another port may belong to a second server
METRICS_OPTION = "--metrics-url"
_PROCESSOR = "CPU"
_FRAMES = frames_name("")  # ends the names of models for raw frames

_DEVICE_METRIC = re.compile("nv_(?:cpu|gpu)_(utilization|memory_used_bytes|memory_total_bytes)")
_WORK_METRICS = {"nv_inference_request_success_total": "requests", "nv_inference_compute_infer_duration_us_total": "us"}
_REASON_CHARACTERS = 120
_STATES = {True: "READY", False: "UNAVAILABLE"}  # for a loaded model
_NS_PER_MS = 1e6
_MS_PER_S = 1e3
_US_PER_S = 1e6

_Version: TypeAlias = tuple[str, str]  # a model's name and version
_Metrics: TypeAlias = Sequence[Any]  # prometheus_client's samples
_ServerState: TypeAlias = tuple[  # version, readiness, and every model's index entry and statistics
    str, bool, dict[_Version, tuple[Mapping[str, Any], Mapping[str, Any]]]
]


@dataclass(frozen=True)
class Batches:
    """Batches from callers' requests, as a model reports them for all instances.

    count, samples: how many batches and samples
    scoring_ms: total time for collating and forward passes
    """

    count: int
    samples: int
    scoring_ms: float


@dataclass(frozen=True)
class ModelStatus:
    """One version of a model.

    Triton counts from when the model was loaded, warm-up included. The model counts ``batches`` and ``samples_refused``
    from Triton's start. A model that prepares ahead forms its own batches, which only ``batches`` counts.

    requests_pending: requests in Triton's queue now; None: not in the metrics
    samples, executions: how many samples and batches Triton handed over
    queue_ms, compute_ms: total time in Triton's queue, and in executions until Triton could go on
    last_used_s: Unix time of the last request; None: no request yet
    batches, samples_refused: callers' batches and invalid samples; None: not in the metrics
    """

    name: str
    version: str
    state: str
    reason: str
    requests_succeeded: int
    requests_failed: int
    requests_pending: int | None
    samples: int
    executions: int
    queue_ms: float
    compute_ms: float
    last_used_s: float | None = None
    batches: Batches | None = None
    samples_refused: int | None = None

    @property
    def batch_count(self) -> int:
        """How many batches callers' requests formed; before the first, how many executions ran."""
        return self.batches.count if self.batches and self.batches.count else self.executions

    @property
    def samples_per_batch(self) -> float | None:
        """Mean number of samples in a batch; None: no batch yet."""
        samples = self.batches.samples if self.batches and self.batches.count else self.samples
        return samples / self.batch_count if self.batch_count else None

    @property
    def queue_ms_per_request(self) -> float | None:
        """Mean time that a request spends in Triton's queue; None: no request yet."""
        return self.queue_ms / self.requests_succeeded if self.requests_succeeded else None

    @property
    def compute_ms_per_batch(self) -> float | None:
        """Mean time per batch; None: no batch yet."""
        total_ms = self.batches.scoring_ms if self.batches and self.batches.count else self.compute_ms
        return total_ms / self.batch_count if self.batch_count else None

    @property
    def busy_ms(self) -> float:
        """Time that the model worked on all devices. Triton omits work that it did not wait for."""
        return max(self.compute_ms, self.batches.scoring_ms if self.batches else 0.0)


@dataclass(frozen=True)
class Device:
    """The processor (``CPU``), or a GPU by UUID. None: Triton does not report the value, or not yet.

    utilization: 0..1
    work: work on this device, by model name
    """

    name: str
    utilization: float | None
    memory_used_bytes: float | None
    memory_total_bytes: float | None
    work: Mapping[str, DeviceWork] = field(default_factory=dict)


@dataclass(frozen=True)
class DeviceWork:
    """One model's work on one device, over all versions.

    requests: answered requests
    compute_s: computing time in seconds; a batch counts once per request
    """

    requests: int
    compute_s: float


@dataclass(frozen=True)
class ServerStatus:
    """A responding server's status.

    metrics_error: why ``devices`` and other metrics are missing; None: they are not
    """

    url: str
    version: str
    ready: bool
    models: tuple[ModelStatus, ...]
    metrics_url: str | None
    metrics_error: str | None
    devices: tuple[Device, ...]

    @classmethod
    def read(
        cls,
        url: str,
        *,
        metrics_url: str | None = None,
        timeout_s: float = 60.0,
        credentials: Credentials | None = None,
    ) -> ServerStatus:
        """Return ``read_async``'s result outside of an event loop. Arguments and errors are the same."""
        return asyncio.run(cls.read_async(url, metrics_url=metrics_url, timeout_s=timeout_s, credentials=credentials))

    @classmethod
    async def read_async(
        cls,
        url: str,
        *,
        metrics_url: str | None = None,
        timeout_s: float = 60.0,
        credentials: Credentials | None = None,
    ) -> ServerStatus:
        """Return the status of the server at ``grpc://host:port`` or ``http://host:port`` (TLS: ``grpcs``, ``https``).

        metrics_url: where to read metrics; None: port METRICS_PORT on the same host, if the server has Triton's own
            ports. Unreadable metrics are left out
        credentials: used for the server, not for the metrics

        Raises ServerUnavailableError, AccessDeniedError, DeadlineExceededError, and InferenceFailedError for an answer
        that is not Triton's.
        """
        host, _, port = split_url(url)[1].rpartition(":")
        if metrics_url is None and port in _PORTS:
            metrics_url = f"http://{host}:{METRICS_PORT}/metrics"
        try:
            version, is_ready, models = await _state(url, timeout_s, credentials)
        except DeadlineExceededError as late:
            raise DeadlineExceededError(f"{with_proxy(url)}: no answer within {timeout_s:g} s") from late
        metrics, fault = await asyncio.to_thread(_read_metrics, metrics_url, timeout_s)
        read = tuple(_model(entry, done, {*models}, metrics) for entry, done in models.values())
        return cls(url, version, is_ready, read, metrics_url, fault, _devices(metrics))

    @property
    def checkpoints(self) -> list[str]:
        """Names of exported checkpoints whose model for raw frames is ready, in alphabetical order."""
        ready = {model.name for model in self.models if model.state == "READY"}
        return sorted(name.removesuffix(_FRAMES) for name in ready if name.endswith(_FRAMES))


async def _state(url: str, timeout_s: float, credentials: Credentials | None) -> _ServerState:
    """Return the server's version, whether it is ready, and every model's index entry and statistics."""
    transport = TritonTransport(url, credentials)

    async def request(client: Any) -> _ServerState:
        version = (await client.get_server_metadata(**transport.as_json))["version"]
        statistics = (await client.get_inference_statistics(**transport.as_json)).get("model_stats", [])
        try:
            answer = await client.get_model_repository_index(**transport.as_json)
            index = answer if isinstance(answer, list) else answer.get("models", [])  # nested in gRPC's answer
        except InferenceServerException as error:
            if triton.RESTRICTED not in (error.message() or ""):
                raise
            loaded = sorted((each["name"], int(each["version"])) for each in statistics)
            index = [
                {"name": name, "version": str(number), "state": _STATES[await client.is_model_ready(name, str(number))]}
                for name, number in loaded
            ]
        done = {(each["name"], each["version"]): each for each in statistics}
        entries = {(each["name"], each.get("version", "")): each for each in index}
        return version, await client.is_server_ready(), {key: (entries[key], done.get(key, {})) for key in entries}

    try:
        return await transport.call(request, timeout_s)
    finally:
        await transport.close()


def _model(
    entry: Mapping[str, Any], done: Mapping[str, Any], known: Collection[_Version], metrics: _Metrics
) -> ModelStatus:
    """Return the status of one version. known: all versions of all models."""
    key = entry["name"], entry.get("version", "")
    times = done.get("inference_stats", {})
    encoder = encoder_name(key[0].removesuffix(_FRAMES))
    is_ensemble = key[0].endswith(_FRAMES) and encoder in {name for name, _ in known}
    failures = 2 if is_ensemble else 1  # how often Triton counts a failed request
    pending = _total(metrics, key, "nv_inference_pending_request_count")
    refused = _total(metrics, key, "rfm_samples_total", outcome="refused")
    return ModelStatus(
        name=key[0],
        version=key[1],
        state=entry.get("state", "UNAVAILABLE"),
        reason=" ".join(entry.get("reason", "").split()),
        requests_succeeded=_whole(times, "success", "count"),
        requests_failed=_whole(times, "fail", "count") // failures,
        requests_pending=None if pending is None else int(pending),
        samples=int(done.get("inference_count", 0)),
        executions=int(done.get("execution_count", 0)),
        queue_ms=_whole(times, "queue", "ns") / _NS_PER_MS,
        compute_ms=sum(_whole(batch, "compute_infer", "ns") for batch in done.get("batch_stats", [])) / _NS_PER_MS,
        last_used_s=int(done.get("last_inference", 0)) / _MS_PER_S or None,
        batches=_batches(metrics, key),
        samples_refused=None if refused is None else int(refused),
    )


def _whole(statistics: Mapping[str, Any], name: str, key: str) -> int:
    """Return a count: gRPC omits zeros and writes other counts as text."""
    return int(statistics.get(name, {}).get(key, 0))


def _read_metrics(url: str | None, timeout_s: float) -> tuple[_Metrics, str | None]:
    """Return the metrics, and why there are none."""
    from prometheus_client.parser import text_string_to_metric_families

    if url is None:
        return [], f"no metrics of the machine: give their URL ({METRICS_OPTION})"
    try:
        with open_url(url, timeout_s) as answer:
            families = list(text_string_to_metric_families(answer.read().decode()))
    except (OSError, HTTPException, ValueError) as error:
        reason = textwrap.shorten(str(error), _REASON_CHARACTERS)
        return [], f"no metrics of the machine: {url}: {reason}: give their URL ({METRICS_OPTION})"
    return [sample for family in families for sample in family.samples], None


def _total(metrics: _Metrics, version: _Version, *names: str, **labels: str) -> float | None:
    """Return the sum of these metrics over all instances; None: there are none."""
    wanted = {"model": version[0], "version": version[1], **labels}.items()
    values = [sample.value for sample in metrics if sample.name in names and wanted <= sample.labels.items()]
    return sum(values) if values else None


def _batches(metrics: _Metrics, version: _Version) -> Batches | None:
    """Return the batches of a version; None: foreign models and older exports report none."""
    count = _total(metrics, version, "rfm_batch_samples_count")
    samples = _total(metrics, version, "rfm_batch_samples_sum")
    scoring_s = _total(metrics, version, "rfm_collate_seconds_sum", "rfm_forward_seconds_sum")
    if count is None or samples is None or scoring_s is None:
        return None
    return Batches(int(count), int(samples), scoring_s * _MS_PER_S)


def _devices(metrics: _Metrics) -> tuple[Device, ...]:
    """Return the devices, with the work done there by each model. A count without a GPU belongs to the processor."""
    values: dict[str, dict[str, float]] = {}
    work: dict[str, dict[str, dict[str, float]]] = {}
    for sample in metrics:
        device = sample.labels.get("gpu_uuid", _PROCESSOR)
        if match := _DEVICE_METRIC.fullmatch(sample.name):
            values.setdefault(device, {})[match[1]] = sample.value
        elif sample.name in _WORK_METRICS:
            done = work.setdefault(device, {}).setdefault(sample.labels["model"], {"requests": 0.0, "us": 0.0})
            done[_WORK_METRICS[sample.name]] += sample.value
    return tuple(
        Device(
            name,
            None if of.get("memory_used_bytes") == 0 else of.get("utilization"),
            of.get("memory_used_bytes") or None,  # Triton reports zeros until it has measured
            of.get("memory_total_bytes") or None,
            {model: DeviceWork(int(d["requests"]), d["us"] / _US_PER_S) for model, d in work.get(name, {}).items()},
        )
        for name, of in values.items()
    )
