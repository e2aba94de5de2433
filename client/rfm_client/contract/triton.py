# SPDX-License-Identifier: MIT
"""Translate Triton's and tritonclient's errors into RewardErrors.

A status is text, as in tritonclient: a name over gRPC, a number over HTTP. tests/triton/test_wording.py makes a real
Triton produce all these phrases.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeAlias, TypeVar

from rfm_client.contract import errors
from rfm_client.contract.addresses import grpc_proxy, with_proxy
from rfm_client.contract.wire import GOAL, NUM_FRAMES, VIEWS, encoder_name, frames_name

BadRequest: TypeAlias = Callable[[str], errors.RewardError]

UNAVAILABLE = ("StatusCode.UNAVAILABLE", "503")
OUT_OF_TIME = ("StatusCode.DEADLINE_EXCEEDED", "504")
CANCELLED = ("StatusCode.CANCELLED", "499")
BAD_GATEWAY = ("502",)  # a proxy's connection to the server ended or was refused
DENIED = ("StatusCode.UNAUTHENTICATED", "StatusCode.PERMISSION_DENIED", "401", "403")

_ServerError = TypeVar("_ServerError", bound=errors.ServerError)

_ERRORS: dict[tuple[str, ...], type[errors.RewardError]] = {
    ("StatusCode.INVALID_ARGUMENT", "400"): errors.InvalidSampleError,
    ("StatusCode.NOT_FOUND", "404"): errors.ModelNotFoundError,
    UNAVAILABLE: errors.ServerUnavailableError,
    CANCELLED: errors.ServerUnavailableError,  # not cancelled by the client: the server is stopping
    BAD_GATEWAY: errors.ServerUnavailableError,
    OUT_OF_TIME: errors.DeadlineExceededError,
}
_ERROR_OF = {status: error for statuses, error in _ERRORS.items() for status in statuses}

PROCESS_ENDED = "is not healthy"  # "Stub process 'rfm_0_0' is not healthy."
NO_VERSIONS = "no available versions"  # the model failed, or is reloading
LOST_REGION = "Unable to find shared memory region"  # the server was restarted
REGION_IN_USE = "it is currently in use"  # while unmapping a region
RESTRICTED = "is restricted, expecting header"  # the API needs a key
METADATA_PREFIX = "triton-grpc-protocol-"  # over gRPC, Triton puts it before the name of the key's header
AUTHORIZATION = "authorization"

_NO_CONNECTION = re.compile(  # gRPC's own messages: nothing was sent
    "failed to connect|connections to all backends failing|errors resolving|resolution failed"
)
_REASON = re.compile(r"(?:: |\[)((?:Connection|Domain name|Name|No route|Network)[\w ]+)\]?$")  # from libc or gRPC
_NO_GRPC = re.compile("Failed parsing HTTP/2|http1|: Socket closed")  # another protocol's answer
_PROXY_ALONE = "http2 header with status: 502"  # a proxy answered, but the server behind it did not
_LOST_CONNECTION = re.compile("Socket closed|Connection reset|Broken pipe|connection termination")  # or a proxy's
_NO_TRUST = re.compile(f"CERTIFICATE|certificate|[Vv]erification [Cc]heck failed|WRONG_VERSION_NUMBER|{RESTRICTED}")
_WRONG_SHAPE = re.compile(  # without the batch axis, which the caller did not add
    r"unexpected shape for input '(?P<name>\w+)'.*?Expected \[-1,(?P<expected>[^\]]*)\], got \[\d+,(?P<got>[^\]]*)\]"
)
_NO_INPUT = re.compile(
    r"(?:expected (?:number of inputs between \d+ and )?\d+ (?:inputs )?but got .*|unexpected .*input )"
    rf"'(?P<name>{'|'.join((*VIEWS, GOAL))})'"
)
_OF_VIEWS = (  # a model that has the input, one that lacks it, and the remedy
    "a model that reads views and a goal, such as Robo-Dopamine",
    "one that reads the frames of one camera",
    "leave out views and goal",
)
_NO_OUTPUT = re.compile(r"unexpected inference output '(\w+)'")
_FIELDS = re.compile(r"(\S+): expected (.*?), got (.*)", re.DOTALL)  # as written by ``LocatedError``
_PREFIX = re.compile(r"^(\[request id: [^\]]*\] )?(in ensemble '[^']*', )?")  # the caller knows both

FEWER_FRAMES = "score some of them (subsample=True), each on few before it (frame_steps), or by a sampling rule"
_START = (
    "start the server there (rfm serve), or give the URL of one that runs (with TLS: grpcs:// or https://; without: "
    "grpc:// or http://)"
)
_ONE_ADDRESS = "; or name 127.0.0.1: of localhost's addresses, IPv6 and IPv4, gRPC reports the fault of one alone"
_GRPC_PORT = "give that port, or http:// for the HTTP port, or grpcs:// with TLS"
_NAME = "give the checkpoint's name with model (--model)"
_FRAMES, _ENCODER = frames_name(""), encoder_name("")
_OF_PARTS = frames_name(_FRAMES), frames_name(_ENCODER)  # ask for frames of NAME_frames, NAME_encoder
_SHOW_KEY = "none was shown, or another: show the key that it wants with api_key (--api-key-file) or headers"
_TRUST = {
    "WRONG_VERSION_NUMBER": "use grpc:// or http:// for a server without TLS",
    "[Hh]ostname|IP address mismatch": "use a host name in the URL that its certificate has",
    "expired|not yet valid": "renew its certificate, or set the clock",
    "(?i)verify.failed": "name its authority, or its self-signed certificate itself, with ca_file (--ca-file)",
    "(?i)certificate.required": "show a certificate with client_certificate, client_key (--client-certificate, ...)",
}


def invalid_sample(text: str) -> errors.InvalidSampleError:
    """Return the error, with fields parsed from the server's text."""
    output = _NO_OUTPUT.search(text)
    if output is not None:
        return errors.InvalidSampleError(text, output[1])
    fields = _FIELDS.fullmatch(text)
    if fields is None:
        return errors.InvalidSampleError(text)
    where, expected, got = fields.groups()
    has_too_many = where.endswith(NUM_FRAMES) and expected.startswith("at most ")
    return errors.InvalidSampleError.at(where, expected, got, FEWER_FRAMES if has_too_many else "")


def error_from(raised: Exception, url: str, bad_request: BadRequest = invalid_sample) -> errors.RewardError | None:
    """Translate an exception from tritonclient or a library below it; None: any other exception.

    bad_request: makes the error for the status INVALID_ARGUMENT, which Triton also gives for an unknown model
    """
    for kind in type(raised).__mro__:  # by name, because these libraries may not be imported
        match kind.__name__:
            case "InferenceServerException":
                return _error_of_answer(raised, url, bad_request)
            case "TimeoutError":  # in Python 3.10 asyncio has its own class
                return errors.DeadlineExceededError(f"{with_proxy(url)}: no answer in time")
            case "SSLError" | "ClientSSLError":
                return denied(url, "", str(raised))
            case "ClientResponseError":
                return errors.InferenceFailedError(
                    f"{url}: expected an answer of Triton's HTTP port (by default 8000), got one in another protocol; "
                    "use grpc:// for its gRPC port"
                )
            case "ClientConnectorError" | "OSError" | "EOFError" | "HTTPException":
                number = getattr(raised, "errno", None) or 0
                return unreachable(url, os.strerror(number) if number > 0 else str(raised) or type(raised).__name__)
            case "ClientError":  # from aiohttp, after the request was sent
                lost = unreachable(url, str(raised) or type(raised).__name__)
                lost.may_have_ended_server = True
                return lost
            case "ValueError" | "LookupError" | "TypeError" | "AttributeError":  # from an answer that is not Triton's
                expected = "an answer of Triton's HTTP port (by default 8000) or gRPC port (8001)"
                return errors.InferenceFailedError(f"{url}: expected {expected}, got an unreadable one: {raised!r}")
    return None


def _error_of_answer(answer: Any, url: str, bad_request: BadRequest) -> errors.RewardError:
    status, message = str(answer.status()), answer.message() or ""
    if status in DENIED or (status == "StatusCode.UNAVAILABLE" and _NO_TRUST.search(message) is not None):
        return denied(url, status, message)
    if status == "StatusCode.UNAVAILABLE" and (_NO_CONNECTION.search(message) or _PROXY_ALONE in message):
        return unreachable(url, message)
    return error_of(status, message, bad_request)


def error_of(status: str, message: str, bad_request: BadRequest) -> errors.RewardError:
    """Translate Triton's status and message; ``bad_request`` as in ``error_from``."""
    text = _PREFIX.sub("", message or "no reason given")
    shape = _WRONG_SHAPE.search(text)
    if shape is not None:
        return errors.InvalidSampleError.at(shape["name"], f"[{shape['expected']}]", f"[{shape['got']}]")
    without = _NO_INPUT.search(text)
    if without is not None:
        return errors.InvalidSampleError.at(without["name"], *_OF_VIEWS)
    if PROCESS_ENDED in text and "Stub process" in text:
        return errors.ProcessEndedError(text)
    if f"has {NO_VERSIONS}" in text:
        return errors.ServerUnavailableError(f"{text}: the server stops, or loads the model")
    if LOST_REGION in text:  # the sample is not at fault: a retry may succeed
        return errors.ServerUnavailableError(text)
    kind = _ERROR_OF.get(status, errors.InferenceFailedError)
    error = bad_request(text) if kind is errors.InvalidSampleError else kind(text)
    if isinstance(error, errors.ServerUnavailableError):
        is_lost = _LOST_CONNECTION.search(text) is not None and not _NO_CONNECTION.search(text)
        error.may_have_ended_server = is_lost or status in BAD_GATEWAY
    return error


def bearer_headers(key: str) -> dict[str, str]:
    """Return the headers with an API key: the usual one, and the metadata that Triton expects over gRPC."""
    return dict.fromkeys((AUTHORIZATION, f"{METADATA_PREFIX}{AUTHORIZATION}"), f"Bearer {key}")


def over_http(headers: Mapping[str, str]) -> dict[str, str]:
    """Return the headers without Triton's gRPC metadata: proxies redact no keys under those names."""
    return {name: value for name, value in headers.items() if not name.startswith(METADATA_PREFIX)}


def denied(url: str, status: str, message: str) -> errors.AccessDeniedError:
    """Return the error for a refused connection or request, with its remedy."""
    remedy = next((remedy for words, remedy in _TRUST.items() if re.search(words, message)), "")
    if status in DENIED or RESTRICTED in message:
        remedy = _SHOW_KEY
    return _with_remedy(errors.AccessDeniedError, f"{url}: access denied: {message}", remedy)


def unreachable(url: str, reason: str) -> errors.ServerUnavailableError:
    """Return the error for a failed connection to the server or its proxy."""
    found = _REASON.search(reason)
    reason, remedy = (found[1] if found else reason), _START
    if url.startswith("grpc://") and _NO_GRPC.search(reason):
        reason, remedy = "no answer of Triton's gRPC port (by default 8001)", _GRPC_PORT
    if url.startswith("grpcs://localhost:"):
        remedy += _ONE_ADDRESS
    if grpc_proxy(url):
        remedy += "; or add the host to no_proxy, unless this proxy leads to it"
    return _with_remedy(errors.ServerUnavailableError, f"{with_proxy(url)}: no connection: {reason}", remedy)


def not_served(model: str, message: str, served: Collection[str]) -> errors.ModelNotFoundError:
    """Return the error for a missing model, with the served checkpoints' names and the remedy."""
    remedy = _NAME
    if frames_name(model) in served:
        remedy = "this checkpoint takes no embeddings: give frames, and ask model_info(frames=True)"
    elif model in map(frames_name, served) and not model.endswith(_OF_PARTS):
        remedy = "this checkpoint takes embeddings alone: export it with --image-encoder and --text-encoder"
    names = ", ".join(sorted({name.removesuffix(_FRAMES).removesuffix(_ENCODER) for name in served})) or "none"
    return _with_remedy(errors.ModelNotFoundError, f"{message}; served: {names}", remedy)


def _with_remedy(kind: type[_ServerError], fault: str, remedy: str) -> _ServerError:
    error = kind(f"{fault}: {remedy}" if remedy else fault)
    if remedy:
        error.fault, error.remedy = fault, remedy
    return error
