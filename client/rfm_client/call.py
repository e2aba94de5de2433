# SPDX-License-Identifier: MIT
"""How one call is made: its options, its deadline, and the ids of its requests."""

from __future__ import annotations

import itertools
import secrets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypedDict

from rfm_client.contract import wire
from rfm_client.transport.deadline import Deadline

_ID_BYTES = 8  # of chance in the ids of a call's requests


class CallOptions(TypedDict, total=False):
    """How one call is made.

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


@dataclass(frozen=True)
class Call:
    """What the requests of one call share.

    outputs: beside the scores that the samples ask for
    request_ids: one for each request
    """

    deadline: Deadline
    outputs: tuple[str, ...]
    request_ids: Iterator[str]
    subsample: bool = False
    resize: bool = False

    @classmethod
    def of(cls, options: CallOptions, deadline: Deadline) -> Call:
        """The call with these options. Raises TypeError for an unknown one, ValueError for one that is not allowed."""
        check_known(options, CallOptions)
        optional = {wire.PROGRESS_LOGITS: options.get("logits", False), wire.TIMING_MS: options.get("timing", False)}
        outputs = tuple(name for name, wanted in optional.items() if wanted)
        return cls(
            deadline,
            outputs,
            new_request_ids(options.get("request_id")),
            subsample=options.get("subsample", False),
            resize=options.get("resize", False),
        )


def check_known(options: Mapping[str, object], known: type) -> None:
    """Raises TypeError for an option that ``known``, a TypedDict, lacks; it would otherwise be ignored in silence."""
    unknown = sorted(options.keys() - known.__annotations__)
    if unknown:
        raise TypeError(f"options: expected some of {', '.join(known.__annotations__)}, got {', '.join(unknown)}")


def new_request_ids(prefix: str | None) -> Iterator[str]:
    """Request ids of one call, which begin alike. Raises ValueError for a prefix that is not allowed."""
    if prefix is not None and not wire.REQUEST_ID.fullmatch(prefix):
        raise ValueError(f"request_id: expected 1 to 64 letters, digits or any of ._:/+=@-, got {prefix!r}")
    prefix = prefix or secrets.token_hex(_ID_BYTES)
    return (f"{prefix}-{number}" for number in itertools.count(1))
