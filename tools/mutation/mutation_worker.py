# SPDX-License-Identifier: MIT
"""Runs the tests of one mutant after the other, each in a process of its own, in the copy that it stands in.

Reads jobs from its standard input, a line of JSON each, and writes pytest's exit code of each; -1: out of time.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import select
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from paths import ROOT

LOG = ROOT / "tmp" / "tests.log"
SHARED_MEMORY = Path("/dev/shm")
# Of what tests need, that which takes long to import and bears a fork. gRPC does not.
HEAVY = (
    "torch", "torch.nn.functional", "numpy", "safetensors.torch", "yaml", "huggingface_hub", "PIL.Image",
    "httpx", "transformers.models.auto", "transformers.models.qwen2_5_vl.modeling_qwen2_5_vl",
    "transformers.models.qwen3_vl.modeling_qwen3_vl", "transformers.models.smolvlm.modeling_smolvlm",
    "transformers.models.dinov2.modeling_dinov2", "transformers.models.bert.modeling_bert", "tokenizers",
)  # fmt: skip
PR_SET_CHILD_SUBREAPER = 36


class InProcess:
    """Leaves out the tests that need a server with every reference checkpoint: it takes minutes to start."""

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = [item for item in items if "served" not in item.fixturenames]


def main() -> None:
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)  # what a test leaves behind becomes our child
    signal.signal(signal.SIGTERM, end)
    for name in HEAVY:
        importlib.import_module(name)
    for line in sys.stdin:
        job = json.loads(line)
        originals = {ROOT / name: (ROOT / name).read_bytes() for name in job["changed"]}
        for name, content in job["changed"].items():
            (ROOT / name).write_text(content)
        print(code_of(job["tests"], job["limit_s"]), flush=True)
        for file, original in originals.items():
            file.write_bytes(original)


def code_of(tests: list[str], limit_s: float) -> int:
    """pytest's exit code; -1 if it was not there in time."""
    child = os.fork()
    if not child:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.setsid()
        output = os.open(LOG, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(output, stream)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os._exit(pytest.main(["-x", "-p", "no:cacheprovider", *tests], plugins=[InProcess()]))
    handle = os.pidfd_open(child)
    in_time = bool(select.select([handle], [], [], limit_s)[0])
    os.close(handle)
    pids = [child, *descendants(os.getpid())]
    if not in_time:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    end_what_is_left()
    for pid in pids:
        for region in SHARED_MEMORY.glob(f"*rfm_{pid}_*"):
            region.unlink(missing_ok=True)
    return os.waitstatus_to_exitcode(status) if in_time else -1


def descendants(pid: int) -> list[int]:
    """Children, their children, and so on."""
    found: list[int] = []
    with suppress(OSError):  # it has ended meanwhile
        children = [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
        found = [one for child in children for one in (child, *descendants(child))]
    return found


def end(*_: object) -> None:
    """Ends with all that tests have started."""
    end_what_is_left()
    os._exit(0)


def end_what_is_left() -> None:
    """Kills what the tests have left, and what that leaves."""
    while left := descendants(os.getpid()):
        for pid in left:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(-1, 0)


if __name__ == "__main__":
    main()
