# SPDX-License-Identifier: MIT
"""A model with several instances: none takes requests from Triton's queue that another could begin at once."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from rfm.journal import Journal
from rfm.proc import arguments_of
from rfm.triton_model.pipeline import Pipeline
from rfm.triton_model.quarantine import all_journals, own_journal

POLL_S = 2e-3  # between two questions whether another instance is idle, while this instance computes
LONG_S = 0.1  # one that owes nothing and has not got on for so long has its ``execute`` wait: it takes nothing
STUCK_S = 5.0  # one that has not got on for so long may hang: nobody leaves requests to it. Few passes take longer.
LOOK_S = 1.0  # between two looks for other instances: they come and go with a load
_MODEL_FILE = 1  # which argument of a model process names its model.py


class OtherInstances:
    """The other instances of a version of a model, as their journals show them.

    files: finds the journals of all instances of the version, this one's included
    own: this instance's journal
    """

    def __init__(self, files: Callable[[], Iterable[Path]], own: Path) -> None:
        self._files = files
        self._own = own
        self._journals: dict[Path, Journal] = {}
        self._looked_s = -math.inf

    @classmethod
    def of_this_process(cls, model: str) -> OtherInstances:
        """Those of the running process, which Triton has started for ``model``."""
        return cls(partial(_journals_of_this_version, model), own_journal(model))

    def wait_for_turn(self, pipeline: Pipeline[Any, Any], max_waiting: int) -> None:
        """Returns when the pipeline should take more requests from Triton.

        That is when it has nothing to do; or when no other has, and fewer than ``max_waiting`` requests wait here or
        none of the others has less to do. Then somebody must take what comes, so that it can be rejected.
        """
        while not (pipeline.is_idle or self._are_busy(pipeline.num_waiting, max_waiting)):
            pipeline.wait_for(lambda: pipeline.is_idle, POLL_S)

    def _are_busy(self, num_waiting: int, max_waiting: int) -> bool:
        """Whether each of the others is at work, with as much to do as ``num_waiting`` from ``max_waiting`` on."""
        if time.monotonic() - self._looked_s >= LOOK_S:
            self._look()
        enough = 0 if num_waiting < max_waiting else num_waiting
        return all(_has(journal, enough) or not journal.is_alive for journal in self._journals.values())

    def _look(self) -> None:
        """Finds the journals of instances that were started since, and forgets those that are gone."""
        self._looked_s = time.monotonic()
        files = {file for file in self._files() if file != self._own}
        for gone in self._journals.keys() - files:
            del self._journals[gone]
        for file in files - self._journals.keys():
            if (journal := Journal.open(file)) is not None:
                self._journals[file] = journal


def _has(journal: Journal, num_owed: int) -> bool:
    """Whether an instance is at work, and owes so many answers, or has not got on for long."""
    busy_s, owed = journal.busy_s, journal.num_owed
    return busy_s > 0 and (owed >= num_owed or busy_s >= (STUCK_S if owed else LONG_S))


def _journals_of_this_version(model: str) -> list[Path]:
    """Those of the processes that run the same model.py. While versions take turns, there are others, too."""
    journals = [journal for file in all_journals(model) if (journal := Journal.open(file)) is not None]
    return [journal.file for journal in journals if _model_file(journal.pid) == _model_file(os.getpid())]


def _model_file(pid: int) -> str | None:
    """The model.py that a model process runs; None: it has ended."""
    return next(iter(arguments_of(pid)[_MODEL_FILE:]), None)
