# SPDX-License-Identifier: MIT
"""Ask a running Triton: HTTP requests with a time limit, and a probe per model."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from tritonclient.utils import np_to_triton_dtype

from rfm.probe_request import probe_request
from rfm_client.contract import wire
from rfm_client.contract.wire import PROBE_PREFIX

PROBE_TIMEOUT_S = 1.0  # for requests that involve no model


NO_ANSWER = (OSError, http.client.HTTPException)


class Http:
    """HTTP client for ``host:port``. All methods raise NO_ANSWER.

    headers: sent with each request
    """

    def __init__(self, host: str, port: int, headers: Mapping[str, str] | None = None) -> None:
        self._address, self._headers = (host, port), headers or {}

    def request(self, method: str, path: str, timeout_s: float, body: bytes | None = None) -> tuple[int, str]:
        """Send a request. Return the response's status and body."""
        connection = http.client.HTTPConnection(*self._address, timeout=timeout_s)
        try:
            connection.request(method, path, body, self._headers)
            answer = connection.getresponse()
            return answer.status, answer.read().decode(errors="replace")
        finally:
            connection.close()

    def json(self, path: str, timeout_s: float = PROBE_TIMEOUT_S, method: str = "GET") -> Any:
        """Send a request. Return the JSON of a response with status 200."""
        status, text = self.request(method, path, timeout_s)
        if status != http.client.OK:
            raise http.client.HTTPException(f"{path}: {status} {text}")
        try:
            return json.loads(text)
        except ValueError as error:
            raise http.client.HTTPException(f"{path}: {error}") from error


BROKEN_COUNT, BROKEN_S = 3, 30.0  # a model is broken after BROKEN_COUNT failed probes in a row, over BROKEN_S
SHARE = 0.1  # probes take at most this share of a model's time
_OUTPUTS = (wire.PROGRESS, wire.VIDEO_EMBEDDINGS)


class Probe:
    """Probes a model in its own thread every ``interval_s``, or less often if responses are slow.

    hang_s: a model without a response for this long counts as hung
    """

    def __init__(self, http: Http, model: str, interval_s: float, hang_s: float) -> None:
        self._http, self._model, self._interval_s, self._hang_s = http, model, interval_s, hang_s
        self._waiting_since_s = time.monotonic()
        self._num_failures: int | None = None  # failures in a row; None: no probe has succeeded yet
        self._succeeded_s = 0.0  # time of the last success
        self.has_answered = False
        self._closed = threading.Event()
        threading.Thread(target=self._run, name=f"rfm-probe-{model}", daemon=True).start()

    def close(self) -> None:
        """Stop probing and end the thread."""
        self._closed.set()

    def fault(self, progress_s: float) -> str | None:
        """Return the reason to restart the model; None: healthy.

        progress_s: monotonic time of the last response or forward pass that Triton counted; a busy model may answer
            probes late
        """
        fails_s = time.monotonic() - self._succeeded_s
        if self._num_failures is not None and self._num_failures >= BROKEN_COUNT and fails_s >= BROKEN_S:
            return f"it has failed at {BROKEN_COUNT} probes in a row"
        if time.monotonic() - max(self._waiting_since_s, progress_s) > self._hang_s:
            return f"it has answered nothing for {self._hang_s:g} s"
        return None

    def _run(self) -> None:
        body: bytes | None = None
        while not self._closed.is_set():
            started_s, took_s = time.monotonic(), 0.0
            try:
                body = body or self._request()
                path = f"/v2/models/{self._model}/infer"
                status, _ = self._http.request("POST", path, 2 * self._hang_s, body)
            except NO_ANSWER:
                pass  # the probe stays open
            else:
                if status != HTTPStatus.SERVICE_UNAVAILABLE:  # a full queue rejects probes, too
                    took_s = time.monotonic() - started_s
                    self._take(status)
            self._closed.wait(max(self._interval_s, min(took_s / SHARE, self._hang_s)))
            if took_s:
                self._waiting_since_s = time.monotonic()

    def _take(self, status: int) -> None:
        self.has_answered = True
        self._waiting_since_s = float("inf")
        if status < HTTPStatus.INTERNAL_SERVER_ERROR:
            self._num_failures, self._succeeded_s = 0, time.monotonic()
        elif self._num_failures is not None:  # counted only after a success: some models fail on any blank sample
            self._num_failures += 1

    def _request(self) -> bytes:
        config = self._http.json(f"/v2/models/{self._model}/config")
        outputs = [{"name": output["name"]} for output in config["output"] if output["name"] in _OUTPUTS]
        inputs = [
            {
                "name": name,
                "shape": array.shape,
                "datatype": np_to_triton_dtype(array.dtype),
                "data": [item.decode() if isinstance(item, bytes) else item for item in array.ravel().tolist()],
            }
            for name, array in probe_request(config).items()
        ]
        return json.dumps({"id": f"{PROBE_PREFIX}-{self._model}", "inputs": inputs, "outputs": outputs}).encode()


def can_be_probed(config: Mapping[str, Any]) -> bool:
    """True for a Python model that this project exported."""
    names = {tensor["name"] for tensor in config["input"]}
    return config.get("backend") == "python" and wire.NUM_FRAMES in names
