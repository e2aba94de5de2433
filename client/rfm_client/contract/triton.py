# SPDX-License-Identifier: MIT
"""How a server says what went wrong: the status of an answer, and its wording where the status does not say enough.

Statuses are as tritonclient gives them: gRPC's by name, HTTP's by number. tests/triton/test_wording.py asks a real
Triton for each of its phrases.
"""

from __future__ import annotations

import re

from rfm_client.contract import errors
from rfm_client.contract.wire import SECOND_FRAMES

UNAVAILABLE = ("StatusCode.UNAVAILABLE", "503")
OUT_OF_TIME = ("StatusCode.DEADLINE_EXCEEDED", "504")
CANCELLED = ("StatusCode.CANCELLED", "499")
BAD_GATEWAY = ("502",)  # of a proxy whose connection to the server ended, or was refused
DENIED = ("StatusCode.UNAUTHENTICATED", "StatusCode.PERMISSION_DENIED", "401", "403")

_ERRORS: dict[tuple[str, ...], type[errors.RewardError]] = {
    ("StatusCode.INVALID_ARGUMENT", "400"): errors.InvalidSampleError,
    ("StatusCode.NOT_FOUND", "404"): errors.ModelNotFoundError,
    UNAVAILABLE: errors.ServerUnavailableError,
    CANCELLED: errors.ServerUnavailableError,  # not by the client: the server is stopping
    BAD_GATEWAY: errors.ServerUnavailableError,
    OUT_OF_TIME: errors.DeadlineExceededError,
}
_ERROR_OF = {status: error for statuses, error in _ERRORS.items() for status in statuses}

PROCESS_ENDED = "is not healthy"  # "Stub process 'rfm_0_0' is not healthy."
NO_VERSIONS = "no available versions"  # of a model that is being loaded again, or failed
LOST_REGION = "Unable to find shared memory region"  # of a server that was started again
REGION_IN_USE = "it is currently in use"  # of a region to unmap: tests/client/test_shared_memory_faults.py
RESTRICTED = "is restricted, expecting header"  # of an API that wants a key

_NO_CONNECTION = re.compile("failed to connect|errors resolving|resolution failed")  # of gRPC itself: nothing was sent
_LOST_CONNECTION = re.compile("Socket closed|Connection reset|Broken pipe|connection termination")  # or of a proxy
_NO_TRUST = re.compile(f"CERTIFICATE|certificate|[Vv]erification [Cc]heck failed|WRONG_VERSION_NUMBER|{RESTRICTED}")
_WRONG_SHAPE = re.compile(  # behind the batch axis, which the caller did not make
    r"unexpected shape for input '(?P<name>\w+)'.*?Expected \[-1,(?P<expected>[^\]]*)\], got \[\d+,(?P<got>[^\]]*)\]"
)
_NO_SECOND_FRAMES = re.compile(rf"expected \d+ inputs but got .*'{SECOND_FRAMES}'|unexpected .*input '{SECOND_FRAMES}'")
_TOO_MANY_FRAMES = re.compile(r"\bnum_frames: expected at most \d")
_PREFIX = re.compile(r"^(\[request id: [^\]]*\] )?(in ensemble '[^']*', )?")  # the caller knows both


def is_denied(status: str, message: str) -> bool:
    """Whether one side refused the other: no key, a wrong one, or a certificate that is not trusted."""
    return status in DENIED or (status == "StatusCode.UNAVAILABLE" and _NO_TRUST.search(message) is not None)


def is_unreachable(status: str, message: str) -> bool:
    """Whether gRPC found no connection to the server."""
    return status == "StatusCode.UNAVAILABLE" and _NO_CONNECTION.search(message) is not None


def error_of(status: str, message: str, bad_request: type[errors.RewardError]) -> errors.RewardError:
    """The error that an answer of Triton means to a caller.

    bad_request: what INVALID_ARGUMENT means; Triton answers it for an unknown model, too
    """
    text = _PREFIX.sub("", message or "no reason given")
    shape = _WRONG_SHAPE.search(text)
    if shape is not None:
        return bad_request(f"{shape['name']}: expected [{shape['expected']}], got [{shape['got']}]")
    if _NO_SECOND_FRAMES.search(text):
        expected = "a model that takes pairs of two frame sizes"
        got = "one that was exported before there was this input: export it again, or resize a trajectory"
        return bad_request(f"{SECOND_FRAMES}: expected {expected}, got {got}")
    if PROCESS_ENDED in text and "Stub process" in text:
        return errors.ProcessEndedError(text)
    if LOST_REGION in text or f"has {NO_VERSIONS}" in text:  # the sample is not at fault: another try may succeed
        return errors.ServerUnavailableError(text)
    if _TOO_MANY_FRAMES.search(text):
        text += ": score some of them (subsample=True), each on few before it (frame_steps), or by a sampling rule"
    kind = _ERROR_OF.get(status, errors.InferenceFailedError)
    error = (bad_request if kind is errors.InvalidSampleError else kind)(text)
    if isinstance(error, errors.ServerUnavailableError):
        is_lost = _LOST_CONNECTION.search(text) is not None and not _NO_CONNECTION.search(text)
        error.may_have_ended_server = is_lost or status in BAD_GATEWAY
    return error
