# SPDX-License-Identifier: MIT
"""Costs for one batch: times, tokens, encoded frames and memory failures."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch

from rfm.engine.device import memory_errors
from rfm_client.contract import InferenceFailedError

Output = TypeVar("Output")

_log = logging.getLogger(__name__)


@dataclass
class Execution:
    """Costs for a batch, added up during scoring.

    collate_s: seconds to make rows and batches, without forward passes
    forward_s: seconds in forward passes, with reading the results
    num_tokens, num_slots: tokens in forward passes, without and with padding
    num_encoded, num_found: frames read by an encoder or vision tower; frames with cached features
    cache_bytes: size of the cached features; None: no cache
    out_of_memory_count: forward passes repeated in halves for lack of memory
    num_unclear: written answers with an unclear score
    num_unreadable: written answers without a score
    on_forward: called after each forward pass, even if it did not fit in memory
    """

    collate_s: float = 0.0
    forward_s: float = 0.0
    num_tokens: int = 0
    num_slots: int = 0
    num_encoded: int = 0
    num_found: int = 0
    cache_bytes: int | None = None
    out_of_memory_count: int = 0
    num_unclear: int = 0
    num_unreadable: int = 0
    on_forward: Callable[[], None] = field(default=lambda: None, compare=False, repr=False)

    def run(
        self,
        forward: Callable[[Any], Sequence[Output]],
        rows: Any,
        divided: Callable[[Any], Output | InferenceFailedError | None] | None = None,
    ) -> list[Output | InferenceFailedError]:
        """Return the output of ``forward`` for each row.

        If the rows do not fit in memory, each half is tried. A row that does not fit alone gets an error.

        rows: a sequence, or a tensor with the rows along its first axis
        divided: handles a row too large to fit alone; None: the row cannot be divided
        """
        try:
            with memory_errors():
                return list(forward(rows))
        except torch.OutOfMemoryError as error:
            self.out_of_memory_count += 1
            _log.warning("out of memory with %d rows: %s", len(rows), error)
        finally:
            self.on_forward()
        torch.cuda.empty_cache()  # does nothing without a GPU
        if len(rows) == 1:
            output = None if divided is None else divided(rows[0])
            return [output or InferenceFailedError("the sample does not fit in the device's memory")]
        half = len(rows) // 2
        return [*self.run(forward, rows[:half], divided), *self.run(forward, rows[half:], divided)]

    @contextmanager
    def collating(self) -> Iterator[None]:
        """Add the time in this context, in which no forward pass runs, to ``collate_s``."""
        started_s = time.perf_counter()
        yield
        self.collate_s += time.perf_counter() - started_s

    @contextmanager
    def forwarding(self) -> Iterator[None]:
        """Add the time in this context, except in ``collating`` inside it, to ``forward_s``."""
        started_s, collated_s = time.perf_counter(), self.collate_s
        yield
        self.forward_s += time.perf_counter() - started_s - (self.collate_s - collated_s)

    def add_tokens(self, num_tokens: int, num_slots: int) -> None:
        """Count the tokens in one forward pass, without and with padding."""
        self.num_tokens += num_tokens
        self.num_slots += num_slots

    @property
    def padding_ratio(self) -> float:
        """The padding share among all token slots, 0 to 1; 0 if there was no forward pass."""
        return 1 - self.num_tokens / self.num_slots if self.num_slots else 0.0
