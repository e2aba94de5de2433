# SPDX-License-Identifier: MIT
"""The models of a Triton that runs: which there are, which of them are ready, and healing for those that are not."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from rfm.supervise.canary import Canary, can_be_asked
from rfm.supervise.healing import ModelHealth, Reload
from rfm.supervise.http import Http
from rfm.supervise.inquiry import Config, Inquiry, Told
from rfm.supervise.process import TritonServer
from rfm.supervise.repository_api import LOADING, READY, UNLOADING
from rfm.supervise.status import NO_REASON, Status
from rfm.supervise.stubs import StubWatch

LOOK_INTERVAL_S = 0.3
UNREADABLE = "its configuration cannot be read"
NOT_LOADED = "it is not loaded"
SILENT = "tritonserver gives no answer"


class Served:
    """Looks after the models of a server that is ready, be they loaded at its start or later.

    canary_s, hang_s, triton_silent_s, say: as Supervisor has them
    restored: configurations of models that the server has not loaded and is to serve
    """

    def __init__(
        self,
        server: TritonServer,
        status: Status,
        *,
        canary_s: float,
        hang_s: float,
        triton_silent_s: float,
        say: Callable[[str], None],
        restored: Mapping[str, Config],
    ) -> None:
        self._server = server
        self._status = status
        self._canary_s = canary_s
        self._hang_s = hang_s
        self._http = Http(server.endpoints.http_host, server.endpoints.http_port)
        self._watch = StubWatch(server.pid, hang_s)
        self._inquiry = Inquiry(server, triton_silent_s)
        self._told: Told | None = None
        self._say = say
        self._models = dict(restored)
        self._health: dict[str, ModelHealth] = {}  # of those that have processes of ours
        self._leaving: set[str] = set()
        self._looked_s = 0.0
        self._num_refused: dict[int, int] = {}  # by process
        self._killed: dict[int, str] = {}  # processes that hung, and how
        # Those of ``restored`` that have none, ensembles say, and are not loaded yet.
        self._owed = {model: config for model, config in restored.items() if not can_be_asked(config)}
        self._reloads: dict[str, Reload] = {}  # of some of them
        for model in restored.keys() - self._owed.keys():
            self._health[model] = self._healthy(model)
            self._health[model].restore(restored[model])
        self._inquiry.start()

    @property
    def is_silent(self) -> bool:
        """Whether Triton itself does not answer."""
        return self._inquiry.is_silent

    @property
    def configs(self) -> dict[str, Config] | None:
        """Of what is served, or should be; None: that is not known yet."""
        return dict(self._models) if self._models or self._told is not None else None

    def look(self) -> list[tuple[str, str]]:
        """Heals what needs to be, and tells which models, and why."""
        told = self._inquiry.told
        if told is None or time.monotonic() - self._looked_s < LOOK_INTERVAL_S:
            return []
        self._looked_s = time.monotonic()
        if told is not self._told:
            self._told = told
            self._watch.tell(told.in_state(READY), told.in_state(LOADING, UNLOADING), told.asked_s)
            self._keep_up(told)
            self._load_owed(told)
        died = {stub.model: self._killed.pop(stub.pid, "its process is dead") for stub in self._watch.dead()}
        for stub, how in self._watch.hung():
            if stub.model in self._health:
                self._killed[stub.pid] = how
                stub.kill()
        healed = [
            (model, why)
            for model, health in self._health.items()
            if (why := health.look(died.get(model), self._models[model]))
        ]
        self._count_refused()
        unreadable = dict.fromkeys(told.unreadable, UNREADABLE)
        reasons = {model: self._reason(model, told) for model in self._models} | unreadable
        self._status.tell(reasons if self._inquiry.is_answered else dict.fromkeys(reasons, SILENT))
        return healed

    def close(self) -> None:
        """Looks after them no more."""
        self._inquiry.close()
        for health in self._health.values():
            health.close()
        for reload in self._reloads.values():
            reload.close()

    def _keep_up(self, told: Told) -> None:
        """Takes in what was loaded, and leaves out what somebody unloaded, once that was seen twice in a row."""
        for model, config in told.configs.items():
            if told.is_unloaded(model):
                continue
            if model not in self._models:
                self._status.restarts.labels(model)  # 0, so that already the first is an increase
            self._models[model] = config
            if model not in self._health and can_be_asked(config):
                self._health[model] = self._healthy(model)
            if model in self._health and model in told.ready:
                self._health[model].tell_ready(told.asked_s)
        leaving = {model for model in self._models if self._is_unloaded(model, told)}
        for model in leaving & self._leaving:
            del self._models[model]
            if model in self._health:
                self._health.pop(model).close()
        self._leaving = leaving

    def _load_owed(self, told: Told) -> None:
        """Loads an ensemble when its parts are ready."""
        for model, config in list(self._owed.items()):
            if model in told.ready:
                del self._owed[model]
            elif model not in self._reloads and all(told.has(*part) for part in _parts(config)):
                self._reloads[model] = Reload(model, self._server, self._watch, lambda: None, self._say)
                self._reloads[model].begin("tritonserver was started again", config, is_out=True)

    def _is_unloaded(self, model: str, told: Told) -> bool:
        """Whether somebody wanted that. Triton says the same of what is loaded anew, and of what that is a part of."""
        if model in self._owed:
            return False
        if model in self._health and self._health[model].is_healing:
            return False
        parts = _parts(self._models[model])
        return told.is_unloaded(model) and all(told.has(*part) or part[0] not in self._models for part in parts)

    def _healthy(self, model: str) -> ModelHealth:
        canary = Canary(
            self._http, model, self._canary_s, self._hang_s, self._status.canary_seconds.labels(model).observe
        )
        canary.start()
        return ModelHealth(self._server, canary, self._watch, self._status, self._say)

    def _reason(self, model: str, told: Told) -> str:
        """Why it is not ready. An ensemble has to be, and all its parts."""
        if model in self._health:
            return self._health[model].reason
        if model not in self._models:
            return NOT_LOADED
        if model in self._reloads and self._reloads[model].is_active:
            return self._reloads[model].reason
        parts = dict.fromkeys(part for part, _ in _parts(self._models[model]))
        reasons = [f"{part}: {why}" for part in parts if (why := self._reason(part, told)) != NO_REASON]
        if reasons:
            return "; ".join(reasons)
        return NO_REASON if model in told.ready else NOT_LOADED

    def _count_refused(self) -> None:
        for stub in self._watch.all:
            journal = stub.journal
            if journal is not None:
                self._status.poison_refused.inc(journal.num_refused - self._num_refused.get(stub.pid, 0))
                self._num_refused[stub.pid] = journal.num_refused


def _parts(config: Config) -> list[tuple[str, int]]:
    """Models and versions of an ensemble."""
    steps = config.get("ensemble_scheduling", {}).get("step", ())
    return [(step["model_name"], int(step["model_version"])) for step in steps]
