# SPDX-License-Identifier: MIT
"""The models of a Triton that runs: which of them are ready, and healing for those that are not."""

from __future__ import annotations

import time

from rfm.server.canary import Canary, can_be_asked
from rfm.server.healing import ModelHealth
from rfm.server.http import Http
from rfm.server.process import TritonServer
from rfm.server.status import READY, Status
from rfm.server.stubs import StubWatch

LOOK_INTERVAL_S = 0.3
CONFIG_TIMEOUT_S = 10.0


class Served:
    """Looks after the models of a server that is ready.

    canary_s, hang_s: as Supervisor has them
    """

    def __init__(self, server: TritonServer, status: Status, canary_s: float, hang_s: float) -> None:
        self._server = server
        self._status = status
        self._http = Http(server.endpoints.http_host, server.endpoints.http_port)
        self._hang_s = hang_s
        self._watch = StubWatch(server.pid, hang_s)
        self._looked_s = 0.0
        self._num_refused: dict[int, int] = {}  # by process
        self._killed: dict[int, str] = {}  # processes that hung, and how
        configs = {name: self._http.get_json(f"/v2/models/{name}/config", CONFIG_TIMEOUT_S) for name in server.models}
        self._ensembles = {
            name: [step["model_name"] for step in config["ensemble_scheduling"]["step"]]
            for name, config in configs.items()
            if "ensemble_scheduling" in config
        }
        self._models = [self._health(name, canary_s) for name, config in configs.items() if can_be_asked(config)]

    def look(self) -> list[tuple[str, str]]:
        """Heals what needs to be, and tells which models, and why. Raises CrashLoopError."""
        if time.monotonic() - self._looked_s < LOOK_INTERVAL_S:
            return []
        self._looked_s = time.monotonic()
        died = {stub.model: self._killed.pop(stub.pid, "its process is dead") for stub in self._watch.dead()}
        for stub, how in self._watch.hung():
            self._killed[stub.pid] = how
            stub.kill()
        healed = [(model.model, why) for model in self._models if (why := model.look(died.get(model.model)))]
        for model in self._models:
            if model.crash_loop is not None:
                raise model.crash_loop
        self._count_refused()
        self._status.tell(self._reasons())
        return healed

    def close(self) -> None:
        """Looks after them no more."""
        for model in self._models:
            model.close()

    def _health(self, name: str, canary_s: float) -> ModelHealth:
        canary = Canary(self._http, name, canary_s, self._hang_s, self._status.canary_seconds.labels(name).observe)
        canary.start()
        return ModelHealth(self._server, canary, self._watch, self._status)

    def _reasons(self) -> dict[str, str]:
        """By model why it is not ready. An ensemble is as ready as its parts."""
        reasons = {model.model: model.reason for model in self._models}
        for name, parts in self._ensembles.items():
            reasons[name] = "; ".join(f"{part}: {reasons[part]}" for part in parts if reasons.get(part, READY) != READY)
        return reasons

    def _count_refused(self) -> None:
        for stub in self._watch.all:
            journal = stub.journal
            if journal is not None:
                self._status.poison_refused.inc(journal.num_refused - self._num_refused.get(stub.pid, 0))
                self._num_refused[stub.pid] = journal.num_refused
