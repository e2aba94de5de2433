# SPDX-License-Identifier: MIT
"""rfm-client on a terminal with 80 columns: tables, and results as they come."""

from __future__ import annotations

import importlib.metadata
import io
import subprocess
from pathlib import Path

import pytest
from rich.console import Console

import clip
from client_commands import RFM_CLIENT, TASK
from engine_server import EngineServer
from rfm_client.cli.show import shortened, status_tables
from rfm_client.command_line import ExitCode
from rfm_client.serving import ServerStatus
from rfm_client.transport.status import ModelStatus
from servers import Endpoints
from terminals import WIDTH, on_terminal

NAMES = ("episode_a.mp4", "episode_b.mp4")


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("a_folder_of_which_the_name_is_long") / "observation.images.front" / "chunk-000"
    folder.mkdir(parents=True)
    for name in NAMES:
        clip.write(folder / name)
    return [folder / name for name in NAMES]


def shown(url: str, *asked: object, code: ExitCode = ExitCode.OK) -> tuple[set[str], list[str]]:
    """Run a command about the demo's checkpoint. Return words and lines, which fit the terminal."""
    told, lines = on_terminal(*asked, "--url", url)
    assert told == code, lines
    assert max(map(len, lines)) <= WIDTH
    return {word for line in lines for word in line.split()}, lines


@pytest.mark.slow
def test_the_state_of_a_server_fits_a_terminal_and_ends_with_what_to_try_next(demo_server: Endpoints) -> None:
    url, asked = demo_server.grpc_url, ("status", "--metrics-url", demo_server.metrics_url)
    words, lines = shown(url, *asked)
    heads = {"model", "v", "state", "requests", "failed", "refused", "pending", "batches", "samples", "queue", "ms"}
    assert heads | {"rfm", "rfm_encoder", "rfm_frames"} <= words
    told = " ".join(" ".join(lines).split())
    assert f"rfm-client score VIDEO --task TASK --url {url}" in told
    assert f"rfm-client gateway --port 8100 --triton {url}" in told
    assert "http://localhost:8100/" in told
    _, lines = on_terminal(*asked, "--url", url, width=150)  # of which the table makes use
    wide = [line.split("  ") for line in lines if line.strip().startswith("model ")]
    assert wide[0][-4:-1] == ["requests since load", "failed since load", "refused since start"]


@pytest.mark.slow
def test_scores_and_comparisons_fit_a_terminal_and_name_each_file(engines: EngineServer, videos: list[Path]) -> None:
    words, _ = shown(engines.url, "score", *videos, "missing.mp4", "--task", TASK, code=ExitCode.FAILED)
    assert {"video", "progress", "success", "frames", "version"} <= words
    assert {word.rpartition("/")[2] for word in words if word.endswith(NAMES)} == set(NAMES)
    words, _ = shown(engines.url, "compare", *videos, "--task", TASK)
    assert {"rank", "P(wins)", "progress", "success", "frames", "second", "mean", "orders"} <= words
    assert {word.rpartition("/")[2] for word in words if word.endswith(".mp4")} == set(NAMES)


SHORTENED = {3: "/da", 4: "...4", 12: "/dat...7.mp4", 20: "/da.../episode_7.mp4", 30: "/data/of/a/robot/episode_7.mp4"}


@pytest.mark.parametrize(("width", "short"), SHORTENED.items())
def test_a_name_is_shortened_in_the_middle(width: int, short: str) -> None:
    assert shortened("/data/of/a/robot/episode_7.mp4", width) == short


def test_the_reason_of_a_model_that_is_not_ready_has_a_line_of_its_own() -> None:
    model = ModelStatus("rfm_encoder", "1", "UNAVAILABLE", "a [reason]", 1, 2, None, 3, 4, 5.0, 6.0, samples_refused=7)
    status = ServerStatus("grpc://localhost:8001", "2.51.0", False, (model,), "", "no metrics", ())
    console = Console(file=io.StringIO(), width=WIDTH)
    console.print(*status_tables(status), sep="\n", markup=False)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    first, second = (line for line in shown.splitlines() if line.strip().startswith("rfm_encoder  1"))
    assert first.split() == ["rfm_encoder", "1", "UNAVAILABLE", "1", "2", "7", "-"]
    assert second.split() == ["rfm_encoder", "1", "4", "0.8", "1.50", "5.00", "load"]
    assert "rfm_encoder 1: a [reason]\n" in shown
    assert shown.rstrip().endswith("no metrics")


@pytest.mark.parametrize(("program", "distribution"), [("rfm", "rfm-triton"), ("rfm-client", "rfm-client")])
def test_a_command_tells_its_version(program: str, distribution: str) -> None:
    done = subprocess.run([RFM_CLIENT.parent / program, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"{program} {importlib.metadata.version(distribution)}\n"
