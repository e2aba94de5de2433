# SPDX-License-Identifier: MIT
"""Checkpoint files: fetch them, digest them, and read them in bounded memory and time, because they are untrusted."""

from __future__ import annotations

import hashlib
import json
import reprlib
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from safetensors import SafetensorError

from rfm.plain_yaml import read_yaml
from rfm_client.contract.checks import git_lfs_pointer
from rfm_client.contract.errors import LocatedError
from rfm_client.contract.hub_access import cached_snapshot

if TYPE_CHECKING:
    from torch import Tensor


WEIGHTS = "model.safetensors"
WEIGHTS_INDEX = "model.safetensors.index.json"
SHARDS = "model-*.safetensors"
NETWORK_CONFIG = "config.json"
ADAPTER_CONFIG = "adapter_config.json"
ADAPTER_WEIGHTS = "adapter_model.safetensors"
RUN_CONFIG = "config.yaml"
RUN_CONFIGS = (RUN_CONFIG, "config.yml", ".hydra/config.yaml")  # the first that exists is read
PREPROCESSOR_CONFIG = "preprocessor_config.json"  # image preprocessing, beside a model's weights
PIL_BICUBIC = 3  # a value of `resample` in PREPROCESSOR_CONFIG
MAX_UINT8 = 255
MAX_JSON_BYTES = 2**24
MAX_HEADER_BYTES = 2**24  # for a safetensors file; a tensor takes about 100 bytes
_LENGTH_BYTES = 8  # length field before a safetensors header
_DTYPES = ("F64", "F32", "F16", "BF16", "I64", "I32", "I16", "I8", "U8", "BOOL")
_AGAIN = "fetch or copy it again"
_START_BYTES = 64  # enough to recognise another kind of file
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
# Exceptions that libraries raise for unexpected content.
_MISFITS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
)
_short = reprlib.Repr()
_short.maxstring = _short.maxother = 100
_MAX_LISTED = 20


class CheckpointError(LocatedError):
    """A checkpoint that cannot be loaded: the file, its fault and the remedy."""


def misfits(*others: type[Exception]) -> tuple[type[Exception], ...]:
    """Return ``others`` and the exceptions that libraries raise for unexpected content."""
    from huggingface_hub import errors

    return (*others, *_MISFITS, getattr(errors, "StrictDataclassError", ValueError))


@contextmanager
def expecting(what: str, where: object) -> Iterator[None]:
    """Turn exceptions for unexpected content into a CheckpointError."""
    try:
        yield
    except misfits() as error:
        raise CheckpointError.at(where, what, f"{type(error).__name__}: {cut(str(error))}") from error


def shown(value: object) -> str:
    """Return the value as a short line for an error message."""
    try:
        return _short.repr(value)
    except ValueError:  # Python refuses to print a number with this many digits
        return f"a huge {type(value).__name__}"


def cut(text: str, most: int = 1000) -> str:
    """Return the text on one line, cut to ``most`` characters."""
    line = " ".join(text[:most].split())
    return line if len(text) <= most else f"{line}..."


def listed(names: Sequence[str]) -> str:
    """Return the names, or the first of many, as a Python list."""
    more = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
    return cut(repr(list(names[:_MAX_LISTED])), 4000) + more


def is_there(file: Path) -> bool:
    """True if the file exists. Raises CheckpointError for a folder, a broken link or anything else but a file."""
    try:
        kind = stat.S_IFMT(file.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        if file.is_symlink():
            raise CheckpointError.at(file, "a file", "a link that leads nowhere") from None
        return False
    except (OSError, ValueError) as error:
        raise CheckpointError.at(file, "a file", error) from error
    if kind != stat.S_IFREG:  # opening a pipe would wait for its writer
        raise CheckpointError.at(file, "a file", _KINDS.get(kind, "something else"))
    return True


def read_json(file: Path) -> dict[str, Any]:
    """Return the file's JSON object. Raises CheckpointError."""
    _require(file)
    try:
        with file.open("rb") as stream:
            text = stream.read(MAX_JSON_BYTES + 1)
        if len(text) > MAX_JSON_BYTES:
            raise CheckpointError.at(file, f"at most {MAX_JSON_BYTES} bytes of JSON", "more")
        content = json.loads(text, object_pairs_hook=_once)
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError.at(file, "JSON", cut(str(error))) from error
    if not isinstance(content, dict):
        raise CheckpointError.at(file, "a JSON object", type(content).__name__)
    return content


def network_config(folder: Path) -> dict[str, Any]:
    """Return config.json from a checkpoint folder; empty if there is none. Raises CheckpointError."""
    return read_json(folder / NETWORK_CONFIG) if is_there(folder / NETWORK_CONFIG) else {}


def read_run_config(file: Path) -> dict[str, Any]:
    """Return config.yaml as plain mappings, lists and scalars, even where tags name Python objects.

    Raises CheckpointError.
    """
    _require(file)
    try:
        config = read_yaml(file, _PlainLoader)
    except (OSError, ValueError) as error:
        raise CheckpointError.at(file, "YAML", cut(str(error))) from error
    if not isinstance(config, dict):
        raise CheckpointError.at(file, "a mapping", type(config).__name__)
    return config


def read_tensors(file: Path) -> dict[str, Tensor]:
    """Return all tensors in a safetensors file. Raises CheckpointError."""
    from safetensors.torch import load_file  # imported here: PyTorch takes seconds, and few commands need it

    _require(file)
    try:
        _check_header(file)
        return load_file(file)
    except (OSError, SafetensorError, *_MISFITS) as error:
        remedy = _AGAIN if isinstance(error, SafetensorError) else ""
        raise CheckpointError.at(file, "a safetensors file", cut(str(error)), remedy) from error


def check_one_form(folder: Path) -> None:
    """Raise CheckpointError for weights both in one file and in shards, because no file tells which are newer."""
    shards = [path.name for path in (folder / WEIGHTS_INDEX, *sorted(folder.glob(SHARDS))) if is_there(path)]
    if shards and is_there(folder / WEIGHTS):
        expected = f"{WEIGHTS} or shards"
        remedy = "name a copy without what is not meant: transformers, which reads the former, leaves it beside shards"
        raise CheckpointError.at(folder, expected, f"{WEIGHTS} and {listed(shards)}, of which one is older", remedy)


def _require(file: Path) -> None:
    if not is_there(file):
        raise CheckpointError.at(file, "a file", "none")


def _check_header(file: Path) -> None:
    """Check what the library does not: names that come twice, types. Raises ValueError, OSError, RecursionError."""
    with file.open("rb") as content:
        start, size = content.read(_START_BYTES), file.stat().st_size
        if pointer := git_lfs_pointer(start):
            raise ValueError(pointer)
        if start and not any(start):
            raise ValueError(f"zeros, as after an unfinished download; {_AGAIN}")
        length = int.from_bytes(start[:_LENGTH_BYTES], "little")
        if length > MAX_HEADER_BYTES:
            raise ValueError(f"a header of {length} bytes, more than {MAX_HEADER_BYTES}")
        if size < _LENGTH_BYTES + length:
            raise ValueError(f"only {size} bytes; {_AGAIN}")
        content.seek(_LENGTH_BYTES)
        header = json.loads(content.read(length), object_pairs_hook=_once)
    for name, tensor in header.items() if isinstance(header, dict) else ():
        dtype = tensor.get("dtype") if isinstance(tensor, dict) and name != "__metadata__" else _DTYPES[0]
        if dtype not in _DTYPES:
            raise ValueError(f"{shown(name)} of type {shown(dtype)}, which is none of {', '.join(_DTYPES)}")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for name, value in pairs:
        if name in content:
            raise ValueError(f"the key {shown(name)} twice")
        content[name] = value
    return content


class _PlainLoader(yaml.SafeLoader):
    """A SafeLoader that reads nodes tagged as Python objects as plain data."""


def _plain(loader: yaml.SafeLoader, _suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return node.value


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


PROVENANCE = "provenance.json"  # beside an exported checkpoint's config.json; nothing reads it
MODEL_CARD = "README.md"
DIGEST_DIGITS = 16  # out of 64; enough to identify a checkpoint and to detect damage
# Suffixes of files that decide scores besides weights: configuration, tokenizer, image processor. These are also
# fetched from the Hub.
SETTINGS_SUFFIXES = (".json", ".jinja", ".model", ".txt", ".yaml", ".yml")
_CHUNK_BYTES = 2**22


def weights_digest(folders: Iterable[Path]) -> str:
    """Return the first DIGEST_DIGITS of the SHA-256 over all safetensors files in the folders. Raises OSError."""
    digest = hashlib.sha256()
    for file in (file for folder in folders for file in sorted(folder.rglob("*.safetensors"))):
        with file.open("rb") as content:
            while chunk := content.read(_CHUNK_BYTES):
                digest.update(chunk)
    return digest.hexdigest()[:DIGEST_DIGITS]


def settings_digest(folders: Iterable[Path], settings: Mapping[str, Any]) -> str:
    """Return the first DIGEST_DIGITS of the SHA-256 over all settings that decide scores. Raises OSError.

    folders: all files in them with SETTINGS_SUFFIXES count, with their paths, except PROVENANCE
    settings: settings that no file holds, as JSON values
    """
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for folder in folders:
        for file in sorted(file for file in folder.rglob("*") if _counts(file)):
            content = file.read_bytes()
            digest.update(f"{file.relative_to(folder).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:DIGEST_DIGITS]


def _counts(file: Path) -> bool:
    return file.suffix in SETTINGS_SUFFIXES and file.name != PROVENANCE and file.is_file()


HUB_WEIGHTS = "*.safetensors"
HUB_FILES = [HUB_WEIGHTS, *(f"*{suffix}" for suffix in SETTINGS_SUFFIXES), MODEL_CARD]


def local_copy(source: str | Path, *, with_weights: bool = False) -> Path:
    """Return the folder of a base model or encoder: ``source`` itself, or a Hub id's main branch, fetched if necessary.

    By itself, transformers would ask an unreachable Hub repeatedly for each file.
    with_weights: False: fetch only the settings
    Raises OSError.
    """
    path = Path(source)
    return path if path.is_dir() else _main_of(str(source), with_weights=with_weights)


@lru_cache
def _main_of(repo_id: str, *, with_weights: bool) -> Path:
    return cached_snapshot(
        repo_id, patterns=HUB_FILES if with_weights else [each for each in HUB_FILES if each != HUB_WEIGHTS]
    )
