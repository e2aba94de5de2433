# SPDX-License-Identifier: MIT
"""Read attributes of HDF5 demonstrations: tasks, the mark of LIBERO, the frame rate."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

DOCUMENTS = ("problem_info", "env_args")  # attributes of ``data`` with a JSON object

_SENTENCES = ("language_instruction", "language", "lang")  # keys of the task in problem_info and env_args
_DEFAULT_FPS = 20.0  # robosuite's


def own_task_of(demo: Any) -> Any:
    """Return the task in a demonstration's ``ep_meta``, as robomimic reads it, or in an attribute; None without one."""
    attributes = getattr(demo, "attrs", {})
    stored = document(attributes, "ep_meta")
    own = next((stored[key] for key in _SENTENCES if stored.get(key)), None)
    return own or next((attribute(attributes, key) for key in _SENTENCES if key in attributes), None)


def task_of(attributes: Mapping[str, Any]) -> Any:
    """Return the task of all demonstrations from the attributes of ``data``; None if there is none."""
    documents = (document(attributes, name) for name in DOCUMENTS)
    return next((found[key] for found in documents for key in _SENTENCES if found.get(key)), None)


def is_of_libero(attributes: Mapping[str, Any]) -> bool:
    """True if the attributes of ``data`` are LIBERO's."""
    env_names = [attribute(attributes, "env_name"), document(attributes, "env_args").get("env_name")]
    env_names.append(attribute(attributes, "tag"))
    has_problem = not {"problem_name", "language_instruction"}.isdisjoint(document(attributes, "problem_info"))
    is_named = any("libero" in str(name).lower() for name in env_names)
    return has_problem or is_named or "bddl_file_name" in attributes


def fps_of(attributes: Mapping[str, Any]) -> float:
    """Return the frames per second: robosuite's control frequency, else its default."""
    told = document(attributes, "env_args").get("env_kwargs")
    fps = told.get("control_freq") if isinstance(told, dict) else None
    return float(fps) if isinstance(fps, int | float) and 0 < fps < 1000 else _DEFAULT_FPS


def document(attributes: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return the JSON object in an attribute; empty if there is none."""
    try:
        found = json.loads(attribute(attributes, name))
    except (ValueError, TypeError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def unread_documents(attributes: Mapping[str, Any]) -> list[str]:
    """Return the names of attributes that should hold a JSON object but do not."""
    broken = [name for name in DOCUMENTS if name in attributes and not document(attributes, name)]
    return [name for name in broken if str(attribute(attributes, name)).strip() not in ("", "{}")]


def attribute(attributes: Mapping[str, Any], name: str) -> Any:
    """Return an attribute, with bytes as text, an array as a list, and a single element without the list.

    Return None for an attribute that is missing, empty or unreadable.
    """
    try:
        value = attributes.get(name)
    except (OSError, RuntimeError, TypeError, ValueError):
        return None
    if isinstance(value, np.ndarray):
        value = value.item() if value.size == 1 else value.tolist()
    if hasattr(value, "dtype") and getattr(value, "shape", ()) is None:  # HDF5's null
        return None
    return value.decode(errors="replace") if isinstance(value, bytes) else value
