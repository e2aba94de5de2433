# SPDX-License-Identifier: MIT
"""Unloads a model whose processes are dead or hung, and loads what it served before."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rfm.launch.process import STALLED_S, TritonServer
from rfm.launch.repository_api import LOADING, READY, RepositoryApi
from rfm.supervise.model_processes import ModelProcess
from rfm.supervise.triton_watch import Config, serving_just

DRAIN_S = 2.0  # for what the model's other processes are working on
KILLED_S = 5.0  # for the kernel to take back what a killed process held
POLL_S = 0.1


class OwedAnswersError(RuntimeError):
    """Processes have ended that owed answers. Triton 2.51 never tells who waits for them; they know when it ends."""


class Reload:
    """The reload of one model, in attempts. One attempt runs at a time, and takes as long as Triton does.

    config: what the model served when it was last ready
    is_out: the model is not loaded now
    was_hung: its processes are killed for what they are working on
    """

    def __init__(self, model: str, server: TritonServer, config: Config, *, is_out: bool, was_hung: bool) -> None:
        self._model = model
        self._server = server
        self._config = config
        self._was_hung = was_hung
        self._to_load: Config | None = config if is_out else None  # None: it is not known yet, or nothing
        self._is_closed = False
        self.out_since_s: float | None = time.monotonic() if is_out else None  # it was unloaded then
        self.ended: list[ModelProcess] = []  # its processes that have ended since
        self._stalled_since_s: float | None = None  # all its processes have loaded, and wait

    def close(self) -> None:
        """Keeps a running attempt from changing anything more."""
        self._is_closed = True

    def load(self, processes: Sequence[ModelProcess]) -> None:
        """Loads the model anew, unless somebody has loaded or unloaded it.

        Raises RepositoryApiError, and OwedAnswersError when the model is unloaded and its processes have ended.

        Ensembles that the model is a part of are unloaded and loaded with it, as they were.

        processes: its processes, dead or alive
        """
        with self._server.repository_api() as api:
            if self.out_since_s is not None and any(e.is_ready for e in api.index() if e.name == self._model):
                return  # another client has loaded it meanwhile
            self._take_out(api, processes)
            if self._to_load is None or self._is_loaded_by_another(api):
                return
            if not self._is_closed:  # else Triton may be another
                # Triton 2.51 never finishes an unload after a request met a dead process of the model. A load goes on.
                api.load(self._model, self._to_load)

    def unload(self, processes: Sequence[ModelProcess]) -> None:
        """Unloads the model, so that callers get an error at once, and a load by others is seen. Raises as ``load``."""
        with self._server.repository_api() as api:
            self._take_out(api, processes)

    def end_stalled(self, processes: Sequence[ModelProcess]) -> None:
        """Ends processes that have loaded, and that Triton does not take up: it waits for their end (``process``).

        processes: of the model, dead or alive, while an attempt is under way
        """
        new = [process for process in processes if process not in self.ended and process.is_alive]
        journals = [process.journal for process in new]
        if not new or any(journal is None or journal.busy_s for journal in journals):
            self._stalled_since_s = None
        elif self._stalled_since_s is None:
            self._stalled_since_s = time.monotonic()
        elif time.monotonic() - self._stalled_since_s > STALLED_S:
            for process in new:
                process.kill()

    def _is_loaded_by_another(self, api: RepositoryApi) -> bool:
        """Whether somebody has loaded the model since it was unloaded. A load under way is waited for: it may fail."""
        while not self._is_closed:
            states = {entry.state for entry in api.index() if entry.name == self._model}
            if LOADING not in states:
                return READY in states
            time.sleep(POLL_S)
        return False

    def _take_out(self, api: RepositoryApi, processes: Sequence[ModelProcess]) -> None:
        """Unloads the model, unless somebody has done so: then it is to stay unloaded."""
        if self.out_since_s is not None:
            return
        self._to_load = self._to_load or self._serves(api)
        if self._to_load is not None:
            api.unload(self._model)
            self.out_since_s = time.monotonic()
            self._end(processes)

    def _serves(self, api: RepositoryApi) -> Config | None:
        """The configuration of exactly the versions that the model serves: a rollout may have changed its file."""
        versions = [entry for entry in api.index() if entry.name == self._model]
        ready = [entry.version for entry in versions if entry.is_ready and entry.version is not None]
        if not ready:
            return None if all(entry.is_unloaded for entry in versions) else self._config
        return serving_just(api.config(self._model, max(ready)), ready)

    def _end(self, processes: Sequence[ModelProcess]) -> None:
        """Returns when none of the processes lives, not even one that Triton keeps with its share of a GPU's memory.

        Raises OwedAnswersError. Triton has reaped them, so nobody else sees that they are dead.
        """
        _wait_for_end(processes, DRAIN_S)
        killed = [process for process in processes if process.is_alive]
        for process in killed:
            process.kill()
        _wait_for_end(killed, KILLED_S)
        num_owed = 0
        for process in processes:
            journal = process.journal
            if journal is not None:
                num_owed += journal.num_owed
                if process in killed and not self._was_hung:
                    journal.close()  # what it was working on is not why it ends
        self.ended = [*self.ended, *processes]
        if num_owed:
            raise OwedAnswersError(f"processes of {self._model} have ended, and owe {num_owed} answers")


def _wait_for_end(processes: Sequence[ModelProcess], most_s: float) -> None:
    deadline_s = time.monotonic() + most_s
    while any(process.is_alive for process in processes) and time.monotonic() < deadline_s:
        time.sleep(POLL_S)
