# SPDX-License-Identifier: MIT
"""What encoders have made of frames and tasks, kept by what these show: the least recently used goes first."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np

from rfm_client.contract import RewardError
from rfm_client.contract.samples import Float32Array

BYTES_PER_MB = 2**20
_ENTRY_BYTES = 256  # of a key, an array's header and a place in the order


Source = TypeVar("Source")
Kept = TypeVar("Kept", bound="_Array")


class _Array(Protocol):  # of NumPy, or a tensor on any device
    @property
    def nbytes(self) -> int: ...


class FeatureCache(Generic[Kept]):
    """Arrays by key, in bounded memory. For any threads.

    limit_bytes: of all arrays together; what does not fit is not kept

    A key must hold a digest of what the array was made of, computed where it was: never one that a caller claims.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.num_bytes = 0
        self._arrays: OrderedDict[Hashable, Kept] = OrderedDict()
        self._changing = threading.Lock()

    def __len__(self) -> int:
        return len(self._arrays)

    def clear(self) -> None:
        """Forgets every array that it keeps."""
        with self._changing:
            self._arrays.clear()
            self.num_bytes = 0

    def found(self, keys: Iterable[Hashable]) -> dict[Hashable, Kept]:
        """The arrays of those keys that have some; they count as used now."""
        with self._changing:
            found = {key: self._arrays[key] for key in keys if key in self._arrays}
            for key in found:
                self._arrays.move_to_end(key)
        return found

    def keep(self, arrays: Mapping[Hashable, Kept]) -> None:
        """Keeps arrays, and lets go of those that were used least recently if there are too many.

        arrays: none is a view, which would keep all that it is a part of
        """
        with self._changing:
            for key, array in arrays.items():
                if key not in self._arrays:
                    self._arrays[key] = array
                    self.num_bytes += array.nbytes + _ENTRY_BYTES
            while self.num_bytes > self.limit_bytes:
                _, array = self._arrays.popitem(last=False)
                self.num_bytes -= array.nbytes + _ENTRY_BYTES


def get_or_make(
    cache: FeatureCache[Float32Array],
    wanted: Iterable[bytes],
    sources: Mapping[bytes, Source],
    make: Callable[[Sequence[Source]], Sequence[Float32Array | RewardError]],
    is_always_made: Callable[[Source], bool] = lambda _: False,
) -> tuple[dict[bytes, Float32Array | RewardError], int]:
    """The features of the wanted keys: those that are kept, and those that are made of their sources now, each once.
    A key that has neither is left out. And how many were made.

    What cannot be made, or is not finite, is not kept.

    is_always_made: of which sources features are made although some are kept
    """
    wanted = list(dict.fromkeys(wanted))
    kept = cache.found(key for key in wanted if key not in sources or not is_always_made(sources[key]))
    found = {key: kept[key] for key in wanted if key in kept}
    missing = [key for key in wanted if key not in found and key in sources]
    made = dict(zip(missing, make([sources[key] for key in missing]) if missing else [], strict=True))
    good = {key: each for key, each in made.items() if not isinstance(each, RewardError)}
    finite = {key: each for key, each in good.items() if np.isfinite(each).all()}
    cache.keep({key: each if each.base is None else each.copy() for key, each in finite.items()})
    return {**found, **made}, len(missing)
