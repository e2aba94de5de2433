# SPDX-License-Identifier: MIT
"""Responses for ``/gpu_status``, ``/health``, ``/model_info``, from Triton's metrics, statistics and configuration."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress

from rfm_client import (
    AccessDeniedError,
    AsyncRewardClient,
    DeadlineExceededError,
    ModelInfo,
    ModelNotFoundError,
    RewardError,
    ServerError,
    ServerUnavailableError,
)
from rfm_client.serving import ServerStatus
from rfm_gateway import schema
from rfm_gateway.config import GatewayConfig
from rfm_gateway.observe import within

HEALTH_TIMEOUT_S = 3.5  # for all probes; with HEALTH_KEPT_S less than the promised 5 s
PROBE_TIMEOUT_S = 1.5  # for one probe; a slower model counts as busy
HEALTH_KEPT_S = 1.0  # responses are cached: requests without a key must not load the models
STATUS_TIMEOUT_S = 5.0
MS_PER_S = 1e3


_REMEDIES = {  # for callers over HTTP, who do not have the client's options
    AccessDeniedError: "whoever runs the gateway sets --triton-ca-file, --triton-certificate, --triton-key or "
    "--triton-api-key-file",
    ModelNotFoundError: "retry if the server restarts; else whoever runs the gateway names a served model with --model",
    ServerUnavailableError: "whoever runs the gateway starts Triton there (rfm serve does so by itself: retry), or "
    "names another with --triton",
}


def message_of(error: RewardError) -> str:
    """Return an error's message, with a remedy for callers over HTTP instead of one for users of the client."""
    if not isinstance(error, ServerError) or not error.remedy:
        return str(error)
    for_callers = type(error)(f"{error.fault}: {_REMEDIES[type(error)]}")
    for_callers.request_id = error.request_id
    return str(for_callers)


class TritonState:
    """The state of the client's checkpoint."""

    def __init__(self, client: AsyncRewardClient, config: GatewayConfig) -> None:
        self._client = client
        self._config = config
        self._refreshing = asyncio.Lock()
        self._refreshed_s = float("-inf")
        self._health: schema.Health | str = ""  # a text: the fault

    async def gpu_status(self) -> schema.GpuStatus:
        """Return the response for ``/gpu_status``. Raises ServerError."""
        return self._gpu_status(await self._config.status(STATUS_TIMEOUT_S))

    async def health(self) -> schema.Health:
        """Return the response for ``/health`` within HEALTH_TIMEOUT_S.

        Raises ServerUnavailableError if a model fails a probe.
        """
        async with self._refreshing:
            if time.monotonic() - self._refreshed_s >= HEALTH_KEPT_S:
                self._health = await self._probe_all()
                self._refreshed_s = time.monotonic()
            found = self._health
        if isinstance(found, str):
            raise ServerUnavailableError(found)
        return found

    async def model_info(self) -> schema.ModelInformation:
        """Return the response for ``/model_info``. Raises ServerError."""
        info = (await within(STATUS_TIMEOUT_S, self._infos()))[0]
        devices = await self._devices(STATUS_TIMEOUT_S)
        parts, types = info.network.get("parameters", {}), info.network.get("types", {})
        total = sum(parts.values())
        return schema.ModelInformation(
            model_path=info.source,
            model_version=max(info.versions, key=int, default=None),
            num_gpus=None if devices is None else devices.total_gpus,
            experiment_config=dict(info.run_config) or {"model": info.network.get("config", {})},
            model_architecture={
                "model_class": info.network.get("class"),
                "model_module": info.network.get("module"),
                "total_parameters": total,
                "trainable_parameters": 0,  # served weights are frozen
                "frozen_parameters": total,
                "trainable_percentage": 0.0,
                "architecture_summary": [
                    {"name": name, "type": types.get(name), "parameters": count} for name, count in parts.items()
                ],
            },
        )

    async def _devices(self, timeout_s: float) -> schema.GpuStatus | None:
        """Return the devices' state; None if the metrics cannot be read, which scoring does not need."""
        try:
            return await within(timeout_s, self.gpu_status())
        except ServerError:
            return None

    async def _infos(self) -> list[ModelInfo]:
        """Return facts about the models for embeddings and for raw frames.

        Raises ServerError, also if one of them or the encoder was served before and is missing.
        """
        served = await self._client.model_infos()
        infos = [info for part in ("embeddings", "frames") for info in served.get(part, [])]
        return infos or [await self._client.model_info(frames=True)]

    async def _probe_all(self) -> schema.Health | str:
        """Probe every model. Return a text with the reason if a model fails a probe."""
        ends_s = time.monotonic() + HEALTH_TIMEOUT_S
        try:
            await within(HEALTH_TIMEOUT_S, self._probe_models())
        except RewardError as error:
            return message_of(error)
        devices = await self._devices(ends_s - time.monotonic())
        return schema.Health(
            status="healthy",
            available_gpus=None if devices is None else devices.available_gpus,
            total_gpus=None if devices is None else devices.total_gpus,
        )

    async def _probe(self, info: ModelInfo) -> None:
        """Probe a model. A late response is no fault: the model may be busy. Raises RewardError."""
        with suppress(DeadlineExceededError):
            await self._client.probe(info, timeout_s=PROBE_TIMEOUT_S)

    async def _probe_models(self) -> None:
        await asyncio.gather(*map(self._probe, await self._infos()))

    def _gpu_status(self, status: ServerStatus) -> schema.GpuStatus:
        names, served = self._client.model_names, {name for device in status.devices for name in device.work}
        # An ensemble is left out: its parts count its requests.
        scorer = names["embeddings"] if names["embeddings"] in served else names["frames"]
        busy_s = {name: _busy_s(status, name) for name in (scorer, names["encoder"])}
        devices = [device for device in status.devices if busy_s.keys() & device.work.keys()] or list(status.devices)
        if not devices:
            raise ServerUnavailableError(status.metrics_error or f"{status.metrics_url}: it names no device")
        is_waiting = any(entry.requests_pending for entry in status.models)
        stats = {
            str(number): schema.GpuStats(
                device=device.name,
                status="processing" if is_waiting else "ready",
                total_requests=device.work[scorer].requests if scorer in device.work else 0,
                total_processing_time=sum(of_device.get(device.name, 0.0) for of_device in busy_s.values()),
                last_used=max((entry.last_used_s for entry in status.models if entry.last_used_s), default=None),
                utilization=device.utilization,
                memory_used_bytes=device.memory_used_bytes,
                memory_total_bytes=device.memory_total_bytes,
            )
            for number, device in enumerate(devices)
        }
        count = len(devices)
        return schema.GpuStatus(
            total_gpus=count,
            available_gpus=0 if is_waiting else count,
            max_workers=count,
            pool_size=count,
            gpu_stats=stats,
        )


def _busy_s(status: ServerStatus, model: str) -> dict[str, float]:
    """Return how many seconds a model computed, by device: Triton's total, divided like the requests' time."""
    total_s = sum(entry.busy_ms for entry in status.models if entry.name == model) / MS_PER_S
    shares = {device.name: device.work[model].compute_s for device in status.devices if model in device.work}
    return {name: total_s * share / sum(shares.values()) for name, share in shares.items() if share}
