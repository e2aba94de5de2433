# SPDX-License-Identifier: MIT
"""One small question to a model every few seconds: does it still answer?

A busy model answers a question late, and a full one refuses it. Neither is dead. So an answer is only missed once the
model has finished nobody's request for some time either.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from http import HTTPStatus
from typing import Any

from tritonclient.utils import np_to_triton_dtype

from rfm.probe import blank_question
from rfm.supervise.http import NO_ANSWER, Http
from rfm_client.contract import wire
from rfm_client.contract.names import PROBE_PREFIX

LATE_S = 2.5  # without any answer: the model is not ready
LATE_FACTOR = 3.0  # of the slowest answer of late, where that is more
SHARE = 0.1  # of a model's time at most
BROKEN_COUNT = 3  # failures, one after the other, of a model that could answer the same question before

_KEPT = 20  # answers
_OUTPUTS = (wire.PROGRESS, wire.VIDEO_EMBEDDINGS)
_DEAD = "is not healthy"
_ABSENT = ("unknown model", "no available versions", "is not ready")


class Verdict(Enum):
    """What is known of a model."""

    UNKNOWN = "it was not asked yet"
    LIVE = "it answers"
    LATE = "it gives no answer in time"
    BUSY = "it works on a long batch"
    HUNG = "it gives no answer"
    DEAD = "its process is dead"
    BROKEN = "it fails at what it could answer before"
    ABSENT = "it is not loaded"


class Canary:
    """Asks a model of a server every ``interval_s``, or less often if it takes long to answer.

    hang_s: how long a model may answer nobody before it counts as hung
    observe: is told how long each answer took
    """

    def __init__(
        self, http: Http, model: str, interval_s: float, hang_s: float, observe: Callable[[float], None]
    ) -> None:
        self.model = model
        self._http = http
        self._interval_s = interval_s
        self._hang_s = hang_s
        self._observe = observe
        self._closing = False
        self._wakes = threading.Event()
        self._thread = threading.Thread(target=self._ask_for_ever, name=f"rfm-canary-{model}", daemon=True)
        self._life = 0
        self.reset()

    def reset(self) -> None:
        """Forgets what it knows, and asks: the model is another."""
        self._life += 1  # what the one before says now does not count
        self._answer = Verdict.UNKNOWN
        self._waiting_since_s: float | None = None
        self._last_success: tuple[Any, float] | None = None
        self._took_s: deque[float] = deque(maxlen=_KEPT)
        self._num_failures = 0
        self._has_succeeded = False
        self._wakes.set()

    def start(self) -> None:
        """Asks from now on."""
        self._thread.start()

    def stop(self) -> None:
        """Asks no more; an answer that it waits for, it does not wait for."""
        self._closing = True
        self._wakes.set()

    def verdict(self) -> Verdict:
        """What is known now."""
        waiting_since_s = self._waiting_since_s
        if waiting_since_s is None or self._answer in (Verdict.DEAD, Verdict.BROKEN):
            return self._answer
        waited_s = time.monotonic() - waiting_since_s
        last_success_s: float | None = 0.0
        if waited_s > LATE_S / 2:
            last_success_s = self._last_success_s()
            waited_s = min(waited_s, time.monotonic() - (last_success_s or 0.0))
        slowest_s = LATE_FACTOR * max(self._took_s, default=0.0)
        if waited_s > max(self._hang_s, slowest_s) and last_success_s is not None:
            return Verdict.HUNG
        return Verdict.LATE if waited_s > max(LATE_S, slowest_s) else self._answer

    def _last_success_s(self) -> float | None:
        """When the model was last seen to have answered anybody; None: Triton does not tell, so it is not the model."""
        try:
            versions = self._http.get_json(f"/v2/models/{self.model}/stats")["model_stats"]
            count = [version["inference_stats"]["success"].get("count", 0) for version in versions]
        except NO_ANSWER:
            return None
        if self._last_success is None or self._last_success[0] != count:
            self._last_success = count, (time.monotonic() if self._last_success else 0.0)
        return self._last_success[1]

    def _ask_for_ever(self) -> None:
        body: bytes | None = None
        while not self._closing:
            self._wakes.clear()
            started_s, life = time.monotonic(), self._life
            if self._waiting_since_s is None:
                self._waiting_since_s = started_s
            try:
                body = body or self._question()
                status, text = self._http.request("POST", f"/v2/models/{self.model}/infer", self._hang_s * 2, body)
            except NO_ANSWER:
                pass  # no answer: it still waits for one
            else:
                if life == self._life and self._judge(status, text):
                    self._took_s.append(time.monotonic() - started_s)
                    self._observe(self._took_s[-1])
            self._wakes.wait(max(self._interval_s, min(self._took_s, default=0.0) / SHARE))

    def _judge(self, status: int, text: str) -> bool:
        """Whether it is an answer of the model, and what it tells. Others leave it waiting."""
        failed = status >= HTTPStatus.INTERNAL_SERVER_ERROR
        if _DEAD in text and failed:
            self._answer = Verdict.DEAD
        elif any(words in text for words in _ABSENT) and status != HTTPStatus.OK:
            self._answer = Verdict.ABSENT
        elif status == HTTPStatus.SERVICE_UNAVAILABLE:
            return False  # its queue is full, or it was not its turn in time
        elif not failed:
            self._answer, self._num_failures, self._has_succeeded = Verdict.LIVE, 0, True
        else:  # it answers; blank frames need not give a readable answer
            self._num_failures += 1
            is_broken = self._has_succeeded and self._num_failures >= BROKEN_COUNT
            self._answer = Verdict.BROKEN if is_broken else Verdict.LIVE
        self._waiting_since_s = None
        return True

    def _question(self) -> bytes:
        config = self._http.get_json(f"/v2/models/{self.model}/config")
        tensors = blank_question(config)
        outputs = [{"name": output["name"]} for output in config["output"] if output["name"] in _OUTPUTS]
        inputs = [
            {
                "name": name,
                "shape": array.shape,
                "datatype": np_to_triton_dtype(array.dtype),
                "data": [item.decode() if isinstance(item, bytes) else item for item in array.ravel().tolist()],
            }
            for name, array in tensors.items()
        ]
        return json.dumps({"id": f"{PROBE_PREFIX}-{self.model}", "inputs": inputs, "outputs": outputs}).encode()


def can_be_asked(config: Mapping[str, Any]) -> bool:
    """Whether a model, of which this is the configuration, is one of ours that has processes of its own."""
    names = {tensor["name"] for tensor in config["input"]}
    return config.get("backend") == "python" and wire.NUM_FRAMES in names
