# SPDX-License-Identifier: MIT
"""What ``/gpu_status``, ``/health`` and ``/model_info`` tell, from Triton's metrics, statistics and configuration."""

from __future__ import annotations

import asyncio
import time

import numpy as np

from rfm_client.access import Access
from rfm_client.async_client import AsyncRewardClient
from rfm_client.deadline import Deadline, timeout
from rfm_client.errors import ModelNotFoundError, RewardError, ServerError, ServerUnavailableError
from rfm_client.gateway import schema
from rfm_client.model_info import ModelInfo
from rfm_client.samples import Trajectory
from rfm_client.status import Device, ServerStatus, read_status
from rfm_client.wire import CANARY_PREFIX

HEALTH_TIMEOUT_S = 3.5  # of all that is asked; with HEALTH_KEPT_S less than the 5 s within which it is to be true
HEALTH_KEPT_S = 1.0  # so that probes, which need no key, do not keep the models busy
STATUS_TIMEOUT_S = 5.0
MS_PER_S = 1e3
_CANARY_FRAMES = 2
_CANARY_PX = 64


class State:
    """Asks the server at ``url``, whose metrics are at ``metrics_url``, about ``model``."""

    def __init__(
        self, client: AsyncRewardClient, url: str, metrics_url: str | None, model: str, access: Access | None = None
    ) -> None:
        self._client = client
        self._url = url
        self._metrics_url = metrics_url
        self._model = model
        self._access = access
        self._asking = asyncio.Lock()
        self._asked_s = -HEALTH_KEPT_S
        self._problem: str | None = None
        self._num_devices: int | None = None

    async def gpu_status(self) -> schema.GpuStatus:
        """Raises ServerError."""
        status = await asyncio.to_thread(
            read_status,
            self._url,
            metrics_url=self._metrics_url,
            timeout_s=STATUS_TIMEOUT_S,
            access=self._access,
        )
        return _gpu_status(status, self._model)

    async def health(self) -> schema.Health:
        """Within HEALTH_TIMEOUT_S. Raises ServerUnavailableError with the reason when a model does not answer."""
        async with self._asking:
            if time.monotonic() - self._asked_s >= HEALTH_KEPT_S:
                deadline = Deadline(HEALTH_TIMEOUT_S)
                self._problem = await self._ask_all(deadline)
                self._num_devices = await self._count_devices(deadline) if self._problem is None else None
                self._asked_s = time.monotonic()
            problem, devices = self._problem, self._num_devices
        if problem is not None:
            raise ServerUnavailableError(problem)
        return schema.Health(status="healthy", available_gpus=devices, total_gpus=devices)

    async def model_info(self) -> schema.ModelInformation:
        """Raises ServerError."""
        deadline = Deadline(STATUS_TIMEOUT_S)
        info = (await self._infos(deadline))[0]
        parts = info.network.get("parameters", {})
        total = sum(parts.values())
        kind = info.network.get("class")
        return schema.ModelInformation(
            model_path=info.source,
            model_version=max(info.versions, key=int, default=None),
            num_gpus=await self._count_devices(deadline),
            experiment_config={"model": info.network.get("config", {})},
            model_architecture={
                "model_class": kind,
                "total_parameters": total,
                "trainable_parameters": 0,  # served weights are frozen
                "frozen_parameters": total,
                "trainable_percentage": 0.0,
                "architecture_summary": [{"name": name, "parameters": count} for name, count in parts.items()],
            },
        )

    async def _count_devices(self, deadline: Deadline) -> int | None:
        """None where the metrics cannot be read: scoring needs them not."""
        try:
            async with timeout(deadline.remaining_s()):
                return (await self.gpu_status()).total_gpus
        except (ServerError, asyncio.TimeoutError):  # in Python 3.10 not the built-in one
            return None

    async def _infos(self, deadline: Deadline) -> list[ModelInfo]:
        """Of the models for embeddings and for raw frames, as far as they are served now: another version may be."""
        infos = []
        missing = None
        for frames in (False, True):
            try:
                left_s = deadline.remaining_s()
                infos.append(await self._client.model_info(frames=frames, refresh=True, timeout_s=left_s))
            except ModelNotFoundError as error:
                missing = error
        if not infos:
            assert missing is not None
            raise missing
        return infos

    async def _ask_all(self, deadline: Deadline) -> str | None:
        """Asks every model for a score of next to nothing; the reason of the first that has none to give."""
        try:
            infos = await self._infos(deadline)
            left_s = deadline.remaining_s()
            canaries = [self._client.progress(_canary(i), timeout_s=left_s, request_id=CANARY_PREFIX) for i in infos]
            await asyncio.gather(*canaries)
        except RewardError as error:
            return str(error)
        return None


def _canary(info: ModelInfo) -> Trajectory:
    if info.video_dim is None or info.text_dim is None:
        blank = np.zeros((_CANARY_FRAMES, _CANARY_PX, _CANARY_PX, 3), np.uint8)
        return Trajectory(frames=blank, task="canary")
    return Trajectory(
        video_embeddings=np.zeros((_CANARY_FRAMES, info.video_dim), np.float32),
        text_embedding=np.zeros(info.text_dim, np.float32),
    )


def _gpu_status(status: ServerStatus, model: str) -> schema.GpuStatus:
    served = {name for device in status.devices for name in device.work}
    # An ensemble's work is that of its parts: it is left out, and a request counted where it is scored.
    scorer = model if model in served else f"{model}_frames"
    parts = {scorer, f"{model}_encoder"}
    devices = [device for device in status.devices if parts & device.work.keys()] or list(status.devices)
    if not devices:
        raise ServerUnavailableError(status.metrics_error or f"{status.metrics_url}: no device is told of")
    is_waiting = any(entry.requests_pending for entry in status.models)
    last_used = max((entry.last_used_s for entry in status.models if entry.last_used_s), default=None)
    stats = {
        str(number): schema.GpuStats(
            device=device.name,
            status="processing" if is_waiting else "ready",
            total_requests=device.work[scorer].requests if scorer in device.work else 0,
            total_processing_time=sum(_busy_s(status, device, name) for name in parts),
            last_used=last_used,
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


def _busy_s(status: ServerStatus, device: Device, model: str) -> float:
    """Seconds of a model's batches on one device: of all that Triton tells, the share that its requests had there."""
    on_all = sum(each.work[model].compute_s for each in status.devices if model in each.work)
    if model not in device.work or not on_all:
        return 0.0
    batches_s = sum(entry.compute_ms for entry in status.models if entry.name == model) / MS_PER_S
    return batches_s * device.work[model].compute_s / on_all
