# SPDX-License-Identifier: MIT
"""Calls to one Triton server over gRPC or HTTP. Errors become RewardErrors."""

from __future__ import annotations

import asyncio
import logging
import math
import os
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeVar

from tritonclient.utils import InferenceServerException

from rfm_client.contract import errors, triton
from rfm_client.contract.addresses import split_url
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.wire import Tensors
from rfm_client.transport.connection import SILENT_S, Credentials
from rfm_client.transport.limits import check_size, timeout
from rfm_client.transport.shared_memory import SharedMemory

Answered = TypeVar("Answered")

_US_PER_S = 1_000_000
_SERVED_TIMEOUT_S = 2.0  # for listing served models in an error

logger = logging.getLogger("rfm_client")


@dataclass(frozen=True)
class Answer:
    """The outputs for one request, and the model version that answered."""

    tensors: Tensors
    model_version: str


class Transport(Protocol):
    """A connection to one server, for one event loop. Methods raise RewardError."""

    url: str

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        """Return the named ``outputs`` that ``model`` gives for ``inputs``. request_id: id in the server's log."""

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        """Return the server's description of ``model``. Raises ModelNotFoundError."""

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        """True if the server answers and ``model`` is ready."""

    async def close(self) -> None:
        """Close the connection to the server."""


class TritonTransport:
    """The transport for ``grpc://host:port`` or ``http://host:port``, with TLS ``grpcs://`` or ``https://``.

    tritonclient is imported, and its client connects, at first use; the client belongs to the event loop that runs
    then. Over gRPC a late or cancelled call is also cancelled on the server, unless scoring has begun; if the host name
    has several addresses (a headless Service), gRPC spreads the requests over them. Over HTTP there is one connection
    per concurrent call, and Triton finishes a request even if its caller has left. Raises ValueError.

    shared_memory: True: send large inputs through memory that the server, on the same host, also maps
    """

    _first_process: ClassVar[int | None] = None  # the first process that used gRPC

    def __init__(self, url: str, credentials: Credentials | None = None, *, shared_memory: bool = False) -> None:
        self.url = url
        self._scheme, self._address = split_url(url)
        self._is_grpc = self._scheme.startswith("grpc")
        self.as_json = {"as_json": True} if self._is_grpc else {}  # makes the client's methods return dictionaries
        self._credentials = credentials or Credentials()
        self._credentials.check_url(url)
        self._shared_memory = SharedMemory(url) if shared_memory else None
        self._client: Any = None  # tritonclient's, for the next call
        self._calls: Counter[Any] = Counter()  # by client; an earlier client closes after its last call
        self._silent_since_s: dict[Any, float] = {}  # by client: its first call since the last answer
        self._is_triton = self._is_grpc  # False: may be the metrics port

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        # If the export sets queue_timeout_ms, Triton drops requests that wait longer in its queue, over HTTP too.
        waits_us = max(int(timeout_s * _US_PER_S), 1)
        largest = max(inputs, key=lambda name: inputs[name].nbytes)

        async def ask(client: Any, memory: SharedMemory | None) -> tuple[Tensors, str]:
            async with nullcontext() if memory is None else memory.lend(client, inputs[largest]) as region:
                regions = {largest: region} if region is not None else {}
                check_size(inputs, regions)
                answer: tuple[Tensors, str] = await client.score(model, inputs, regions, outputs, request_id, waits_us)
                return answer

        async def request(client: Any) -> Answer:
            for memory in (self._shared_memory, self._shared_memory, None):  # a restarted server maps a new region
                try:
                    arrays, version = await ask(client, memory)
                    break
                except InferenceServerException as error:
                    if memory is None or triton.LOST_REGION not in (error.message() or ""):
                        raise
            absent = [name for name in outputs if name not in arrays]
            if absent:
                raise errors.InferenceFailedError(f"outputs: expected {', '.join(outputs)}, got no {', '.join(absent)}")
            return Answer(arrays, version)

        return await self.call(request, timeout_s, model=model)

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        async def request(client: Any) -> ModelInfo:
            # Before the configuration: a version that becomes ready in between makes callers ask again.
            versions = (await client.get_model_metadata(model, **self.as_json))["versions"]
            config = await client.get_model_config(model, **self.as_json)
            return ModelInfo.from_config(config.get("config", config), versions)  # nested in gRPC's answer

        return await self.call(request, timeout_s, model=model, bad_request=errors.ModelNotFoundError)

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        async def request(client: Any) -> bool:
            is_ready = bool(await client.is_server_ready() and await client.is_model_ready(model))
            if is_ready and not self._is_triton:  # Triton's metrics port says over HTTP that everything is ready
                with suppress(InferenceServerException, errors.InferenceFailedError):  # the metrics port never refuses
                    await client.get_server_metadata()
                self._is_triton = True
            return is_ready

        try:
            return await self.call(request, timeout_s)
        except errors.ServerError:
            return False

    async def close(self) -> None:
        try:
            if self._shared_memory is not None:
                await self._answered(self._shared_memory.close)
        finally:
            for client in [*self._calls]:
                await client.close()

    async def call(
        self,
        request: Callable[[Any], Awaitable[Answered]],
        timeout_s: float,
        *,
        model: str = "",
        bad_request: triton.BadRequest = triton.invalid_sample,
    ) -> Answered:
        """Return what ``request`` gets from tritonclient's client. Raises RewardError.

        model: named in the error for a missing model
        bad_request: as in ``triton.error_from``
        """
        try:
            # One limit for gRPC and HTTP. Triton drops a cancelled gRPC call, unless scoring has begun.
            async with timeout(timeout_s):
                return await self._answered(request)
        except errors.RewardError:
            raise
        except Exception as raised:
            error = triton.error_from(raised, self.url, bad_request)
            if error is None:
                raise
            if isinstance(error, errors.ModelNotFoundError):
                error = await self._not_served(model, error)
            raise error from raised

    async def _not_served(self, model: str, error: errors.ModelNotFoundError) -> errors.ModelNotFoundError:
        """Return the error with the served models' names, if the server lists them in time."""
        with suppress(Exception):
            async with timeout(_SERVED_TIMEOUT_S):
                statistics = await self._answered(lambda client: client.get_inference_statistics(**self.as_json))
                served = {each["name"] for each in statistics.get("model_stats", [])}
                return triton.not_served(model, error.message, served)
        return error

    async def _answered(self, request: Callable[[Any], Awaitable[Answered]]) -> Answered:
        """Return ``request``'s answer. If it is cancelled on a silent connection, later calls get a new one."""
        client = self._client = self._client or self._open()
        self._calls[client] += 1
        self._silent_since_s.setdefault(client, time.monotonic())
        try:
            answer = await request(client)
            self._silent_since_s.pop(client, None)
            return answer
        except InferenceServerException:  # an answer, or gRPC has noticed that the connection ended
            self._silent_since_s.pop(client, None)
            raise
        except asyncio.CancelledError:
            silent_s = time.monotonic() - self._silent_since_s.get(client, math.inf)
            if client is self._client and silent_s >= SILENT_S:
                logger.info("%s: nothing comes over the connection: the next call gets a new one", self.url)
                self._client = None
            raise
        finally:
            self._calls[client] -= 1
            if client is not self._client and not self._calls[client]:
                await client.close()
                del self._calls[client]
                self._silent_since_s.pop(client, None)

    def _open(self) -> Any:
        """Return a client with tritonclient's methods. It connects at first use and sends the credentials."""
        if not self._is_grpc:
            from rfm_client.transport.http import HttpClient

            return HttpClient(self._scheme, self._address, self._credentials)
        process = TritonTransport._first_process = TritonTransport._first_process or os.getpid()
        if process != os.getpid():  # gRPC would crash or hang
            raise RuntimeError(
                f"gRPC was used in process {process}, which forked this one: "
                "have multiprocessing start its processes by spawn or forkserver"
            )
        from rfm_client.transport.grpc import GrpcClient

        return GrpcClient(self._scheme, self._address, self._credentials)
