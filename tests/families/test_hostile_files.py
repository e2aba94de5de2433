# SPDX-License-Identifier: MIT
"""Checkpoints and settings that are broken or lie: `rfm export` refuses them, soon, and changes nothing."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import goldens
import rfm_export
from engines import serve_config
from in_process import rfm
from reward_models import ROOT
from rfm import families
from rfm.checkpoint.content import MAX_HEADER_BYTES, MAX_JSON_BYTES, CheckpointError
from rfm.plain_yaml import MAX_YAML_BYTES
from rfm_client.options import ConfigError
from rfm_commands.config import Config
from spoilt import WEIGHTS, Spoil, copied, files_in, settings, text, text_settings, weights

REWIND = goldens.config("legacy_keys_l2")
VLM = goldens.config("q25_mean_l2")
ADAPTER = goldens.config("q25_peft_adapter_disc10")
ROBOREWARD = ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint"

LONGEST_S = 30
MOST_MEMORY_BYTES = 512 * 2**20  # above the process's peak


@pytest.fixture(autouse=True)
def _soon() -> Iterator[None]:
    """Whatever waits for a pipe, or works for ever, is interrupted."""

    def late(*_: object) -> None:
        raise TimeoutError(f"no end within {LONGEST_S} s")

    previous = signal.signal(signal.SIGALRM, late)
    signal.alarm(LONGEST_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


def raw_header(change: Callable[[bytes], bytes]) -> Spoil:
    """Another header before the same numbers."""

    def spoil(folder: Path) -> None:
        content = (folder / WEIGHTS).read_bytes()
        (length,) = struct.unpack_from("<Q", content)
        raw = change(content[8 : 8 + length])
        (folder / WEIGHTS).write_bytes(struct.pack("<Q", len(raw)) + raw + content[8 + length :])

    return spoil


def header(**changes: object) -> Spoil:
    """Other things about the first tensor."""

    def change(raw: bytes) -> bytes:
        told = json.loads(raw)
        told[FIRST].update(changes)
        return json.dumps(told).encode()

    return raw_header(change)


def instead(name: str, make: Callable[[Path], object]) -> Spoil:
    """Something else under the name of a file."""
    return lambda folder: [(folder / name).unlink(), make(folder / name)]


def shards(**weight_map: Any) -> Spoil:
    index = json.dumps({"weight_map": weight_map})
    return instead(WEIGHTS, lambda file: Path(f"{file}.index.json").write_text(index))


def other_endian(folder: Path) -> None:
    content = (folder / WEIGHTS).read_bytes()
    (length,) = struct.unpack_from("<Q", content)
    numbers = np.frombuffer(content[8 + length :], "<f4").byteswap()
    (folder / WEIGHTS).write_bytes(content[: 8 + length] + numbers.tobytes())


FIRST = "first_embedding_A"
LAUGHS = "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}' if n else 'x'] * 10)}]\n" for n in range(12))
MERGES = "a0: &a0 {x: 1}\n" + "".join(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}\n" for n in range(1, 12))

SAFETENSORS = rf"{WEIGHTS}: expected a safetensors file, got "
HOSTILE: dict[str, tuple[Spoil, str]] = {
    # safetensors
    "an empty file": (lambda f: (f / WEIGHTS).write_bytes(b""), SAFETENSORS + "only 0 bytes"),
    "a header of 2^63 bytes": (
        lambda f: (f / WEIGHTS).write_bytes(struct.pack("<Q", 2**63) + b"{}"),
        SAFETENSORS + f"one whose header would be {2**63} bytes long",
    ),
    "a header that fits but is huge": (
        raw_header(lambda _: b"{" + b" " * MAX_HEADER_BYTES + b"}"),
        SAFETENSORS + "one whose header would be",
    ),
    "a deep header": (raw_header(lambda _: b"[" * 2**20), SAFETENSORS),
    "a tensor twice": (
        raw_header(lambda raw: raw.replace(b"{", f'{{"{FIRST}": {{}}, '.encode(), 1)),
        SAFETENSORS + f"the key '{FIRST}' twice",
    ),
    "offsets beyond the end": (header(data_offsets=[0, 2**60]), SAFETENSORS),
    "a shape that lies": (header(shape=[1, 1, 10**6]), SAFETENSORS),
    "a type that is none": (header(dtype="PY"), SAFETENSORS + f"'{FIRST}' of type 'PY'"),
    "whole numbers as weights": (header(dtype="I32"), rf"{FIRST}: expected numbers like"),
    "a tail": (lambda f: (f / WEIGHTS).write_bytes((f / WEIGHTS).read_bytes() + b"tail"), SAFETENSORS),
    "Git LFS": (
        text(WEIGHTS, "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n"),
        SAFETENSORS + "Git LFS's note of where it is; `git lfs pull` fetches it",
    ),
    "numbers of the other endianness": (other_endian, r"expected finite weights, got|expected the checkpoint's scores"),
    # settings
    "a deep config.json": (text("config.json", "[" * 10**6), r"config\.json: expected JSON, got"),
    "a huge config.json": (text("config.json", " " * (MAX_JSON_BYTES + 1)), r"config\.json: expected at most \d+ bytes"),
    "a number of many digits": (text("config.json", "9" * 10**5), r"config\.json: expected JSON, got"),
    "a key twice": (text("config.json", '{"max_len": 3, "max_len": 4}'), r"config\.json: expected JSON, got the key 'max_len' twice"),
    "max_len that nothing can hold": (settings("config.json", max_len=10**15), r"max_len: expected 1 to \d+, got 10{15}"),
    "frames without end": (settings("config.json", trained_frames=10**30), r"trained_frames: expected at most \d+"),
    "a model type that is a list": (settings("config.json", model_type=[]), r"model_type: expected rewind_transformer"),
    "a billion laughs": (text("config.yaml", LAUGHS), r"config\.yaml: expected YAML, got aliases that stand for more"),
    "a billion merges": (text("config.yaml", MERGES), r"config\.yaml: expected YAML, got aliases that stand for more"),
    "a value inside itself": (text("config.yaml", "model: &m {rewind: *m}"), r"got a value that is inside itself"),
    "a deep config.yaml": (text("config.yaml", "[" * 10**5), r"config\.yaml: expected YAML, got"),
    "a huge config.yaml": (text("config.yaml", "#" * (MAX_YAML_BYTES + 1)), r"config\.yaml: expected YAML, got more than"),
    "a number of a thousand digits": (text("config.yaml", f"a: 0x{'f' * 1000}"), r"got a number of 1002 digits"),
    "a key twice in YAML": (text("config.yaml", "data: {}\ndata: {}"), r"config\.yaml: expected YAML, got the key 'data' twice"),
    # names
    "a shard elsewhere": (shards(a="../secret.safetensors"), r"expected names of files beside it, got '\.\./secret"),
    "a shard with a NUL": (shards(a="a\0.safetensors"), r"expected a file|not there"),
    # not a file
    "a folder as weights": (instead(WEIGHTS, Path.mkdir), rf"{WEIGHTS}: expected a file, got a folder"),
    "a pipe as weights": (instead(WEIGHTS, os.mkfifo), rf"{WEIGHTS}: expected a file, got a pipe"),
    "a pipe as config.yaml": (instead("config.yaml", os.mkfifo), r"config\.yaml: expected a file, got a pipe"),
    "a device": (instead(WEIGHTS, lambda f: f.symlink_to("/dev/zero")), rf"{WEIGHTS}: expected a file, got a device"),
    "a link to nowhere": (instead("config.json", lambda f: f.symlink_to("gone")), r"got a link that leads nowhere"),
    "a link out of the checkpoint": (
        instead(WEIGHTS, lambda f: f.symlink_to(REWIND.checkpoint / WEIGHTS)),
        rf"{WEIGHTS}: expected a file of the checkpoint, got a link to /",
    ),
}  # fmt: skip


def refused(checkpoint: Path, repository: Path, message: str, *options: str) -> None:
    """`rfm export` says one line, with exit status 1, soon, in little memory, and the repository stays as it is."""
    before, largest_kib = files_in(repository), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    arguments = ["export", "--checkpoint", str(checkpoint), "--repository", str(repository), *options]
    result = rfm(*arguments)
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    below_bar = result.stderr.rpartition("\r")[2].partition("\n")[2]  # of transformers 5, which loads a base model
    line = below_bar or result.stderr
    assert re.search(message, line), result.stderr
    assert line.startswith("rfm: ")
    assert len(line) < 10_000
    assert files_in(repository) == before
    assert not list(repository.parent.glob(".*export*"))
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - largest_kib) * 1024 < MOST_MEMORY_BYTES


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    repository = tmp_path_factory.mktemp("hostile") / "model_repository"
    rfm_export.export(REWIND.checkpoint, repository, serve_config(REWIND))
    return repository


@pytest.mark.parametrize(("spoil", "message"), HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_checkpoint_is_refused(tmp_path: Path, repository: Path, spoil: Spoil, message: str) -> None:
    folder = copied(REWIND, tmp_path / "checkpoint")
    spoil(folder)
    refused(folder, repository, message)


HOSTILE_VLM: dict[str, tuple[Spoil, str]] = {
    "layers without end": (
        text_settings(num_hidden_layers=10**9),
        r"num_hidden_layers: expected at most 1024, got 1000000000",
    ),
    "a vocabulary that nothing can hold": (
        text_settings(vocab_size=10**12),
        r"embed_tokens\.weight: expected \[1000000000000, \d+\], got",
    ),
    "a configuration that is a list": (settings("config.json", text_config=[1]), r"text_config: expected settings of the backbone, got \[1\]"),
    "another type of value": (text_settings(num_attention_heads="x"), r"expected a backbone that"),
    "a pipe as adapter": (lambda f: os.mkfifo(f / "adapter_config.json"), r"adapter_config\.json: expected a file, got a pipe"),
    "code of its own": (settings("config.json", auto_map={"AutoConfig": "evil.Config"}, model_type="evil"), r"expected"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "message"), HOSTILE_VLM.values(), ids=HOSTILE_VLM)
def test_a_hostile_vision_language_checkpoint_is_refused(tmp_path: Path, spoil: Spoil, message: str) -> None:
    folder = copied(VLM, tmp_path / "checkpoint")
    spoil(folder)
    (tmp_path / "model_repository").mkdir()
    refused(folder, tmp_path / "model_repository", message, "--base-model", VLM.sources["base_model"])


def test_a_language_model_with_layers_without_end_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoint"
    shutil.copytree(ROBOREWARD, folder)
    text_settings(num_hidden_layers=10**9)(folder)
    with pytest.raises(CheckpointError, match=r"num_hidden_layers: expected at most 1024, got 1000000000"):
        families.load(str(folder), reward_model="roboreward")


def test_lora_factors_whose_product_would_be_huge_are_refused(tmp_path: Path) -> None:
    folder = copied(ADAPTER, tmp_path / "checkpoint")

    def widen(adapter: dict[str, torch.Tensor]) -> None:
        name = next(name for name in adapter if ".lora_A." in name)
        adapter |= {name: torch.zeros(1, 2**20), name.replace("lora_A", "lora_B"): torch.zeros(2**20, 1)}

    weights(widen, "adapter_model.safetensors")(folder)
    (tmp_path / "model_repository").mkdir()
    message = r"expected LoRA factors of \[\d+, \d+\], got \[1048576, 1\] and \[1, 1048576\]"
    refused(folder, tmp_path / "model_repository", message, "--base-model", ADAPTER.sources["base_model"])


def test_the_code_of_a_base_model_is_not_run(tmp_path: Path) -> None:
    mark = tmp_path / "was_here"
    (tmp_path / "evil.py").write_text(f"open({str(mark)!r}, 'w')\n")
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "evil", "auto_map": {"AutoConfig": "evil.Config"}}))
    with pytest.raises(CheckpointError, match=r"base model .*: model_type: expected one of .*, got 'evil'"):
        families.load(ADAPTER.checkpoint, base_model=str(tmp_path))
    assert not mark.exists()


def test_the_links_of_the_hubs_cache_are_followed(tmp_path: Path) -> None:
    blobs, snapshot = (tmp_path / "models--org--name" / part for part in ("blobs", f"snapshots/{'0' * 40}"))
    blobs.mkdir(parents=True)
    snapshot.mkdir(parents=True)
    for number, file in enumerate(sorted(REWIND.checkpoint.iterdir())):
        shutil.copy(file, blobs / str(number))
        (snapshot / file.name).symlink_to(Path("..", "..", "blobs", str(number)))
    repository = tmp_path / "model_repository"
    rfm_export.export(snapshot, repository, serve_config(REWIND))
    assert not [path for path in repository.rglob("*") if path.is_symlink()]


BAD_SETTINGS = {
    "a path as name": ("export: {name: ../../etc}", r"serve\.yaml: export\.name: expected letters, digits, _ and -, got"),
    "an endless name": (f"export: {{name: {'a' * 300}}}", r"export\.name: expected at most 100 characters, got 300"),
    "a batch beyond int32": ("export: {max_batch_size: 9999999999}", r"max_batch_size: expected at most 2147483647"),
    "GPUs without end": ("num_gpus: 1000000000", r"serve\.yaml: num_gpus: expected at most 4096"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "message"), BAD_SETTINGS.values(), ids=BAD_SETTINGS)
def test_hostile_settings_are_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "serve.yaml").write_text(content)
    with pytest.raises(ConfigError, match=message):
        Config.from_yaml(tmp_path / "serve.yaml")


@pytest.mark.parametrize("source", ["../nowhere", "org/..", "..@tag", "a" * 5000, "~nobody-here/x/y", "a\0b"])
def test_what_is_no_id_is_not_asked_for(tmp_path: Path, source: str) -> None:
    refused(Path(source), tmp_path, "checkpoint: expected a folder that exists or a Hugging Face id")
