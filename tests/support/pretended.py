# SPDX-License-Identifier: MIT
"""A GPU that is not there: tensors that say that they lie on ``cuda``, and are computed on the CPU.

As on a GPU, an operator that is given tensors of both places fails. What the host would wait for is counted: values that
it asks for, and copies from memory that is not pinned. CUDA's own calls are recorded.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from rfm.engine import scoring, threads

CUDA = torch.device("cuda", 0)
_ASKS = {"_local_scalar_dense", "item", "is_nonzero", "equal", "nonzero", "masked_select", "_unique2", "unique_dim"}
_READS = {torch.Tensor.tolist, torch.Tensor.item, torch.Tensor.__int__, torch.Tensor.__float__, torch.Tensor.__bool__}
_COPIES = {"to", "_to_copy", "copy_"}


@dataclass
class Seen:
    """What was done on the device.

    asked: by operator, how often the host waited for a value or a size
    awaited: copies to the device for which the host waited
    calls: of CUDA's own functions, in order
    """

    asked: Counter[str] = field(default_factory=Counter)
    awaited: int = 0
    num_operators: int = 0
    calls: list[str] = field(default_factory=list)


class OnDevice(torch.Tensor):
    """A tensor on the device; ``held``: its values."""

    held: torch.Tensor
    seen: Seen

    @staticmethod
    def __new__(cls: type[OnDevice], held: torch.Tensor) -> OnDevice:
        made = torch.Tensor._make_wrapper_subclass(
            cls, held.shape, held.stride(), held.storage_offset(), dtype=held.dtype, device=CUDA
        )
        made.held = held
        return made

    def __init__(self, held: torch.Tensor) -> None:
        pass

    def __repr__(self, **_: Any) -> str:
        return f"OnDevice({self.held!r})"

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Indexing looks for the device's own code before any operator is dispatched; so it is done here."""
        if func in _READS:
            cls.seen.asked[func.__name__] += 1
            return func(_on_host(args[0]))
        if func not in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
            with torch._C.DisableTorchFunctionSubclass():  # or what comes back from the device would be wrapped
                return func(*args, **(kwargs or {}))
        tensors = [each for each in tree_flatten(args)[0] if isinstance(each, torch.Tensor) and each.dim()]
        if not all(isinstance(each, OnDevice) for each in tensors):
            raise RuntimeError("index: expected all tensors to be on the same device, got cuda and cpu")
        cls.seen.num_operators += 1
        if any(each.dtype is torch.bool for each in tree_flatten(args[1])[0] if isinstance(each, torch.Tensor)):
            cls.seen.asked["a mask"] += 1  # for how many it picks
        return _wrapped(func(*tree_map(_on_host, args)), "cuda")

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {}, cls.seen)


class Pretending(TorchDispatchMode):
    """Has operators with ``device="cuda"`` make such tensors, and sees them all."""

    def __init__(self, seen: Seen) -> None:
        super().__init__()
        self.seen = OnDevice.seen = seen

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {}, self.seen)


def computed(func: Any, args: Any, kwargs: dict[str, Any], seen: Seen) -> Any:
    """What an operator gives, on the device if it is told to, or its tensors lie there."""
    name = func._schema.name.removeprefix("aten::")
    named = dict(zip((argument.name for argument in func._schema.arguments), args, strict=False)) | kwargs
    tensors = [each for each in tree_flatten((args, kwargs))[0] if isinstance(each, torch.Tensor)]
    there = [each for each in tensors if isinstance(each, OnDevice)]
    here = [each for each in tensors if not isinstance(each, OnDevice)]
    told = named.get("device")
    target = torch.device(told).type if told is not None else ("cuda" if there else "cpu")
    if name == "copy_":
        target = "cuda" if isinstance(args[0], OnDevice) else "cpu"
    if not there and target == "cpu":
        return func(*args, **kwargs)
    if name == "_has_compatible_shallow_copy_type":
        return False  # a parameter that lies here cannot become one that lies there: a new one is made
    seen.num_operators += 1
    is_copy = (name in _COPIES and told is not None) or name == "copy_"
    if there and any(each.dim() for each in here) and not is_copy:
        raise RuntimeError(f"{name}: expected all tensors to be on the same device, got cuda and cpu")
    crosses = is_copy and (bool(here) if target == "cuda" else bool(there))
    if crosses and target == "cuda":
        seen.awaited += not named.get("non_blocking") or not all(hasattr(each, "pinned_here") for each in here)
    masks = any(each.dtype is torch.bool for each in tree_flatten(named.get("indices", ()))[0] if each is not None)
    grows = name == "repeat_interleave" and named.get("output_size") is None
    if (crosses and target == "cpu") or name in _ASKS or masks or grows:
        seen.asked[name] += 1
    on_host = tree_map(_on_host, (args, kwargs))
    made = func(*on_host[0], **on_host[1])
    if func._schema.is_mutable and isinstance(args[0], OnDevice):
        return args[0]
    if crosses:
        made = made.clone()
    return _wrapped(made, target)


def _on_host(value: Any) -> Any:
    if isinstance(value, OnDevice):
        return value.held
    return torch.device("cpu") if isinstance(value, torch.device) else value


def _wrapped(made: Any, target: str) -> Any:
    def wrap(value: Any) -> Any:
        return OnDevice(value) if target == "cuda" and isinstance(value, torch.Tensor) else value

    return tree_map(wrap, made)


class _Stream:
    """A stream of CUDA, which records what it is asked."""

    def __init__(self, seen: Seen, device: torch.device = CUDA) -> None:
        self.seen, self.device = seen, device

    def wait_stream(self, other: object) -> None:
        self.seen.calls.append("wait_stream")


@contextlib.contextmanager
def pretended(monkeypatch: pytest.MonkeyPatch) -> Iterator[Seen]:
    """A context in which PyTorch has a GPU."""
    seen = Seen()

    def recorded(name: str, given: Any = None) -> Any:
        def call(*_: Any, **__: Any) -> Any:
            seen.calls.append(name)
            return given() if given else None

        return call

    def pin(tensor: torch.Tensor) -> torch.Tensor:
        seen.calls.append("pin_memory")
        copy = tensor.clone()
        copy.pinned_here = True
        return copy

    class Threads(ThreadPoolExecutor):
        """Threads in which PyTorch has the GPU, too: what it dispatches by is a thread's own."""

        def submit(self, work: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            def pretending() -> Any:
                with Pretending(seen):
                    return work(*args, **kwargs)

            return super().submit(pretending)

    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: None)
    monkeypatch.setattr(torch.cuda, "Stream", recorded("Stream", lambda: _Stream(seen)))
    monkeypatch.setattr(torch.cuda, "stream", recorded("stream", contextlib.nullcontext))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda *_: _Stream(seen))
    monkeypatch.setattr(torch.cuda, "empty_cache", recorded("empty_cache"))
    monkeypatch.setattr(torch.cuda, "set_device", recorded("set_device"))
    monkeypatch.setattr(torch.Tensor, "pin_memory", pin)
    monkeypatch.setattr(torch.Tensor, "record_stream", recorded("record_stream"))
    monkeypatch.setattr(torch, "autocast", lambda **_: contextlib.nullcontext())  # asks the device
    for module in (scoring, threads):
        monkeypatch.setattr(module, "ThreadPoolExecutor", Threads)
    with Pretending(seen):
        yield seen
