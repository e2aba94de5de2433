# SPDX-License-Identifier: MIT
"""The plug-in in a LeRobot of its own: parser, factories, saved folders, a dataset, the guide's example, and an environment."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from labelling import LEROBOT
from lerobot_environment import IS_THERE, run
from paths import ROOT
from servers import Endpoints

pytestmark = [pytest.mark.nightly, IS_THERE]

GUIDE = (ROOT / "docs" / "guides" / "use_with_lerobot.md").read_text()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the guide's dataset."""
    shutil.copytree(LEROBOT / "toy_v30_many", tmp_path / "my_dataset")
    return tmp_path


def test_the_example_of_the_guide_prints_the_output_in_the_guide(demo_server: Endpoints, folder: Path) -> None:
    (code,) = re.findall(r"^```py\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
    (shown,) = re.findall(r"^```text\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
    assert run(["-c", code.replace("grpc://localhost:8001", demo_server.grpc_url)], folder) == shown


def test_lerobot_loads_saves_and_calls_the_model(demo_server: Endpoints, folder: Path) -> None:
    program = ROOT / "tests" / "support" / "lerobot_program.py"
    options = re.search(r"^    (--reward_model.*)$", GUIDE, re.MULTILINE)
    assert options
    arguments = options[1].replace("grpc://gpu:8001", demo_server.grpc_url).split()
    assert run([str(program), *arguments], folder).splitlines()[-1] == "all is well"


def test_a_success_in_lerobot_s_meta_world_is_paid_by_its_last_frame(demo_server: Endpoints, folder: Path) -> None:
    """Its environment resets in the successful step: rendered frames are refused."""
    program = ROOT / "tests" / "support" / "lerobot_metaworld.py"
    assert run([str(program), demo_server.grpc_url], folder).splitlines()[-1].startswith("all is well")
