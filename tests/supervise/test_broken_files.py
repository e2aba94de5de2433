# SPDX-License-Identifier: MIT
"""Files that Triton cannot load are refused with a remedy before it starts, or loads them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from commands import REPOSITORY, nothing_left_behind
from in_process import rfm
from repositories import changing
from rfm.parameters import EXPORT_PARAMETER, FAMILY_PARAMETER
from rfm.serve.installation import ServerStartError
from rfm.serve.repository import fault_in, stage, versions_in_file
from rfm.serve.triton_server import TritonServer
from rfm_client.contract.description import DESCRIPTION_PARAMETER
from servers import Endpoints, find_installation

FOREIGN = 'name: "foreign"\nbackend: "python"\nmax_batch_size: 1\na_field_of_a_newer_triton: 1\n'


def write_config(text: str) -> Callable[[Path], object]:
    return lambda model: (model / "config.pbtxt").write_text(text)


def parameter(name: str, value: str | None) -> Callable[[Path], None]:
    """Give a parameter another value; None: remove it."""

    def change(model: Path) -> None:
        with changing(model) as config:
            del config.parameters[name]
            if value is not None:
                config.parameters[name].string_value = value

    return change


AGAIN = "/config.pbtxt: .* got one of an older version; "
DAMAGES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "garbage": ("rfm", write_config("%%% {"), "/rfm/config.pbtxt: expected a model's configuration, got 1:1 : "),
    "empty": ("rfm", write_config(""), "/rfm/config.pbtxt: expected a model's configuration, got an empty file; "),
    "of no version": ("rfm", parameter(EXPORT_PARAMETER, None), f"/rfm{AGAIN}"),
    "of an older version": ("rfm_frames", parameter(EXPORT_PARAMETER, "0"), f"/rfm_frames{AGAIN}"),
    "of a newer version": ("rfm_encoder", parameter(EXPORT_PARAMETER, "999"), "/rfm_encoder/.* of a newer version; "),
    "no programs": (
        "rfm",
        lambda model: [file.unlink() for file in model.parent.glob("rfm*/1/model.py")],
        "/rfm/1/model.py: expected the model's program, .*; .*/rfm_encoder/1/model.py: expected ",
    ),
    "no version": ("rfm", lambda model: shutil.rmtree(model / "1"), "/rfm/1: expected the folder of a version, got no"),
    "a wrong description": (
        "rfm",
        parameter(DESCRIPTION_PARAMETER, '{"text_dim": "32"}'),
        "/rfm/config.pbtxt: parameter description: text_dim: expected int or null, got '32'; ",
    ),
    "no family": ("rfm", parameter(FAMILY_PARAMETER, None), "/rfm/config.pbtxt: .* parameter family, got none; "),
}


@pytest.mark.parametrize(("model", "damage", "told"), DAMAGES.values(), ids=DAMAGES)
def test_a_repository_with_broken_files_is_refused_before_triton_starts(
    tmp_path: Path, model: str, damage: Callable[[Path], object], told: str
) -> None:
    repository = shutil.copytree(REPOSITORY, tmp_path / "models")
    damage(repository / model)
    server = TritonServer(repository, Endpoints.free(), find_installation())
    with nothing_left_behind(), pytest.raises(ServerStartError) as refused:
        server.start_ready()
    assert re.match(re.escape(str(repository)) + told, str(refused.value)), refused.value
    assert f"export again with `rfm export --checkpoint CHECKPOINT --repository {repository}`" in str(refused.value)
    assert refused.value.model == model


def test_a_model_with_broken_files_is_refused_before_a_running_server_loads_it(tmp_path: Path) -> None:
    repository = shutil.copytree(REPOSITORY, tmp_path / "models")
    (repository / "rfm" / "1" / "model.py").unlink()
    done = rfm("models", "load", "rfm", f"--repository={repository}", "--url=grpc://127.0.0.1:1")
    assert done.exit_code == 1
    assert done.stderr.startswith(f"rfm: {repository}/rfm/1/model.py: expected the model's program, got none; ")


SERVED = {"a": [1, 2], "b": [1]}
STAGED: dict[str, tuple[dict[str, str], bool]] = {  # what the files name, and does a restart read them
    "as served": ({"a": "versions: 1\n  versions: 2", "b": "versions: 1"}, True),
    "a rollout went back": ({"a": "versions: 1", "b": "versions: 1"}, True),
    "a rollout has ended": ({"a": "versions: 2", "b": "versions: 1"}, True),
    "a new export": ({"a": "versions: 1", "b": "versions: 2"}, False),
    "unreadable": ({"a": "versions: 1", "b": "version"}, False),
}


@pytest.mark.parametrize("name", STAGED)
def test_a_restart_reads_files_that_name_only_versions_that_were_served(tmp_path: Path, name: str) -> None:
    files, is_read = STAGED[name]
    repository, folder = tmp_path / "models", tmp_path / "staged"
    for model, versions in files.items():
        (repository / model / "1").mkdir(parents=True)
        (repository / model / "config.pbtxt").write_text(f"version_policy {{ specific {{ {versions} }} }}")
    served = {model: {"version_policy": {"specific": {"versions": each}}} for model, each in SERVED.items()}
    assert stage(repository, served, folder) == (repository if is_read else folder)
    if not is_read:
        assert {model: versions_in_file(folder, model) for model in SERVED} == SERVED
        assert (folder / "a" / "1").samefile(repository / "a" / "1")


def test_a_model_of_another_program_needs_only_the_files_that_triton_needs(tmp_path: Path) -> None:
    folder = tmp_path / "foreign"
    (folder / "3").mkdir(parents=True)
    write_config(FOREIGN)(folder)
    fault = fault_in(tmp_path, "foreign")
    assert fault is not None
    assert fault.startswith(f"{folder / '3' / 'model.py'}: expected the model's program, got none")
    (folder / "3" / "model.py").touch()
    assert fault_in(tmp_path, "foreign") is None
    write_config(FOREIGN + 'default_model_filename: "other.py"\n')(folder)
    assert "/3/other.py: expected" in str(fault_in(tmp_path, "foreign"))
