# SPDX-License-Identifier: MIT
"""The model-repository API of a running server: index, load, unload, and a probe of one version.

Uses gRPC, because a load over HTTP blocks all connections of Triton's HTTP thread until the model is loaded.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import tritonclient.grpc
from google.protobuf.json_format import MessageToDict
from tritonclient.utils import InferenceServerException, np_to_triton_dtype

from rfm.serve.access import HEADER, VARIABLE, grpc_metadata
from rfm_client.contract import triton
from rfm_client.contract.addresses import split_url
from rfm_client.contract.checks import require
from rfm_client.contract.errors import LocatedError, ServerUnavailableError
from rfm_client.contract.wire import PROBE_PREFIX, Tensors

INDEX_PATH = "/v2/repository/index"  # for HTTP
READY, LOADING, UNLOADING = "READY", "LOADING", "UNLOADING"
POLL_S = 0.1
ANSWER_S = 1800.0  # for a request; a load returns only after the warm-up
FINISH_S = 600.0  # for requests in flight on an old version
_CHANNEL = [
    ("grpc.min_reconnect_backoff_ms", 10_000),  # also limits the time to connect
    ("grpc.enable_http_proxy", 0),
]
_SERVER_STATUSES = (*triton.UNAVAILABLE, *triton.OUT_OF_TIME, *triton.CANCELLED)
_GOING = (READY, UNLOADING)
_NOT_LOADED = "not loaded"  # this project's name for a missing state
_UNAVAILABLE, _UNLOADED = "UNAVAILABLE", "unloaded"


class RepositoryApiError(LocatedError):
    """A failed repository API request, with the reason."""

    @property
    def is_refusal(self) -> bool:
        """True if the server answered that the request is at fault."""
        answer = self.__cause__
        return isinstance(answer, InferenceServerException) and answer.status() == "StatusCode.INVALID_ARGUMENT"


@dataclass(frozen=True)
class ModelVersion:
    """A version in the server's index. version: None: not loaded yet; state: READY, UNAVAILABLE, ..."""

    name: str
    version: int | None
    state: str
    reason: str

    @property
    def is_ready(self) -> bool:
        """True if its state is READY."""
        return self.state == READY

    @property
    def has_failed(self) -> bool:
        """True if the version could not be loaded; False if it loads, unloads or was unloaded on request."""
        return self.state in (_NOT_LOADED, _UNAVAILABLE) and self.reason != _UNLOADED

    @property
    def is_unloaded(self) -> bool:
        """True if the version was unloaded on request or never loaded; False if it failed to load."""
        return self.state == _NOT_LOADED or (self.state, self.reason) == (_UNAVAILABLE, _UNLOADED)


_NO_KEY = "a server started without one takes none: start it again with --admin-key-file"
_KEYS = (  # what an administrator's and a caller's request show, in which header, where it comes from, and a remedy
    ("admin key", HEADER, f"--admin-key-file or {VARIABLE}", _NO_KEY),
    ("API key", triton.AUTHORIZATION, "--api-key-file or RFM_API_KEY_FILE", ""),
)


class RepositoryApi:
    """Client for the server at ``url``: grpc://host:port, or grpcs:// with TLS. A context manager.

    options: for tritonclient's gRPC client, such as those from Credentials
    headers: sent with each request, such as an API key that the server asks of callers

    The constructor raises InvalidValueError for an unusable URL, the methods raise RepositoryApiError.
    """

    def __init__(
        self,
        url: str,
        admin_key: str | None,
        options: Mapping[str, Any] | None = None,
        *,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        scheme, address = split_url(url)
        expected = "grpc://host:port (its gRPC port, 8001) or with TLS grpcs://host:port"
        require("url", scheme in ("grpc", "grpcs"), expected, url)
        self._url = url
        self._headers = {**grpc_metadata(admin_key), **(headers or {})}
        given = dict(options or {})
        channel = [*_CHANNEL, *given.pop("channel_args", ())]
        self._client = tritonclient.grpc.InferenceServerClient(address, channel_args=channel, **given)

    def index(self) -> list[ModelVersion]:
        """Return all versions in the repository, sorted by name and version."""
        answer = self._request(self._client.get_model_repository_index)
        return versions_of(MessageToDict(entry) for entry in answer.models)

    def ready_versions(self, model: str) -> list[int]:
        """Return the ready versions of ``model``."""
        ready = (entry for entry in self.index() if entry.name == model and entry.is_ready)
        return [entry.version for entry in ready if entry.version is not None]

    def config(self, model: str) -> Any:
        """Return the configuration of a served model, a ``ModelConfig``."""
        return self._request(self._client.get_model_config, model).config

    def load(self, model: str) -> None:
        """Load the versions in the model's configuration. If the load fails, the served versions stay."""
        self._request(self._client.load_model, model)

    def unload(self, model: str) -> None:
        """Unload the model once its requests in flight are done."""
        self._request(self._client.unload_model, model)

    def wait_gone(self, model: str, kept: Collection[int] = ()) -> None:
        """Wait until every version of the model is unloaded, except ``kept``."""
        deadline_s = time.monotonic() + FINISH_S
        while time.monotonic() < deadline_s:
            going = [entry for entry in self.index() if entry.name == model and entry.state in _GOING]
            if all(entry.version in kept for entry in going):
                return
            time.sleep(POLL_S)
        raise RepositoryApiError.at(model, f"its old versions to finish within {FINISH_S:g} s", "no end")

    def check_api_key(self) -> None:
        """Raise RepositoryApiError unless callers with this API key may score."""
        self._request(self._client.get_system_shared_memory_status)

    def infer(self, model: str, version: int, inputs: Tensors, outputs: Collection[str]) -> Tensors:
        """Return a version's outputs for a probe. The request id distinguishes probes from callers' requests."""
        tensors = []
        for name, array in inputs.items():
            tensors.append(tritonclient.grpc.InferInput(name, array.shape, np_to_triton_dtype(array.dtype)))
            tensors[-1].set_data_from_numpy(array)
        answer = self._request(
            self._client.infer,
            model,
            tensors,
            model_version=str(version),
            outputs=[tritonclient.grpc.InferRequestedOutput(name) for name in outputs],
            request_id=f"{PROBE_PREFIX}-{model}-{version}",
        )
        return {name: answer.as_numpy(name) for name in outputs}

    def _request(self, call: Any, *arguments: Any, **more: Any) -> Any:
        try:
            return call(*arguments, headers=self._headers, client_timeout=ANSWER_S, **more)
        except InferenceServerException as error:
            message = one_line(error.message() or "no reason given")
            if triton.RESTRICTED in message:
                is_callers = call in (self._client.infer, self._client.get_system_shared_memory_status)
                key, header, options, remedy = _KEYS[is_callers]
                got = "another" if f"{triton.METADATA_PREFIX}{header}" in self._headers else "none"
                expected = f"that of the server at {self._url} ({options})"
                raise RepositoryApiError.at(key, expected, got, remedy) from None
            ours = triton.error_from(error, self._url)
            if isinstance(ours, ServerUnavailableError) and ours.remedy and message not in str(ours):  # no connection
                raise RepositoryApiError(str(ours)) from error
            if "http2 header with status: 403" in message:
                remedy = "a proxy refuses this call: ask Triton's own port (--url)"
                raise RepositoryApiError(f"{self._url}: {message}: {remedy}") from error
            is_server_s = str(error.status()) in _SERVER_STATUSES
            raise RepositoryApiError(f"{self._url}: {message}" if is_server_s else message) from error

    def __enter__(self) -> RepositoryApi:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()


def versions_of(index: Iterable[Mapping[str, str]]) -> list[ModelVersion]:
    """Return the versions in a server's index, sorted by name and version."""
    versions = [
        ModelVersion(
            entry["name"],
            int(entry["version"]) if entry.get("version") else None,
            entry.get("state", _NOT_LOADED),
            one_line(entry.get("reason", "")),
        )
        for entry in index
    ]
    return sorted(versions, key=lambda entry: (entry.name, entry.version or 0))


def one_line(reason: str) -> str:
    """Return the first line of an error message, without its traceback."""
    return reason.strip().partition("\n")[0].strip()
