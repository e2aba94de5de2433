# SPDX-License-Identifier: MIT
"""Read untrusted YAML files as plain values, in bounded memory and time."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import yaml

MAX_YAML_BYTES = 2**18  # a training run's config.yaml has a few thousand
MAX_YAML_VALUES = 100_000  # with all aliases and merge keys expanded
MAX_DIGITS = 100

# PyYAML's errors, and those that it raises for `!!timestamp x`, `!!bool x`, `!!int ""`, 5000 digits, 1000 brackets.
_MISREAD = (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)


def read_yaml(file: Path, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """Return the file's only document. Raises OSError, and ValueError for invalid YAML or exceeded limits."""
    with file.open("rb") as content:
        text = content.read(MAX_YAML_BYTES + 1)
    if len(text) > MAX_YAML_BYTES:
        raise ValueError(f"more than {MAX_YAML_BYTES} bytes")
    try:
        reading = loader(text)
        try:
            node = reading.get_single_node()
            if node is None:
                return None
            if _num_values(node, {}) > MAX_YAML_VALUES:
                raise ValueError(f"aliases that stand for more than {MAX_YAML_VALUES} values")
            return reading.construct_document(node)
        finally:
            reading.dispose()
    except yaml.MarkedYAMLError as error:
        place = "" if error.problem_mark is None else f" in line {error.problem_mark.line + 1}"
        raise ValueError(f"a mistake{place} ({error.problem or error.context})") from error
    except _MISREAD as error:
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error


def _num_values(node: yaml.Node, known: dict[int, int | None]) -> int:
    """Count the values in a node, with its aliases expanded.

    Raises ValueError for a node that contains itself and for a duplicate key.
    """
    if id(node) in known:
        count = known[id(node)]
        if count is None:
            raise ValueError("a value that is inside itself")
        return count
    if node.tag.endswith(":int") and len(node.value) > MAX_DIGITS:
        raise ValueError(f"a number of {len(node.value)} digits")
    known[id(node)] = None
    children: list[yaml.Node] = []
    if isinstance(node, yaml.SequenceNode):
        children = node.value
    elif isinstance(node, yaml.MappingNode):
        keys = Counter((key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        twice = [name for (_, name), count in keys.items() if count > 1]
        if twice:
            raise ValueError(f"the key {twice[0]!r} twice")
        children = [part for pair in node.value for part in pair]
    known[id(node)] = total = 1 + sum(_num_values(child, known) for child in children)
    return total
