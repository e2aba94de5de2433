# SPDX-License-Identifier: MIT
"""A model process that ends by itself. Each test runs in a separate process."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import pytest

PATIENCE_S = 60.0
GUARD = """
    import os, sys, threading, time
    from types import SimpleNamespace
    from rfm.triton_model.watchdog import Watchdog
    WORKS = threading.Event()
    watchdog = Watchdog(0.8, WORKS.is_set)
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    program = textwrap.dedent(GUARD) + textwrap.dedent(code)
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


@pytest.mark.parametrize(
    "hang", ["time.sleep(3600)", "ctypes.PyDLL(None).sleep(3600)  # unlike CDLL, it keeps Python's lock"]
)
def test_a_batch_that_hangs_ends_the_process_and_the_log_says_where(hang: str) -> None:
    ended = run(f"""
        import ctypes
        def hanging():
            {hang}
        WORKS.set()
        hanging()
    """)
    assert ended.returncode == 1
    assert "Timeout" in ended.stderr and "in hanging" in ended.stderr


@pytest.mark.slow
def test_a_batch_that_gets_on_and_a_model_that_waits_go_on() -> None:
    ended = run("""
        WORKS.set()
        for _ in range(15):
            time.sleep(0.1)
            watchdog.step()
        WORKS.clear()
        time.sleep(1.5)
        watchdog.close()
        sys.exit(7)
    """)
    assert ended.returncode == 7, ended.stderr


BATCHES = """
    scored = SimpleNamespace(outcome="scored", is_counted=False)
    failed = SimpleNamespace(outcome="failed", is_counted=True)
    refused = SimpleNamespace(outcome="refused", is_counted=True)
    def broken():
        raise RuntimeError("a lost device")
"""


def test_an_instance_that_fails_at_the_blank_sample_after_three_failed_batches_ends() -> None:
    ended = run(f"""{BATCHES}
    for batches, blank in (
        ([[failed], [failed], [failed]], broken),  # it never scored the blank sample
        ([[scored], [failed], [failed], [failed, scored], [failed]], broken),  # not in a row
        ([[scored], [refused], [refused], [refused]], broken),
        ([[scored], [failed], [failed], [failed]], lambda: None),  # the inputs fail
        ([[scored], [failed], [failed, refused]], broken),
    ):
        for batch in batches:
            watchdog.look_at(batch, blank)
    print("goes on", flush=True)
    watchdog.look_at([failed], broken)
    os._exit(7)
    """)
    assert (ended.returncode, ended.stdout) == (1, "goes on\n"), ended.stderr
    assert "a lost device" in ended.stderr
