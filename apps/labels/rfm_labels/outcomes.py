# SPDX-License-Identifier: MIT
"""Read which episodes succeeded, from where recorders and people put it. Needs pyarrow, and h5py for HDF5."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from rfm_labels.datasets.faults import DatasetError, named, require
from rfm_labels.datasets.hdf5 import is_hdf5
from rfm_labels.datasets.hdf5_contents import demonstrations, opened_hdf5
from rfm_labels.datasets.lerobot_meta import EPISODES_FILE, column_types, json_lines, read_table
from rfm_labels.datasets.readers import is_reader, read_episodes
from rfm_labels.datasets.tasks_table import read_csv

_EPISODES, _SUCCESS = ("episode", "video", "episode_index"), "success"  # columns in an outcomes CSV
_MEANINGS = {
    **dict.fromkeys(("true", "1", "yes", "y", "success", "successful", "succeeded"), True),
    **dict.fromkeys(("false", "0", "no", "n", "failure", "failed", "fail", "unsuccessful"), False),
    **dict.fromkeys(("", "nan", "none", "suboptimal"), None),  # suboptimal: it may have ended well or not
}
_COSTS = {"-1": False, "0": True}  # rewards of -1 until success
Stored: TypeAlias = Mapping[Any, tuple[str, Sequence[Any]]]  # place for messages, and one or T values, by episode


def read_outcomes(
    source: str, dataset: Path | None = None, names: Mapping[int, str] | None = None
) -> dict[Any, bool | None]:
    """Return each episode's outcome by number, in a CSV file by name if ``names`` lack it; None: unknown.

    An episode succeeds if any of its frames does, as in LeRobot's evaluation. Values: true, false, 1, 0, yes, no;
    rewards of 1 and 0, or 0 and -1; success, failure and similar words; null, NaN, an empty cell or "suboptimal" for
    unknown.

    source: a CSV file with the columns ``episode`` (a number, a name, or both as tables show them: ``0 (red_cup.mp4)``;
        also called ``video`` or ``episode_index``) and ``success``; a LeRobot column, per frame or per episode; an
        attribute or array of each demonstration in an HDF5 file; or a reader, ``FILE.py:FUNCTION``
    dataset: the LeRobot folder, the HDF5 file, or the folder of the reader's recordings
    names: of the labelled episodes, by number, which a reader must give in the same order; None: unchecked

    Raises DatasetError.
    """
    if is_reader(source):
        require("outcome", dataset is not None, "the folder of the recordings with a reader", "none")
        outcomes = {}
        for number, episode in enumerate(read_episodes(source, dataset or Path())):
            labelled = (names or {}).get(number, episode.name)
            remedy = "label again, and yield new recordings last"
            require(f"outcome: episode {number}", episode.name == labelled, labelled, f"{episode.name}: {remedy}")
            outcomes[number] = episode.success
        return outcomes
    if Path(source).suffix.lower() == ".csv":
        return _outcomes(_SUCCESS, _of_csv(Path(source), names or {}))
    if dataset is not None and is_hdf5(dataset):
        return _outcomes(source, _of_hdf5(source, dataset))
    if dataset is None or not (dataset / "meta").is_dir():
        expected = "a CSV file, a column of a local LeRobot dataset, a name in an HDF5 file, or a reader"
        raise DatasetError.at("outcome", expected, repr(source))
    return _outcomes(source, _of_lerobot(source, dataset))


def _of_csv(file: Path, names: Mapping[int, str]) -> Stored:
    known = {text: number for number, name in names.items() for text in (name, named(number, name))}
    columns, rows = read_csv(file)
    got = ", ".join(columns) if rows else "no rows"
    name = next((each for each in _EPISODES if each in columns), _EPISODES[0])
    require(file, bool(rows) and {name, _SUCCESS} <= {*columns}, f"the columns {name} and {_SUCCESS}", got)
    stored: dict[Any, tuple[str, Sequence[Any]]] = {}
    for where, cells in rows:
        row = dict(zip(columns, cells, strict=False))
        text = row.get(name, "").strip()
        episode: Any = int(text) if text.isdecimal() else known.get(text, text)
        other = known.get(text, episode)
        either = f": write {named(other, text)} or {named(episode, names.get(episode))}" if other != episode else ""
        is_one = bool(text) and not either
        require(f"{where}: {name}", is_one, "the number or name of one episode", f"{text!r}{either}")
        require(where, episode not in stored, "each episode once", f"{text} again")
        stored[episode] = f"{where}: {_SUCCESS}", [row.get(_SUCCESS)]
    return stored


def _of_hdf5(name: str, file: Path) -> Stored:
    with opened_hdf5(file) as opened:
        stored, known = {}, set[str]()
        for number, (_, group) in demonstrations(file, opened).items():
            if hasattr(group, "keys"):
                arrays = [each for each, value in group.items() if hasattr(value, "shape")]
                holders = dict.fromkeys(arrays, group) | dict.fromkeys(group.attrs, group.attrs)
                values = np.ravel(holders[name][name]).tolist() if name in holders else []
                stored[number] = f"outcome: {group.name}: {name}", values
                known |= holders.keys()
        expected = f"a CSV file, a reader, or one of {', '.join(sorted(known))}"
        require("outcome", name in known, expected, repr(name))
        return stored


def _of_lerobot(name: str, dataset: Path) -> Stored:
    frames, episodes = (
        sorted(dataset.glob(pattern)) for pattern in ("data/**/*.parquet", "meta/episodes/**/*.parquet")
    )
    columns = [list(column_types(files[0])) if files else [] for files in (frames, episodes)]
    stored: dict[int, tuple[str, list[Any]]] = {}
    for files, names in zip((frames, episodes), columns, strict=True):
        if name in names:
            for file in files:
                table = read_table(file, ["episode_index", name]).to_pydict()
                for episode, value in zip(table["episode_index"], table[name], strict=True):
                    stored.setdefault(episode, (f"outcome: {name}: episode {episode}", []))[1].append(value)
            return stored
    file = dataset / EPISODES_FILE
    lines = list(json_lines(file)) if file.is_file() else []
    if not lines or name not in lines[0][1]:
        known = ", ".join(columns[0])
        raise DatasetError.at("outcome", f"a CSV file, or a column of {dataset}: {known}", repr(name))
    return {line["episode_index"]: (f"{where}: {name}", [line.get(name)]) for where, line in lines}


def _outcomes(source: str, stored: Stored) -> dict[Any, bool | None]:
    texts = {episode: [_text(value) for value in values] for episode, (_, values) in stored.items()}
    found = {text for text in chain.from_iterable(texts.values()) if _MEANINGS.get(text, True) is not None}
    expected = "-1 or 1 in some episode, which shows whether 0 is a failure"
    require(f"outcome: {source}", "reward" not in source or found != {"0"}, expected, "0 in all")
    are_costs = "reward" in source and "-1" in found and found <= _COSTS.keys()
    meanings: Mapping[str, bool | None] = {**_MEANINGS, **_COSTS} if are_costs else _MEANINGS
    outcomes: dict[Any, bool | None] = {}
    for episode, (where, values) in stored.items():
        for text, value in zip(texts[episode], values, strict=True):
            require(where, text in meanings, "true, false, 1, 0, success or failure", repr(value))
        known = [meaning for text in texts[episode] if (meaning := meanings[text]) is not None]
        outcomes[episode] = any(known) if known else None
    return outcomes


def _text(value: Any) -> str:
    """Return a stored value in one form: lower case, and whole numbers without a point."""
    while isinstance(value, list) and len(value) == 1:
        (value,) = value
    text = value.decode(errors="replace") if isinstance(value, bytes) else "" if value is None else str(value)
    return text.strip().lower().removesuffix(".0")
