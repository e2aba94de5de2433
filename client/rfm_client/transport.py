# SPDX-License-Identifier: MIT
"""Named tensors to a Triton server and back, over gRPC or HTTP; the errors of both in our own tree."""

from __future__ import annotations

import re
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from http.client import HTTPException
from typing import Any, Protocol

from tritonclient.utils import InferenceServerException, np_to_triton_dtype

from rfm_client import errors
from rfm_client.wire import Tensors

# What a status means to the caller: as gRPC names it, or as HTTP numbers it.
_STATUS_ERRORS: dict[str, type[errors.RewardError]] = {
    "StatusCode.INVALID_ARGUMENT": errors.InvalidSampleError,
    "400": errors.InvalidSampleError,
    "StatusCode.NOT_FOUND": errors.ModelNotFoundError,
    "404": errors.ModelNotFoundError,
    "StatusCode.UNAVAILABLE": errors.ServerUnavailableError,
    "503": errors.ServerUnavailableError,
    "StatusCode.DEADLINE_EXCEEDED": errors.DeadlineExceededError,
    "504": errors.DeadlineExceededError,
}

_IN_ENSEMBLE = re.compile(r"^in ensemble '[^']*', ")  # what Triton puts before a message; the caller knows the model


class Transport(Protocol):
    """What RewardClient needs of a connection. Thread-safe; its methods raise a RewardError."""

    def infer(self, model: str, inputs: Tensors, outputs: Collection[str]) -> Tensors:
        """The named ``outputs`` of ``model`` for ``inputs``."""

    def max_batch_size(self, model: str) -> int:
        """The most samples that ``model`` takes in one request. ModelNotFoundError when it is not served."""

    def is_ready(self, model: str) -> bool:
        """Whether the server answers and ``model`` is ready."""

    def close(self) -> None:
        """Closes the connection."""


def connect(url: str, timeout_s: float) -> Transport:
    """The transport for ``grpc://host:port`` or ``http://host:port``; every call ends within ``timeout_s``."""
    scheme, separator, address = url.rstrip("/").partition("://")
    if not separator or not address or scheme not in ("grpc", "http"):
        raise ValueError(f"url: expected grpc://host:port or http://host:port, got {url!r}")
    return GrpcTransport(address, timeout_s) if scheme == "grpc" else HttpTransport(address, timeout_s)


class GrpcTransport:
    """gRPC: one channel for all threads; a call that runs out of time is cancelled on the server too."""

    def __init__(self, address: str, timeout_s: float) -> None:
        import tritonclient.grpc as triton

        self._triton = triton
        self._timeout_s = timeout_s
        self._client = triton.InferenceServerClient(address)

    def infer(self, model: str, inputs: Tensors, outputs: Collection[str]) -> Tensors:
        tensors, requested = _request(self._triton, inputs, outputs)
        with _mapped_errors():
            answer = self._client.infer(model, tensors, outputs=requested, client_timeout=self._timeout_s)
            return _outputs(answer, outputs)

    def max_batch_size(self, model: str) -> int:
        with _mapped_errors(errors.ModelNotFoundError):
            answer = self._client.get_model_config(model, client_timeout=self._timeout_s)
            return int(answer.config.max_batch_size)

    def is_ready(self, model: str) -> bool:
        return _is_ready(self._client, model, client_timeout=self._timeout_s)

    def close(self) -> None:
        self._client.close()


class HttpTransport:
    """HTTP: one connection a thread, since tritonclient's must not leave the thread that made it (gevent)."""

    def __init__(self, address: str, timeout_s: float) -> None:
        import tritonclient.http as triton

        self._triton = triton
        self._address = address
        self._timeout_s = timeout_s
        self._of_thread = threading.local()

    @property
    def _client(self) -> Any:
        if not hasattr(self._of_thread, "client"):
            self._of_thread.client = self._triton.InferenceServerClient(
                self._address, connection_timeout=self._timeout_s, network_timeout=self._timeout_s
            )
        return self._of_thread.client

    def infer(self, model: str, inputs: Tensors, outputs: Collection[str]) -> Tensors:
        tensors, requested = _request(self._triton, inputs, outputs)
        with _mapped_errors():
            answer = self._client.infer(model, tensors, outputs=requested)
            return _outputs(answer, outputs)

    def max_batch_size(self, model: str) -> int:
        with _mapped_errors(errors.ModelNotFoundError):
            return int(self._client.get_model_config(model)["max_batch_size"])

    def is_ready(self, model: str) -> bool:
        return _is_ready(self._client, model)

    def close(self) -> None:
        """Closes this thread's connection; another thread's is closed when that thread ends."""
        if hasattr(self._of_thread, "client"):
            self._of_thread.client.close()
            del self._of_thread.client


def _request(triton: Any, inputs: Tensors, outputs: Collection[str]) -> tuple[list[Any], list[Any]]:
    tensors = []
    for name, array in inputs.items():
        tensor = triton.InferInput(name, array.shape, np_to_triton_dtype(array.dtype))
        tensor.set_data_from_numpy(array)
        tensors.append(tensor)
    return tensors, [triton.InferRequestedOutput(name) for name in outputs]


def _outputs(answer: Any, names: Collection[str]) -> Tensors:
    arrays = {name: answer.as_numpy(name) for name in names}
    absent = [name for name, array in arrays.items() if array is None]
    if absent:
        raise errors.InferenceFailedError(f"outputs: expected {', '.join(names)}, got no {', '.join(absent)}")
    return arrays


def _is_ready(client: Any, model: str, **options: Any) -> bool:
    try:
        with _mapped_errors():
            return bool(client.is_server_ready(**options) and client.is_model_ready(model, **options))
    except errors.ServerError:
        return False


@contextmanager
def _mapped_errors(bad_request: type[errors.RewardError] = errors.InvalidSampleError) -> Iterator[None]:
    """``bad_request``: what a 400 means; Triton answers it for an unknown model too."""
    try:
        yield
    except InferenceServerException as error:
        kind = _STATUS_ERRORS.get(str(error.status()), errors.InferenceFailedError)
        kind = bad_request if kind is errors.InvalidSampleError else kind
        raise kind(_IN_ENSEMBLE.sub("", error.message() or "no reason given")) from error
    except TimeoutError as error:
        raise errors.DeadlineExceededError(f"no answer in time: {error}") from error
    except (OSError, EOFError, HTTPException) as error:
        raise errors.ServerUnavailableError(f"connection lost: {error!r}") from error
    except (ValueError, LookupError, TypeError) as error:  # while reading what is no answer of a KServe server
        raise errors.InferenceFailedError(f"the answer cannot be read: {error!r}") from error
