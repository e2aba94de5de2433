# SPDX-License-Identifier: MIT
"""Triton's current status: models, work and devices. Read-only.

Where the repository index needs a key (``rfm serve``), only loaded models are listed.
"""

from __future__ import annotations

import asyncio
import re
import textwrap
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from http.client import HTTPException
from typing import Any, TypeAlias

from tritonclient.utils import InferenceServerException

from rfm_client.contract import triton
from rfm_client.contract.addresses import open_url, split_url
from rfm_client.contract.errors import DeadlineExceededError, ServerUnavailableError
from rfm_client.contract.wire import encoder_name, frames_name
from rfm_client.transport.calls import connect
from rfm_client.transport.connection import WRONG_PORT_ERRORS, Credentials, wrong_port

METRICS_PORT = 8002
METRICS_OPTION = "--metrics-url"
_PROCESSOR = "CPU"
_FRAMES = frames_name("")  # ends the names of models for raw frames
PENDING_METRIC = "nv_inference_pending_request_count"

_DEVICE_METRIC = re.compile("nv_(cpu|gpu)_(utilization|memory_used_bytes|memory_total_bytes)")
_REQUESTS_METRIC = "nv_inference_request_success_total"
_COMPUTE_METRIC = "nv_inference_compute_infer_duration_us_total"
_BATCH_SAMPLES_METRIC = "rfm_batch_samples"
_SAMPLES_METRIC, _REFUSED = "rfm_samples_total", "refused"  # a value for the label ``outcome``
_SCORING_METRICS = ("rfm_collate_seconds", "rfm_forward_seconds")
_SAMPLED_METRIC = "nv_cpu_memory_used_bytes"
_SAMPLING_S = 2.5  # Triton measures devices every two seconds; before the first time, it reports zeros
_POLL_S = 0.2
_REASON_CHARACTERS = 120
_STATES = {True: "READY", False: "UNAVAILABLE"}  # for a loaded model
_NS_PER_MS = 1e6
_MS_PER_S = 1e3
_US_PER_S = 1e6

_Version: TypeAlias = tuple[str, str]  # a model's name and version
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
    """The processor (``CPU``), or a GPU by UUID. None: Triton does not report the value.

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
    metrics_url: str
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

        metrics_url: where to read metrics; None: port METRICS_PORT on the same host. Unreadable metrics are left out
        credentials: used for the server, not for the metrics

        Raises ServerUnavailableError, AccessDeniedError, DeadlineExceededError, and InferenceFailedError for an answer
        that is not Triton's.
        """
        metrics_url = metrics_url or f"http://{split_url(url)[1].rpartition(':')[0]}:{METRICS_PORT}/metrics"
        try:
            version, is_ready, models = await _state(url, timeout_s, credentials)
        except DeadlineExceededError as late:
            raise DeadlineExceededError(f"{late.server or url}: no answer within {timeout_s:g} s") from late
        except WRONG_PORT_ERRORS as error:
            if named := await asyncio.to_thread(wrong_port, url):
                raise ServerUnavailableError(named) from error
            raise
        metrics = await asyncio.to_thread(_read_metrics, metrics_url, timeout_s)
        read = tuple(_model(entry, done, {*models}, metrics) for entry, done in models.values())
        return cls(url, version, is_ready, read, metrics_url, metrics.error, metrics.devices)

    @property
    def checkpoints(self) -> list[str]:
        """Names of exported checkpoints whose model for raw frames is ready, in alphabetical order."""
        ready = {model.name for model in self.models if model.state == "READY"}
        return sorted(name.removesuffix(_FRAMES) for name in ready if name.endswith(_FRAMES))


@dataclass(frozen=True)
class _Metrics:
    devices: tuple[Device, ...] = ()
    pending: Mapping[_Version, int] = field(default_factory=dict)
    batches: Mapping[_Version, Batches] = field(default_factory=dict)
    refused: Mapping[_Version, int] = field(default_factory=dict)
    error: str | None = None


async def _state(url: str, timeout_s: float, credentials: Credentials | None) -> _ServerState:
    """Return the server's version, whether it is ready, and every model's index entry and statistics."""
    transport = connect(url, credentials=credentials)

    async def request(client: Any) -> _ServerState:
        version = (await client.get_server_metadata(**transport.as_json))["version"]
        statistics = (await client.get_inference_statistics(**transport.as_json)).get("model_stats", [])
        try:
            answer = await client.get_model_repository_index(**transport.as_json)
            index = answer if isinstance(answer, list) else answer.get("models", [])  # nested in gRPC's answer
        except InferenceServerException as error:
            if triton.RESTRICTED not in (error.message() or ""):
                raise
            loaded = sorted(
                ((each["name"], each["version"]) for each in statistics), key=lambda key: (key[0], int(key[1]))
            )
            index = [
                {"name": name, "version": version, "state": _STATES[await client.is_model_ready(name, version)]}
                for name, version in loaded
            ]
        done = {(each["name"], each["version"]): each for each in statistics}
        entries = {(each["name"], each.get("version", "")): each for each in index}
        return version, await client.is_server_ready(), {key: (entries[key], done.get(key, {})) for key in entries}

    try:
        return await transport.ask(request, timeout_s)
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
    return ModelStatus(
        name=key[0],
        version=key[1],
        state=entry.get("state", "UNAVAILABLE"),
        reason=" ".join(entry.get("reason", "").split()),
        requests_succeeded=_whole(times, "success", "count"),
        requests_failed=_whole(times, "fail", "count") // failures,
        requests_pending=metrics.pending.get(key),
        samples=int(done.get("inference_count", 0)),
        executions=int(done.get("execution_count", 0)),
        queue_ms=_whole(times, "queue", "ns") / _NS_PER_MS,
        compute_ms=sum(_whole(batch, "compute_infer", "ns") for batch in done.get("batch_stats", [])) / _NS_PER_MS,
        last_used_s=int(done.get("last_inference", 0)) / _MS_PER_S or None,
        batches=metrics.batches.get(key),
        samples_refused=metrics.refused.get(key),
    )


def _whole(statistics: Mapping[str, Any], name: str, key: str) -> int:
    """Return a count: gRPC omits zeros and writes other counts as text."""
    return int(statistics.get(name, {}).get(key, 0))


def _read_metrics(url: str, timeout_s: float) -> _Metrics:
    try:
        samples = _scrape(url, timeout_s)
        sampled_by_s = time.monotonic() + _SAMPLING_S
        while any(each.name == _SAMPLED_METRIC and not each.value for each in samples):
            if time.monotonic() >= sampled_by_s:
                break
            time.sleep(_POLL_S)
            samples = _scrape(url, timeout_s)
    except (OSError, HTTPException, ValueError) as error:
        reason = textwrap.shorten(str(error), _REASON_CHARACTERS)
        return _Metrics(error=f"no metrics of the machine: {url}: {reason}: give their URL ({METRICS_OPTION})")
    refused = [sample for sample in samples if sample.labels.get("outcome") == _REFUSED]
    num_samples = _totals(samples, f"{_BATCH_SAMPLES_METRIC}_sum")
    scoring_s = _totals(samples, *(f"{name}_sum" for name in _SCORING_METRICS))
    return _Metrics(
        devices=_devices(samples),
        pending={version: int(count) for version, count in _totals(samples, PENDING_METRIC).items()},
        batches={  # foreign models and older exports report none
            version: Batches(int(count), int(num_samples[version]), scoring_s[version] * _MS_PER_S)
            for version, count in _totals(samples, f"{_BATCH_SAMPLES_METRIC}_count").items()
        },
        refused={version: int(count) for version, count in _totals(refused, _SAMPLES_METRIC).items()},
    )


def _scrape(url: str, timeout_s: float) -> list[Any]:
    from prometheus_client.parser import text_string_to_metric_families

    with open_url(url, timeout_s) as answer:
        families = text_string_to_metric_families(answer.read().decode())
        return [sample for family in families for sample in family.samples]


def _totals(samples: list[Any], *names: str) -> dict[_Version, float]:
    """Return the sum of these metrics over all instances, by version."""
    totals: dict[_Version, float] = {}
    for sample in samples:
        if sample.name in names:
            version = sample.labels["model"], sample.labels["version"]
            totals[version] = totals.get(version, 0.0) + sample.value
    return totals


def _devices(samples: list[Any]) -> tuple[Device, ...]:
    """Return the devices, with the work done there by each model. A count without a GPU belongs to the processor."""
    values: dict[str, dict[str, float]] = {}
    work: dict[str, dict[str, DeviceWork]] = {}
    for sample in samples:
        match = _DEVICE_METRIC.fullmatch(sample.name)
        if match:
            values.setdefault(sample.labels.get("gpu_uuid", match[1].upper()), {})[match[2]] = sample.value
        if sample.name in (_REQUESTS_METRIC, _COMPUTE_METRIC):
            models, model = work.setdefault(sample.labels.get("gpu_uuid", _PROCESSOR), {}), sample.labels["model"]
            done = models.get(model, DeviceWork(0, 0.0))
            if sample.name == _REQUESTS_METRIC:
                models[model] = replace(done, requests=done.requests + int(sample.value))
            else:
                models[model] = replace(done, compute_s=done.compute_s + sample.value / _US_PER_S)
    return tuple(
        Device(
            name, of.get("utilization"), of.get("memory_used_bytes"), of.get("memory_total_bytes"), work.get(name, {})
        )
        for name, of in values.items()
    )
