# SPDX-License-Identifier: MIT
"""Rules for imports."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from graphlib import TopologicalSorter
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
from typing_extensions import Unpack

from paths import ROOT
from rfm_client import RewardClient
from rfm_client.episodes import EpisodeOptions

SHARED = {"rfm.config", "rfm.engine", "rfm.files", "rfm.saved", "rfm.weights", "rfm_client.contract"}
FAMILIES = ("rewind", "robometer", "topreward", "roboreward", "robodopamine", "rynnvalue")
FOLDERS = {
    "rfm": ".",
    "rfm_client": "client",
    "rfm_commands": "commands",
    "rfm_export": "export",
    **{f"rfm_{name}": f"apps/{name}" for name in ("gateway", "labels", "page", "rl")},
    "lerobot_reward_rfm": "apps/rl",
}
APPLICATIONS = (
    "lerobot_reward_rfm",
    "rfm_gateway",
    "rfm_labels",
    "rfm_page",
    "rfm_rl",
)  # which import public names alone
PUBLIC = {  # modules; each lists the names in __all__
    "rfm_client": {"", "command_line", "episodes", "frames", "options", "plot", "recording", "serving"},
    "rfm_gateway": {"", "mounting"},
    "rfm_labels": {"", "commands", "datasets"},
    "rfm_rl": {"", "rlinf", "sb3"},
    "rfm_export": {""},
    "rfm": {"config", "engine", "published"},
}
MOST_NAMES = 84  # of the client's public modules together
MOST_NAMES_OF_LABELS = 36
# Part of the client -> the parts below it, which alone it may import.
CLIENT: dict[str, set[str]] = {
    "contract": set(),
    "transport": {"contract"},
    "frames": {"contract"},
    "scoring": {"contract", "transport", "frames"},
    "episodes": {"contract", "transport", "frames", "scoring"},
    "async_client": {"contract", "transport", "frames", "scoring", "episodes"},
    "client": {"contract", "transport", "frames", "scoring", "episodes", "async_client"},
    "options": {"contract"},
    "plot": {"contract"},
    "recording": {"contract", "transport"},
    "serving": {"contract", "transport"},
}  # the rest, which all others leave alone: cli and command_line
# Package, module, or folder of programs -> packages of ours that it may import besides itself; "!": exceptions.
MAY_IMPORT = {
    **{f"rfm_client.{part}": {f"rfm_client.{lower}" for lower in lowers} for part, lowers in CLIENT.items()},
    "rfm_client": set(),
    **{application: {"rfm_client"} for application in APPLICATIONS},
    "rfm_page": {"rfm_client", "rfm_gateway", "rfm_labels"},
    "rfm.files": {"rfm.plain_yaml", "rfm_client.contract"},
    "rfm.weights": {"rfm.files"},
    "rfm.saved": {"rfm.files"},
    "rfm.qwen": SHARED,
    **{f"rfm.families.{family}": {*SHARED, "rfm.qwen"} for family in FAMILIES},  # no other family
    "rfm.published": {*SHARED, "rfm.families", "rfm.qwen"},
    "rfm.triton_model": {"rfm.engine", "rfm.files", "rfm.parameters", "rfm.probe_request", "rfm_client.contract"},
    "rfm.serve": {"rfm.config", "rfm.parameters", "rfm.probe_request", "rfm_client.contract"},
    "rfm.engine": {"rfm.config", "rfm.files", "rfm_client.contract"},
    "rfm": {"rfm_client.contract"},
    "rfm_export": {"rfm", "rfm_client.contract"},
    "rfm_commands": {"rfm", "rfm_client", "rfm_export", "rfm_gateway", "rfm_labels"},
    "model_repository": {"rfm", "!rfm.published", "rfm_client.contract"},
    "examples": {"rfm_client", "rfm_labels", "rfm_rl"},
    "benchmarks": {"rfm_client", "rfm_gateway", "rfm_labels", "rfm_rl"},
}
EXCEPTIONS = {
    "commands/rfm_commands/cli.py": {"rfm_export"},  # the command, where all packages meet
    "examples/demo_training/losses.py": {"rfm"},  # trains the served network
    "examples/demo_training/networks.py": {"rfm"},
    "examples/demo.py": {"rfm", "rfm_commands"},  # starts the server
    "examples/train_policy.py": {"rfm"},
    "benchmarks/bench.py": {"rfm"},  # starts servers
    "benchmarks/contestants.py": {"rfm", "rfm_commands", "rfm_export"},
    "benchmarks/gpu.py": {"rfm"},
    "benchmarks/perf_analyzer.py": {"rfm"},
    "benchmarks/random_checkpoints.py": {"rfm"},
    "benchmarks/real_size.py": {"rfm"},
    "benchmarks/serving.py": {"rfm", "rfm_export"},
    "benchmarks/peers/engines.py": {"rfm"},  # the peers score with our engine, or weights
    "benchmarks/peers/upstream_forward.py": {"rfm"},
}
LIGHT = {"numpy", "tritonclient", "aiohttp", "typing_extensions"}  # the last for type checkers only
# Packages that only an extra brings, and the files that need them.
EXTRAS = {
    "av": {"video_decoding.py"},
    "async_timeout": {"limits.py"},  # Python 3.10 only
    "PIL": {"pictures.py", "fit_to_checkpoint.py"},
    "typer": {"cli"},
    "matplotlib": {"cli", "plot.py"},
    "huggingface_hub": {"hub_access.py"},
    "rerun": {"recording.py"},
    "prometheus_client": {"status.py"},
}


def names_imported(file: Path) -> Iterator[tuple[str, str]]:
    """Yield module and name of each import in a file; an empty name for the module itself."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from ((name.name, "") for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module and node.level == 0, f"{file}: relative import"
            yield from ((node.module, name.name) for name in node.names)


def imports(file: Path) -> set[str]:
    """Return the dotted names of all imports in a file."""
    return {dotted for module, name in names_imported(file) for dotted in (module, f"{module}.{name}".rstrip("."))}


def _module(file: Path) -> str:
    """Dotted name of a file, whose path is relative to what Python searches."""
    return ".".join(file.with_suffix("").parts).removesuffix(".__init__")


def is_part(name: str, packages: set[str]) -> bool:
    """Return True if the module is, or lies in, one of these packages."""
    return any(name == package or name.startswith(f"{package}.") for package in packages)


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_imports_point_the_right_way(package: str) -> None:
    place = ROOT / FOLDERS.get(package.partition(".")[0], ".") / package.replace(".", "/")
    files = [file for file in (*place.rglob("*.py"), place.with_suffix(".py")) if file.exists()]
    assert files
    forbidden = {name[1:] for name in MAY_IMPORT[package] if name.startswith("!")}
    for file in files:
        allowed = {package, *MAY_IMPORT[package], *EXCEPTIONS.get(str(file.relative_to(ROOT)), set())}
        ours = {name for name in imports(file) if name.partition(".")[0] in FOLDERS}
        assert not {name for name in ours if is_part(name, forbidden) or not is_part(name, allowed)}, file


@pytest.mark.parametrize("package", FOLDERS)
def test_no_modules_import_each_other(package: str) -> None:
    """Not even for types: modules in a circle can only be read, tested and changed together."""
    root = ROOT / FOLDERS[package]
    files = {_module(file.relative_to(root)): file for file in (root / package).rglob("*.py")}
    needs: dict[str, set[str]] = {}
    for module, file in files.items():
        imported = {dotted if (dotted := f"{of}.{name}") in files else of for of, name in names_imported(file)}
        needs[module] = imported & files.keys() - {module}
    TopologicalSorter(needs).prepare()  # raises CycleError, which shows a circle


@pytest.mark.parametrize("package", (*APPLICATIONS, "rfm_commands"))
def test_an_application_imports_public_names_alone_and_so_do_importers_of_it(package: str) -> None:
    for file in (ROOT / FOLDERS[package] / package).rglob("*.py"):
        for module, name in names_imported(file):
            top, _, inner = module.partition(".")
            if top not in {*FOLDERS} - {package} or {package, top}.isdisjoint(APPLICATIONS):
                continue
            assert inner in PUBLIC[top], f"{file}: {module}"
            assert name in importlib.import_module(module).__all__, f"{file}: {module}.{name}"


@pytest.mark.parametrize(("package", "most"), [("rfm_client", MOST_NAMES), ("rfm_labels", MOST_NAMES_OF_LABELS)])
def test_a_package_has_few_public_names(package: str, most: int) -> None:
    modules = [".".join(filter(None, (package, inner))) for inner in PUBLIC[package]]
    names = [f"{module}.{name}" for module in modules for name in importlib.import_module(module).__all__]
    assert len(modules) <= 8
    assert len(names) <= most


def test_the_client_needs_only_light_packages() -> None:
    for file in (ROOT / "client" / "rfm_client").rglob("*.py"):
        part = file.relative_to(ROOT / "client" / "rfm_client").parts
        extras = {module for module, files in EXTRAS.items() if files & set(part)}
        tops = {name.partition(".")[0] for name in imports(file)}
        assert tops - sys.stdlib_module_names <= LIGHT | extras | {"rfm_client"}, file


def test_no_extra_of_the_client_names_a_distribution_of_ours() -> None:
    """A package index may give such a name to a stranger. The client names itself, which pip has by then."""
    named = re.findall(r'"(rfm-[\w-]*)', (ROOT / "client" / "pyproject.toml").read_text())
    assert set(named) == {"rfm-client"}


LOADS = {  # modules: packages that must not be loaded with them
    "rfm.engine": {"transformers", "PIL", "av", "matplotlib"},
    ", ".join(f"rfm.families.{family}" for family in FAMILIES): {"rfm.published", "transformers", "huggingface_hub"},
    "rfm_labels": {*EXTRAS, "h5py", "pyarrow", "fsspec", "ray", "scipy", "sklearn", "torch"} - {"async_timeout"},
    "rfm_commands.cli, rfm_commands.rollout, rfm.serve.supervisor": {"torch"},  # two seconds and 200 MB
}


@pytest.mark.slow
@pytest.mark.parametrize("modules", LOADS)
def test_importing_a_module_loads_no_package_that_it_may_not_need(modules: str) -> None:
    code = f"import sys, {modules}; print(sorted({LOADS[modules]} & set(sys.modules)))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_the_domain_knows_nothing_of_triton() -> None:
    for file in (ROOT / "rfm").rglob("*.py"):
        if not {"serve", "triton_model"} & set(file.parts):
            assert not [name for name in imports(file) if "triton" in name.replace("rfm_triton", "")], file


def test_only_its_own_folder_and_its_reader_know_a_family() -> None:
    """Others ask rfm.families, which finds a family by name."""
    for file in (file for part in ("rfm", "export") for file in (ROOT / part).rglob("*.py")):
        others = {
            f"rfm.families.{family}"
            for family in FAMILIES
            if family not in (file.stem.partition("_")[0], file.parent.name)
        }
        assert not [name for name in imports(file) if is_part(name, others)], file


def test_the_keywords_of_an_episode_are_its_options() -> None:
    """A TypedDict cannot be derived from a dataclass."""
    options = get_type_hints(EpisodeOptions)
    (keywords,) = get_args(get_type_hints(RewardClient.episode, localns={"Unpack": Unpack})["options"])
    assert get_type_hints(keywords) == {field.name: options[field.name] for field in fields(EpisodeOptions)}


@pytest.mark.parametrize(
    "part", ["client", "apps", "rfm", "export", "commands", "examples", "benchmarks", "tests", "tools"]
)
def test_files_say_their_licence_and_why_they_ignore_a_type_error(part: str) -> None:
    files = [*(ROOT / part).rglob("*.py")]
    assert files
    for file in files:
        text = file.read_text()
        assert text.startswith("# SPDX-License-Identifier: MIT\n"), file
        ignores = re.findall(r"# type: ignore.*", text) if part not in ("tests", "tools") else []
        assert not [ignore for ignore in ignores if not re.match(r"# type: ignore\[[\w,-]+\]  # \w", ignore)], file
