# SPDX-License-Identifier: MIT
"""Find modules without LoRA factors in an adapter, by PEFT's rules (``check_target_module_exists`` of PEFT 0.21).

A module is the name of its weight without ``.weight``, under VlmRewardModel's names.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from rfm.checkpoint.content import CheckpointError, listed, shown

WHOLE, TEXT = "model.", "model.language_model."  # what PEFT wraps
_ALL_LINEAR = "all-linear"
_LAYER = re.compile(r"\.\d+\.")  # the first one in a name
_PATTERN_S = 5  # for a pattern of an unknown author


def check_factors(
    file: Path, config: Mapping[str, Any], present: set[str], weights: Mapping[str, Tensor], root: str
) -> None:
    """Raise CheckpointError for modules that an adapter trained, but whose factors are missing.

    file: with ``config``, the adapter's configuration
    present: modules with factors
    weights: of the whole network
    root: begins the names of the modules that PEFT wrapped
    """
    check_none_lost(file, _targeted(file, config, present, weights, root) - present)


def check_none_lost(file: Path, lost: set[str]) -> None:
    """Raise CheckpointError if factors are lost. file: the file that names their modules, for the message"""
    if lost:
        got = f"none for {listed(sorted(lost))}: these modules would score as before training"
        remedy = "copy or save the weights again where they were trained"
        raise CheckpointError.at(file, "LoRA factors of each module that was trained", got, remedy)


def check_replaced(file: Path, config: Mapping[str, Any], replaced: Iterable[str], weights: Iterable[str]) -> None:
    """Raise CheckpointError for a weight of ``modules_to_save`` that an adapter lacks. replaced: weights that it has"""
    names = config.get("modules_to_save") or ()
    saved = {weight for weight in weights for name in names if f".{name}." in f".{weight}"}
    if missing := sorted(saved - set(replaced)):
        where, remedy = f"{file}: modules_to_save", "copy or save the adapter again where it was trained"
        raise CheckpointError.at(where, "the weights of each module", f"none for {listed(missing)}", remedy)


def _targeted(
    file: Path, config: Mapping[str, Any], present: set[str], weights: Mapping[str, Tensor], root: str
) -> set[str]:
    """Return the modules that ``config`` targets; if ``present`` has others, its kinds of modules in all layers."""
    axes = {name.removesuffix(".weight"): tensor.dim() for name, tensor in weights.items() if name.endswith(".weight")}
    modules = [module for module, dim in axes.items() if module.startswith(root) and dim > 1]
    for prefix in (root, WHOLE, ""):
        keys = {module.removeprefix(prefix): axes[module] for module in modules}
        matched = _matched(file, config, keys)
        found = {module for module in modules if module.removeprefix(prefix) in matched}
        if found and present <= found:
            return found
    kinds = {_LAYER.sub(".*.", module, count=1) for module in present}
    return {module for module in modules if _LAYER.sub(".*.", module, count=1) in kinds}


def _matched(file: Path, config: Mapping[str, Any], keys: Mapping[str, int]) -> set[str]:
    """Return the keys that ``target_modules`` and its exceptions name. keys: with the axes of each weight"""
    wanted = config.get("target_modules") or []
    linear = {key for key, dim in keys.items() if dim == 2 and "embed" not in key.rpartition(".")[2]}
    found = linear if wanted == _ALL_LINEAR else _named(file, "target_modules", wanted, keys)
    layers = config.get("layers_to_transform")
    if isinstance(wanted, list) and layers not in (None, []):
        numbers = layers if isinstance(layers, list) else [layers]
        found = {key for key in found if key in wanted or _layer_of(key, config.get("layers_pattern")) in numbers}
    saved = config.get("modules_to_save") or ()
    found = {key for key in found if not any(f".{name}." in f".{key}." for name in saved)}
    return found - _named(file, "exclude_modules", config.get("exclude_modules") or [], keys)


def _named(file: Path, field: str, names: list[str] | str, keys: Iterable[str]) -> set[str]:
    """Return the keys that end with one of ``names``, or that match it as a pattern."""
    if not isinstance(names, str):
        return {key for key in keys if any(f".{key}".endswith(f".{name}") for name in names)}
    import regex  # of transformers; Python's own has no time limit

    try:
        return {key for key in keys if regex.fullmatch(names, key, timeout=_PATTERN_S)}
    except (TimeoutError, regex.error) as error:
        raise CheckpointError.at(f"{file}: {field}", "a pattern of names", f"{shown(names)}: {error}") from error


def _layer_of(key: str, patterns: list[str] | str | None) -> int | None:
    """Return the layer's number in a key, behind one of the names ``patterns`` (none: behind any name)."""
    names = [patterns] if isinstance(patterns, str) else patterns or [r"[^.]*"]
    for name in names:
        escaped = name if name == r"[^.]*" else re.escape(name)
        if (found := re.match(rf"(?:^|.*?\.){escaped}\.(\d+)\.", key)) is not None:
            return int(found[1])
    return None
