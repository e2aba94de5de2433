# SPDX-License-Identifier: MIT
"""Errors of a connection, which end in what mends them."""

from __future__ import annotations

import re
from collections.abc import Collection

from rfm_client.contract import errors, triton

_START = "start the server there (rfm serve), or give the URL of one that runs"
_NO_PROXY = "unset that variable, or add the server's host to no_proxy"
_SHOW_KEY = "show the key that it wants with api_key (--api-key-file) or headers"
_TRUST = {
    "[Hh]ostname|IP address mismatch": "use a host name in the URL that its certificate has",
    "expired|not yet valid": "renew its certificate, or set the clock",
    "(?i)verify.failed": "name its authority, or its self-signed certificate itself, with ca_file (--ca-file)",
    "(?i)certificate.required": "show a certificate with client_certificate, client_key (--client-certificate, ...)",
}


def denied(url: str, status: str, message: str) -> errors.AccessDeniedError:
    """The error of two sides of which one refuses the other."""
    is_keyed = status in triton.DENIED or triton.RESTRICTED in message
    fitting = (remedy for words, remedy in _TRUST.items() if re.search(words, message))
    remedy = _SHOW_KEY if is_keyed else next(fitting, None)
    return errors.AccessDeniedError(f"{url}: access denied: {message}{f': {remedy}' if remedy else ''}")


def unreachable(url: str, reason: str, proxy: str | None = None) -> errors.ServerUnavailableError:
    """The error of a server to which there is no connection, be it because of a proxy (``grpc_proxy``)."""
    if proxy is None:
        return errors.ServerUnavailableError(f"{url}: no connection: {reason}: {_START}")
    return errors.ServerUnavailableError(f"{url}: no connection through {proxy}: {reason}: {_NO_PROXY}")


def not_served(message: str, served: Collection[str]) -> errors.ModelNotFoundError:
    """The error of a server that lacks a model, with those that it serves."""
    names = ", ".join(sorted(served)) or "none"
    return errors.ModelNotFoundError(f"{message}; served: {names}: give the checkpoint's name with model (--model)")
