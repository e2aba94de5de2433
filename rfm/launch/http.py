# SPDX-License-Identifier: MIT
"""Plain HTTP requests to a Triton on this machine, each on a connection of its own and within a time limit."""

from __future__ import annotations

import http.client
import json
from collections.abc import Mapping
from typing import Any

PROBE_TIMEOUT_S = 1.0  # of what Triton answers by itself


class UnreadableAnswerError(Exception):
    """An answer that is no JSON, or has another status than 200."""


NO_ANSWER = (OSError, http.client.HTTPException, UnreadableAnswerError)  # or none that can be read


class Http:
    """The server at ``host:port``. Its methods raise one of NO_ANSWER."""

    def __init__(self, host: str, port: int) -> None:
        self._address = host, port

    def request(
        self,
        method: str,
        path: str,
        timeout_s: float,
        body: bytes | None = None,
        *,
        headers: Mapping[str, str] | None = None,
    ) -> tuple[int, str]:
        """Status and content of the answer."""
        connection = http.client.HTTPConnection(*self._address, timeout=timeout_s)
        try:
            connection.request(method, path, body, headers or {})
            answer = connection.getresponse()
            return answer.status, answer.read().decode(errors="replace")
        finally:
            connection.close()

    def get_json(
        self,
        path: str,
        timeout_s: float = PROBE_TIMEOUT_S,
        *,
        method: str = "GET",
        headers: Mapping[str, str] | None = None,
    ) -> Any:
        """The content of an answer that is JSON."""
        status, text = self.request(method, path, timeout_s, headers=headers)
        if status != http.client.OK:
            raise UnreadableAnswerError(f"{path}: {status} {text}")
        try:
            return json.loads(text)
        except ValueError as error:
            raise UnreadableAnswerError(f"{path}: {error}") from error
