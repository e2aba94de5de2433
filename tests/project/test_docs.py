# SPDX-License-Identifier: MIT
"""The documentation: examples run as they stand, and nothing required is missing."""

from __future__ import annotations

import glob
import inspect
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from click import Command, Context
from PIL import Image
from typer.main import get_command

import clip
import hdf5_writers
import toy_dataset
from in_process import rfm_app, rfm_client, rfm_client_app
from labelling import LEROBOT
from paths import ROOT
from rfm_client import PreferenceSample, ProgressSample, RewardClient, Trajectory
from rfm_client.contract import FRAME_SCORES, wire
from rfm_labels import ClientScorer, LabelOptions, label, open_dataset
from servers import Endpoints

pytestmark = pytest.mark.triton

DOCS = ROOT / "docs"
CLIENT_GUIDE = DOCS / "guides" / "use_the_client.md"
READER_GUIDE = DOCS / "guides" / "label_whatever_you_recorded.md"
CONTRACT = DOCS / "reference" / "contract.md"
ARCHITECTURE = DOCS / "explanation" / "architecture.md"
GUIDES = sorted([*DOCS.glob("guides/*.md"), *DOCS.glob("tutorials/*.md")])
RUN = (ROOT / "README.md", ROOT / "client" / "README.md", *GUIDES)  # whose examples and client commands are run
DOCUMENTS = sorted({*ROOT.glob("*.md"), *ROOT.glob("[!.]*/**/*.md")} - {*ROOT.glob("build/**/*.md")})
README_LINES = 120

BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"^ {4,}(rfm-client [^#\n]*)", re.MULTILINE)
ANY_COMMAND = re.compile(r"^ {4,}(?:[^#\n`]*[;&|] *)?((?:\.venv/bin/)?rfm(?:-client)? (?:\\\n|[^#\n])*)", re.MULTILINE)
IN_A_SCRIPT = re.compile(r"^ {0,3}(rfm(?:-client)? (?:-|\w+ -)(?:\\\n|[^#\n])*)", re.MULTILINE)  # not indented: fenced
VARIABLE = re.compile(r"\$\(\(.*?\)\)|\$\w+")
ENDS = ("|", "||", "&", "&&", ";", ">")  # no arguments follow
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.*)", re.MULTILINE)
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
PATH = re.compile(r"[` ](?!\.venv)([\w.-]+/[\w./-]*\w/?)(?=[` ])")
SERVED_AS = {  # placeholders of the guides, and values of this server and dataset
    "--model first": "--model rfm",
    "--model second": "--model rfm",
    "--episodes 0:20": "--episodes 0:8",
    "--robots 8 --hz 10": "--robots 1 --hz 0.5 --seconds 2",
}


def found(pattern: re.Pattern[str], files: Iterable[Path] = RUN) -> list[Any]:
    """Return each match in each document as a parameter. Those of the guides run at night."""
    matches = [
        pytest.param(
            match,
            id=f"{file.relative_to(ROOT)} {number}",
            marks=[pytest.mark.nightly] if files is RUN and file in GUIDES and file != CLIENT_GUIDE else [],
        )
        for file in files
        for number, match in enumerate(pattern.findall(file.read_text()))
    ]
    assert matches
    return matches


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The files named in the documentation."""
    (tmp_path / "demo_output").mkdir()
    for name in (
        "video.mp4", "a.mp4", "b.mp4", "success.mp4", "failure.mp4", "demo_output/success.mp4", "demo_output/failure.mp4",
    ):  # fmt: skip
        clip.write(tmp_path / name)
    shutil.copytree(LEROBOT / "toy_v21", tmp_path / "my_dataset")
    shutil.copytree(ROOT / "tests" / "rlds" / "toy_steps_texts", tmp_path / "rlds_dataset")
    shutil.copytree(ROOT / "tests" / "videos", tmp_path / "tests" / "videos")
    outcomes = "".join(
        f"{episode.index},{episode.index % 2}\n" for episode in open_dataset(tmp_path / "my_dataset").episodes
    )
    (tmp_path / "outcomes.csv").write_text(f"episode,success\n{outcomes}")
    toy_dataset.write(tmp_path / "demo_output" / "toy", clips=2)
    hdf5_writers.write_robomimic(tmp_path / "demos.hdf5", [{"front": hdf5_writers.video(4)}])
    (tmp_path / "recordings" / "0" / "videos").mkdir(parents=True)
    (tmp_path / "recordings" / "0" / "colors").mkdir()
    clip.write(tmp_path / "recordings" / "0" / "videos" / "front.mp4")
    for t, frame in enumerate(pictures(7)):
        Image.fromarray(frame).save(tmp_path / "recordings" / "0" / "colors" / f"{t}_front.jpg")
    np.savez(tmp_path / "recordings" / "0.npz", frames=pictures(8), task="stack the cups")
    (tmp_path / "recordings" / "tasks.csv").write_text("episode,task\n0,stack the cups\n")
    (reader,) = re.findall(r"^```python\n(# my_reader\.py.*?)^```", READER_GUIDE.read_text(), re.MULTILINE | re.DOTALL)
    (tmp_path / "my_reader.py").write_text(reader)
    np.savez(tmp_path / "episode.npz", frames=pictures(0), task="stack the cups")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def pictures(seed: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.random.default_rng(seed).integers(0, 256, (8, 64, 64, 3), np.uint8)


def names() -> dict[str, Any]:
    """Names that the examples use; the demo checkpoint reads embeddings of 64 and 32."""
    random = np.random.default_rng(0)
    embeddings, text = random.standard_normal((8, 64), np.float32), random.standard_normal(32, np.float32)
    filmed = Trajectory(frames=pictures(1), task="stack the cups")
    rewound = Trajectory(video_embeddings=embeddings[::-1], text_embedding=text)
    steps = [{"observation.images.top": image, "task": "stack the cups"} for image in pictures(2)]
    return {
        "frames": pictures(3),
        "other": filmed,
        "rewound": rewound,
        "embeddings": embeddings,
        "text": text,
        "samples": [ProgressSample(filmed), PreferenceSample(rewound, rewound)],
        "trajectories": [filmed, rewound],
        "dataset": steps,
        "images": pictures(4),
        "camera": pictures(6),
        "done": np.arange(8) < 3,
        "moved": np.arange(8) > 5,
        "RewardClient": RewardClient,
        "models": ["rfm"],
        "successes": [filmed],
        "failures": [Trajectory(frames=pictures(5), task="stack the cups")],
    }


@pytest.mark.parametrize("code", found(BLOCK))
def test_every_example_runs(demo_server: Endpoints, folder: Path, code: str) -> None:
    code = code.replace("grpc://localhost:8001", demo_server.grpc_url)
    for source, name in re.findall(r"(my_dataset/|demos\.)(\w+)_progress\.parquet", code):
        dataset = open_dataset("demos.hdf5" if source == "demos." else "my_dataset")
        with RewardClient(demo_server.grpc_url) as client:
            label(dataset, ClientScorer(client), LabelOptions(name=name, frames=4, advantage=5))
    shown: dict[str, Any] = names()
    exec(compile(code, "README", "exec"), shown)
    if "envs" in shown:
        for environment in (shown["env"], shown["envs"]):
            _, info = environment.reset(seed=0)
            assert "reward_model" in info
            environment.close()


@pytest.mark.slow
@pytest.mark.parametrize("command", found(COMMAND))
def test_every_command_line_runs(demo_server: Endpoints, folder: Path, command: str) -> None:
    if command.startswith("rfm-client gateway"):
        return  # it ends with a signal; tests/gateway runs it
    for placeholder, served in SERVED_AS.items():
        command = command.replace(placeholder, served)
    if command.startswith("rfm-client evaluate") or " --remove " in command:
        dataset = command.split()[2]
        labels = re.findall(rf"(?:{dataset}/|--remove )(\w+?)(?:_progress\.parquet|$)", command) or ["rfm"]
        for name in labels:
            assert rfm_client("label", dataset, "--name", name, "--url", demo_server.grpc_url).exit_code == 0
    if not re.search(r"[|&;$<>]", command):
        words = [file for word in shlex.split(command) for file in sorted(glob.glob(word)) or [word]]  # noqa: PTH207
        done = rfm_client(*words[1:], env={"RFM_URL": demo_server.grpc_url})
        assert done.exit_code == 0, done.output
        return
    environment = {
        **os.environ,
        "RFM_URL": demo_server.grpc_url,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    shown = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True, timeout=120)
    assert shown.returncode == 0, shown.stderr


def test_every_command_of_the_client_is_shown() -> None:
    guide = CLIENT_GUIDE.read_text()
    for name in get_command(rfm_client_app).commands:  # type: ignore[attr-defined]
        assert f"rfm-client {name}" in guide


def test_every_exit_code_is_shown() -> None:
    from rfm_client.command_line import ExitCode

    guide = CLIENT_GUIDE.read_text()
    for code in ExitCode:
        assert f"| {code.value} |" in guide


def test_every_option_of_the_client_is_explained() -> None:
    from rfm_client.async_client import ClientOptions
    from rfm_client.scoring.samples import CallOptions

    options = {**inspect.signature(RewardClient).parameters, **CallOptions.__annotations__}
    explained = inspect.cleandoc(f"{ClientOptions.__doc__}\n{CallOptions.__doc__}")
    assert [name for name in options if not re.search(rf"\b{name}\b.*:", explained)] == []


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= README_LINES


@pytest.mark.parametrize(
    "command", [*found(ANY_COMMAND, DOCUMENTS), *found(IN_A_SCRIPT, [*DOCUMENTS, *ROOT.glob("examples/*.sh")])]
)
def test_every_command_line_is_one_that_the_commands_take(command: str) -> None:
    """Parsed by the command itself, not run."""
    words = shlex.split(VARIABLE.sub("1", command.replace("\\\n", " ")))
    if "..." in words or any("[" in word for word in words):
        return  # a pattern
    program, *arguments = itertools.takewhile(lambda word: word not in ENDS, words)
    parse(get_command(rfm_app if Path(program).name == "rfm" else rfm_client_app), arguments)


def parse(command: Command, arguments: Sequence[str], parent: Context | None = None) -> None:
    """Raise click's UsageError for unknown options and wrong values."""
    subcommands: dict[str, Command] = getattr(command, "commands", {})
    end = next((index for index, word in enumerate(arguments, 1) if word in subcommands), len(arguments))
    context = command.make_context(command.name, list(arguments[:end]), parent)
    if subcommands:
        parse(subcommands[arguments[end - 1]], arguments[end:], context)


def test_every_tensor_of_the_contract_is_documented() -> None:
    contract = CONTRACT.read_text()
    inputs = (*wire.embedding_inputs(1, 1), *wire.frame_inputs(with_views=True))
    rows = " ".join(line.split("|")[1] for line in contract.splitlines() if line.startswith("| `"))
    for spec in (*inputs, *wire.score_outputs(10, FRAME_SCORES)):
        assert f"`{spec.name}`" in rows


def test_the_request_of_the_contract_runs(demo_server: Endpoints) -> None:
    request = json.loads((ROOT / "examples" / "kserve_request.json").read_text())
    answer = httpx.post(f"{demo_server.http_url}/v2/models/rfm_frames/infer", json=request, timeout=60)
    assert answer.status_code == 200, answer.text
    outputs = {output["name"]: output for output in answer.json()["outputs"]}
    assert outputs["progress"]["shape"] == [2, 3]


def test_the_answer_to_the_curl_of_the_contract_is_strict_json(demo_server: Endpoints, curl: str) -> None:
    (command,) = re.findall(r"^```bash\n(curl .*?)^```", CONTRACT.read_text(), re.MULTILINE | re.DOTALL)
    _, *words = shlex.split(command.replace("localhost:8000", f"{demo_server.http_url}"))
    done = subprocess.run([curl, *words], capture_output=True, text=True, check=True, timeout=60)
    answer = json.loads(done.stdout, parse_constant=pytest.fail)
    assert {output["name"]: output["shape"] for output in answer["outputs"]} == {"progress": [1, 2], "success": [1, 2]}


def test_every_request_to_triton_names_the_type_of_its_body() -> None:
    commands = re.findall(r"curl [^`]*?/v2/[^`]*", CONTRACT.read_text())
    assert len(commands) == 2
    assert all("Content-Type: application/json" in command for command in commands)


def test_the_tables_of_the_reference_are_those_of_the_code() -> None:
    command = [sys.executable, ROOT / "tools" / "reference.py", "--check"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda file: str(file.relative_to(ROOT)))
def test_every_link_leads_somewhere(document: Path) -> None:
    for link in LINK.findall(CODE.sub("", document.read_text())):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (document.parent / name).resolve() if name else document
        assert target.exists(), link
        assert not anchor or anchor in map(slug, HEADING.findall(target.read_text())), link


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("document", [ARCHITECTURE, ROOT / "CONTRIBUTING.md"], ids=lambda file: file.name)
def test_every_file_that_is_named_is_there(document: Path) -> None:
    paths = PATH.findall(document.read_text())
    assert paths
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_make_help_has_a_line_for_every_target() -> None:
    text = (ROOT / "Makefile").read_text()
    (names,) = re.findall(r"^\.PHONY:((?:[^\n]*\\\n)*[^\n]*)", text, re.MULTILINE)
    help_text = subprocess.run(["make", "help"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    told = dict(re.findall(r"^make (\S+) +(\S.*)$", help_text, re.MULTILINE))
    assert sorted(told) == sorted(names.replace("\\", "").split())


@pytest.mark.parametrize("minor", [9, 13])
def test_make_refuses_an_unsupported_python_before_anything_is_installed(tmp_path: Path, minor: int) -> None:
    stand_in, environment = tmp_path / "python", tmp_path / "venv"
    pretend = f"import sys; sys.version_info = (3, {minor}, 0); exec(sys.argv[1])"
    stand_in.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{pretend}' \"$2\"\n")
    stand_in.chmod(0o755)
    words = ["make", f"VENV={environment}", f"PYTHON={stand_in}", "demo"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    expected = f"make: expected Python 3.10, 3.11 or 3.12, got 3.{minor}: make demo PYTHON=python3.12"
    assert (done.returncode, done.stderr.splitlines()[0]) == (2, expected)
    assert not environment.exists()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda file: str(file.relative_to(ROOT)))
def test_every_make_command_is_a_target(document: Path) -> None:
    if document.name == "CHANGELOG.md":
        return  # it tells of targets that were
    for target in re.findall(r"^    make ([\w-]+)|`make ([\w-]+)`", document.read_text(), re.MULTILINE):
        assert re.search(rf"^{target[0] or target[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE), target
