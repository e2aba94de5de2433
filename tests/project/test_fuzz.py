# SPDX-License-Identifier: MIT
"""A short run of fuzz.py, and of kill_export.py; `make chaos` has the long ones."""

from __future__ import annotations

from pathlib import Path

import pytest

import fuzz
import kill_export

pytestmark = [pytest.mark.triton, pytest.mark.slow]

REQUESTS = 1000
KILLS = 6


def test_no_request_stops_the_server_or_is_blamed_on_it(tmp_path: Path) -> None:
    with fuzz.served(tmp_path) as doors:
        report = fuzz.fuzz(doors, REQUESTS, seed=1)
        assert report.num_late == 0
        assert report.ours == []
        assert report.still_right
        assert "Traceback" not in doors.log.read_text(errors="replace")
        for kind, counts in report.statuses.items():  # every door was reached
            assert counts.total() == REQUESTS // len(fuzz.KINDS), kind
        assert report.statuses["HTTP, odd samples"].keys() <= {"200", "400", "500"}
        assert not any(
            status.startswith("5")
            for kind in fuzz.KINDS
            if kind.startswith("gateway")
            for status in report.statuses[kind]
        )


def test_a_killed_export_leaves_a_repository_that_can_be_served(tmp_path: Path) -> None:
    trial = kill_export.Trial(tmp_path)
    try:
        assert len(list(trial.kills(KILLS))) == KILLS
        trial.finish()
    finally:
        trial.close()
