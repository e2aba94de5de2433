# SPDX-License-Identifier: MIT
"""Long work in a thread, so that the event loop is not blocked."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Returned = TypeVar("Returned")

MIN_BYTES = 2**20  # a smaller copy takes no longer than a change of thread


async def off_loop(
    num_bytes: int | None, work: Callable[Arguments, Returned], *arguments: Arguments.args, **options: Arguments.kwargs
) -> Returned:
    """Return the result of ``work``, which handles ``num_bytes``. From MIN_BYTES, or for None, it runs in a thread."""
    if num_bytes is not None and num_bytes < MIN_BYTES:
        return work(*arguments, **options)
    return await asyncio.to_thread(work, *arguments, **options)
