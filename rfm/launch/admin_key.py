# SPDX-License-Identifier: MIT
"""The key without which a server's models, logging and tracing cannot be changed.

``rfm serve`` always restricts these APIs of Triton. Shared memory stays open: clients on the same host use it, and a
region has its maker's name. Triton takes the key only as an argument, so this user and root can see it in ``/proc``. It
is in no log, message or environment of a process started here.
"""

from __future__ import annotations

import re
import secrets
import stat
from collections.abc import Mapping, MutableMapping
from pathlib import Path

from rfm_client.contract.names import ADMIN_KEY_VARIABLE

VARIABLE = ADMIN_KEY_VARIABLE
HEADER = "rfm-admin-key"
MIN_CHARACTERS = 16

_GRPC_PREFIX = "triton-grpc-protocol-"  # Triton puts it before the name
_RESTRICTED = "model-repository,logging,trace"
_RANDOM_BYTES = 32
_VISIBLE = re.compile("[!-~]*")  # what a header can carry as it is


class AdminKeyError(Exception):
    """A key that cannot be used: where it stands and what was expected, never the key."""


def new_key() -> str:
    """A new random key, as text that fits in a URL."""
    return secrets.token_urlsafe(_RANDOM_BYTES)


def take_key(file: Path | None, environment: MutableMapping[str, str]) -> str | None:
    """The key in ``file``, else that of ``environment``; None if there is neither.

    It is taken out of ``environment``, so that no process that is started has it. Raises AdminKeyError.
    """
    given = environment.pop(VARIABLE, None)
    if file is not None:
        return _checked(_read(file), f"--admin-key-file: {file}")
    return None if given is None else _checked(given, VARIABLE)


def restrictions(key: str) -> list[str]:
    """Arguments of tritonserver that refuse administrative requests without ``key``."""
    return [
        f"--{option}={_RESTRICTED}:{HEADER}={key}" for option in ("http-restricted-api", "grpc-restricted-protocol")
    ]


def http_headers(key: str | None) -> Mapping[str, str]:
    """What an HTTP request to a restricted API shows."""
    return {} if key is None else {HEADER: key}


def grpc_metadata(key: str | None) -> Mapping[str, str]:
    """What a gRPC request to a restricted API shows."""
    return {} if key is None else {f"{_GRPC_PREFIX}{HEADER}": key}


def _read(file: Path) -> str:
    """The key in a file whose permissions are as strict as PostgreSQL's of a private key.

    The owner alone; a file of root's may be read by its group too, which is how containers are handed a secret.
    """
    try:
        status = file.stat()
        if not stat.S_ISREG(status.st_mode):
            raise AdminKeyError(f"--admin-key-file: expected a file, got {file}, which is none")
        expected = 0o640 if status.st_uid == 0 else 0o600
        mode = stat.S_IMODE(status.st_mode)
        if mode & ~expected:
            owner = "root's file" if status.st_uid == 0 else "file"
            raise AdminKeyError(
                f"--admin-key-file: {file}: expected mode {expected:o} or less of a {owner}, got {mode:o}"
            )
        return file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise AdminKeyError(f"--admin-key-file: expected a text file at {file}, got: {reason}") from None


def _checked(text: str, where: str) -> str:
    key = text.strip()
    if len(key) < MIN_CHARACTERS:
        raise AdminKeyError(f"{where}: expected at least {MIN_CHARACTERS} characters, got {len(key)}")
    if not _VISIBLE.fullmatch(key):
        raise AdminKeyError(f"{where}: expected visible ASCII characters without spaces, got others")
    return key
