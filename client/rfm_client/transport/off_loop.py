# SPDX-License-Identifier: MIT
"""Work that takes a while, out of the event loop's way."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Returned = TypeVar("Returned")

MIN_BYTES = 2**20  # copying less takes no longer than changing threads


async def off_loop(
    num_bytes: int, work: Callable[Arguments, Returned], *arguments: Arguments.args, **options: Arguments.kwargs
) -> Returned:
    """What ``work`` gives, which handles so many bytes: in a thread if they are many."""
    if num_bytes < MIN_BYTES:
        return work(*arguments, **options)
    return await asyncio.to_thread(work, *arguments, **options)
