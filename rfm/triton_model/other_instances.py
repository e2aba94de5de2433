# SPDX-License-Identifier: MIT
"""A model with several instances: none takes requests from Triton's queue that another could begin at once."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from rfm.journal import Journal
from rfm.triton_model.pipeline import Pipeline
from rfm.triton_model.quarantine import all_journals, own_journal

POLL_S = 2e-3  # between two questions whether another instance is idle, while this instance computes
LONG_S = 0.1  # one that has worked on a batch for so long takes nothing from Triton soon, whatever it owes
LOOK_S = 1.0  # between two looks for other instances: they come and go with a load


class OtherInstances:
    """The other instances of a model, as their journals show them.

    files: finds the journals of all instances, this one's included
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
        return cls(partial(all_journals, model), own_journal(model))

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
    """Whether an instance is at work, and owes so many answers or has worked for long."""
    busy_s = journal.busy_s
    return busy_s > 0 and (journal.num_owed >= num_owed or busy_s >= LONG_S)
