# SPDX-License-Identifier: MIT
"""Dataset errors, and messages that list the faults in many episodes with the options that help."""

from __future__ import annotations

import json
import sysconfig
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from traceback import extract_tb
from typing import Any

from rfm_client import RewardError
from rfm_client.options import InvalidValueError, git_lfs_pointer
from rfm_client.options import require as require_that

_MOST_SHOWN = 20
_OTHERS_CODE = ("<frozen", sysconfig.get_path("stdlib"), "site-packages", str(Path(__file__).parents[1]))


def listed(numbers: Iterable[int]) -> str:
    """Format sorted numbers for ``--episodes``: ``0:17,18,20:40``."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1]:
            runs[-1][1] += 1
        else:
            runs.append([number, number + 1])
    return ",".join(str(first) if end == first + 1 else f"{first}:{end}" for first, end in runs)


def named(number: int, name: str | None) -> str:
    """Return an episode's number with its own name, if that says more: ``3 (red_cup.mp4)``."""
    return f"{number} ({name})" if name and name != str(number) else str(number)


def shortened(lines: Sequence[str]) -> list[str]:
    """Return the first lines, and a line that counts the rest."""
    more = len(lines) - _MOST_SHOWN
    return [*lines[:_MOST_SHOWN], *([f"... and {more} more"] if more > 0 else [])]


class DatasetError(RewardError, InvalidValueError):
    """A contradictory or unreadable dataset. where: a file, or a place in it."""


def unreadable(file: Path, expected: str, error: object) -> DatasetError:
    """Return the error for a file that a library cannot read; the library's ``error`` does not mention Git LFS."""
    with suppress(OSError):
        error = (git_lfs_pointer(file) if file.is_file() else "") or error
    return DatasetError.at(file, expected, error)


def json_object(file: Path) -> dict[str, Any]:
    """Read a JSON file. Raises DatasetError unless it holds an object."""
    try:
        document = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError.at(file, "a readable JSON file", error) from error
    require(file, isinstance(document, dict), "a JSON object", type(document).__name__)
    return dict(document)


class MissingTaskError(DatasetError):
    """An episode without a task."""


class UnusedTaskError(DatasetError):
    """A task from the caller that no episode needs."""


class FaultsError(DatasetError):
    """Several faults, one per line, then the options that help."""

    @classmethod
    def of(cls, faults: Mapping[int, RewardError], numbers: Sequence[int]) -> FaultsError:
        """Return the error for these episodes: a line for each distinct fault, then the options that help.

        numbers: all chosen episodes
        """
        alike: dict[str, list[int]] = {}
        for number, fault in faults.items():
            alike.setdefault(str(fault), []).append(number)
        texts = [text if len(those) == 1 else f"{text} (episodes {listed(those)})" for text, those in alike.items()]
        head = f"episodes: expected {len(numbers)} that can be labelled, got {len(faults)} with faults:"
        lines = [*[head] * (len(texts) > 1), *shortened(texts)]
        num_without_task = sum(isinstance(fault, MissingTaskError) for fault in faults.values())
        if num_without_task > 1:
            lines.append(f'for the {num_without_task} without a task: --task "SENTENCE"')
        others = [number for number in numbers if number not in faults]
        if others:
            lines.append(f"to continue without the faulty episodes: --episodes {listed(others)}")
        return cls("\n".join(lines))


@contextmanager
def faults_of_reader(where: object) -> Iterator[None]:
    """Turn an error in a user's code into a DatasetError that names the last line of that code."""
    try:
        yield
    except RewardError:
        raise
    except Exception as error:
        lines = extract_tb(error.__traceback__)
        own = [each for each in lines if not any(part in each.filename for part in _OTHERS_CODE)]
        got = f"{type(error).__name__}: {error}"
        got += "".join(f" ({Path(each.filename).name}, line {each.lineno})" for each in own[-1:])
        raise DatasetError.at(where, "a reader that runs", got) from error


require = partial(require_that, error=DatasetError)
