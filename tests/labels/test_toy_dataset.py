# SPDX-License-Identifier: MIT
"""The guide's comparison of two checkpoints on the toy dataset."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import toy_dataset
from in_process import rfm_app, rfm_client_app
from paths import ROOT
from rfm_client.contract.description import TOY
from rfm_labels import evaluate_labels, read_outcomes

GUIDE = ROOT / "docs" / "guides" / "how_good_is_it.md"
COMMAND = re.compile(r"^ {4}((?:python|rfm|rfm-client) .*demo_output/toy(?:.*\\\n)*.*)", re.MULTILINE)
ROW = re.compile(r"^ *(early|full) +(\d.*) \S+ *$", re.MULTILINE)  # without the rate, which differs from run to run


def run(command: str) -> str:
    """Return the output of a command of the guide, run in this process."""
    example = typer.Typer()
    example.command()(toy_dataset.write)
    program, *words = shlex.split(command.replace("\\\n", " "))
    if program == "python":
        assert words.pop(0) == "examples/toy_dataset.py"
    done = CliRunner().invoke({"python": example, "rfm": rfm_app, "rfm-client": rfm_client_app}[program], words)
    assert done.exit_code == 0, done.output
    return done.stdout


def rows(text: str) -> dict[str, list[float]]:
    return {name: [float(cell.rstrip("%")) for cell in cells.split()] for name, cells in ROW.findall(text)}


@pytest.mark.slow
def test_the_guide_s_commands_tell_the_trained_checkpoint_from_the_early_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")  # as the guide shows the table
    for name in ("model_repository", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    guide = GUIDE.read_text()
    *_, printed = map(run, COMMAND.findall(guide))
    assert rows(printed).keys() == {"early", "full"}
    for name, numbers in rows(printed).items():
        assert rows(guide)[name] == pytest.approx(numbers, abs=0.01)  # rounding, on another CPU
    assert (tmp_path / "demo_output" / "models.png").read_bytes().startswith(b"\x89PNG")

    toy = tmp_path / "demo_output" / "toy"
    files = [toy / f"{name}_progress.parquet" for name in ("early", "full")]
    comparison = evaluate_labels(files, read_outcomes(str(toy / "outcomes.csv")))
    assert comparison.notes == [f"early, full: {TOY}"]
    early, full = comparison.evaluations
    assert early.by_progress is not None
    assert full.by_progress is not None
    assert full.by_progress.auroc > early.by_progress.auroc + 0.2  # five times the training
