# SPDX-License-Identifier: MIT
"""What the kernel tells of the processes that another has started."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from rfm.launch import proc
from rfm_serve import wait_for


@pytest.mark.parametrize("has_lists", [True, False])
def test_children_are_found_dead_or_alive(monkeypatch: pytest.MonkeyPatch, has_lists: bool) -> None:
    if not has_lists:  # a kernel without CONFIG_PROC_CHILDREN
        monkeypatch.setattr(Path, "exists", lambda *_: False)
    children = [subprocess.Popen(["sleep", "3600"]) for _ in range(2)]
    try:
        children[0].kill()
        wait_for(lambda: (stat := proc.stat_of(children[0].pid)) is not None and stat.state == proc.ZOMBIE)
        assert {child.pid for child in children} <= set(proc.children_of(os.getpid()))
        assert os.getppid() not in proc.children_of(os.getpid())
    finally:
        for child in children:
            child.kill()
            child.wait()
    assert not {child.pid for child in children} & set(proc.children_of(os.getpid()))
