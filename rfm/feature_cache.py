# SPDX-License-Identifier: MIT
"""What encoders have made of frames and tasks, kept by what these show: the least recently used goes first."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from rfm_client.contract import RewardError
from rfm_client.contract.samples import Float32Array

Source = TypeVar("Source")

BYTES_PER_MB = 2**20
_ENTRY_BYTES = 256  # of a key, an array's header and a place in the order


class FeatureCache:
    """Features by key, in bounded memory. For one thread.

    limit_bytes: of all features together; what does not fit is not kept

    A key must be a digest of what the features were made of, computed where they were: never one that a caller claims.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.num_bytes = 0
        self._features: OrderedDict[bytes, Float32Array] = OrderedDict()

    def __len__(self) -> int:
        return len(self._features)

    def get_or_make(
        self,
        wanted: Iterable[bytes],
        sources: Mapping[bytes, Source],
        make: Callable[[Sequence[Source]], Sequence[Float32Array | RewardError]],
    ) -> tuple[dict[bytes, Float32Array | RewardError], int]:
        """The features of the wanted keys: those that are kept, and those that are made of their sources now, each
        once. A key that has neither is left out. And how many were made.

        What cannot be made, or is not finite, is not kept.
        """
        wanted = list(dict.fromkeys(wanted))
        found = self.found(wanted)
        missing = [key for key in wanted if key not in found and key in sources]
        made = dict(zip(missing, make([sources[key] for key in missing]) if missing else [], strict=True))
        good = {key: each for key, each in made.items() if not isinstance(each, RewardError)}
        self.keep({key: each for key, each in good.items() if np.isfinite(each).all()})
        return {**found, **made}, len(missing)

    def found(self, keys: Iterable[bytes]) -> dict[bytes, Float32Array]:
        """The features of those keys that have some; they count as used now."""
        found = {key: self._features[key] for key in keys if key in self._features}
        for key in found:
            self._features.move_to_end(key)
        return found

    def keep(self, features: Mapping[bytes, Float32Array]) -> None:
        """Keeps features, and lets go of those that were used least recently if there are too many."""
        for key, array in features.items():
            if key not in self._features:
                self._features[key] = array if array.base is None else array.copy()  # a view keeps all that it is of
                self.num_bytes += _size(array)
        while self.num_bytes > self.limit_bytes:
            _, array = self._features.popitem(last=False)
            self.num_bytes -= _size(array)


def _size(array: Float32Array) -> int:
    return array.nbytes + _ENTRY_BYTES
