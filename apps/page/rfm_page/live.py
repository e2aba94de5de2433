# SPDX-License-Identifier: MIT
"""Running episodes that clients report, for the page: at most MOST_EPISODES, in memory.

Every field of a report is checked. The page polls a few times a second. Answers are not held open, since an open answer
would keep the gateway from stopping while a page is shown.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import io
import itertools
import json
import secrets
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from PIL import Image, UnidentifiedImageError
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    FailFast,
    Field,
    StringConstraints,
    ValidationError,
)

from rfm_client.serving import off_loop
from rfm_gateway.mounting import BodyLimits, field_errors
from rfm_page.scores import ABOUT, INSTEAD

MOST_BODY_BYTES = 4 * 2**20
MOST_EPISODES = 128  # ended episodes are forgotten first, then the longest silent
MOST_ENDED = 4096  # results of ended episodes; the newest are kept
MOST_POINTS = 1000  # of a curve; the newest are kept
FORGOTTEN_AFTER_S = 300.0  # of silence
MOST_FRAME_BYTES = 128 * 2**10
MOST_FRAME_PX = 1024  # on each side
_MOST_FRAMES = 64
_MOST_STEPS = 2000  # of a report by our client
_MOST_LETTERS = 2000
_MOST_NUMBER = 10**9  # the limit of a step's number
_MOST_DIGITS = 15  # of a cursor's number
_HEADERS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}


def _jpeg(text: Any) -> bytes:
    """Return the JPEG file in base64. Checks its header and does not decode it. Raises ValueError."""
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


def _known(scores: dict[str, float]) -> dict[str, float]:
    if others := sorted(set(scores) - set(INSTEAD)):
        raise ValueError(f"expected only {', '.join(INSTEAD)}, got {others[0]!r}")
    return scores


class _Step(_Strict):
    """A step. instead: what the model predicts in place of progress, by the score's name"""

    step: _Count
    progress: float | None
    success: float | None
    succeeded: bool
    ms: Annotated[float, Field(ge=0)]
    instead: Annotated[dict[str, float], AfterValidator(_known)] = {}


class _ReportedEpisode(_Strict):
    """An episode. reward, total_reward: the newest reward that was paid, and the sum so far; None: none was"""

    id: _Id
    name: _Text
    env: _Count
    task: _Text
    threshold: float | None
    ended: bool
    reward: float | None = None
    total_reward: float | None = None
    steps: Annotated[list[_Step], FailFast(), Field(max_length=_MOST_STEPS)]


class LiveReport(_Strict):
    """A report: steps in order, and JPEG files by episode id."""

    episodes: Annotated[list[_ReportedEpisode], FailFast(), Field(max_length=_MOST_STEPS)]
    frames: Annotated[dict[_Id, Annotated[bytes, BeforeValidator(_jpeg)]], Field(max_length=_MOST_FRAMES)]

    @classmethod
    def read(cls, body: bytes) -> LiveReport:
        """Read a report from JSON. Raises RequestValidationError for an invalid field."""
        try:
            return cls.model_validate_json(body)
        except ValidationError as error:
            raise RequestValidationError(field_errors(error)) from None


@dataclass
class _KeptEpisode:
    """A reported episode.

    about: its name, env, task and threshold
    changed, frame_changed: number of the report with the newest change, and with the newest frame
    points: the newest points, each with the number of its report
    """

    about: dict[str, Any]
    heard_s: float = 0.0
    changed: int = 0
    has_ended: bool = False
    reward: float | None = None
    total_reward: float | None = None
    points: deque[tuple[int, dict[str, Any]]] = field(default_factory=lambda: deque(maxlen=MOST_POINTS))
    frame: bytes | None = None
    frame_changed: int = 0

    def since(self, known: int) -> dict[str, Any]:
        """Return the changes since a report, by its number."""
        if self.changed <= known:
            return {}
        newest = self.points[-1][1] if self.points else None
        new = [point for _, point in itertools.takewhile(lambda each: each[0] > known, reversed(self.points))][::-1]
        return {
            **self.about,
            "has_ended": self.has_ended,
            "reward": self.reward,
            "total_reward": self.total_reward,
            "frame": self.frame_changed or None,
            "newest": newest,
            "steps": [point["step"] for point in new],
            "progress": [point["progress"] for point in new],
            "success": [point["success"] for point in new],
            "instead": {
                name: [point["instead"].get(name) for point in new] for name in (newest["instead"] if newest else ())
            },
        }

    def result(self, key: str, number: int) -> dict[str, Any]:
        """Return how the episode ended. number: its number in its run, from 1"""
        newest = self.points[-1][1] if self.points else None
        instead = next(iter(newest["instead"].items()), None) if newest else None
        leading, value = instead or ("progress", newest["progress"] if newest else None)
        return {
            "id": key,
            "run": self.about["name"],
            "number": number,
            "total_reward": self.total_reward,
            "leading": leading,
            "value": value,
            "success": newest["success"] if newest else None,
            "succeeded": bool(newest and newest["succeeded"]),
            "num_steps": newest["step"] + 1 if newest else 0,
        }


class LiveEpisodes:
    """The newest episodes, each with its newest frame and points, and how episodes ended. For one thread.

    Each answer has a cursor. With it, the next answer has only changes.

    clock_s: returns the time in seconds
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._episodes: dict[str, _KeptEpisode] = {}  # the longest silent first
        self._ended: dict[str, tuple[int, dict[str, Any]]] = {}  # results with the number of their report, oldest first
        self._changed = 0
        self._life = secrets.token_hex(8)  # makes cursors of an earlier gateway invalid

    def take(self, report: LiveReport) -> None:
        """Add a report. An end or a frame of an unknown episode without steps is ignored."""
        self._changed += 1
        for told in report.episodes:
            if not told.steps and told.id not in self._episodes:
                continue
            about = told.model_dump(include={"name", "env", "task", "threshold"})
            episode = self._episodes.pop(told.id, None) or _KeptEpisode(about)
            episode.heard_s, episode.changed = self._clock_s(), self._changed
            episode.has_ended |= told.ended
            if told.total_reward is not None:
                episode.reward, episode.total_reward = told.reward, told.total_reward
            for step in told.steps:
                if not episode.points or step.step > episode.points[-1][1]["step"]:  # a client may send a report twice
                    episode.points.append((self._changed, step.model_dump()))
            self._episodes[told.id] = episode
            if episode.has_ended:
                self._end(told.id, episode)
        for key, frame in report.frames.items():
            if key in self._episodes:
                episode = self._episodes[key]
                episode.frame, episode.frame_changed, episode.changed = frame, self._changed, self._changed
        self._forget()

    def since(self, cursor: str) -> dict[str, Any]:
        """Return all episodes, with the changes since a cursor, and the next cursor.

        cursor: from an earlier answer; any other text: everything counts as a change
        """
        self._forget()
        life, _, number = cursor.partition(".")
        is_number = number.isascii() and number.isdecimal() and len(number) <= _MOST_DIGITS
        known = int(number) if life == self._life and is_number else 0
        return {
            "cursor": f"{self._life}.{self._changed}",
            "is_whole": known == 0,
            "most_points": MOST_POINTS,
            "scores": ABOUT,
            "episodes": [
                {"id": key, "age_s": self._clock_s() - episode.heard_s, **episode.since(known)}
                for key, episode in self._episodes.items()
            ],
            "ended": [end for changed, end in self._ended.values() if changed > known],
        }

    def _end(self, key: str, episode: _KeptEpisode) -> None:
        """Keep how an episode ended. The last steps and rewards may come after the end."""
        if key in self._ended:
            number = self._ended[key][1]["number"]
        else:
            own = (end["number"] for _, end in reversed(self._ended.values()) if end["run"] == episode.about["name"])
            number = next(own, 0) + 1
        self._ended[key] = self._changed, episode.result(key, number)
        if len(self._ended) > MOST_ENDED:
            del self._ended[next(iter(self._ended))]

    def frame(self, key: str) -> bytes | None:
        """Return the newest frame of an episode as a JPEG file, or None."""
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
    """Return the endpoints of running episodes. The evaluation server has no such endpoints."""
    router, episodes = APIRouter(include_in_schema=False), LiveEpisodes()

    @router.post("/live/reports", status_code=204)
    async def report(request: Request) -> None:
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
