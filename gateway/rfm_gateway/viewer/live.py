# SPDX-License-Identifier: MIT
"""The episodes that clients report while they run, as the page shows them. They are in memory alone, and few.

Reports are checked to the last field, since nobody vouches for them. The page asks a few times a second what is new,
and is answered at once: an answer that stays open would keep the gateway from stopping as long as somebody looks at it.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import io
import itertools
import json
import reprlib
import secrets
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from PIL import Image, UnidentifiedImageError
from pydantic import BaseModel, BeforeValidator, ConfigDict, FailFast, Field, StringConstraints, ValidationError

from rfm_client.transport.off_loop import off_loop
from rfm_gateway.body import BodyLimits, field_errors

MOST_BODY_BYTES = 4 * 2**20
MOST_EPISODES = 128  # first those go that have ended, then those that have been silent for longest
MOST_POINTS = 1000  # of one curve: the newest
FORGOTTEN_AFTER_S = 300.0  # of silence
MOST_FRAME_BYTES = 128 * 2**10
MOST_FRAME_PX = 1024  # on each side
_MOST_FRAMES = 64
_MOST_STEPS = 2000  # of one report of our client; so each of its episodes has so many at most, too
_MOST_LETTERS = 2000
_MOST_NUMBER = 10**9  # a chart's axis goes further than to whole numbers
_MOST_DIGITS = 15  # of a cursor's number
_HEADERS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}


def _jpeg(text: Any) -> bytes:
    """The file in a text of base64. Raises ValueError. Only its head is read here: it is not decoded."""
    if not isinstance(text, str):
        raise ValueError(f"expected base64, got {type(text).__name__}")
    if len(text) > MOST_FRAME_BYTES * 4 // 3:
        raise ValueError(f"expected at most {MOST_FRAME_BYTES} bytes, got more")
    try:
        content = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise ValueError("expected base64, got other text") from None
    expected = f"expected a JPEG file of at most {MOST_FRAME_PX}x{MOST_FRAME_PX} pixels"
    try:
        with Image.open(io.BytesIO(content), formats=["JPEG"]) as image:
            size = image.size
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise ValueError(f"{expected}, got another file") from None
    if max(size) > MOST_FRAME_PX:
        raise ValueError(f"{expected}, got {size[0]}x{size[1]}")
    return content


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


_Id = Annotated[str, StringConstraints(pattern="^[0-9a-f]{32}$")]
_Text = Annotated[str, StringConstraints(max_length=_MOST_LETTERS)]
_Count = Annotated[int, Field(ge=0, le=_MOST_NUMBER)]


class _Step(_Strict):
    step: _Count
    progress: float | None
    success: float | None
    succeeded: bool
    ms: Annotated[float, Field(ge=0)]


class _ReportedEpisode(_Strict):
    id: _Id
    name: _Text
    env: _Count
    task: _Text
    threshold: float | None
    ended: bool
    steps: Annotated[list[_Step], FailFast(), Field(max_length=_MOST_STEPS)]


class LiveReport(_Strict):
    """What one report says: steps in their order, and JPEG files by the episodes' ids."""

    episodes: Annotated[list[_ReportedEpisode], FailFast(), Field(max_length=_MOST_STEPS)]
    frames: Annotated[dict[_Id, Annotated[bytes, BeforeValidator(_jpeg)]], Field(max_length=_MOST_FRAMES)]

    @classmethod
    def read(cls, body: bytes) -> LiveReport:
        """The report in JSON. Raises RequestValidationError for a field that is not allowed."""
        try:
            return cls.model_validate_json(body)
        except ValidationError as error:
            raise RequestValidationError(field_errors(error)) from None


@dataclass
class _KeptEpisode:
    """What is known of an episode.

    about: its name, env, task and threshold
    changed, frame_changed: number of the report that brought the newest of it
    points: the newest, each with the number of the report that brought it
    """

    about: dict[str, Any]
    heard_s: float = 0.0
    changed: int = 0
    has_ended: bool = False
    points: deque[tuple[int, dict[str, Any]]] = field(default_factory=lambda: deque(maxlen=MOST_POINTS))
    frame: bytes | None = None
    frame_changed: int = 0

    def since(self, known: int) -> dict[str, Any]:
        """What is new since the report of a number."""
        if self.changed <= known:
            return {}
        new = [point for _, point in itertools.takewhile(lambda each: each[0] > known, reversed(self.points))][::-1]
        return {
            **self.about,
            "has_ended": self.has_ended,
            "frame": self.frame_changed or None,
            "newest": self.points[-1][1] if self.points else None,
            "steps": [point["step"] for point in new],
            "progress": [point["progress"] for point in new],
            "success": [point["success"] for point in new],
        }


class LiveEpisodes:
    """The newest episodes, each with its newest frame and points. For one thread.

    Each answer has a cursor. Asked with it, the next answer has only what is new.

    clock_s: gives the time in seconds
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._episodes: dict[str, _KeptEpisode] = {}  # first the one that has been silent for longest
        self._changed = 0
        self._life = secrets.token_hex(8)  # a cursor of an earlier gateway is none of this one

    def take(self, report: LiveReport) -> None:
        """Takes a report over. Of an episode that is not known, an end or a frame alone is left out."""
        self._changed += 1
        for told in report.episodes:
            if not told.steps and told.id not in self._episodes:
                continue
            about = told.model_dump(include={"name", "env", "task", "threshold"})
            episode = self._episodes.pop(told.id, None) or _KeptEpisode(about)
            episode.heard_s, episode.changed = self._clock_s(), self._changed
            episode.has_ended |= told.ended
            for step in told.steps:
                if not episode.points or step.step > episode.points[-1][1]["step"]:  # a report may come twice
                    episode.points.append((self._changed, step.model_dump()))
            self._episodes[told.id] = episode
        for key, frame in report.frames.items():
            if key in self._episodes:
                episode = self._episodes[key]
                episode.frame, episode.frame_changed, episode.changed = frame, self._changed, self._changed
        self._forget()

    def since(self, cursor: str) -> dict[str, Any]:
        """All episodes, and of those that have changed since a cursor what is new. The answer has the next cursor.

        cursor: of an earlier answer; any other text: nothing is known yet
        """
        self._forget()
        life, _, number = cursor.partition(".")
        is_number = number.isascii() and number.isdecimal() and len(number) <= _MOST_DIGITS
        known = int(number) if life == self._life and is_number else 0
        return {
            "cursor": f"{self._life}.{self._changed}",
            "is_whole": known == 0,
            "most_points": MOST_POINTS,
            "episodes": [
                {"id": key, "age_s": self._clock_s() - episode.heard_s, **episode.since(known)}
                for key, episode in self._episodes.items()
            ],
        }

    def frame(self, key: str) -> bytes | None:
        """The newest frame of an episode, a JPEG file; None: there is none."""
        episode = self._episodes.get(key)
        return None if episode is None else episode.frame

    def _forget(self) -> None:
        oldest_s = self._clock_s() - FORGOTTEN_AFTER_S
        kept = {key: episode for key, episode in self._episodes.items() if episode.heard_s >= oldest_s}
        ended_first = sorted(kept, key=lambda key: not kept[key].has_ended)
        for key in ended_first[: max(0, len(kept) - MOST_EPISODES)]:
            del kept[key]
        self._episodes = kept


def live_routes(limits: BodyLimits) -> APIRouter:
    """The endpoints of running episodes. They are the page's, and not those of the evaluation server."""
    router, episodes = APIRouter(include_in_schema=False), LiveEpisodes()

    @router.post("/live/reports", status_code=204)
    async def report(request: Request) -> None:
        kind = request.headers.get("content-type", "").partition(";")[0].strip()
        if kind != "application/json":  # which no page of elsewhere may send unasked
            raise HTTPException(415, f"content-type: expected application/json, got {reprlib.repr(kind)}")
        body = await limits.read(request, MOST_BODY_BYTES)
        episodes.take(await off_loop(len(body), LiveReport.read, body))

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
