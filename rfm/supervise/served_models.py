# SPDX-License-Identifier: MIT
"""The models of a Triton that runs: which there are, which of them are ready, and healing for those that are not.

What is watched, and the fault that no other watch sees:

| watch | the fault that it alone sees |
|---|---|
| Triton's exit status (``supervisor``) | Triton has ended |
| Triton's endpoints ``/v2`` and ``/metrics`` (``TritonWatch``) | Triton lives and does nothing |
| Triton's repository index (``TritonWatch``) | somebody has loaded or unloaded a model; an ensemble is not ready |
| zombies among Triton's children (``ProcessWatch``) | one of several processes is dead: probes go to the others |
| stopped children (``ProcessWatch``) | one of several processes is stopped (SIGSTOP) while it is idle |
| the journals of model processes (``ProcessWatch``) | one of several processes hangs in a forward pass |
| a probe of each model (``ModelProbe``): no answer | a process hangs between two batches, which no journal shows |
| a probe: "is not healthy" | a dead process that Triton has reaped, so that it is no zombie |
| a probe: failures in a row | requests fail before they reach ``model.py``, in Triton's Python backend |
| the self check in each process (``rfm.triton_model``) | one of several processes fails at every request |

All of this is looked at in one thread, which feeds each model's lifecycle. What may wait runs in the background.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial

from rfm.launch.http import Http
from rfm.launch.process import TritonServer
from rfm.launch.repository_api import LOADING, READY, UNLOADING
from rfm.supervise.model_probe import ModelProbe, can_be_probed
from rfm.supervise.model_processes import ModelProcess, ProcessWatch
from rfm.supervise.model_states import State
from rfm.supervise.model_watch import ModelWatch
from rfm.supervise.status import NO_REASON, Status
from rfm.supervise.triton_watch import Config, Snapshot, TritonWatch

LOOK_INTERVAL_S = 0.3
UNREADABLE = "its configuration cannot be read"
NOT_LOADED = "it is not loaded"
SILENT = "tritonserver gives no answer"


class ServedModels:
    """Looks after the models of a server that is ready, be they loaded at its start or later.

    say, canary_s, hang_s, triton_silent_s: as Supervisor has them
    restored: configurations of models that the server has not loaded and is to serve
    """

    def __init__(
        self,
        server: TritonServer,
        status: Status,
        say: Callable[[str], None],
        *,
        canary_s: float,
        hang_s: float,
        triton_silent_s: float,
        restored: Mapping[str, Config],
    ) -> None:
        self._server = server
        self._status = status
        self._say = say
        http = Http(server.endpoints.http_host, server.endpoints.http_port)
        self._new_probe = partial(ModelProbe, http, interval_s=canary_s, hang_s=hang_s)
        self._processes = ProcessWatch(server.pid, hang_s)
        self._triton = TritonWatch(server, triton_silent_s)
        self._snapshot: Snapshot | None = None  # the latest that was taken in
        self._configs = dict(restored)
        self._models: dict[str, ModelWatch] = {}  # those that are probed, and what was restored
        self._leaving: set[str] = set()
        self._looked_s = 0.0
        self.owing: str | None = None  # how a process has died that owed answers, by the last look
        self._num_refused: dict[ModelProcess, int] = {}
        self._killed: dict[int, str] = {}  # processes that hung, and how
        for name, config in restored.items():
            self._models[name] = self._new_model(name, config)
            if self._models[name].is_probed:
                self._models[name].restore(config)

    @property
    def is_silent(self) -> bool:
        """Whether Triton itself does not answer."""
        return self._triton.is_silent

    def _find_owing(self) -> str | None:
        """How a process has died whose callers still wait for answers; None: none has.

        Triton 2.51 never tells them, even when the model is loaded anew. They know when Triton ends.
        """
        for process in self._processes.dead():
            journal = process.journal
            if journal is not None and journal.num_owed:
                return f"a process of {process.model} is dead, and owes {journal.num_owed} answers"
        return next((model.owing for model in self._models.values() if model.owing), None)

    @property
    def configs(self) -> dict[str, Config] | None:
        """The configurations of what is served, or should be; None: they are not known yet."""
        return dict(self._configs) if self._configs or self._snapshot is not None else None

    def look(self) -> list[tuple[str, str]]:
        """Heals the models that need it. Gives those that are healed from now on, and why."""
        if time.monotonic() - self._looked_s < LOOK_INTERVAL_S:
            return []
        self._looked_s = time.monotonic()
        self._triton.look()
        snapshot = self._triton.snapshot
        if snapshot is None:
            return []
        if snapshot is not self._snapshot:
            self._snapshot = snapshot
            ready, going = snapshot.in_state(READY), snapshot.in_state(LOADING, UNLOADING)
            self._processes.update(ready, going, snapshot.requested_s)
            self._keep_up(snapshot)
        self.owing = self._find_owing()
        if self.owing is not None:
            return []
        died = self._died()
        looks = [(name, model.look(died.get(name), self._configs[name])) for name, model in self._models.items()]
        self._count_refused()
        self._record(snapshot)
        return [(name, why) for name, why in looks if why is not None]

    def close(self) -> None:
        """Ends the care for all models, which stay as they are."""
        for model in self._models.values():
            model.close()

    def _died(self) -> dict[str, str]:
        """How a process of each model has died. A hanging one is killed, and found dead by the next look."""
        dead = self._processes.dead()
        died = {process.model: self._killed.pop(process.pid, "its process is dead") for process in dead}
        for process, how in self._processes.hung():
            if process.model in self._models:
                self._killed[process.pid] = how
                process.kill()
        return died

    def _keep_up(self, snapshot: Snapshot) -> None:
        """Adds models that were loaded, and drops those that two looks in a row saw unloaded."""
        for name, config in snapshot.configs.items():
            if snapshot.is_unloaded(name):
                continue
            if name not in self._configs:
                self._status.restarts.labels(name)  # 0, so that already the first is an increase
            self._configs[name] = config
            if name not in self._models and can_be_probed(config):
                self._models[name] = self._new_model(name, config)
            if name in self._models and name in snapshot.ready:
                self._models[name].record_ready(snapshot.requested_s)
        leaving = {name for name in self._configs if self._is_unloaded(name, snapshot)}
        for name in leaving & self._leaving:
            del self._configs[name]
            if name in self._models:
                self._models.pop(name).close()
        self._leaving = leaving
        for name, model in self._models.items():
            config = self._configs[name]
            if model.state is State.WAITING and all(snapshot.has(*part) for part in _parts(config)):
                model.restore(config)

    def _is_unloaded(self, name: str, snapshot: Snapshot) -> bool:
        """Whether somebody unloaded the model. Triton says the same of a model that is loaded anew, and of its
        ensembles.
        """
        model = self._models.get(name)
        if model is not None and (model.is_healing or (not model.is_probed and model.state is not State.READY)):
            return False
        parts = _parts(self._configs[name])
        return snapshot.is_unloaded(name) and all(snapshot.has(*p) or p[0] not in self._configs for p in parts)

    def _new_model(self, name: str, config: Config) -> ModelWatch:
        probe = None
        if can_be_probed(config):
            probe = self._new_probe(name, observe=self._status.probe_seconds.labels(name).observe)
        return ModelWatch(name, probe, self._server, self._processes, self._status, self._say)

    def _record(self, snapshot: Snapshot) -> None:
        reasons = {name: self._reason(name, snapshot) for name in self._configs}
        reasons |= dict.fromkeys(snapshot.unreadable, UNREADABLE)
        self._status.record(reasons if self._triton.is_answered else dict.fromkeys(reasons, SILENT))

    def _reason(self, name: str, snapshot: Snapshot) -> str:
        """Why a model is not ready. An ensemble is ready when it and all its parts are."""
        model = self._models.get(name)
        if model is not None and (model.is_healing or model.is_probed):
            return model.reason
        if name not in self._configs:
            return NOT_LOADED
        parts = dict.fromkeys(part for part, _ in _parts(self._configs[name]))
        reasons = [f"{part}: {why}" for part in parts if (why := self._reason(part, snapshot)) != NO_REASON]
        if reasons:
            return "; ".join(reasons)
        return NO_REASON if name in snapshot.ready else NOT_LOADED

    def _count_refused(self) -> None:
        for process in self._processes.all:
            journal = process.journal
            if journal is not None:
                self._status.poison_refused.inc(journal.num_refused - self._num_refused.get(process, 0))
                self._num_refused[process] = journal.num_refused


def _parts(config: Config) -> list[tuple[str, int]]:
    """Models and versions that an ensemble is made of."""
    steps = config.get("ensemble_scheduling", {}).get("step", ())
    return [(step["model_name"], int(step["model_version"])) for step in steps]
