# SPDX-License-Identifier: MIT
"""Reports of running episodes come in here, and the page asks here what is new.

The page asks a few times a second, and is answered at once. An answer that stays open would keep the gateway from
stopping as long as somebody looks at the page.
"""

from __future__ import annotations

import asyncio
import json
import reprlib

import anyio
from fastapi import APIRouter, HTTPException, Request, Response

from rfm_client.transport.off_loop import off_loop
from rfm_gateway.body import BodyLimits, parsed_bytes
from rfm_gateway.viewer.live import LiveEpisodes
from rfm_gateway.viewer.live_report import MOST_BODY_BYTES, read_report

_HEADERS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}


def live_routes(limits: BodyLimits, timeout_s: float) -> APIRouter:
    """The endpoints of running episodes. They are the page's, and not those of the evaluation server."""
    router, episodes = APIRouter(include_in_schema=False), LiveEpisodes()

    @router.post("/live/reports", status_code=204)
    async def report(request: Request) -> None:
        kind = request.headers.get("content-type", "").partition(";")[0].strip()
        if kind != "application/json":  # which no page of elsewhere may send unasked
            raise HTTPException(415, f"content-type: expected application/json, got {reprlib.repr(kind)}")
        with limits.admitted(request, MOST_BODY_BYTES) as admitted:
            await admitted.wait_for_room(request.state.begin_by)
            with anyio.fail_after(timeout_s):
                body = await admitted.request.body()
            admitted.share.take(parsed_bytes(body))
            episodes.take(*await off_loop(len(body), read_report, body, admitted.share))

    @router.get("/viewer/live")
    async def news(after: str = "") -> Response:
        text = await asyncio.to_thread(json.dumps, episodes.since(after), allow_nan=False)
        return Response(text, media_type="application/json", headers=_HEADERS)

    @router.get("/viewer/live/{episode}/frame")
    async def frame(episode: str) -> Response:
        found = episodes.frame(episode)
        if found is None:
            raise HTTPException(404, "episode: expected one that runs and has a frame, got another")
        return Response(found, media_type="image/jpeg", headers=_HEADERS)

    return router
