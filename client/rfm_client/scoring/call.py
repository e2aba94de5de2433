# SPDX-License-Identifier: MIT
"""How one call is made: its options, its deadline, and the ids of its requests."""

from __future__ import annotations

import itertools
import secrets
from typing import TypedDict

from rfm_client.contract import wire
from rfm_client.transport.deadline import Deadline

_ID_BYTES = 8  # of chance in the ids of a call's requests


class CallOptions(TypedDict, total=False):
    """Options that every call takes.

    timeout_s: the longest that it may take, instead of the client's
    logits: with the raw scores of the progress bins, which only discrete checkpoints have
    timing: with the server's time for the batch
    subsample: of a trajectory longer than ``ModelInfo.max_frames`` so many frames are scored, evenly from the first to
        the last, as training cuts its clips; ``frame_indices`` names them (None: all)
    resize: frames are made as small as the checkpoint reads them before they are sent (needs Pillow); ReWiND's scores
        differ slightly from those of the frames as they are
    request_id: with which the ids of the call's requests begin, in errors and in the server's log (None: a random one)
    """

    timeout_s: float | None
    logits: bool
    timing: bool
    subsample: bool
    resize: bool
    request_id: str | None


class Call:
    """What the requests of one call share. Raises ValueError for a request id that is not allowed.

    outputs: beside the scores that the samples ask for
    request_ids: one for each request
    """

    def __init__(
        self,
        deadline: Deadline,
        *,
        logits: bool = False,
        timing: bool = False,
        subsample: bool = False,
        resize: bool = False,
        request_id: str | None = None,
    ) -> None:
        if request_id is not None and not wire.REQUEST_ID.fullmatch(request_id):
            raise ValueError(f"request_id: expected 1 to 64 letters, digits or any of ._:/+=@-, got {request_id!r}")
        prefix = request_id or secrets.token_hex(_ID_BYTES)
        self.deadline = deadline
        self.request_ids = (f"{prefix}-{number}" for number in itertools.count(1))
        self.outputs = (*[wire.PROGRESS_LOGITS] * logits, *[wire.TIMING_MS] * timing)
        self.subsample, self.resize = subsample, resize
