# SPDX-License-Identifier: MIT
"""A health probe: one small request to a model every few seconds.

A busy model answers a probe late, and a full one refuses it. Neither is dead. So an answer is only missed once the
model has finished nobody's request for some time either.
"""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from tritonclient.utils import np_to_triton_dtype

from rfm.launch.http import NO_ANSWER, Http
from rfm.probe import blank_question
from rfm.supervise.background import Calls
from rfm.supervise.model_states import Event
from rfm_client.contract import triton, wire
from rfm_client.contract.names import PROBE_PREFIX

LATE_S = 2.5  # without any answer: the model is not ready
LATE_FACTOR = 3.0  # of the slowest answer of late, where that is more
SHARE = 0.1  # of a model's time at most
BROKEN_COUNT = 3  # failures, one after the other, of a model that could answer the same probe before

_KEPT = 20  # answers
_OUTPUTS = (wire.PROGRESS, wire.VIDEO_EMBEDDINGS)


@dataclass(frozen=True)
class Reply:
    """The answer to a probe: status, text, seconds. body: the probe that was sent"""

    status: int
    text: str
    took_s: float
    body: bytes


class ModelProbe:
    """Probes a model of a server every ``interval_s``, or less often if it takes long to answer.

    hang_s: how long a model may answer nobody before it counts as hung
    observe: takes how long each answer took
    """

    def __init__(
        self, http: Http, model: str, interval_s: float, hang_s: float, observe: Callable[[float], None]
    ) -> None:
        self._http = http
        self._model = model
        self._interval_s = interval_s
        self._hang_s = hang_s
        self._observe = observe
        self.renew()

    def renew(self) -> None:
        """Forgets what it knows: the model's processes are others, and their probe is sent at once."""
        self._known: Event | None = None
        self._probes: Calls[Reply] = Calls(f"rfm-probe-{self._model}", NO_ANSWER)
        self._body: bytes | None = None
        self._due_s = time.monotonic()
        self._waiting_since_s: float | None = None
        self._stats: Calls[list[int]] = Calls(f"rfm-stats-{self._model}", NO_ANSWER)
        self._successes: list[int] | None = None  # requests that each version has answered
        self._last_success_s = -math.inf  # when they were last seen to grow
        self._has_stats = False  # else Triton gives no answer; the model may
        self._took_s: deque[float] = deque(maxlen=_KEPT)
        self._num_failures: int | None = None  # in a row; None: it has never answered as it should

    def look(self) -> Event | None:
        """What is known of the model now; None: nothing yet. Sends the next probe when it is due."""
        if (probe := self._probes.ended()) is not None:
            self._take(probe)
            self._due_s = time.monotonic() + max(self._interval_s, min(self._took_s, default=0.0) / SHARE)
        if not self._probes.is_under_way and time.monotonic() >= self._due_s:
            self._waiting_since_s = self._waiting_since_s or time.monotonic()
            self._probes.begin(self._send_probe)
        if self._waiting_since_s is not None and time.monotonic() - self._waiting_since_s > LATE_S / 2:
            self._look_at_stats()
        return self._judged()

    def _judged(self) -> Event | None:
        if self._waiting_since_s is None or self._known in (Event.DEAD, Event.BROKEN):
            return self._known
        waited_s = time.monotonic() - max(self._waiting_since_s, self._last_success_s)
        slowest_s = LATE_FACTOR * max(self._took_s, default=0.0)
        if waited_s > max(self._hang_s, slowest_s) and self._has_stats:
            return Event.HUNG
        return Event.LATE if waited_s > max(LATE_S, slowest_s) else self._known

    def _look_at_stats(self) -> None:
        """Reads Triton's counts of answered requests: a model that answers others is not hung."""
        if (stats := self._stats.ended()) is not None:
            self._has_stats = stats.exception() is None
            if self._has_stats:
                successes = stats.result()
                if self._successes not in (None, successes):
                    self._last_success_s = time.monotonic()
                self._successes = successes
        if not self._stats.is_under_way:
            self._stats.begin(self._read_stats)

    def _read_stats(self) -> list[int]:
        """Answered requests of each version, as Triton counts them. Runs in a thread of its own."""
        versions = self._http.get_json(f"/v2/models/{self._model}/stats")["model_stats"]
        return [version["inference_stats"]["success"].get("count", 0) for version in versions]

    def _send_probe(self) -> Reply:
        """The reply to one probe, and how long it took. Runs in a thread of its own."""
        started_s = time.monotonic()
        body = self._body or self._request()
        status, text = self._http.request("POST", f"/v2/models/{self._model}/infer", self._hang_s * 2, body)
        return Reply(status, text, time.monotonic() - started_s, body)

    def _take(self, probe: Future[Reply]) -> None:
        """Records a reply. Without one, or with one that is not the model's, the probe stays open."""
        if probe.exception() is not None:
            return
        reply = probe.result()
        self._body = reply.body
        known = self._event_of(reply)
        if known is not None:
            self._known, self._waiting_since_s, self._has_stats = known, None, False
            self._took_s.append(reply.took_s)
            self._observe(reply.took_s)

    def _event_of(self, reply: Reply) -> Event | None:
        failed = reply.status >= HTTPStatus.INTERNAL_SERVER_ERROR
        if triton.PROCESS_ENDED in reply.text and failed:
            return Event.DEAD
        if triton.is_absent(reply.text) and reply.status != HTTPStatus.OK:
            return Event.ABSENT
        if reply.status == HTTPStatus.SERVICE_UNAVAILABLE:
            return None  # its queue is full, or it was not its turn in time
        if not failed:
            self._num_failures = 0
            return Event.ANSWERED
        if self._num_failures is None:
            return Event.ANSWERED  # it answers; blank frames need not give a readable answer
        self._num_failures += 1
        return Event.BROKEN if self._num_failures >= BROKEN_COUNT else Event.ANSWERED

    def _request(self) -> bytes:
        config = self._http.get_json(f"/v2/models/{self._model}/config")
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
        return json.dumps({"id": f"{PROBE_PREFIX}-{self._model}", "inputs": inputs, "outputs": outputs}).encode()


def can_be_probed(config: Mapping[str, Any]) -> bool:
    """Whether a model, of which this is the configuration, is one of ours that has processes of its own."""
    names = {tensor["name"] for tensor in config["input"]}
    return config.get("backend") == "python" and wire.NUM_FRAMES in names
