# SPDX-License-Identifier: MIT
"""The options, deadline and request ids of one call."""

from __future__ import annotations

import itertools
import secrets
from copy import copy
from typing import TypedDict

from rfm_client.contract import wire
from rfm_client.contract.errors import InvalidValueError
from rfm_client.transport.limits import Deadline

_ID_BYTES = 8  # random bytes in the ids of a call's requests


class CallOptions(TypedDict, total=False):
    """Options of every call.

    timeout_s: time limit; None: the client's
    logits: True: add the raw scores for the progress bins (checkpoints with bins only)
    log_prob: True: add a log-probability for each frame (TOPReward only)
    all_scores: True: add every other score for frames, except ``logits``
    timing: True: add the server's time for the batch
    subsample: True: score at most ``ModelInfo.max_frames`` frames, evenly spaced from first to last, as in training;
        ``frame_indices`` in the result lists them
    resize: True: shrink frames to the checkpoint's size before sending (needs Pillow); ReWiND's scores then differ
        slightly
    request_id: prefix for request ids in errors and in the server's log; None: random
    """

    timeout_s: float | None
    logits: bool
    log_prob: bool
    all_scores: bool
    timing: bool
    subsample: bool
    resize: bool
    request_id: str | None


class Call:
    """Values shared by all requests in one call. Raises ValueError for an invalid request id.

    outputs: outputs requested by name
    request_ids: an id for each request
    server: index of the server to ask first; None: the least busy
    checks_blank: True: tell of videos that show nothing
    """

    server: int | None = None
    checks_blank = True

    def __init__(
        self,
        deadline: Deadline,
        *,
        logits: bool = False,
        log_prob: bool = False,
        all_scores: bool = False,
        timing: bool = False,
        subsample: bool = False,
        resize: bool = False,
        request_id: str | None = None,
    ) -> None:
        if request_id is not None and not wire.REQUEST_ID.fullmatch(request_id):
            raise InvalidValueError.at("request_id", "1 to 64 letters, digits or any of ._:/+=@-", repr(request_id))
        prefix = request_id or secrets.token_hex(_ID_BYTES)
        self.deadline = deadline
        self.request_ids = (f"{prefix}-{number}" for number in itertools.count(1))
        options = {wire.PROGRESS_LOGITS: logits, "log_prob": log_prob, wire.TIMING_MS: timing}
        self.outputs = tuple(name for name, is_asked in options.items() if is_asked)
        self.all_scores, self.subsample, self.resize = all_scores, subsample, resize

    def at(self, server: int) -> Call:
        """Return a copy of the call that asks this server first."""
        call = copy(self)
        call.server = server
        return call
