# SPDX-License-Identifier: MIT
"""One model of a running Triton: asked, watched, and loaded anew when its processes are dead or hung."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

from rfm.server.canary import Canary, Verdict
from rfm.server.inquiry import Config
from rfm.server.process import TritonServer
from rfm.server.repository_api import RepositoryApi, RepositoryApiError
from rfm.server.restarts import CrashLoopError, Restarts
from rfm.server.status import NO_REASON, Status
from rfm.server.stubs import Stub, StubWatch

DRAIN_S = 2.0  # for what the model's other processes are working on
POLL_S = 0.1
JUDGE_INTERVAL_S = 0.5

_HEALED = {Verdict.HUNG, Verdict.DEAD, Verdict.BROKEN}


class ModelHealth:
    """Keeps one model answering. Whether Triton runs is another's business.

    watch: of the server's model processes
    """

    def __init__(self, server: TritonServer, canary: Canary, watch: StubWatch, status: Status) -> None:
        self.model = canary.model
        self._server = server
        self._canary = canary
        self._watch = watch
        self._status = status
        self._restarts = Restarts(f"model {self.model}")
        self._restarts.started()
        self._healing: threading.Thread | None = None
        self._closed = threading.Event()
        self._judged_s = 0.0
        self._verdict = Verdict.UNKNOWN
        self._trouble = ""  # why it was not loaded
        self._is_out = False  # it was unloaded, and not loaded since
        self.crash_loop: CrashLoopError | None = None

    def close(self) -> None:
        """Asks it no more, and leaves it as it is."""
        self._closed.set()
        self._canary.stop()

    @property
    def reason(self) -> str:
        """Why it is not ready; NO_REASON if it is."""
        if self.is_healing:
            return f"it is loaded anew{f', after: {self._trouble}' if self._trouble else ''}"
        return NO_REASON if self._verdict is Verdict.LIVE else self._verdict.value

    @property
    def is_healing(self) -> bool:
        """Whether it is loaded anew."""
        return self._healing is not None and self._healing.is_alive()

    def look(self, died: str | None, config: Config) -> str | None:
        """Heals the model if need be, in a thread, and then tells why.

        died: how one of its processes has
        config: of what it served when it was last ready
        """
        if self.is_healing:
            return None
        if time.monotonic() - self._judged_s >= JUDGE_INTERVAL_S:
            self._verdict, self._judged_s = self._canary.verdict(), time.monotonic()
            if self._verdict is Verdict.HUNG and self._watch.is_getting_on(self.model):
                self._verdict = Verdict.LATE  # the canary waits behind a long batch
            self._status.tell_canary(self.model, is_ok=self._verdict is Verdict.LIVE)
        if died is None and self._verdict not in _HEALED:
            return None
        why = died or self._verdict.value
        self._status.tell_canary(self.model, is_ok=False)
        self._healing = threading.Thread(
            target=self._heal, args=(why, config), name=f"rfm-heal-{self.model}", daemon=True
        )
        self._healing.start()
        return why

    def _heal(self, why: str, config: Config) -> None:
        """Returns when the model is loaded anew: just what it served before, whatever its configuration file says."""
        served: Config | None = None
        self._trouble, self._is_out = "", False
        while True:
            try:
                if self._closed.wait(self._restarts.pause_s(self._trouble or why)):
                    return
                with RepositoryApi(self._server.endpoints.http_url, self._server.admin_key) as api:
                    served = served or self._served(api, config)
                    if served is not None:  # else somebody has unloaded it meanwhile
                        self._reload(api, served)
                break
            except RepositoryApiError as error:
                self._trouble = str(error)
            except CrashLoopError as error:
                self.crash_loop = error
                return
        self._restarts.started()
        self._verdict = Verdict.UNKNOWN
        self._canary.reset()

    def _served(self, api: RepositoryApi, last: Config) -> Config | None:
        """The configuration of the versions that it serves, and of no others: a rollout may have changed its file."""
        versions = [entry for entry in api.index() if entry.name == self.model]
        ready = [entry.version for entry in versions if entry.is_ready and entry.version is not None]
        if not ready:
            return None if all(entry.is_unloaded for entry in versions) else last
        return {**api.config(self.model, max(ready)), "version_policy": {"specific": {"versions": ready}}}

    def _reload(self, api: RepositoryApi, served: Config) -> None:
        """Ensembles that the model is a part of are unloaded and loaded with it, as they were."""
        if self._is_out and any(entry.is_ready for entry in api.index() if entry.name == self.model):
            return  # somebody has loaded it meanwhile
        if not self._is_out:
            old = self._watch.of_model(self.model)
            api.unload(self.model)
            self._is_out = True
            self._end(old)
        if not self._closed.is_set():  # else Triton may be another
            # Triton 2.51 never finishes to unload a model of which a request met a dead process. A load does not mind.
            api.load(self.model, served)

    def _end(self, old: Sequence[Stub]) -> None:
        """Returns when none of them lives: not even those that Triton keeps, with their share of a GPU's memory."""
        deadline_s = time.monotonic() + DRAIN_S
        while any(stub.is_alive for stub in old) and time.monotonic() < deadline_s:
            time.sleep(POLL_S)
        for stub in old:
            if stub.is_alive:
                stub.kill()
                if self._verdict is not Verdict.HUNG and stub.journal is not None:
                    stub.journal.close()  # what it was working on is not why it ends
        self._watch.bury(old)
