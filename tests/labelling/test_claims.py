# SPDX-License-Identifier: MIT
"""Claims: an episode is of one process, until that process has ended or is silent; and it is said who is waited for."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from labelling import LEROBOT, BrightnessScorer
from rfm_client.labelling import LabelOptions, Watch, label, open_dataset
from rfm_client.labelling.claims import Claims
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.label import plan_labels
from rfm_client.labelling.plan import Item

ROOT = LEROBOT / "toy_v30_many"


def item() -> Item:
    return Item(open_dataset(ROOT).episodes[0], "0" * 32, 0)


@pytest.mark.parametrize("url", ["memory://labels/claims", "{}"])
def test_a_claim_holds_until_it_is_given_back_or_its_process_ends(output: Path, url: str) -> None:
    parts = Parts(url.format(output))
    with Claims(parts) as first, Claims(parts) as second:
        assert first.take(item())
        assert not second.take(item())
        first.give_back(item())
        assert second.take(item())
        second.give_back(item())
        ended = subprocess.Popen([sys.executable, "-c", ""])
        ended.wait()
        owner = json.dumps({"host": socket.gethostname(), "pid": ended.pid}).encode()
        parts.fs.pipe_file(parts.path(item().key + ".claim"), owner)
        assert first.take(item())


def test_a_claim_of_another_machine_expires_unless_it_is_renewed(output: Path) -> None:
    parts = Parts(str(output))
    path = output / (item().key + ".claim")
    path.write_text(json.dumps({"host": "another machine", "pid": 1}))
    with Claims(parts, expiry_s=30, renewal_s=0.01) as claims:
        assert not claims.take(item())
        os.utime(path, (time.time() - 31, time.time() - 31))
        assert claims.take(item())
        os.utime(path, (time.time() - 31, time.time() - 31))
        while path.stat().st_mtime < time.time() - 30:
            time.sleep(0.005)  # until it is renewed
        assert not Claims(parts, expiry_s=30).take(item())
    assert not path.exists()


def test_a_claim_from_the_future_is_of_a_wrong_clock_and_expires_too(output: Path) -> None:
    path = output / (item().key + ".claim")
    path.write_text(json.dumps({"host": "another machine", "pid": 1}))
    with Claims(Parts(str(output)), expiry_s=30) as claims:
        os.utime(path, (time.time() + 20, time.time() + 20))
        assert not claims.take(item())
        os.utime(path, (time.time() + 3600, time.time() + 3600))
        assert claims.take(item())


def test_a_claim_that_cannot_be_read_is_named_with_the_remedy(output: Path) -> None:
    path = output / (item().key + ".claim")
    path.mkdir()
    with Claims(Parts(str(output))) as claims, pytest.raises(OSError) as caught:
        claims.take(item())
    advice = "delete it if no process labels this dataset"
    assert str(caught.value) == f"{path}: expected a claim that can be read and deleted, got Is a directory: {advice}"


class Waiting(Watch):
    """Ends the other machine's claim as soon as the run says that it waits for it."""

    def __init__(self, claim: Path) -> None:
        self.claim, self.lines = claim, [""]

    def note(self, text: str) -> None:
        if text.startswith("waiting"):
            self.lines.append(text)
            self.claim.unlink()


def test_a_run_says_for_which_claim_it_waits_and_what_to_delete(output: Path) -> None:
    options = LabelOptions(output=output, episodes=[4, 5], formats=("progress",))
    keys = [item.key for item in plan_labels(open_dataset(ROOT), BrightnessScorer(), options).items]
    claim = output / ".rfm_parts" / f"{keys[1]}.claim"
    claim.parent.mkdir()
    claim.write_text('{"host": "another machine", "pid": 1}')
    os.utime(claim, (time.time() - 9, time.time() - 9))
    watch = Waiting(claim)
    report = label(open_dataset(ROOT), BrightnessScorer(), options, watch)
    owner = f'episode 5: {claim}: claimed by {{"host": "another machine", "pid": 1}}, whose last sign of life'
    (told,) = watch.lines[1:]
    assert re.fullmatch(
        rf"waiting for {re.escape(owner)} was \d+ s ago: it is void 60 s after that; .* you may delete the file", told
    )
    assert report.files == [output / "rfm_progress.parquet"]
