# SPDX-License-Identifier: MIT
"""How objects that hold something end: at the end of a ``with`` block, and in the process that made them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from typing_extensions import Self


class OneProcess:
    """Holds a connection: cannot be pickled or copied, and says what to pass instead."""

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            f"{type(self).__name__}: expected an object without a connection to pickle or copy: pass "
            "functools.partial(RewardClient, url) instead, and call that in each process"
        )


class Closing:
    """A context manager that closes itself."""

    def close(self) -> None:
        """Gives back what it holds."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        self.close()


class AsyncClosing:
    """An async context manager that closes itself."""

    async def close(self) -> None:
        """Gives back what it holds."""
        raise NotImplementedError

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_raised: object) -> None:
        await self.close()
