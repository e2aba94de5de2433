# SPDX-License-Identifier: MIT
"""The key that protects a server's models, logging and tracing against changes.

``rfm serve`` always restricts these APIs of Triton. Shared memory stays open, because clients on the same host use it.
Triton takes the key only as an argument, so its user and root can read it in ``/proc``. No log, message or environment
of a child process holds the key.
"""

from __future__ import annotations

import re
import secrets
import stat
from collections.abc import Mapping, MutableMapping
from pathlib import Path

from rfm_client.contract.checks import require
from rfm_client.contract.errors import InvalidValueError
from rfm_client.contract.names import ADMIN_KEY_VARIABLE

VARIABLE = ADMIN_KEY_VARIABLE
HEADER = "rfm-admin-key"
MIN_CHARACTERS = 16

_GRPC_PREFIX = "triton-grpc-protocol-"  # Triton puts it before the name
_RESTRICTED = "model-repository,logging,trace"
_RANDOM_BYTES = 32
_VISIBLE = re.compile("[!-~]*")  # characters that a header can carry unchanged


def new_key() -> str:
    """Return a new random key, as URL-safe text."""
    return secrets.token_urlsafe(_RANDOM_BYTES)


def take_key(file: Path | None, environment: MutableMapping[str, str]) -> str | None:
    """Return the key in ``file``, else the key in ``environment``, else None. Raises InvalidValueError.

    Removes the key from ``environment``, so that no child process gets it.
    """
    given = environment.pop(VARIABLE, None)
    if file is not None:
        return _checked(_read(file), f"--admin-key-file: {file}")
    return None if given is None else _checked(given, VARIABLE)


def restrictions(key: str) -> list[str]:
    """Return arguments of tritonserver that refuse administrative requests without ``key``."""
    return [
        f"--{option}={_RESTRICTED}:{HEADER}={key}" for option in ("http-restricted-api", "grpc-restricted-protocol")
    ]


def http_headers(key: str | None) -> Mapping[str, str]:
    """Return the headers of an HTTP request to a restricted API."""
    return {} if key is None else {HEADER: key}


def grpc_metadata(key: str | None) -> Mapping[str, str]:
    """Return the metadata of a gRPC request to a restricted API."""
    return {} if key is None else {f"{_GRPC_PREFIX}{HEADER}": key}


def _read(file: Path) -> str:
    """Return the key in a file with permissions as strict as PostgreSQL demands of a private key.

    Only the owner may read it. The group may also read a file that root owns, since containers get secrets that way.
    """
    try:
        status = file.stat()
        require("--admin-key-file", stat.S_ISREG(status.st_mode), "a file", f"{file}, which is none")
        expected = 0o640 if status.st_uid == 0 else 0o600
        mode = stat.S_IMODE(status.st_mode)
        if mode & ~expected:
            owner = "root's file" if status.st_uid == 0 else "file"
            raise InvalidValueError.at(
                f"--admin-key-file: {file}", f"mode {expected:o} or less of a {owner}", f"{mode:o}"
            )
        return file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise InvalidValueError.at("--admin-key-file", f"a text file at {file}", reason) from None


def _checked(text: str, where: str) -> str:
    key = text.strip()
    require(where, len(key) >= MIN_CHARACTERS, f"at least {MIN_CHARACTERS} characters", len(key))
    require(where, bool(_VISIBLE.fullmatch(key)), "visible ASCII characters without spaces", "others")  # shows no key
    return key
