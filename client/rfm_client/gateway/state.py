# SPDX-License-Identifier: MIT
"""What ``/gpu_status``, ``/health`` and ``/model_info`` tell, from Triton's metrics, statistics and configuration."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import numpy as np

from rfm_client.async_client import AsyncRewardClient
from rfm_client.errors import ModelNotFoundError, RewardError, ServerUnavailableError
from rfm_client.gateway import schema
from rfm_client.model_info import ModelInfo
from rfm_client.samples import Trajectory
from rfm_client.status import Device, ServerStatus, read_status

CANARY_TIMEOUT_S = 5.0
CANARY_KEPT_S = 1.0  # so that probes, which need no key, do not keep the models busy
STATUS_TIMEOUT_S = 5.0
_CANARY_FRAMES = 2
_CANARY_PX = 64


class State:
    """Asks the server at ``url``, whose metrics are at ``metrics_url``, about ``model``."""

    def __init__(self, client: AsyncRewardClient, url: str, metrics_url: str | None, model: str) -> None:
        self._client = client
        self._url = url
        self._metrics_url = metrics_url
        self._model = model
        self._asking = asyncio.Lock()
        self._asked_s = -CANARY_KEPT_S
        self._problem: str | None = None

    async def gpu_status(self) -> schema.GpuStatus:
        """Raises ServerError."""
        status = await asyncio.to_thread(
            read_status, self._url, metrics_url=self._metrics_url, timeout_s=STATUS_TIMEOUT_S
        )
        return _gpu_status(status, self._model)

    async def health(self) -> schema.Health:
        """Raises ServerUnavailableError with the reason when a model does not answer."""
        async with self._asking:
            if time.monotonic() - self._asked_s >= CANARY_KEPT_S:
                self._problem = await self._ask_all()
                self._asked_s = time.monotonic()
            problem = self._problem
        if problem is not None:
            raise ServerUnavailableError(problem)
        devices = (await self.gpu_status()).total_gpus
        return schema.Health(status="healthy", available_gpus=devices, total_gpus=devices)

    async def model_info(self) -> schema.ModelInformation:
        """Raises ServerError."""
        infos = await self._infos()
        info = infos[0]
        parts = info.network.get("parameters", {})
        total = sum(parts.values())
        kind = info.network.get("class")
        status = await self.gpu_status()
        return schema.ModelInformation(
            model_path=info.source,
            model_version=max(info.versions, key=int, default=None),
            num_gpus=status.total_gpus,
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

    async def _infos(self) -> list[ModelInfo]:
        """Of the models for embeddings and for raw frames, as far as they are served."""
        infos = []
        missing = None
        for frames in (False, True):
            try:
                infos.append(await self._client.model_info(frames=frames, timeout_s=STATUS_TIMEOUT_S))
            except ModelNotFoundError as error:
                missing = error
        if not infos:
            assert missing is not None
            raise missing
        return infos

    async def _ask_all(self) -> str | None:
        """Asks every model for a score of next to nothing; the reason of the first that has none to give."""
        try:
            for info in await self._infos():
                await self._client.progress(_canary(info), timeout_s=CANARY_TIMEOUT_S)
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
    gpus = [device for device in status.devices if device.name != "CPU"]
    devices = [device for device in gpus if device.work] or list(status.devices)
    if not devices:
        raise ServerUnavailableError(status.metrics_error or f"{status.metrics_url}: no device is told of")
    is_waiting = any(entry.requests_pending for entry in status.models)
    last_used = max((entry.last_used_s for entry in status.models if entry.last_used_s), default=None)
    stats = {
        str(number): schema.GpuStats(
            device=device.name,
            status="processing" if is_waiting else "ready",
            total_requests=_requests(device, model),
            total_processing_time=sum(work.compute_s for work in _models_alone(device, model)),
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


def _requests(device: Device, model: str) -> int:
    """A request for raw frames of a ReWiND checkpoint passes its encoder and its scorer: it is counted at the last."""
    work = device.work.get(model) or device.work.get(f"{model}_frames")
    return 0 if work is None else work.requests


def _models_alone(device: Device, model: str) -> list[Any]:
    return [work for name, work in device.work.items() if name in (model, f"{model}_encoder", f"{model}_frames")]
