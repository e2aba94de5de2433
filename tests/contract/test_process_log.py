# SPDX-License-Identifier: MIT
"""The log lines of `rfm serve`, the gateway and the model processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rfm_client.options import ConfigError
from rfm_client.serving import write_log

HEAD = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z"
PROGRAM = """
import logging, os, sys
from rfm_client.contract.process import about, write_log
write_log("rfm-serve", os.environ)
log = logging.getLogger("rfm.serve")
"""


def run(code: str, **options: Any) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", PROGRAM + code]
    return subprocess.run(words, **{"stderr": subprocess.PIPE, "text": True, "check": False, **options})


def test_each_line_has_time_level_process_and_requests_also_those_of_a_traceback() -> None:
    ended = run("""
log.debug("not at this level")
log.info("ready: %s", "rfm")
with about(["a-1", "b\\n2,c"]):
    try:
        raise ValueError("two\\nlines \\x1b[31m")
    except ValueError:
        log.exception("failed")
""")
    ready, *failed = ended.stderr.splitlines()
    assert re.fullmatch(rf"{HEAD} INFO rfm-serve\[\d+\]: ready: rfm", ready)
    heads, messages = zip(*(line.split(": ", 1) for line in failed), strict=True)
    assert all(re.fullmatch(rf"{HEAD} ERROR rfm-serve\[\d+\] request=a-1,b%0A2%2Cc", head) for head in heads)
    assert messages[:2] == ("failed", "Traceback (most recent call last):")
    assert messages[-2:] == ("ValueError: two", r"lines \x1b[31m")


def test_a_log_that_cannot_be_written_ends_nothing() -> None:
    """A full disk, a pipe without a reader, and no standard error."""
    code = """
for _ in range(1000):
    log.warning("a line")
sys.exit(7)
"""
    reading, writing = os.pipe()
    os.close(reading)
    with Path("/dev/full").open("w") as full, os.fdopen(writing, "w") as closed:
        assert [run(code, stderr=broken).returncode for broken in (full, closed)] == [7, 7]
    words = ["/bin/sh", "-c", 'exec "$@" 2>&-', "sh", sys.executable, "-c", PROGRAM + code]
    assert subprocess.run(words, check=False).returncode == 7


def test_the_level_is_a_variable() -> None:
    assert run('log.debug("told")', env={**os.environ, "RFM_LOG_LEVEL": "debug"}).stderr.endswith(": told\n")
    with pytest.raises(ConfigError, match="RFM_LOG_LEVEL: expected one of DEBUG, INFO, WARNING, ERROR, got 'LOUD'"):
        write_log("rfm-serve", {"RFM_LOG_LEVEL": "loud"})
