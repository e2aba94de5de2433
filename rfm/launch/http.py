# SPDX-License-Identifier: MIT
"""HTTP requests to a Triton on this machine, each with its own connection and time limit."""

from __future__ import annotations

import http.client
import json
from collections.abc import Mapping
from typing import Any

PROBE_TIMEOUT_S = 1.0  # for answers without a model


class UnreadableAnswerError(Exception):
    """An answer with a status other than 200, or without JSON."""


NO_ANSWER = (OSError, http.client.HTTPException, UnreadableAnswerError)


class Http:
    """The server at ``host:port``. Its methods raise NO_ANSWER.

    headers: sent with each request
    """

    def __init__(self, host: str, port: int, headers: Mapping[str, str] | None = None) -> None:
        self._address, self._headers = (host, port), headers or {}

    def request(self, method: str, path: str, timeout_s: float, body: bytes | None = None) -> tuple[int, str]:
        """Send a request. Return status and content of the answer."""
        connection = http.client.HTTPConnection(*self._address, timeout=timeout_s)
        try:
            connection.request(method, path, body, self._headers)
            answer = connection.getresponse()
            return answer.status, answer.read().decode(errors="replace")
        finally:
            connection.close()

    def json(self, path: str, timeout_s: float = PROBE_TIMEOUT_S, method: str = "GET") -> Any:
        """Send a request. Return the JSON of the answer."""
        status, text = self.request(method, path, timeout_s)
        if status != http.client.OK:
            raise UnreadableAnswerError(f"{path}: {status} {text}")
        try:
            return json.loads(text)
        except ValueError as error:
            raise UnreadableAnswerError(f"{path}: {error}") from error
