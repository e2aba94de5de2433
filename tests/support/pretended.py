# SPDX-License-Identifier: MIT
"""Two pretended GPUs: tensors claim to lie on ``cuda:0`` or ``cuda:1``, and the CPU computes them.

As on GPUs, an operator fails for tensors on two devices, and ``cuda`` is the thread's current device. What the
host would wait for is counted: values that it asks for, and copies from memory that is not pinned. CUDA's own calls are
recorded.
"""

from __future__ import annotations

import contextlib
import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch.utils._device import _device_constructors
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from rfm.engine import scoring, threads

CUDA = torch.device("cuda", 0)
SECOND = torch.device("cuda", 1)
CPU = torch.device("cpu")
_ASKS = {"_local_scalar_dense", "item", "is_nonzero", "equal", "nonzero", "masked_select", "_unique2", "unique_dim"}
_READS = {torch.Tensor.tolist, torch.Tensor.item, torch.Tensor.__int__, torch.Tensor.__float__, torch.Tensor.__bool__}
_GUARDED = {  # methods that look for the device before the operator is dispatched
    torch.Tensor.copy_: torch.ops.aten.copy_.default,
    torch.Tensor.__invert__: torch.ops.aten.bitwise_not.default,
}
_COPIES = {"to", "_to_copy", "copy_"}


@dataclass
class Seen:
    """The work done on the device.

    asked: by operator, how often the host waited for a value or a size
    awaited: copies to the device for which the host waited
    calls: of CUDA's own functions, in order
    made_on: by device, how many tensors were made there
    """

    asked: Counter[str] = field(default_factory=Counter)
    awaited: int = 0
    num_operators: int = 0
    calls: list[str] = field(default_factory=list)
    made_on: Counter[torch.device] = field(default_factory=Counter)
    _of_thread: threading.local = field(default_factory=threading.local)

    @property
    def current(self) -> torch.device:
        """The thread's current device."""
        return getattr(self._of_thread, "device", CUDA)

    @current.setter
    def current(self, device: torch.device) -> None:
        self._of_thread.device = device

    def placed(self, device: Any) -> torch.device:
        """Return the device with an index; ``cuda`` is the current one."""
        device = self.current if device is None else torch.device("cuda", device) if type(device) is int else device
        device = torch.device(device)
        if device.type == "cuda" and device.index is None:
            return self.current
        if device.type == "cuda" and device not in (CUDA, SECOND):
            raise RuntimeError(f"CUDA error: invalid device ordinal {device.index}")
        return device


class OnDevice(torch.Tensor):
    """A tensor on a device. held: the values"""

    held: torch.Tensor
    seen: Seen

    @staticmethod
    def __new__(cls: type[OnDevice], held: torch.Tensor, device: torch.device) -> OnDevice:
        made = torch.Tensor._make_wrapper_subclass(
            cls, held.shape, held.stride(), held.storage_offset(), dtype=held.dtype, device=device
        )
        made.held = held
        cls.seen.made_on[device] += 1
        return made

    def __init__(self, held: torch.Tensor, device: torch.device) -> None:
        pass

    def __repr__(self, **_: Any) -> str:
        return f"OnDevice({self.held!r})"

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Indexing looks for the device's own code before any operator is dispatched; so it is done here."""
        if func in _READS:
            cls.seen.asked[func.__name__] += 1
            return func(_on_host(args[0]))
        if func in _GUARDED:
            return computed(_GUARDED[func], args, kwargs or {}, cls.seen)
        if func not in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
            with torch._C.DisableTorchFunctionSubclass():  # or results from the device would be wrapped
                return func(*args, **(kwargs or {}))
        tensors = [each for each in tree_flatten(args)[0] if isinstance(each, torch.Tensor) and each.dim()]
        _check_together("index", tensors)
        cls.seen.num_operators += 1
        if any(each.dtype is torch.bool for each in tree_flatten(args[1])[0] if isinstance(each, torch.Tensor)):
            cls.seen.asked["a mask"] += 1  # for how many it picks
        return _wrapped(func(*tree_map(_on_host, args)), tensors[0].device)

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {}, cls.seen)


class Pretending(TorchDispatchMode):
    """Has operators with a CUDA device make such tensors, and sees them all."""

    def __init__(self, seen: Seen) -> None:
        super().__init__()
        self.seen = OnDevice.seen = seen

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {}, self.seen)


def computed(func: Any, args: Any, kwargs: dict[str, Any], seen: Seen) -> Any:
    """Return an operator's result, on the device if asked to or if the inputs lie there."""
    name = func._schema.name.removeprefix("aten::")
    named = dict(zip((argument.name for argument in func._schema.arguments), args, strict=False)) | kwargs
    tensors = [each for each in tree_flatten((args, kwargs))[0] if isinstance(each, torch.Tensor)]
    there = [each for each in tensors if isinstance(each, OnDevice)]
    here = [each for each in tensors if not isinstance(each, OnDevice)]
    told = named.get("device")
    target = seen.placed(told) if told is not None else there[0].device if there else CPU
    if name == "copy_":
        target = args[0].device
    if not there and target.type != "cuda":
        return func(*args, **kwargs)
    if name == "_has_compatible_shallow_copy_type":
        return False  # a parameter cannot move to another device, so a new one is made
    seen.num_operators += 1
    is_copy = (name in _COPIES and told is not None) or name == "copy_"
    if there and not is_copy:
        _check_together(name, [*there, *(each for each in here if each.dim())])
    crosses = is_copy and any(each.device != target for each in tensors)
    if crosses and target != CPU:
        seen.awaited += not named.get("non_blocking") or not all(hasattr(each, "pinned_here") for each in here)
    masks = any(each.dtype is torch.bool for each in tree_flatten(named.get("indices", ()))[0] if each is not None)
    grows = name == "repeat_interleave" and named.get("output_size") is None
    if (crosses and target == CPU) or name in _ASKS or masks or grows:
        seen.asked[name] += 1
    on_host = tree_map(_on_host, (args, kwargs))
    made = func(*on_host[0], **on_host[1])
    if func._schema.is_mutable:
        return args[0]
    if crosses:
        made = made.clone()
    return _wrapped(made, target)


def _check_together(name: str, tensors: list[torch.Tensor]) -> None:
    devices = sorted({str(each.device) for each in tensors})
    if len(devices) > 1:
        found = " and ".join(devices)
        raise RuntimeError(f"{name}: expected all tensors to be on the same device, found {found}")


def _on_host(value: Any) -> Any:
    if isinstance(value, OnDevice):
        return value.held
    return CPU if isinstance(value, torch.device) else value


def _wrapped(made: Any, target: torch.device) -> Any:
    def wrap(value: Any) -> Any:
        return OnDevice(value, target) if target != CPU and isinstance(value, torch.Tensor) else value

    return tree_map(wrap, made)


class _Stream:
    """A CUDA stream that records the calls."""

    def __init__(self, seen: Seen, device: Any = None) -> None:
        self.seen, self.device = seen, seen.placed(device)

    def wait_stream(self, other: object) -> None:
        self.seen.calls.append("wait_stream")


@contextlib.contextmanager
def pretended(monkeypatch: pytest.MonkeyPatch) -> Iterator[Seen]:
    """A context in which PyTorch has two GPUs."""
    seen = Seen()

    def recorded(name: str, given: Any = None) -> Any:
        def call(*of: Any) -> Any:
            seen.calls.append(name)
            return given(*of) if given else None

        return call

    def use(device: Any) -> None:
        seen.current = seen.placed(device)

    @contextlib.contextmanager
    def within(device: torch.device) -> Iterator[None]:
        before, seen.current = seen.current, device
        yield
        seen.current = before

    def record(tensor: torch.Tensor, stream: _Stream) -> None:
        assert tensor.device == stream.device

    def pin(tensor: torch.Tensor) -> torch.Tensor:
        seen.calls.append("pin_memory")
        copy = tensor.clone()
        copy.pinned_here = True
        return copy

    on_host = torch.tensor
    _device_constructors()  # PyTorch keeps these functions at the first call: the real torch.tensor among them

    def tensor(data: Any, *, device: Any = None, **more: Any) -> torch.Tensor:
        made = on_host(data, **more)
        return made if device is None else made.to(device)

    class Stream(_Stream):
        """A new stream. A class, since transformers has the name in annotations."""

        def __init__(self, *device: Any) -> None:
            seen.calls.append("Stream")
            super().__init__(seen, *device)

    class Threads(ThreadPoolExecutor):
        """Threads in which PyTorch also has the GPU, since dispatch keys are per thread."""

        def submit(self, work: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            def pretending() -> Any:
                with Pretending(seen):
                    return work(*args, **kwargs)

            return super().submit(pretending)

    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: None)
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", recorded("stream", lambda stream: within(stream.device)))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda *device: _Stream(seen, *device))
    monkeypatch.setattr(torch.cuda, "current_device", lambda: seen.current.index)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "empty_cache", recorded("empty_cache"))
    monkeypatch.setattr(torch.cuda, "set_device", recorded("set_device", use))
    monkeypatch.setattr(torch, "tensor", tensor)
    monkeypatch.setattr(torch.Tensor, "pin_memory", pin)
    monkeypatch.setattr(torch.Tensor, "record_stream", recorded("record_stream", record))
    monkeypatch.setattr(torch, "autocast", lambda **_: contextlib.nullcontext())  # asks the device
    for module in (scoring, threads):
        monkeypatch.setattr(module, "ThreadPoolExecutor", Threads)
    with Pretending(seen):
        yield seen
