# SPDX-License-Identifier: MIT
"""Named tensors to one Triton server and back, over gRPC or HTTP; the errors of both in our own tree."""

from __future__ import annotations

import asyncio
import io
import logging
import os
import ssl
from collections.abc import Awaitable, Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, partial
from typing import Any, Protocol, TypeVar

import numpy as np
from tritonclient.utils import InferenceServerException, np_to_triton_dtype

from rfm_client.contract import errors, triton
from rfm_client.contract.addresses import split_url
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.proxies import grpc_proxy
from rfm_client.contract.wire import Tensors
from rfm_client.transport import remedies
from rfm_client.transport.access import SECURE_SCHEMES, Access
from rfm_client.transport.connection import Connection, grpc_options
from rfm_client.transport.deadline import timeout
from rfm_client.transport.off_loop import MIN_BYTES, off_loop
from rfm_client.transport.shared_memory import Region, SharedMemory

Answered = TypeVar("Answered")

_US_PER_S = 1_000_000
_AS_IT_IS = {"Accept-Encoding": "identity"}  # else aiohttp asks for gzip, which makes floats little smaller
_SMALL_BYTES = 16  # what is asked about one sample, but for its embeddings
_NUM_SMALL_INPUTS = 512  # that are kept
_UNREADABLE = (ValueError, LookupError, TypeError)  # what comes of an answer that is not a KServe server's
_SERVED_TIMEOUT_S = 2.0  # of what an error adds

LATE = "no answer in time"

logger = logging.getLogger("rfm_client")


@dataclass(frozen=True)
class Answer:
    """The outputs of one request, and the version of the model that gave them."""

    tensors: Tensors
    model_version: str


class Transport(Protocol):
    """A connection to one server, for one event loop. Its methods raise a RewardError."""

    url: str

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        """The named ``outputs`` of ``model`` for ``inputs``. request_id: what the server calls the request"""

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        """What the server says of ``model``. ModelNotFoundError when it is not served."""

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        """Whether the server answers and ``model`` is ready."""

    async def close(self) -> None:
        """Closes the connection to the server."""


def connect(
    url: str, *, shared_memory: bool = False, access: Access | None = None, named: str | None = None
) -> Transport:
    """The transport for ``grpc://host:port`` or ``http://host:port``, or with TLS ``grpcs://`` or ``https://``.

    It connects when it is first used. Raises ValueError.

    shared_memory: large inputs go through memory that the server, on the same host, maps too
    access: certificates, and what is shown with each request
    named: over gRPC, the ``host:port`` by which the server at this address is known, to its certificate too
    """
    if split_url(url)[0].startswith("grpc"):
        return GrpcTransport(url, access or Access(), shared_memory=shared_memory, named=named)
    return HttpTransport(url, access or Access(), shared_memory=shared_memory)


class TritonTransport:
    """What gRPC and HTTP have in common: tritonclient's asyncio clients are the same but for a few options."""

    _proxy: str | None = None  # as an error tells it

    def __init__(self, url: str, access: Access, *, shared_memory: bool) -> None:
        self.url = url
        self._scheme, self._address = split_url(url)
        self._access = access
        if access.uses_tls and not self._is_secure:
            raise ValueError(f"url: expected grpcs:// or https:// with certificates, got {url}")
        self._shared_memory = SharedMemory(self) if shared_memory else None
        self._requested = cache(lambda name: self._triton.InferRequestedOutput(name))
        self._small_input = lru_cache(_NUM_SMALL_INPUTS)(self._new_small_input)
        self._connection: Connection | None = None
        self._left: list[Connection] = []  # and perhaps not closed yet

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        request = partial(self._infer, model, inputs, outputs, request_id, timeout_s)
        return await self._call(request, timeout_s)

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        async def request(client: Any) -> ModelInfo:
            return ModelInfo.from_config(await self._model_config(client, model))

        return await self._call(request, timeout_s, bad_request=errors.ModelNotFoundError)

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        async def request(client: Any) -> bool:
            return bool(await client.is_server_ready() and await client.is_model_ready(model))

        try:
            return await self._call(request, timeout_s)
        except errors.ServerError:
            return False

    async def close(self) -> None:
        try:
            if self._shared_memory is not None:
                await self._shared_memory.close()
        finally:
            for connection in (*self._left, *filter(None, [self._connection])):
                await connection.close()

    async def register_region(self, name: str, byte_size: int) -> None:
        with self._connected().used() as client:
            await client.register_system_shared_memory(name, f"/{name}", byte_size)

    async def unregister_region(self, name: str) -> None:
        with self._connected().used() as client:
            await client.unregister_system_shared_memory(name)

    async def _infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], request_id: str, timeout_s: float, client: Any
    ) -> Answer:
        requested = [self._requested(name) for name in outputs]
        # Triton drops a request that waits in its queue for longer, over HTTP too: no client waits for the answer.
        waits_us = max(int(timeout_s * _US_PER_S), 1)
        ask = partial(client.infer, model, outputs=requested, request_id=request_id, timeout=waits_us)
        largest = max(inputs, key=lambda name: inputs[name].nbytes)
        if self._shared_memory is None:
            answer = await ask(await off_loop(inputs[largest].nbytes, self._inputs, inputs, {}))
        else:
            answer = await self._sharing(self._shared_memory, largest, inputs, ask)
        return Answer(_outputs(answer, outputs), self._model_version(answer))

    async def _sharing(
        self, memory: SharedMemory, largest: str, inputs: Tensors, ask: Callable[[list[Any]], Awaitable[Answered]]
    ) -> Answered:
        """What the server answers to inputs of which it finds the ``largest`` in shared memory, if that can be."""
        async with memory.lend(inputs[largest]) as region:
            regions = {largest: region} if region is not None else {}
            through_socket = 0 if regions else inputs[largest].nbytes
            tensors = await off_loop(through_socket, self._inputs, inputs, regions)
            try:
                return await ask(tensors)
            except InferenceServerException as error:
                if region is not None and triton.LOST_REGION in (error.message() or ""):
                    memory.forget(region)
                raise

    def _inputs(self, inputs: Tensors, regions: Mapping[str, Region]) -> list[Any]:
        tensors = []
        for name, array in inputs.items():
            if array.nbytes <= _SMALL_BYTES and not array.dtype.hasobject:
                tensors.append(self._small_input(name, array.shape, array.dtype.str, array.tobytes()))
                continue
            tensor = self._triton.InferInput(name, array.shape, np_to_triton_dtype(array.dtype))
            if name in regions:
                tensor.set_shared_memory(regions[name].name, array.nbytes)
            else:
                tensor.set_data_from_numpy(array)
            tensors.append(tensor)
        return tensors

    def _new_small_input(self, name: str, shape: tuple[int, ...], dtype: str, content: bytes) -> Any:
        """An input that requests share, since tensors so small are the same again and again."""
        array = np.frombuffer(content, dtype).reshape(shape)
        tensor = self._triton.InferInput(name, shape, np_to_triton_dtype(array.dtype))
        tensor.set_data_from_numpy(array)
        return tensor

    async def _call(
        self,
        request: Callable[[Any], Awaitable[Answered]],
        timeout_s: float,
        *,
        bad_request: type[errors.RewardError] = errors.InvalidSampleError,
    ) -> Answered:
        """What the server answers to ``request``, within ``timeout_s``.

        bad_request: the error for a 400, with which Triton answers for an unknown model, too
        """
        try:
            # Not by a deadline of gRPC: Triton 2.51 overlooks that one has passed, but not that a call is cancelled.
            async with timeout(timeout_s):
                return await self._answer(request)
        except InferenceServerException as error:
            raise await self._error_of(str(error.status()), error.message() or "", bad_request) from error
        except (asyncio.TimeoutError, TimeoutError) as error:  # in Python 3.10 two
            where = self.url if self._proxy is None else f"{self.url} through {self._proxy}"
            raise errors.DeadlineExceededError(f"{where}: {LATE}") from error
        except self.protocol_errors as error:
            got = "no answer of an HTTP server"
            raise errors.InferenceFailedError(f"{self.url}: {got}: {type(error).__name__}") from error
        except self.access_errors as error:
            raise remedies.denied(self.url, "", str(error)) from error
        except self.connection_errors as error:
            unavailable = remedies.unreachable(self.url, str(error) or type(error).__name__)
            unavailable.may_have_ended_server = self._was_under_way(error)
            raise unavailable from error
        except _UNREADABLE as error:
            raise errors.InferenceFailedError(f"{self.url}: the answer cannot be read: {error!r}") from error

    async def _error_of(self, status: str, message: str, bad_request: type[errors.RewardError]) -> errors.RewardError:
        """The error that an answer means to a caller, as ``triton.error_of`` has it, with its remedy."""
        if triton.is_denied(status, message):
            return remedies.denied(self.url, status, message)
        if triton.is_unreachable(status, message):
            return remedies.unreachable(self.url, message, self._proxy)
        error = triton.error_of(status, message, bad_request)
        if isinstance(error, errors.ModelNotFoundError):
            with suppress(InferenceServerException, asyncio.TimeoutError, *_UNREADABLE, *self.connection_errors):
                async with timeout(_SERVED_TIMEOUT_S):
                    with self._connected().used() as client:
                        return remedies.not_served(error.message, await self._served_models(client))
        return error

    async def _answer(self, request: Callable[[Any], Awaitable[Answered]]) -> Answered:
        """What the server answers; a connection over which nothing comes is left to those who use it already."""
        connection = self._connected()
        try:
            with connection.used() as client:
                answer = await request(client)
            connection.record_answer()
            return answer
        except InferenceServerException:
            connection.record_answer()  # or gRPC knows itself that the connection has ended
            raise
        except asyncio.CancelledError:
            if connection.is_silent and connection is self._connection:
                logger.info("%s: nothing comes over the connection: the next call gets a new one", self.url)
                self._connection = None
                self._left = [*(left for left in self._left if not left.is_closed), connection]
                connection.leave()
            raise

    def _connected(self) -> Connection:
        if self._connection is None:
            self._connection = Connection(self._open())
        return self._connection

    @property
    def _is_secure(self) -> bool:
        return self._scheme in SECURE_SCHEMES

    # What differs. A module is imported when it is first needed; a client belongs to the event loop that runs then.

    @cached_property
    def _triton(self) -> Any:
        raise NotImplementedError

    def _open(self) -> Any:
        """A client of tritonclient's, which connects when it is first used."""
        raise NotImplementedError

    @property
    def connection_errors(self) -> tuple[type[Exception], ...]:
        return (OSError, EOFError)

    def _was_under_way(self, error: Exception) -> bool:
        """Whether a connection error may have come after the request was sent. gRPC says so otherwise (error_of)."""
        return False

    @property
    def protocol_errors(self) -> tuple[type[Exception], ...]:
        return ()

    @property
    def access_errors(self) -> tuple[type[Exception], ...]:
        return ()

    async def registered_regions(self) -> list[str]:
        raise NotImplementedError

    async def _model_config(self, client: Any, model: str) -> Mapping[str, Any]:
        raise NotImplementedError

    async def _served_models(self, client: Any) -> set[str]:
        raise NotImplementedError

    def _model_version(self, answer: Any) -> str:
        raise NotImplementedError


class GrpcTransport(TritonTransport):
    """gRPC: a call that runs out of time, or is cancelled, is cancelled on the server too (if it has not begun)."""

    _first_process: int | None = None  # that used gRPC

    def __init__(self, url: str, access: Access, *, shared_memory: bool, named: str | None = None) -> None:
        super().__init__(url, access, shared_memory=shared_memory)
        self._options = {**grpc_options(named or self._address), **_name_options(named)}
        self._proxy = grpc_proxy(named or self._address)

    @cached_property
    def _triton(self) -> Any:
        import tritonclient.grpc.aio

        return tritonclient.grpc.aio

    def _open(self) -> Any:
        process = GrpcTransport._first_process = GrpcTransport._first_process or os.getpid()
        if process != os.getpid():  # it would crash or hang
            raise RuntimeError(
                f"gRPC was used in process {process}, which forked this one: "
                "have multiprocessing start its processes by spawn or forkserver"
            )
        client = self._triton.InferenceServerClient(
            self._address, channel_args=list(self._options.items()), **self._access.grpc_options(self._scheme)
        )
        self._access.show_with_each_request(client)
        return client

    async def registered_regions(self) -> list[str]:
        with self._connected().used() as client:
            answer = await client.get_system_shared_memory_status(as_json=True)
        return list(answer.get("regions", {}))

    async def _served_models(self, client: Any) -> set[str]:
        answer = await client.get_inference_statistics(as_json=True)
        return {entry["name"] for entry in answer.get("model_stats", [])}

    async def _model_config(self, client: Any, model: str) -> Mapping[str, Any]:
        answer = await client.get_model_config(model, as_json=True)
        config: Mapping[str, Any] = answer["config"]
        return config

    def _model_version(self, answer: Any) -> str:
        return str(answer.get_response().model_version)


def _name_options(named: str | None) -> dict[str, str]:
    if named is None:
        return {}
    return {"grpc.default_authority": named, "grpc.ssl_target_name_override": named.rpartition(":")[0].strip("[]")}


class HttpTransport(TritonTransport):
    """HTTP: as many connections as there are calls at a time. Triton finishes a request that nobody waits for."""

    @cached_property
    def _triton(self) -> Any:
        import tritonclient.http.aio

        return tritonclient.http.aio

    def _open(self) -> Any:
        secure = {"ssl": True, "ssl_context": self._access.ssl_context} if self._is_secure else {}
        client = self._triton.InferenceServerClient(self._address, conn_limit=0, conn_timeout=None, **secure)
        self._access.show_with_each_request(client)
        post = client._post

        async def post_stream(request_uri: str, request_body: Any, headers: Any, query_params: Any) -> Any:
            # As a stream aiohttp sends it piece by piece; in one piece it would hold the event loop, and warns.
            is_large = isinstance(request_body, bytes) and len(request_body) >= MIN_BYTES
            body = io.BytesIO(request_body) if is_large else request_body
            return await post(request_uri, body, {**(headers or {}), **_AS_IT_IS}, query_params)

        client._post = post_stream
        return client

    @property
    def connection_errors(self) -> tuple[type[Exception], ...]:
        import aiohttp

        return (aiohttp.ClientError, OSError, EOFError)

    def _was_under_way(self, error: Exception) -> bool:
        import aiohttp

        return isinstance(error, aiohttp.ClientError) and not isinstance(error, aiohttp.ClientConnectorError)

    @property
    def protocol_errors(self) -> tuple[type[Exception], ...]:
        import aiohttp

        return (aiohttp.ClientResponseError,)

    @property
    def access_errors(self) -> tuple[type[Exception], ...]:
        import aiohttp

        return (aiohttp.ClientSSLError, ssl.SSLError)

    async def registered_regions(self) -> list[str]:
        with self._connected().used() as client:
            return [region["name"] for region in await client.get_system_shared_memory_status()]

    async def _served_models(self, client: Any) -> set[str]:
        answer = await client.get_inference_statistics()
        return {entry["name"] for entry in answer["model_stats"]}

    async def _model_config(self, client: Any, model: str) -> Mapping[str, Any]:
        config: Mapping[str, Any] = await client.get_model_config(model)
        return config

    def _model_version(self, answer: Any) -> str:
        return str(answer.get_response()["model_version"])


def _outputs(answer: Any, names: Collection[str]) -> Tensors:
    arrays = {name: answer.as_numpy(name) for name in names}
    absent = [name for name, array in arrays.items() if array is None]
    if absent:
        raise errors.InferenceFailedError(f"outputs: expected {', '.join(names)}, got no {', '.join(absent)}")
    return arrays
