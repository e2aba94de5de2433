# SPDX-License-Identifier: MIT
"""What the answers to one batch took. Whoever answers adds to it; who asked may read it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Execution:
    """The work on one batch.

    collate_s: seconds in which no forward pass ran: rows were made, and batches of them
    forward_s: seconds in forward passes, with what it takes to read their results
    num_tokens, num_slots: tokens of the rows that were scored, and of the forward passes, padding included
    out_of_memory_count: forward passes that did not fit in memory; their halves were tried again
    """

    collate_s: float = 0.0
    forward_s: float = 0.0
    num_tokens: int = 0
    num_slots: int = 0
    out_of_memory_count: int = 0

    def add_forward(self, num_tokens: int, num_slots: int) -> None:
        """Counts the tokens of one more forward pass."""
        self.num_tokens += num_tokens
        self.num_slots += num_slots

    @property
    def padding_ratio(self) -> float:
        """The share 0..1 of the token slots that held no token; 0 if there was no forward pass."""
        return 1 - self.num_tokens / self.num_slots if self.num_slots else 0.0
