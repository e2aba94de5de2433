# SPDX-License-Identifier: MIT
"""What may import what, and what is said where."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from rfm.cli import app

ROOT = Path(__file__).parents[1]
OURS = {"rfm", "rfm_client", "rfm_export"}
# Folder -> what of ours it may import besides itself.
MAY_IMPORT = {
    "client/rfm_client": set(),
    "rfm": {"rfm_client"},
    "export/rfm_export": {"rfm", "rfm_client"},
    "model_repository": {"rfm", "rfm_client"},
    "examples": {"rfm_client"},
    "benchmarks": {"rfm_client"},
}
EXCEPTIONS = {
    "rfm/cli.py": {"rfm_export"},  # the command, where all packages meet
    "examples/demo_training/losses.py": {"rfm"},  # what is trained is the network that is served
    "examples/demo_training/networks.py": {"rfm"},
    "examples/demo.py": {"rfm"},  # starts the server
    "examples/evaluate_demo_checkpoint.py": {"rfm"},
    "benchmarks/bench.py": {"rfm", "rfm_export"},  # the engine without a server, and what is served
    "benchmarks/contestants.py": {"rfm"},
    "benchmarks/forward.py": {"rfm"},
    "benchmarks/perf_analyzer.py": {"rfm"},
    "benchmarks/peers/litserve_server.py": {"rfm"},  # the peers score with our engine, or weights
    "benchmarks/peers/mosec_server.py": {"rfm"},
    "benchmarks/peers/message.py": {"rfm"},
    "benchmarks/peers/upstream_forward.py": {"rfm"},
}
CLIENT_LAYERS = (  # imports point left
    "errors", "samples", "results", "wire", "resize", "model_info", "off_loop", "deadline", "access", "connection", "shared_memory", "transport",
    "names", "server", "servers", "in_flight", "packing", "fit", "async_client", "loop_thread", "client",
)  # fmt: skip
LIGHT = {"numpy", "tritonclient", "aiohttp", "typing_extensions"}  # the last for type checkers only
# What only an extra brings, and which files need it.
EXTRAS = {
    "av": {"video.py"},
    "async_timeout": {"deadline.py"},  # Python 3.10 only
    "PIL": {"resize.py", "gateway"},
    "gymnasium": {"gym.py"},
    "typer": {"cli", "gateway"},
    "fastapi": {"gateway"},
    "starlette": {"gateway"},
    "python_multipart": {"gateway"},
    "pydantic": {"gateway"},
    "pydantic_core": {"gateway"},
    "uvicorn": {"gateway"},
    "anyio": {"gateway"},
    "rich": {"cli", "show.py"},
    "matplotlib": {"show.py"},
    "prometheus_client": {"status.py", "gateway"},
}


def imports(file: Path) -> set[str]:
    """Dotted names of everything that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            found |= {node.module or "", *(f"{node.module}.{name.name}" for name in node.names)}
    return found


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_imports_point_the_right_way(folder: str) -> None:
    for file in (ROOT / folder).rglob("*.py"):
        allowed = MAY_IMPORT[folder] | {Path(folder).name} | EXCEPTIONS.get(str(file.relative_to(ROOT)), set())
        ours = {name.partition(".")[0] for name in imports(file)} & OURS
        assert ours <= allowed, file


def test_the_client_s_layers_point_left() -> None:
    for index, layer in enumerate(CLIENT_LAYERS):
        names = imports(ROOT / "client" / "rfm_client" / f"{layer}.py")
        for right in CLIENT_LAYERS[index + 1 :]:
            assert f"rfm_client.{right}" not in names, layer


def test_the_client_needs_only_light_packages() -> None:
    for file in (ROOT / "client" / "rfm_client").rglob("*.py"):
        part = file.relative_to(ROOT / "client" / "rfm_client").parts[0]
        extras = {module for module, files in EXTRAS.items() if part in files}
        tops = {name.partition(".")[0] for name in imports(file)}
        assert tops - sys.stdlib_module_names <= LIGHT | extras | {"rfm_client"}, file


def test_scoring_embeddings_needs_no_extra() -> None:
    check = "import sys, rfm.engine; print(sorted({'transformers', 'PIL', 'av', 'matplotlib'} & set(sys.modules)))"
    output = subprocess.run([sys.executable, "-c", check], check=True, capture_output=True, text=True).stdout
    assert output.strip() == "[]"


def test_the_domain_knows_nothing_of_triton() -> None:
    for file in (ROOT / "rfm").rglob("*.py"):
        if "server" not in file.parts and file.name not in ("cli.py", "demo.py"):
            assert not [name for name in imports(file) if "triton" in name or name.startswith("rfm.server")], file


def test_every_command_and_option_is_documented() -> None:
    readme = (ROOT / "README.md").read_text()
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        assert command.help, name
        assert f"rfm {name}" in readme
        for parameter in command.params:
            if parameter.name != "help":
                assert parameter.help, (name, parameter.name)


def test_every_tensor_of_the_contract_is_documented() -> None:
    from rfm_client import wire

    readme = (ROOT / "README.md").read_text()
    specs = (*wire.embedding_inputs(1, 1), *wire.frame_inputs(), *wire.score_outputs(10))
    for spec in specs:
        assert f"`{spec.name}`" in readme


def test_every_key_of_the_configuration_is_documented() -> None:
    from dataclasses import fields

    from rfm.config import ServeConfig

    readme = (ROOT / "README.md").read_text()
    for field in fields(ServeConfig):
        assert f"`{field.name}`" in readme, field.name


def test_files_say_their_licence() -> None:
    files = [file for part in ("client", "rfm", "export", "examples", "tests") for file in (ROOT / part).rglob("*.py")]
    assert files
    for file in files:
        assert re.match(r"# SPDX-License-Identifier: MIT\n", file.read_text()), file
