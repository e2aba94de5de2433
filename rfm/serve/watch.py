# SPDX-License-Identifier: MIT
"""Watch a running Triton: its served models, their readiness, and faults (docs/explanation/faults.md).

A silent Triton answers no ``/metrics``; ``ModelProcesses`` finds dead and stopped processes; a ``Probe`` finds a model
that hangs outside a batch, or whose requests fail before they reach model.py.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from functools import partial
from urllib.parse import quote

from rfm.serve.probe import NO_ANSWER, Http, Probe, can_be_probed
from rfm.serve.processes import ModelProcesses
from rfm.serve.repository import Config
from rfm.serve.repository_api import INDEX_PATH, LOADING, UNLOADING, ModelVersion, versions_of
from rfm.serve.status import NO_REASON
from rfm.serve.triton_server import TritonServer
from rfm_client.contract.description import num_instances

LOOK_S = 0.5
LOOKS = 3  # in a row without an answer, before Triton counts as silent
_TIMEOUT_S = 1.5
_INDEX_TIMEOUT_S = 5.0
_PROGRESS = re.compile(  # counters that grow while a model makes progress
    r'^(?P<series>(?:nv_inference_request_success|rfm_forward_passes_total)\{[^}]*\bmodel="(?P<model>[^"]+)".*\}) '
    r"(?P<count>\S+)$",
    re.MULTILINE,
)
TRITON = "triton"
logger = logging.getLogger(__name__)


class TritonWatch:
    """Looks at Triton every LOOK_S in its own thread, until ``close``.

    probe_s: seconds between a model's probes
    silent_s: a Triton without a response for this long counts as silent
    served: configurations of the models to serve; the watch adds those it finds
    """

    def __init__(self, server: TritonServer, *, probe_s: float, silent_s: float, served: Mapping[str, Config]) -> None:
        self._http = server.http
        self._metrics = Http(server.endpoints.host, server.endpoints.metrics_port)
        self._new_probe = partial(Probe, self._http, interval_s=probe_s, hang_s=server.hang_s)
        self._silent_s = silent_s
        self._processes = ModelProcesses(server.pid)
        self._probes: dict[str, Probe] = {}
        self._counts: dict[str, str] = {}  # by series
        self._progress_s: dict[str, float] = {}  # when a model last made progress
        self._ready: dict[str, list[int]] = {}  # ready versions by model
        self._seen: dict[str, list[int]] | None = None  # ready versions at the look before
        self._going: set[str] = set()  # models that are loading or unloading
        self._wanted: dict[str, int] = {}  # process count by model; excludes models that are loading
        self._leaving: set[str] = set()
        self.served = dict(served)
        self.reasons: dict[str, str] = dict.fromkeys(served, "it is loading")
        self.fault: tuple[str, str] | None = None  # the model, or TRITON, and the reason
        self.is_of_load = False  # True: the fault is in a load, which somebody asked for
        self._closed = threading.Event()
        threading.Thread(target=self._run, name="rfm-watch", daemon=True).start()

    def close(self) -> None:
        """Stop the looks and the probes."""
        self._closed.set()

    def _run(self) -> None:
        try:
            self._look()
        finally:
            for probe in self._probes.values():
                probe.close()

    def _look(self) -> None:
        num_failed, answered_s = 0, time.monotonic()
        while not self._closed.wait(LOOK_S) and self.fault is None:
            try:
                _, text = self._metrics.request("GET", "/metrics", min(_TIMEOUT_S, self._silent_s / LOOKS))
            except NO_ANSWER:
                num_failed += 1
                self.reasons = dict.fromkeys(self.served, f"{TRITON} gives no answer")
                if num_failed >= LOOKS and time.monotonic() - answered_s >= self._silent_s:
                    self.fault = TRITON, f"no answer for {self._silent_s:g} s"
                continue
            num_failed, answered_s = 0, time.monotonic()
            try:
                self._note_progress(text)
                with suppress(*NO_ANSWER):  # a load may block Triton's HTTP threads
                    self._keep_up()
                self.fault = self._dead() or self._probed()
            except Exception:  # the next look may succeed; without looks, no fault leads to a restart
                logger.exception("an unexpected error")

    def _note_progress(self, metrics: str) -> None:
        for match in _PROGRESS.finditer(metrics):
            if match["count"] != self._counts.get(match["series"]):
                self._counts[match["series"]], self._progress_s[match["model"]] = match["count"], time.monotonic()

    def _dead(self) -> tuple[str, str] | None:
        found = self._processes.fault(self._wanted, is_settled=not self._going)
        if found is None:
            return None
        loading = next(iter(self._going)) if len(self._going) == 1 else TRITON
        self.is_of_load = (found[0] or loading) in self._going
        return found[0] or loading, found[1]

    def _probed(self) -> tuple[str, str] | None:
        probed = {name: probe.fault(self._progress_s.get(name, 0.0)) for name, probe in self._probes.items()}
        return next(((name, why) for name, why in probed.items() if why is not None), None)

    def _keep_up(self) -> None:
        """Read Triton's index. Raises NO_ANSWER."""
        timeout_s = min(_INDEX_TIMEOUT_S, self._silent_s / LOOKS)  # a silent Triton must not look like a hung model
        versions = versions_of(self._http.json(INDEX_PATH, timeout_s, "POST"))
        ready = {entry.name: list[int]() for entry in versions}
        for entry in versions:
            if entry.is_ready:
                ready[entry.name].append(entry.version or 1)
        loading = {entry.name for entry in versions if entry.state == LOADING}
        self._going = loading | {entry.name for entry in versions if entry.state == UNLOADING}
        for model in ready:
            self._keep_up_with(model, ready[model])
        self._log_changes()
        unloaded = ready.keys() - {entry.name for entry in versions if not entry.is_unloaded}
        for model in unloaded & self._leaving:
            self.served.pop(model, None)
        self._leaving = unloaded
        known = [model for model in ready.keys() - loading if model in self.served or not ready[model]]
        self._wanted = {model: len(ready[model]) * num_instances(self.served.get(model, {})) for model in known}
        self.reasons = {name: self._reason(name, versions) for name in self.served}

    def _keep_up_with(self, model: str, ready: list[int]) -> None:
        """If a model's ready versions have changed, record its configuration and probe it."""
        if not ready:
            self._forget(model)
        elif model not in self._going and ready != self._ready.get(model):
            path = f"/v2/models/{quote(model, safe='')}/versions/{max(ready)}/config"
            self.served[model] = {**self._http.json(path), "version_policy": {"specific": {"versions": [*ready]}}}
            before = self._probes.get(model)
            self._forget(model)
            if can_be_probed(self.served[model]):
                self._probes[model] = self._new_probe(model)
                known = before is not None and before.has_answered
                self._probes[model].has_answered = known  # a reloaded model stays ready
            self._ready[model] = ready

    def _log_changes(self) -> None:
        ready = dict(self._ready)
        before, self._seen = ready if self._seen is None else self._seen, ready
        for model in sorted(before.keys() | ready.keys()):
            was, now = before.get(model, []), ready.get(model, [])
            if was != now and not (was and {*was} < {*now}):  # in a rollout, both for a moment
                logger.info("%s: serves version %s (before: %s)", model, *(_listed(each) for each in (now, was)))

    def _forget(self, model: str) -> None:
        """Stop probing a model that was reloaded or unloaded."""
        self._ready.pop(model, None)
        if model in self._probes:
            self._probes.pop(model).close()

    def _reason(self, model: str, versions: Collection[ModelVersion]) -> str:
        """Return why the model is not ready, or NO_REASON."""
        if model not in self._ready:
            stated = [entry.reason for entry in versions if entry.name == model and entry.reason]
            return next(iter(stated), "it is not loaded")
        probe = self._probes.get(model)
        if probe is not None and not probe.has_answered:
            return "it has not answered a probe yet"
        steps = self.served[model].get("ensemble_scheduling", {}).get("step", [])
        parts = [step["model_name"] for step in steps if step["model_name"] in self.served]
        reasons = {part: self._reason(part, versions) for part in parts}
        return next((f"{part}: {reason}" for part, reason in reasons.items() if reason != NO_REASON), NO_REASON)


def _listed(versions: Collection[int]) -> str:
    return ", ".join(map(str, versions)) or "none"
