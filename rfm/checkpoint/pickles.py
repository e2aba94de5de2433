# SPDX-License-Identifier: MIT
"""Pickles where weights should be. They are never opened here, since that may run code; messages say how it is done."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from pathlib import Path

from rfm.checkpoint.content import CheckpointError, cut

_PICKLES = ("*.bin", "*.pt", "*.pth", "*.ckpt", "*.pkl")
# What training leaves beside weights, to go on from.
_STATES = ("optimizer*", "*optim_states*", "scheduler*", "rng_state*", "random_states*", "scaler*", "training_args*")
_CONVERT = (
    "import argparse, functools, sys, torch, safetensors.torch as s; "
    "torch.serialization.add_safe_globals([argparse.Namespace]); "
    "load = lambda file: functools.reduce("
    "lambda d, key: d[key] if isinstance(d.get(key), dict) else d, "
    "('state_dict', 'model_state_dict', 'model', 'module'), "
    "torch.load(file, map_location='cpu', weights_only=True)); "
    "s.save_file({name: t.clone(memory_format=torch.contiguous_format) "
    "for file in sys.argv[2:] for name, t in load(file).items() if torch.is_tensor(t)}, "
    "sys.argv[1], {'format': 'pt'})"
)


def pickled_weights(names: Iterable[str], stem: str) -> list[str]:
    """Those of a folder's files that are pickles and may hold its weights.

    stem: how transformers begins their names; if there are such, the others are left out
    """
    pickles = sorted(name for name in names if _is_any(name, _PICKLES) and not _is_any(name, _STATES))
    usual = [name for name in pickles if name == f"{stem}.bin" or fnmatch(name, f"{stem}-*-of-*.bin")]
    return usual or pickles


def refuse_pickles(folder: Path, wanted: str, stem: str) -> None:
    """Raises CheckpointError if ``folder`` has pickled weights, where the file ``wanted`` is not there."""
    names = pickled_weights((file.name for file in folder.iterdir()), stem)
    if not names:
        return
    if len(names) > 1 and f"{stem}.bin" in names:
        both = f"{stem}.bin and {names[0]}"
        raise CheckpointError(f"{folder}: expected one form of the weights, got {both}; move away what is not meant")
    raise CheckpointError(f"{folder}: expected {wanted}, got {cut(', '.join(names))}: {remedy(folder, names, wanted)}")


def remedy(folder: Path, names: Sequence[str], wanted: str) -> str:
    """What a pickle risks, and the command that converts those in ``folder``, all shards or the first other."""
    files = names if names[0].endswith(".bin") and "-of-" in names[0] else names[:1]
    return (
        "pickles may run code when they are loaded, so they are refused. If you trust who made it, convert it. "
        "weights_only=True lets PyTorch make tensors and little else; do not convert a file that needs more: "
        + command(_CONVERT, [folder / wanted, *(folder / name for name in files)])
    )


def command(code: str, arguments: Iterable[str | Path]) -> str:
    """A line for a shell that runs ``code``, which has no double quotes."""
    return f'python -c "{code}" {shlex.join(map(str, arguments))}'


def _is_any(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(name, pattern) for pattern in patterns)
