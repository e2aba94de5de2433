# SPDX-License-Identifier: MIT
"""What a Triton says of itself: does it answer at all, and what does it serve?"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import quote

from google.protobuf import text_format
from tritonclient.grpc.model_config_pb2 import ModelConfig

from rfm.launch.admin_key import http_headers
from rfm.launch.http import NO_ANSWER, Http
from rfm.launch.process import TritonServer
from rfm.launch.repository_api import INDEX_PATH, READY, ModelVersion, versions_of
from rfm.launch.repository_folder import CONFIG_FILE
from rfm.supervise.background import Calls

INTERVAL_S = 1.0
LOOKS = 3  # without any answer, at least, before it has to be started again

_ENDPOINT_TIMEOUT_S = 1.5  # at most; a look tries both endpoints
_INDEX_TIMEOUT_S = 5.0

Config = Mapping[str, Any]


@dataclass(frozen=True)
class Snapshot:
    """What a Triton serves.

    requested_s: when it was requested, by time.monotonic
    configs: of each model, when it was last ready
    unreadable: models that are ready, and whose configuration cannot be read
    """

    requested_s: float
    versions: Collection[ModelVersion]
    configs: Mapping[str, Config]
    ready: frozenset[str]  # models
    unreadable: frozenset[str]

    def is_unloaded(self, model: str) -> bool:
        """Whether it was unloaded because somebody wanted that."""
        return all(entry.is_unloaded for entry in self.versions if entry.name == model)

    def has(self, model: str, version: int) -> bool:
        """Whether this version of the model is ready; -1: any version."""
        ready = {number for name, number in self.in_state(READY) if name == model}
        return bool(ready) if version == -1 else version in ready

    def in_state(self, *states: str) -> set[tuple[str, int]]:
        """Names and versions of the models that are in one of these states."""
        return {(entry.name, entry.version or 0) for entry in self.versions if entry.state in states}


def serving_just(config: Config, versions: Sequence[int]) -> Config:
    """A model's configuration, for these versions alone: a file may name others by now."""
    return {**config, "version_policy": {"specific": {"versions": list(versions)}}}


def names_the_same_versions(repository: Path, model: str, config: Config) -> bool:
    """Whether the model's file names the versions of ``config``, which is as ``serving_just`` gives it."""
    try:
        file = text_format.Parse((repository / model / CONFIG_FILE).read_text(), ModelConfig())
    except (OSError, UnicodeDecodeError, text_format.ParseError):
        return False
    return bool(list(file.version_policy.specific.versions) == config["version_policy"]["specific"]["versions"])


class TritonWatch:
    """Looks every INTERVAL_S whether a server that is ready answers, and what it serves.

    silent_s: how long it may give no answer, to LOOKS looks in a row, before it has to be started again
    """

    def __init__(self, server: TritonServer, silent_s: float) -> None:
        endpoints = server.endpoints
        self._http = Http(endpoints.http_host, endpoints.http_port)
        self._metrics = Http(endpoints.host, endpoints.metrics_port)
        self._headers = http_headers(server.admin_key)
        self._silent_s = silent_s
        self._endpoint_timeout_s = min(silent_s / LOOKS / 2, _ENDPOINT_TIMEOUT_S)
        self._failed_looks = 0  # in a row
        self._silent_since_s = 0.0  # when the first of them began
        self._looks: Calls[Snapshot | None] = Calls("rfm-triton-watch", NO_ANSWER)
        self._looked_s = 0.0
        self._due_s = 0.0
        self.snapshot: Snapshot | None = None  # the latest

    def look(self) -> None:
        """Takes in the result of the last look, and begins the next one when it is due."""
        look = self._looks.ended()
        if look is not None and look.exception() is None:
            self._failed_looks = 0
            self.snapshot = look.result() or self.snapshot  # if there is none, the next look requests it again
        elif look is not None:
            self._silent_since_s = self._silent_since_s if self._failed_looks else self._looked_s
            self._failed_looks += 1
        if not self._looks.is_under_way and time.monotonic() >= self._due_s:
            self._looked_s = time.monotonic()
            self._due_s = self._looked_s + INTERVAL_S
            self._looks.begin(self._looked)

    @property
    def is_silent(self) -> bool:
        """Whether it has not answered for ``silent_s``, and has to be started again."""
        return self._failed_looks >= LOOKS and time.monotonic() - self._silent_since_s >= self._silent_s

    @property
    def is_answered(self) -> bool:
        """Whether it has answered the last look."""
        return not self._failed_looks

    def _looked(self) -> Snapshot | None:
        """What Triton serves; None: it answers, but not that. It runs in a thread of its own, and changes nothing.

        Raises one of NO_ANSWER.
        """
        try:
            self._http.request("GET", "/v2", self._endpoint_timeout_s)
        except NO_ANSWER:  # while the threads of HTTP wait for models that are loaded, this one answers still
            self._metrics.request("GET", "/metrics", self._endpoint_timeout_s)
        try:
            return self._new_snapshot()
        except NO_ANSWER:
            return None

    def _new_snapshot(self) -> Snapshot:
        requested_s = time.monotonic()
        index = self._http.get_json(INDEX_PATH, _INDEX_TIMEOUT_S, method="POST", headers=self._headers)
        versions = versions_of(index)
        loaded = sorted({entry.name for entry in versions if entry.is_ready})
        configs = {} if self.snapshot is None else dict(self.snapshot.configs)
        for model in loaded:
            numbers = [entry.version for entry in versions if entry.name == model and entry.is_ready and entry.version]
            path = f"/v2/models/{quote(model, safe='')}/versions/{max(numbers, default=1)}/config"
            with suppress(*NO_ANSWER):  # the others are looked after
                configs[model] = serving_just(self._http.get_json(path), numbers)
        known = [model for model in loaded if model in configs]
        ready = frozenset(model for model in known if self._is_ready(configs[model]))
        return Snapshot(requested_s, versions, configs, ready, frozenset(loaded) - frozenset(known))

    def _is_ready(self, config: Config) -> bool:
        """Whether Triton calls an ensemble ready. A model that is not made of others has a probe of its own."""
        if "ensemble_scheduling" not in config:
            return True
        path = f"/v2/models/{quote(config['name'], safe='')}/ready"
        status, _ = self._http.request("GET", path, self._endpoint_timeout_s)
        return status == HTTPStatus.OK
