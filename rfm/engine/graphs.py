# SPDX-License-Identifier: MIT
"""CUDA graphs: a repeated call with equal tensor shapes becomes one launch instead of thousands.

In a pass over a few samples, the host takes longer to launch the kernels than the device takes to run them.

Tests replace ``CudaCapture``. Without a GPU, a "replay" that calls the function on the held inputs shows what a replay
can get wrong: inputs that were not copied, outputs that another replay overwrites, values that the host has read.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from torch import Tensor

MAX_GRAPHS = 8  # each holds 10 to 20 MB for a 4B network, and its inputs and output
PLAIN_CALLS = 2  # per shape before its capture: they initialise libraries, and rare shapes need no graph
MAX_TOKENS = 2_560  # more keep the device busy for longer than the host launches
STEP_TOKENS = 64
IDLE_CALLS = 256  # a graph unused for this many calls makes room for another
MAX_COUNTED = 1024  # shapes whose calls are counted

Function: TypeAlias = Callable[..., Tensor]

_log = logging.getLogger(__name__)


@dataclass(eq=False)
class Captured:
    """A captured call.

    inputs: tensors read by ``replay``
    output: tensor written by ``replay``
    pool: handle of the memory shared by graphs
    last_call: number of the last call to use this graph
    """

    inputs: Sequence[Tensor]
    output: Tensor
    replay: Callable[[], object]
    pool: Any = None
    last_call: int = 0

    def __call__(self, tensors: Sequence[Tensor]) -> Tensor:
        """Return the output for these tensors."""
        for held, tensor in zip(self.inputs, tensors, strict=True):
            held.copy_(tensor)
        self.replay()
        return self.output.clone()  # graphs share memory, so the next replay of any graph may overwrite the output


class CudaCapture:
    """Captures calls on a CUDA device, all on one stream, as PyTorch requires if graphs share memory."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream: Any = None  # made at the first capture

    def __call__(self, function: Function, tensors: Sequence[Tensor], beside: Captured | None) -> Captured:
        """Return the captured call ``function(*tensors)``. Raises RuntimeError if it cannot be captured.

        beside: a captured call whose memory it shares; None: it is the only one
        """
        self._stream = self._stream or torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]  # as PyTorch declares it
        pool = torch.cuda.graph_pool_handle() if beside is None else beside.pool
        inputs = [tensor.clone() for tensor in tensors]
        graph = torch.cuda.CUDAGraph()
        # PyTorch leaves the stream of a failed capture as the current one; this context restores it.
        with torch.cuda.stream(torch.cuda.current_stream(self._device)):
            try:
                # thread_local: other threads pin memory and copy frames meanwhile.
                with torch.cuda.graph(graph, pool=pool, stream=self._stream, capture_error_mode="thread_local"):
                    output = function(*inputs)
            except RuntimeError:
                # PyTorch leaves its allocator in the capture state, in which empty_cache() fails.
                with suppress(RuntimeError):
                    torch._C._cuda_endAllocateToPool(self._stream.device.index, pool)
                raise
        return Captured(inputs, output, graph.replay, pool)


class Graphs:
    """Calls tensor functions; from the third call with the same shapes, as a CUDA graph. For one thread.

    capture: captures a call, as ``CudaCapture`` does
    max_graphs: how many graphs are kept

    After a capture has failed, all calls are plain.
    """

    def __init__(self, capture: Callable[..., Captured], max_graphs: int = MAX_GRAPHS) -> None:
        self.num_captured = self.num_replayed = 0
        self.has_failed = False
        self._capture, self._max_graphs = capture, max_graphs
        self._captured: dict[Hashable, Captured] = {}
        self._num_plain: Counter[Hashable] = Counter()
        self._num_calls = 0

    def __call__(self, function: Function, tensors: Sequence[Tensor], constants: Hashable, num_tokens: int) -> Tensor:
        """Return ``function(*tensors)``.

        constants: everything besides the tensors that determines the result
        num_tokens: a call with more than MAX_TOKENS is plain
        """
        if self.has_failed or num_tokens > MAX_TOKENS:
            return function(*tensors)
        self._num_calls += 1
        key = (constants, *((tensor.shape, tensor.dtype, tensor.device) for tensor in tensors))
        if key not in self._captured and not (self._is_due(key) and self._has_captured(key, function, tensors)):
            return function(*tensors)
        captured = self._captured[key]
        captured.last_call = self._num_calls
        self.num_replayed += 1
        return captured(tensors)

    def padded(self, num_rows: int, length: int) -> int:
        """Return the padded length for rows with ``length`` tokens, so other lengths share a graph.

        A batch too large for a graph is not padded.
        """
        padded = -(-length // STEP_TOKENS) * STEP_TOKENS
        return padded if num_rows * padded <= MAX_TOKENS and not self.has_failed else length

    def clear(self) -> None:
        """Drop all graphs and free the memory."""
        self._captured.clear()
        self._num_plain.clear()

    def _is_due(self, key: Hashable) -> bool:
        """Count a call without a graph; return True if it should be captured."""
        if len(self._num_plain) >= MAX_COUNTED:
            self._num_plain.clear()
        self._num_plain[key] += 1
        if self._num_plain[key] <= PLAIN_CALLS:
            return False
        # A capture takes as long as many passes, so more shapes than graphs must not capture in turn.
        oldest = min((each.last_call for each in self._captured.values()), default=0)
        return len(self._captured) < self._max_graphs or self._num_calls - oldest > IDLE_CALLS

    def _has_captured(self, key: Hashable, function: Function, tensors: Sequence[Tensor]) -> bool:
        """Capture a call; if there are too many graphs, drop the least recently used one. Return False if it fails."""
        try:
            captured = self._capture(function, tensors, next(iter(self._captured.values()), None))
        except RuntimeError as error:  # also out of memory
            self.has_failed = True
            self.clear()
            reason = str(error.__context__ or error).partition("\n")[0]
            _log.warning("CUDA graphs are off in this process, because a capture failed: %s", reason)
            return False
        self.num_captured += 1
        if len(self._captured) >= self._max_graphs:  # only now: the new graph shares memory with an old one
            del self._captured[min(self._captured, key=lambda each: self._captured[each].last_call)]
        self._captured[key] = captured
        return True
