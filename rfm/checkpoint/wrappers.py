# SPDX-License-Identifier: MIT
"""Prefixes that training code puts before names of weights."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rfm.checkpoint.content import CheckpointError, shown
from rfm.checkpoint.pickles import command

if TYPE_CHECKING:
    from torch import Tensor

_INSIDE = r"_orig_mod|_fsdp_wrapped_module|_checkpoint_wrapped_module|_forward_module"  # before names of layers, too
_WRAPPERS = re.compile(rf"^(?:(?:module|base_model\.model|{_INSIDE})\.)+|(?<=\.)(?:(?:{_INSIDE})\.)+")
_HEAD = "progress_head.4.weight"  # of every network of ours
_STRIP = (
    "import sys, safetensors.torch as s; prefix, target, *files = sys.argv[1:]; "
    "t = [(name.removeprefix(prefix), v) for file in files for name, v in s.load_file(file).items()]; "
    "assert len(dict(t)) == len(t), 'two tensors would have one name'; s.save_file(dict(t), target, {'format': 'pt'})"
)
_STRIPPED = "stripped.safetensors"


def unwrapped(weights: Mapping[str, Tensor], files: Sequence[Path], target: Path) -> dict[str, Tensor]:
    """The weights without the prefixes of DataParallel, torch.compile, PEFT, FSDP, nor another one that all have.

    files: those that hold the weights; target: that which would hold them without another prefix
    Raises CheckpointError if only some have it, or two would have one name. Which names are right is not known here.
    """
    bare: dict[str, Tensor] = {}
    for name, tensor in weights.items():
        if (short := _WRAPPERS.sub("", name)) in bare:
            raise CheckpointError(f"{target.parent}: expected each weight once, got {shown(short)} and {shown(name)}")
        bare[short] = tensor
    head = next((name for name in bare if name == _HEAD or name.endswith(f".{_HEAD}")), _HEAD)
    prefix = head.removesuffix(_HEAD)
    other = next((name for name in bare if not name.startswith(prefix)), None)
    if other is not None:
        stripped = target.parent / _STRIPPED
        line = f"{command(_STRIP, [prefix, stripped, *files])} && mv {shlex.join([str(stripped), str(target)])}"
        then = "" if list(files) == [target] else ", then move the shards and their index away"
        raise CheckpointError(
            f"{target.parent}: expected {_HEAD}, got {shown(head)}, with the prefix {prefix} that {shown(other)} lacks"
            f"; strip it with: {line}{then}"
        )
    return {name.removeprefix(prefix): tensor for name, tensor in bare.items()}
