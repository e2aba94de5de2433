# SPDX-License-Identifier: MIT
"""What one batch took: times, tokens, failures of memory. The code that answers adds to it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch

from rfm.engine.device import free_unused, memory_errors
from rfm_client.contract import InferenceFailedError

Output = TypeVar("Output")

_log = logging.getLogger(__name__)


@dataclass
class Execution:
    """The work on one batch.

    collate_s: seconds in which no forward pass ran: rows were made, and batches of them
    forward_s: seconds in forward passes, with what it takes to read their results
    num_tokens, num_slots: tokens of the rows that were scored, and of the forward passes, padding included
    num_encoded, num_found: frames that went through an encoder or a vision tower; frames whose features were at hand
    cache_bytes: of the features that are kept now; None: none are
    out_of_memory_count: forward passes that did not fit in memory; their halves were tried again
    on_forward: called after each forward pass, one that did not fit included
    """

    collate_s: float = 0.0
    forward_s: float = 0.0
    num_tokens: int = 0
    num_slots: int = 0
    num_encoded: int = 0
    num_found: int = 0
    cache_bytes: int | None = None
    out_of_memory_count: int = 0
    on_forward: Callable[[], None] = field(default=lambda: None, compare=False, repr=False)

    def run(self, forward: Callable[[Any], Sequence[Output]], rows: Any) -> list[Output | InferenceFailedError]:
        """What a forward pass gives for each of ``rows``: a sequence, or a tensor of them.

        Out of memory, its halves are tried; a row that does not fit alone is an error of its own.
        """
        try:
            with memory_errors():
                return list(forward(rows))
        except torch.OutOfMemoryError as error:
            self.out_of_memory_count += 1
            _log.warning("out of memory with %d rows: %s", len(rows), error)
        finally:
            self.on_forward()
        free_unused()
        if len(rows) == 1:
            return [InferenceFailedError("the sample does not fit in the device's memory")]
        half = len(rows) // 2
        return [*self.run(forward, rows[:half]), *self.run(forward, rows[half:])]

    @contextmanager
    def collating(self) -> Iterator[None]:
        """A context in which no forward pass runs: its time counts as collate time."""
        started_s = time.perf_counter()
        yield
        self.collate_s += time.perf_counter() - started_s

    @contextmanager
    def forwarding(self) -> Iterator[None]:
        """A context in which forward passes run: its time, without that in ``collating``, counts as forward time."""
        started_s, collated_s = time.perf_counter(), self.collate_s
        yield
        self.forward_s += time.perf_counter() - started_s - (self.collate_s - collated_s)

    def add_tokens(self, num_tokens: int, num_slots: int) -> None:
        """Counts the tokens and slots of one more forward pass."""
        self.num_tokens += num_tokens
        self.num_slots += num_slots

    @property
    def padding_ratio(self) -> float:
        """The share 0..1 of the token slots that held no token; 0 if there was no forward pass."""
        return 1 - self.num_tokens / self.num_slots if self.num_slots else 0.0
