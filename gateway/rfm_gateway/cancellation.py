# SPDX-License-Identifier: MIT
"""Callers who hang up: their requests are cancelled."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from fastapi import Request

Returned = TypeVar("Returned")


class CallerLeftError(Exception):
    """The caller has hung up before the answer was there."""


async def while_connected(request: Request, work: Coroutine[Any, Any, Returned]) -> Returned:
    """What ``work`` gives. If the caller hangs up, it is cancelled with its requests to Triton: CallerLeftError.

    The body of the request must have been read.
    """
    working = asyncio.create_task(work)
    leaving = asyncio.create_task(_disconnected(request))
    try:
        await asyncio.wait((working, leaving), return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise CallerLeftError("the caller has hung up")
        return working.result()
    finally:
        for task in (working, leaving):
            task.cancel()
        await asyncio.gather(working, leaving, return_exceptions=True)


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
