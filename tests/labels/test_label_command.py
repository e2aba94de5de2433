# SPDX-License-Identifier: MIT
"""rfm-client label and rfm label."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet
from typer.testing import Result

from client_commands import invoke
from gateways import free_port
from in_process import rfm
from labelling import FRONT, LEROBOT
from paths import ROOT
from rfm_client.command_line import ExitCode
from rfm_client.contract.description import TOY
from servers import Endpoints

DATASET = LEROBOT / "toy_v30_many"
MODELS = ROOT / "model_repository"
FILES = ("rfm_progress.parquet", "reward_signals/rfm.parquet")
ENGINE = (
    *("--checkpoint", MODELS / "rfm" / "1" / "checkpoint"),
    *("--image-encoder", MODELS / "rfm_encoder" / "1" / "image_encoder"),
    *("--text-encoder", MODELS / "rfm_encoder" / "1" / "text_encoder"),
)


def own(*words: object) -> Result:
    """rfm label in this process."""
    return rfm("label", *words)


def cells(output: str) -> dict[str, str]:
    """Return the rows of the printed table with two columns."""
    rows = [re.split(r"\s{2,}", line.strip()) for line in output.splitlines()]
    return {row[0]: row[1] for row in rows if len(row) == 2}


@pytest.mark.slow
@pytest.mark.triton
def test_both_commands_write_the_same_labels_and_print_their_decisions(demo_server: Endpoints, output: Path) -> None:
    words = ("--episodes", "2,3,9", "--frames", 8, "--cameras", "front", "--alias", "sarm_progress")
    served = invoke("label", DATASET, *words, "--output", output, "--url", demo_server.http_url)
    assert (served.exit_code, [line.removeprefix("rfm-client: note: ") for line in served.stderr.splitlines()]) == (
        0,
        [
            f"cameras: {FRONT} (asked for)",
            "sampling: rint (the checkpoint's training did not pad)",
            "frames: 8 (asked for)",
            TOY,
            "3 of the dataset's 10 episodes have labels; LeRobot's reader gives frames of the others the weight 1.0",
        ],
    )
    assert {"episodes": "3", "frames": "121"}.items() <= cells(served.stdout).items()
    written = [output / name for name in (FILES[0], "sarm_progress.parquet", FILES[1])]
    assert [line for line in served.stdout.splitlines() if line.startswith(str(output))] == list(map(str, written))

    (output / "own").mkdir()
    result = own(DATASET, *ENGINE, *words, "--output", output / "own", "--format", "progress")
    assert result.exit_code == 0, result.stderr
    assert sorted(path.name for path in (output / "own").iterdir() if path.is_file()) == [
        FILES[0],
        "sarm_progress.parquet",
    ]
    told, other = (parquet.read_table(folder / FILES[0]) for folder in (output, output / "own"))
    assert told.column_names == other.column_names
    for name in told.column_names:
        np.testing.assert_allclose(told[name], other[name], rtol=0, atol=1e-5)


@pytest.mark.triton
def test_a_dry_run_prints_the_plan_and_writes_nothing(demo_server: Endpoints, output: Path) -> None:
    cameras = ("--cameras", "front", "--cameras", "wrist")
    result = invoke("label", DATASET, *cameras, "--dry-run", "--output", output, "--url", demo_server.grpc_url)
    assert result.exit_code == 0, result.stderr
    told = cells(result.stdout)
    assert told["dataset"] == "LeRobot v3.0: toy_v30_many"
    assert told["episodes"] == "10"
    assert told["frames"] == "428, of 2 cameras: 856 to be decoded"
    assert told["tasks"].startswith("5: put the blue block in the bowl")
    assert list(output.iterdir()) == []


@pytest.mark.triton
def test_a_second_run_scores_nothing_and_a_report_needs_no_server(demo_server: Endpoints, output: Path) -> None:
    words = ("label", DATASET, "--limit", 2, "--output", output)
    first = invoke(*words, "--url", demo_server.grpc_url)
    again = invoke(*words, "--url", demo_server.grpc_url)
    assert (first.exit_code, again.exit_code) == (0, 0)
    assert "rfm-client: note: 97 of 97 frames are labelled already" in again.stderr
    assert again.stdout == first.stdout
    for source in (DATASET, output / FILES[0], output / FILES[1]):
        where = ["--output", output] if source == DATASET else []
        report = invoke("label", source, "--report", *where, "--url", "grpc://localhost:1")
        assert (report.exit_code, report.stderr) == (0, "")
        assert cells(report.stdout) == cells(first.stdout)


def test_outputs_that_the_training_run_did_not_train_are_listed(output: Path) -> None:
    """Only of labelled outputs, not of preference or similarity."""
    checkpoint = shutil.copytree(MODELS / "rfm" / "1" / "checkpoint", output / "checkpoint")
    heads = "".join(f"train_{head}_head: false, " for head in ("progress", "preference", "success", "similarity"))
    (checkpoint / "config.yaml").write_text(f"model: {{{heads}}}\nloss: {{predict_last_frame_progress: true}}\n")
    result = own(DATASET, *ENGINE, "--checkpoint", checkpoint, "--dry-run", "--output", output)
    assert result.exit_code == 0, result.stderr
    of_run = [line.partition(" is ")[0] for line in result.stderr.splitlines() if line.startswith("rfm: config.yaml: ")]
    assert of_run == [
        "rfm: config.yaml: model.train_progress_head",
        "rfm: config.yaml: model.train_success_head",
        "rfm: config.yaml: loss.predict_last_frame_progress",
    ]


def test_a_checkpoint_without_its_encoders_is_refused_before_the_first_episode(output: Path) -> None:
    result = own(DATASET, *ENGINE[:2], "--output", output)
    got = "expected encoders, since it scores embeddings, got none; name them with --image-encoder and --text-encoder"
    assert (result.exit_code, result.stderr) == (1, f"rfm: {ENGINE[1]}: {got}\n")


WRONG = {
    "a format": (["--format", "csv"], "'--format': expected some of progress, signals, got csv"),
    "an order of colours": (["--channels", "a=gbr"], "'--channels': expected one of rgb, bgr, got 'gbr'"),
    "a camera twice": (["--orient", "a=none", "--orient", "a=rotate90"], "expected each camera once, got 'a=rotate90'"),
}


@pytest.mark.parametrize(("words", "message"), WRONG.values(), ids=WRONG)
def test_wrong_options_are_refused(words: list[str], message: str) -> None:
    result = invoke("label", DATASET, *words)
    assert result.exit_code == ExitCode.USAGE
    assert message in result.stderr


def test_without_a_server_it_ends_at_once(output: Path) -> None:
    result = invoke("label", DATASET, "--output", output, "--url", f"grpc://127.0.0.1:{free_port()}")
    assert result.exit_code == ExitCode.UNAVAILABLE
    assert list(output.iterdir()) == []
