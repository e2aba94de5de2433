# SPDX-License-Identifier: MIT
"""A server's process: its log, on standard error, and the number of files that it may have open.

`rfm serve`, the gateway and the model processes write one format:

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
_OURS = ("rfm", "rfm_client", "rfm_gateway")  # loggers that the level is for: at DEBUG, libraries would log too much
_IN_IDS = "._:/+=@-"  # besides letters and digits
_MOST_IDS, _MOST_LETTERS = 64, 64  # in a line
_ID_BYTES = 8  # random, for a request without an id

_requests: ContextVar[str] = ContextVar("requests", default="")


def write_log(process: str, environment: Mapping[str, str]) -> None:
    """Write this process's log to standard error. A line that cannot be written is dropped.

    process: name of the process in each line
    environment: its LEVEL_VARIABLE is the lowest level of the project's own lines; default: INFO

    Raises ConfigError for an unknown level.
    """
    level = environment.get(LEVEL_VARIABLE, "INFO").upper()
    if level not in _LEVELS:
        raise ConfigError.at(LEVEL_VARIABLE, f"one of {', '.join(_LEVELS)}", f"{level!r:.100}")
    root = logging.getLogger()
    for each in [each for each in root.handlers if type(each) is logging.StreamHandler]:
        root.removeHandler(each)  # for the short lines of a command, which becomes a server here
    handler = _StandardError()
    handler.setFormatter(LogLines(process))
    logging.basicConfig(handlers=[handler], level=logging.INFO)
    for name in _OURS:
        logging.getLogger(name).setLevel(level)


def begin_request(given: str = "") -> str:
    """Return the id of a request, and name it in every line that is logged in this context from now on.

    given: the caller's id. A random id replaces an id that breaks log lines, or by which metrics would count a probe
    """
    is_usable = REQUEST_ID.fullmatch(given) and not given.startswith(PROBE_PREFIX)
    request_id = given if is_usable else secrets.token_hex(_ID_BYTES)
    _requests.set(_in_log([request_id]))
    return request_id


@contextmanager
def about(ids: Iterable[str]) -> Iterator[None]:
    """Context manager in which every logged line names these requests."""
    token = _requests.set(_in_log(ids))
    try:
        yield
    finally:
        _requests.reset(token)


def _in_log(ids: Iterable[str]) -> str:
    """Return ids without spaces, separated by commas: the beginnings of the first ones."""
    return ",".join(quote(each[:_MOST_LETTERS], safe=_IN_IDS) for each in islice(ids, _MOST_IDS))


class _StandardError(logging.Handler):
    """Unbuffered, so that a line that could not be written leaves nothing behind that fails at exit."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(Exception):  # a full disk, a closed pipe, arguments that do not fit the message
            if sys.stderr is not None:  # None: closed, and another file may have its number
                os.write(2, self.format(record).encode(errors="backslashreplace"))


class LogLines(logging.Formatter):
    """Formatter that puts a head before each line of a record, so that neither tracebacks nor callers can forge lines.

    process: name of the process in each line
    """

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Return the lines of a record, each with a newline."""
        text = record.getMessage()
        if record.exc_info:
            text += f"\n{self.formatException(record.exc_info)}"
        when = datetime.fromtimestamp(record.created, timezone.utc).isoformat(timespec="milliseconds")
        whose = f"{self._process}[{record.process}]" + (f" request={_requests.get()}" if _requests.get() else "")
        head = f"{when.replace('+00:00', 'Z')} {record.levelname} {whose}: "
        return "".join(f"{head}{_printable(line)}\n" for line in text.splitlines())


def _printable(line: str) -> str:
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in line)


MOST = 2**16  # some container runtimes allow 2**30, and programs that walk through all descriptors then stand still


def raise_limit() -> int:
    """Raise this process's limit to what its user may have, at most MOST; return the limit. Children inherit it."""
    if sys.platform == "win32":
        return MOST
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = MOST if hard == resource.RLIM_INFINITY else min(hard, MOST)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        with suppress(OSError, ValueError):  # macOS allows less than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MOST if soft == resource.RLIM_INFINITY else soft
