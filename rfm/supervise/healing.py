# SPDX-License-Identifier: MIT
"""One model of a running Triton: asked, watched, and loaded anew when its processes are dead or hung."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

from rfm.supervise.canary import Canary, Verdict
from rfm.supervise.inquiry import Config, serving_just
from rfm.supervise.process import TritonServer
from rfm.supervise.repository_api import RepositoryApi, RepositoryApiError
from rfm.supervise.restarts import CrashLoopError, Restarts
from rfm.supervise.status import NO_REASON, Status
from rfm.supervise.stubs import Stub, StubWatch

DRAIN_S = 2.0  # for what the model's other processes are working on
POLL_S = 0.1
JUDGE_INTERVAL_S = 0.5
RETRY_S = 300.0  # after so many failures in a row that they are a crash loop

_SLOW = {Verdict.LATE, Verdict.HUNG}
_READY = {Verdict.LIVE, Verdict.BUSY}
_HEALED = {Verdict.HUNG, Verdict.DEAD, Verdict.BROKEN}


class Reload:
    """Loads one model anew, in a thread, until it is loaded: with the configuration that it served before.

    done: called when it is loaded, or somebody has loaded or unloaded it meanwhile
    say: is told that it fails again and again
    """

    def __init__(
        self, model: str, server: TritonServer, watch: StubWatch, done: Callable[[], None], say: Callable[[str], None]
    ) -> None:
        self._model = model
        self._server = server
        self._watch = watch
        self._done = done
        self._say = say
        self._restarts = Restarts(f"model {model}")
        self._restarts.started()
        self._thread: threading.Thread | None = None
        self._wakes = threading.Event()
        self._closed = False
        self._served: Config | None = None
        self._out_since_s: float | None = None  # it was unloaded then, and not loaded since
        self._trouble = ""  # why it was not loaded
        self._is_crash_loop = False

    def begin(self, why: str, config: Config, *, is_out: bool = False, was_hung: bool = False) -> None:
        """Starts it.

        config: of what it served when it was last ready
        is_out: it is not loaded now
        was_hung: its processes are killed for what they are working on
        """
        self._trouble, self._is_crash_loop = "", False
        self._served = config if is_out else None
        self._out_since_s = time.monotonic() if is_out else None
        self._wakes.clear()
        name = f"rfm-heal-{self._model}"
        self._thread = threading.Thread(target=self._run, args=(why, config, was_hung), name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leaves it as it is."""
        self._closed = True
        self._wakes.set()

    def tell_ready(self, asked_s: float) -> None:
        """The model was ready at ``asked_s``: somebody may have loaded it."""
        if self._out_since_s is not None and asked_s > self._out_since_s:
            self._wakes.set()

    @property
    def is_active(self) -> bool:
        """Whether it is not loaded yet."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def reason(self) -> str:
        """Why it is not ready."""
        after = f", after: {self._trouble}" if self._trouble else ""
        if self._is_crash_loop:
            return f"it is loaded anew every {RETRY_S / 60:g} minutes{after}"
        return f"it is loaded anew{after}"

    def _run(self, why: str, config: Config, was_hung: bool) -> None:
        while True:
            pause_s = self._pause_s(self._trouble or why)
            if self._is_crash_loop:  # so that nobody waits for it, and a load by somebody is seen
                self._tried(lambda api: self._take_out(api, config, was_hung))
            self._wakes.wait(pause_s)
            self._wakes.clear()
            if self._closed:
                return
            if self._tried(lambda api: self._load(api, config, was_hung)):
                break
        self._restarts.started()
        self._done()

    def _pause_s(self, why: str) -> float:
        try:
            return self._restarts.pause_s(why)
        except CrashLoopError as error:
            self._trouble = self._trouble or why
            if not self._is_crash_loop:
                self._is_crash_loop = True
                self._say(f"{error}; it is not ready, and tried again every {RETRY_S / 60:g} minutes")
            return RETRY_S

    def _tried(self, attempt: Callable[[RepositoryApi], None]) -> bool:
        try:
            server = self._server
            with RepositoryApi(server.endpoints.grpc_url, server.admin_key, server.grpc_options) as api:
                attempt(api)
        except RepositoryApiError as error:
            self._trouble = str(error)
            return False
        return True

    def _load(self, api: RepositoryApi, config: Config, was_hung: bool) -> None:
        """Ensembles that the model is a part of are unloaded and loaded with it, as they were."""
        if self._out_since_s is not None and any(entry.is_ready for entry in api.index() if entry.name == self._model):
            return  # somebody has loaded it meanwhile
        self._take_out(api, config, was_hung)
        if self._served is not None and not self._closed:  # else Triton may be another
            # Triton 2.51 never finishes to unload a model of which a request met a dead process. A load does not mind.
            api.load(self._model, self._served)

    def _take_out(self, api: RepositoryApi, config: Config, was_hung: bool) -> None:
        """Unloads it, unless somebody has done so: then it is to stay unloaded."""
        if self._out_since_s is not None:
            return
        self._served = self._served or self._serves(api, config)
        if self._served is not None:
            old = self._watch.of_model(self._model)
            api.unload(self._model)
            self._out_since_s = time.monotonic()
            self._end(old, was_hung)

    def _serves(self, api: RepositoryApi, last: Config) -> Config | None:
        """The configuration of the versions that it serves, and of no others: a rollout may have changed its file."""
        versions = [entry for entry in api.index() if entry.name == self._model]
        ready = [entry.version for entry in versions if entry.is_ready and entry.version is not None]
        if not ready:
            return None if all(entry.is_unloaded for entry in versions) else last
        return serving_just(api.config(self._model, max(ready)), ready)

    def _end(self, old: Sequence[Stub], was_hung: bool) -> None:
        """Returns when none of them lives: not even those that Triton keeps, with their share of a GPU's memory."""
        deadline_s = time.monotonic() + DRAIN_S
        while any(stub.is_alive for stub in old) and time.monotonic() < deadline_s:
            time.sleep(POLL_S)
        for stub in old:
            if stub.is_alive:
                stub.kill()
                if not was_hung and stub.journal is not None:
                    stub.journal.close()  # what it was working on is not why it ends
        self._watch.bury(old)


class ModelHealth:
    """Keeps one model answering. Whether Triton runs is another's business.

    watch: of the server's model processes
    say: is told of what fails again and again
    """

    def __init__(
        self, server: TritonServer, canary: Canary, watch: StubWatch, status: Status, say: Callable[[str], None]
    ) -> None:
        self.model = canary.model
        self._canary = canary
        self._watch = watch
        self._status = status
        self._reload = Reload(self.model, server, watch, self._forget, say)
        self._judged_s = 0.0
        self._verdict = Verdict.UNKNOWN
        self._is_ready = False

    def close(self) -> None:
        """Asks it no more, and leaves it as it is."""
        self._reload.close()
        self._canary.stop()

    @property
    def reason(self) -> str:
        """Why it is not ready; NO_REASON if it is."""
        if self.is_healing:
            return self._reload.reason
        return NO_REASON if self._is_ready else self._verdict.value

    @property
    def is_healing(self) -> bool:
        """Whether it is loaded anew."""
        return self._reload.is_active

    def restore(self, config: Config) -> None:
        """Loads it into a Triton that was started again."""
        self._reload.begin("tritonserver was started again", config, is_out=True)

    def tell_ready(self, asked_s: float) -> None:
        """The model was ready at ``asked_s``, as Triton says."""
        self._reload.tell_ready(asked_s)

    def look(self, died: str | None, config: Config) -> str | None:
        """Heals the model if need be, in a thread, and then tells why.

        died: how one of its processes has
        config: of what it served when it was last ready
        """
        if self.is_healing:
            return None
        if time.monotonic() - self._judged_s >= JUDGE_INTERVAL_S:
            self._judge()
        if died is None and self._verdict not in _HEALED:
            return None
        why = died or self._verdict.value
        self._status.tell_canary(self.model, is_ok=False)
        self._reload.begin(why, config, was_hung=self._verdict is Verdict.HUNG)
        return why

    def _judge(self) -> None:
        """A probe may wait behind a long batch, or many: whoever is busy stays ready, until it counts as hung."""
        self._verdict, self._judged_s = self._canary.verdict(), time.monotonic()
        if self._verdict in _SLOW and self._watch.is_getting_on(self.model):
            self._verdict = Verdict.BUSY
        self._is_ready = self._verdict in _READY or (self._verdict is Verdict.LATE and self._is_ready)
        self._status.tell_canary(self.model, is_ok=self._verdict is Verdict.LIVE)

    def _forget(self) -> None:
        """It is another."""
        self._verdict, self._is_ready = Verdict.UNKNOWN, False
        self._canary.reset()
