# SPDX-License-Identifier: MIT
"""What holds a connection belongs to one process."""

from __future__ import annotations

from typing import NoReturn


class OneProcess:
    """Cannot be pickled or copied, and says what to pass instead."""

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            f"{type(self).__name__}: expected an object without a connection to pickle or copy: pass "
            "functools.partial(RewardClient, url) instead, and call that in each process"
        )
