# SPDX-License-Identifier: MIT
"""A bounded cache for frame and task features, by digest."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from rfm.engine.threads import FrameThreads
from rfm_client.contract import RewardError
from rfm_client.contract.samples import Float32Array, UInt8Array
from rfm_client.contract.wire import frame_digest

BYTES_PER_MIB = 2**20
_ENTRY_BYTES = 256  # key, array header and ordered dict entry


Source = TypeVar("Source")
Kept = TypeVar("Kept", bound=Any)  # a NumPy array, or a tensor on any device


class FeatureCache(Generic[Kept]):
    """Arrays by key, thread-safe. The least recently used arrays are removed first.

    limit_bytes: total size limit, with a fixed overhead per array

    Compute a key's digest here, from the array's source: a caller's digest could name other content.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.num_bytes = 0
        self._arrays: OrderedDict[Hashable, Kept] = OrderedDict()
        self._changing = threading.Lock()

    def __len__(self) -> int:
        return len(self._arrays)

    def clear(self) -> None:
        """Remove every array from the cache."""
        with self._changing:
            self._arrays.clear()
            self.num_bytes = 0

    def found(self, keys: Iterable[Hashable]) -> dict[Hashable, Kept]:
        """Return the cached arrays among ``keys``, and mark them as recently used."""
        with self._changing:
            found = {key: self._arrays[key] for key in keys if key in self._arrays}
            for key in found:
                self._arrays.move_to_end(key)
        return found

    def keep(self, arrays: Mapping[Hashable, Kept]) -> None:
        """Add arrays, then remove the least recently used until the rest fits ``limit_bytes``.

        arrays: no views, since a view keeps the whole array behind it in memory
        """
        with self._changing:
            for key, array in arrays.items():
                if key not in self._arrays:
                    self._arrays[key] = array
                    self.num_bytes += array.nbytes + _ENTRY_BYTES
            while self.num_bytes > self.limit_bytes:
                _, array = self._arrays.popitem(last=False)
                self.num_bytes -= array.nbytes + _ENTRY_BYTES


def digests_of(frames: Sequence[UInt8Array], threads: FrameThreads) -> list[bytes]:
    """Return the frames' digests, uint8 [H, W, 3], computed in these threads."""
    parts = threads.parts(lambda part: [frame_digest(frame) for frame in part], frames)
    return [digest for part in parts for digest in part]


def get_or_make(
    cache: FeatureCache[Float32Array],
    wanted: Iterable[bytes],
    sources: Mapping[bytes, Source],
    make: Callable[[Sequence[Source]], Sequence[Float32Array | RewardError]],
    is_always_made: Callable[[Source], bool] = lambda _: False,
) -> tuple[dict[bytes, Float32Array | RewardError], int]:
    """Return features for the wanted keys, cached or newly made, and how many were made.

    Each feature is made once. Keys without cached features and without a source are left out. Errors and features
    with NaN or infinite values are not cached.

    is_always_made: True for a source whose cached features must not be used
    """
    wanted = list(dict.fromkeys(wanted))
    kept = cache.found(wanted)
    found = {key: kept[key] for key in wanted if key in kept and not (key in sources and is_always_made(sources[key]))}
    missing = [key for key in wanted if key not in found and key in sources]
    made = dict(zip(missing, make([sources[key] for key in missing]) if missing else [], strict=True))
    good = {key: each for key, each in made.items() if not isinstance(each, RewardError)}
    finite = {key: each for key, each in good.items() if np.isfinite(each).all()}
    cache.keep({key: each if each.base is None else each.copy() for key, each in finite.items()})
    return {**found, **made}, len(missing)
