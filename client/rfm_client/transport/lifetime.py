# SPDX-License-Identifier: MIT
"""Bases of objects with connections: they close after a ``with`` block and stay in their process."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from typing_extensions import Self


class OneProcess:
    """An object with a connection, which cannot be pickled or copied."""

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            f"{type(self).__name__}: expected an object without a connection to pickle or copy: pass "
            "functools.partial(RewardClient, url) instead, and call that in each process"
        )


class Closing:
    """A context manager that closes itself."""

    def close(self) -> None:
        """Release the resources of this object."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        self.close()


class AsyncClosing:
    """An async context manager that closes itself."""

    async def close(self) -> None:
        """Release the resources of this object."""
        raise NotImplementedError

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_raised: object) -> None:
        await self.close()
