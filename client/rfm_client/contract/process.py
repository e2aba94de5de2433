# SPDX-License-Identifier: MIT
"""A server process: its log on standard error, and how many files it may open.

`rfm serve`, the gateway and the model processes write the same format:

2026-11-27T09:30:00.123Z ERROR rfm-gateway[57] request=7f62c7f345dedac0-1: the message
"""

from __future__ import annotations

import logging
import os
import secrets
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from datetime import datetime, timezone
from itertools import islice
from urllib.parse import quote

from rfm_client.contract.settings import ConfigError
from rfm_client.contract.wire import PROBE_PREFIX, REQUEST_ID

LEVEL_VARIABLE = "RFM_LOG_LEVEL"

_LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")
_OURS = ("rfm", "rfm_client", "rfm_gateway")  # loggers that the level applies to: at DEBUG, libraries log too much
_IN_IDS = "._:/+=@-"  # allowed besides letters and digits
_MOST_IDS, _MOST_LETTERS = 64, 64  # per line, per id
_ID_BYTES = 8  # random bytes for a request without an id

_requests: ContextVar[str] = ContextVar("requests", default="")


def write_log(process: str, environment: Mapping[str, str]) -> None:
    """Write this process's log to standard error. Lines that cannot be written are dropped.

    process: process name in every line
    environment: LEVEL_VARIABLE sets the lowest level for the project's own lines; default: INFO

    Raises ConfigError for an unknown level.
    """
    level = environment.get(LEVEL_VARIABLE, "INFO").upper()
    if level not in _LEVELS:
        raise ConfigError.at(LEVEL_VARIABLE, f"one of {', '.join(_LEVELS)}", f"{level!r:.100}")
    root = logging.getLogger()
    for each in [each for each in root.handlers if type(each) is logging.StreamHandler]:
        root.removeHandler(each)  # it writes a command's short lines, but the command becomes a server here
    handler = _StandardError()
    handler.setFormatter(LogLines(process))
    logging.basicConfig(handlers=[handler], level=logging.INFO)
    for name in _OURS:
        logging.getLogger(name).setLevel(level)


def begin_request(given: str = "") -> str:
    """Return a request id, and add it to every line logged in this context from now on.

    given: the caller's id. A random id replaces one that breaks log lines or that metrics would count as a probe
    """
    is_usable = REQUEST_ID.fullmatch(given) and not given.startswith(PROBE_PREFIX)
    request_id = given if is_usable else secrets.token_hex(_ID_BYTES)
    _requests.set(_in_log([request_id]))
    return request_id


@contextmanager
def about(ids: Iterable[str]) -> Iterator[None]:
    """Context manager that adds these request ids to every logged line."""
    token = _requests.set(_in_log(ids))
    try:
        yield
    finally:
        _requests.reset(token)


def _in_log(ids: Iterable[str]) -> str:
    """Return the first ids, truncated, without spaces, separated by commas."""
    return ",".join(quote(each[:_MOST_LETTERS], safe=_IN_IDS) for each in islice(ids, _MOST_IDS))


class _StandardError(logging.Handler):
    """Unbuffered handler, so that an unwritable line leaves nothing behind that fails at exit."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(Exception):  # a full disk, a closed pipe, arguments that do not fit the message
            if sys.stderr is not None:  # None: closed, and another file may now use the number
                os.write(2, self.format(record).encode(errors="backslashreplace"))


class LogLines(logging.Formatter):
    """Formatter that puts a head before every line in a record, so that neither tracebacks nor callers can forge lines.

    process: process name in every line
    """

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's lines, each ending in a newline."""
        text = record.getMessage()
        if record.exc_info:
            text += f"\n{self.formatException(record.exc_info)}"
        when = datetime.fromtimestamp(record.created, timezone.utc).isoformat(timespec="milliseconds")
        whose = f"{self._process}[{record.process}]" + (f" request={_requests.get()}" if _requests.get() else "")
        head = f"{when.replace('+00:00', 'Z')} {record.levelname} {whose}: "
        return "".join(f"{head}{_printable(line)}\n" for line in text.splitlines())


def _printable(line: str) -> str:
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in line)


MOST_FILES = 2**16  # some container runtimes allow 2**30, and programs that loop over all descriptors then hang


def raise_limit() -> int:
    """Raise this process's limit to the user's maximum, at most MOST_FILES. Return it; children inherit it."""
    if sys.platform == "win32":
        return MOST_FILES
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        with suppress(OSError, ValueError):  # macOS allows less than it reports
            resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MOST_FILES if soft == resource.RLIM_INFINITY else soft
