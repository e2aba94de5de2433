# SPDX-License-Identifier: MIT
"""`rfm export` refuses broken and hostile files in one line, and changes nothing. All faults: test_refused_checkpoints.py."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest

import goldens
import rfm_export
from engines import serve_config
from in_process import rfm
from spoilt import WEIGHTS, Spoil, copied, files_in, text

REWIND = goldens.config("legacy_keys_l2")


def other_endian(folder: Path) -> None:
    content = (folder / WEIGHTS).read_bytes()
    (length,) = struct.unpack_from("<Q", content)
    numbers = np.frombuffer(content[8 + length :], "<f4").byteswap()
    (folder / WEIGHTS).write_bytes(content[: 8 + length] + numbers.tobytes())


def linked(folder: Path) -> None:
    (folder / WEIGHTS).unlink()
    (folder / WEIGHTS).symlink_to(REWIND.checkpoint / WEIGHTS)


HOSTILE: dict[str, tuple[Spoil, str]] = {
    "an empty file": (text(WEIGHTS, ""), rf"{WEIGHTS}: expected a safetensors file, got only 0 bytes"),
    "a zero byte": (text("config.yaml", "a: \0"), r"config\.yaml: expected YAML, got"),
    "numbers of the other endianness": (other_endian, r"expected finite weights, got|expected the checkpoint's scores"),
    "a link out of the checkpoint": (linked, rf"{WEIGHTS}: expected a file of the checkpoint, got a link to /"),
}


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    repository = tmp_path_factory.mktemp("hostile") / "model_repository"
    rfm_export.export(REWIND.checkpoint, repository, serve_config(REWIND))
    return repository


@pytest.mark.parametrize(("spoil", "message"), HOSTILE.values(), ids=HOSTILE)
def test_a_refused_export_leaves_the_repository_alone(
    tmp_path: Path, repository: Path, spoil: Spoil, message: str
) -> None:
    folder, before = copied(REWIND, tmp_path / "checkpoint"), files_in(repository)
    spoil(folder)
    result = rfm("export", "--checkpoint", str(folder), "--repository", str(repository))
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    assert re.match(f"rfm: .*{message}", result.stderr), result.stderr
    assert files_in(repository) == before
    assert not list(repository.parent.glob(".*export*"))
