# SPDX-License-Identifier: MIT
"""Where tokens lie when rows of unlike lengths are packed one after the other, without padding between them.

B rows, N tokens of all rows, L tokens of the longest row. Everything but attention is computed of the packed tokens
[N, D]; attention alone needs rows of one length, [B, L, D].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

_SIGNIFICANT_BITS = 5


def rounded_up(count: int) -> int:
    """The next number with at most five significant bits, at most a sixteenth more.

    Tensors of as many rows have one of few shapes, so that kernels which are made for each shape are made once.
    """
    step = 1 << max(count.bit_length() - _SIGNIFICANT_BITS, 0)
    return -(-count // step) * step


@dataclass(frozen=True)
class Packing:
    """Rows of some numbers of tokens, one after the other. Behind the last is room for tokens that mean nothing.

    num_rows, longest, num_tokens: B, L and N
    at: int64 [N + room], where each token lies in [B * L, ...]; those that mean nothing are said to lie at 0
    mask: bool [B, 1, 1, L], true at tokens of the row; None if all rows are of one length
    """

    num_rows: int
    longest: int
    num_tokens: int
    at: Tensor
    mask: Tensor | None

    @classmethod
    def of(cls, lengths: npt.NDArray[np.int64]) -> Packing:
        """The packing of rows with so many tokens each; lengths: int64 [B]."""
        num_rows, longest, num_tokens = len(lengths), int(lengths.max()), int(lengths.sum())
        at = np.zeros(rounded_up(num_tokens), np.int64)
        at[:num_tokens] = np.arange(num_tokens) + np.repeat(np.arange(num_rows) * longest - starts(lengths), lengths)
        mask = None
        if num_tokens < num_rows * longest:
            mask = torch.from_numpy(np.arange(longest) < lengths[:, None])[:, None, None]
        return cls(num_rows, longest, num_tokens, torch.from_numpy(at), mask)

    def to(self, device: torch.device) -> Packing:
        """The packing with its tensors on ``device``."""
        return replace(self, at=self.at.to(device), mask=None if self.mask is None else self.mask.to(device))

    def empty(self, width: int, like: Tensor) -> Tensor:
        """Zeros [N + room, D]."""
        return like.new_zeros(len(self.at), width)

    def padded(self, packed: Tensor) -> Tensor:
        """[N + room, D] -> [B, L, D], zeros behind the end of each row."""
        tokens = packed[: self.num_tokens]
        if self.mask is not None:
            rows = packed.new_zeros(self.num_rows * self.longest, packed.shape[-1])
            rows[self.at[: self.num_tokens]] = tokens
            tokens = rows
        return tokens.unflatten(0, (self.num_rows, self.longest))

    def packed(self, padded: Tensor) -> Tensor:
        """[B, L, D] -> [N + room, D]."""
        rows = padded.flatten(0, 1)
        is_packed = self.mask is None and len(rows) == len(self.at)
        return rows if is_packed else rows[self.at]


def starts(lengths: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """int64 [B], where each of parts of int64 [B] begins when they lie one after the other."""
    return np.cumsum(lengths) - lengths
