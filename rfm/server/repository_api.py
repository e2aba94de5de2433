# SPDX-License-Identifier: MIT
"""A running server's model-repository API, over HTTP: what is loaded, load, unload; and a question to one version."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from http.client import HTTPException
from types import TracebackType
from typing import Any

import tritonclient.http
from tritonclient.utils import InferenceServerException, np_to_triton_dtype

from rfm.server.admin_key import VARIABLE, http_headers
from rfm_client.transport import split_url
from rfm_client.wire import CANARY_PREFIX, Tensors

READY, LOADING, UNLOADING = "READY", "LOADING", "UNLOADING"
POLL_S = 0.1
CONNECT_S = 10.0
ANSWER_S = 1800.0  # of one request: a load answers when the model is warmed up
FINISH_S = 600.0  # requests in flight on a version that is taken out

_FORBIDDEN = "403"
_GOING = (READY, UNLOADING)
_NOT_LOADED = "not loaded"  # Triton tells no state
_UNAVAILABLE, _UNLOADED = "UNAVAILABLE", "unloaded"


class RepositoryApiError(Exception):
    """What the server did not do, and why."""


@dataclass(frozen=True)
class ModelVersion:
    """A version as the server knows it; one that it does not know yet has no number. state: READY, UNAVAILABLE, ..."""

    name: str
    version: int | None
    state: str
    reason: str

    @property
    def is_ready(self) -> bool:
        """Whether it answers requests, as far as the server knows."""
        return self.state == READY

    @property
    def is_unloaded(self) -> bool:
        """Whether it is not loaded because nobody wants it to be. One that failed has another reason."""
        return self.state == _NOT_LOADED or (self.state, self.reason) == (_UNAVAILABLE, _UNLOADED)


class RepositoryApi:
    """The server at ``url`` (http://host:port). A context manager. Its methods raise RepositoryApiError."""

    def __init__(self, url: str, admin_key: str | None) -> None:
        scheme, address = _split(url)
        if scheme != "http":
            raise RepositoryApiError(f"url: expected http://host:port, got {url}")
        self._url = url
        self._headers = http_headers(admin_key)
        self._client = tritonclient.http.InferenceServerClient(
            address, connection_timeout=CONNECT_S, network_timeout=ANSWER_S
        )

    def index(self) -> list[ModelVersion]:
        """Everything in the repository, by name and version."""
        return versions_of(self._ask(self._client.get_model_repository_index, headers=self._headers))

    def ready_versions(self, model: str) -> list[int]:
        """Those that are served now."""
        ready = (entry for entry in self.index() if entry.name == model and entry.is_ready)
        return [entry.version for entry in ready if entry.version is not None]

    def config(self, model: str, version: int) -> dict[str, Any]:
        """With which it was loaded."""
        config: dict[str, Any] = self._ask(self._client.get_model_config, model, str(version), headers=self._headers)
        return config

    def load(self, model: str, config: Mapping[str, Any] | None = None) -> None:
        """Has the server serve what the model's configuration says; what was served before stays if that fails.

        config: instead of the one in the model's file
        """
        instead = None if config is None else json.dumps(config)
        self._ask(self._client.load_model, model, headers=self._headers, config=instead)

    def unload(self, model: str) -> None:
        """Has the server forget the model, after the requests that it is working on."""
        self._ask(self._client.unload_model, model, headers=self._headers)

    def wait_gone(self, model: str, kept: Collection[int] = ()) -> None:
        """Returns when no version of the model but ``kept`` works on a request."""
        deadline_s = time.monotonic() + FINISH_S
        while time.monotonic() < deadline_s:
            going = [entry for entry in self.index() if entry.name == model and entry.state in _GOING]
            if all(entry.version in kept for entry in going):
                return
            time.sleep(POLL_S)
        raise RepositoryApiError(f"{model}: expected its old versions to finish within {FINISH_S:g} s, got no end")

    def infer(self, model: str, version: int, inputs: Tensors, outputs: Collection[str]) -> Tensors:
        """What one version answers. By its id it is told from callers' requests in logs."""
        tensors = []
        for name, array in inputs.items():
            tensors.append(tritonclient.http.InferInput(name, array.shape, np_to_triton_dtype(array.dtype)))
            tensors[-1].set_data_from_numpy(array)
        answer = self._ask(
            self._client.infer,
            model,
            tensors,
            model_version=str(version),
            outputs=[tritonclient.http.InferRequestedOutput(name) for name in outputs],
            request_id=f"{CANARY_PREFIX}-{model}-{version}",
        )
        return {name: answer.as_numpy(name) for name in outputs}

    def _ask(self, call: Any, *arguments: Any, **options: Any) -> Any:
        try:
            return call(*arguments, **options)
        except InferenceServerException as error:
            if str(error.status()) == _FORBIDDEN:
                got = "another" if self._headers else "none"
                raise RepositoryApiError(
                    f"admin key: expected that of the server at {self._url} (--admin-key-file or {VARIABLE}), got {got}"
                ) from None
            raise RepositoryApiError(one_line(error.message() or "no reason given")) from error
        except (OSError, EOFError, HTTPException) as error:
            raise RepositoryApiError(f"{self._url}: no answer: {error or type(error).__name__}") from error

    def __enter__(self) -> RepositoryApi:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._client.close()


def versions_of(index: Iterable[Mapping[str, str]]) -> list[ModelVersion]:
    """The entries of a server's index, by name and version."""
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
    """What happened; the lines behind it are where."""
    lines = reason.strip().splitlines()
    return lines[0].strip() if lines else ""


def _split(url: str) -> tuple[str, str]:
    try:
        return split_url(url)
    except ValueError as error:
        raise RepositoryApiError(str(error)) from None
