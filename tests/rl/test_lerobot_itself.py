# SPDX-License-Identifier: MIT
"""The plug-in in a LeRobot of its own: parser, factories, saved folders, a dataset, the guide's example, and an environment."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from labelling import LEROBOT
from paths import ROOT
from servers import Endpoints

pytestmark = pytest.mark.nightly  # minutes, most of them to install 5 GB

GUIDE = (ROOT / "docs" / "guides" / "use_with_lerobot.md").read_text()
PYTHON = "python3.12"  # LeRobot needs it
OURS = {"client": ROOT / "client", "rl": ROOT / "apps" / "rl"}


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python with LeRobot and the plug-in."""
    if subprocess.run([PYTHON, "-V"], capture_output=True, check=False).returncode if shutil.which(PYTHON) else True:
        pytest.skip(f"{PYTHON} is not installed")
    folder = tmp_path_factory.mktemp("lerobot")
    environment = folder / "environment"
    ours = [shutil.copytree(place, folder / name) for name, place in OURS.items()]  # pip builds in the folder
    subprocess.run([PYTHON, "-m", "venv", environment], check=True)
    packages = "lerobot[dataset,metaworld]>=0.6", "mujoco<3.4", "stable-baselines3"  # for Meta-World 3.0
    subprocess.run([environment / "bin" / "pip", "install", "--quiet", *packages, *ours], check=True, timeout=1800)
    return environment / "bin" / "python"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the guide's dataset."""
    shutil.copytree(LEROBOT / "toy_v30_many", tmp_path / "my_dataset")
    return tmp_path


def run(python: Path, arguments: list[str], folder: Path) -> str:
    """Return what a program prints."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {
        "HF_HUB_OFFLINE": "1",
        "MUJOCO_GL": "egl",
    }
    done = subprocess.run(
        [python, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.timeout(2400)
def test_the_example_of_the_guide_prints_what_the_guide_shows(
    demo_server: Endpoints, python: Path, folder: Path
) -> None:
    (code,) = re.findall(r"^```py\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
    (shown,) = re.findall(r"^```text\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
    assert run(python, ["-c", code.replace("grpc://localhost:8001", demo_server.grpc_url)], folder) == shown


@pytest.mark.timeout(2400)
def test_lerobot_loads_saves_and_calls_the_model(demo_server: Endpoints, python: Path, folder: Path) -> None:
    program = ROOT / "tests" / "support" / "lerobot_program.py"
    options = re.search(r"^    (--reward_model.*)$", GUIDE, re.MULTILINE)
    assert options
    arguments = options[1].replace("grpc://gpu:8001", demo_server.grpc_url).split()
    assert run(python, [str(program), *arguments], folder).splitlines()[-1] == "all is well"


@pytest.mark.timeout(2400)
def test_a_success_in_lerobot_s_meta_world_is_paid_by_its_last_frame(
    demo_server: Endpoints, python: Path, folder: Path
) -> None:
    """Its environment resets in the successful step: rendered frames are refused."""
    program = ROOT / "tests" / "support" / "lerobot_metaworld.py"
    assert run(python, [str(program), demo_server.grpc_url], folder).splitlines()[-1].startswith("all is well")
