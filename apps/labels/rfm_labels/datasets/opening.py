# SPDX-License-Identifier: MIT
"""Open a dataset by path or Hub id, by a pattern or by a reader, or explain how to open an unknown layout."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path

from rfm_client.frames import ChannelOrder, Orientation
from rfm_client.options import first_names
from rfm_labels.datasets.dataset import SIGNALS_FOLDER, AskedCorrections, Dataset, SeveralTasks, TaskOverride
from rfm_labels.datasets.episodes import Episode, EpisodeDataset
from rfm_labels.datasets.faults import DatasetError, require
from rfm_labels.datasets.hdf5 import SUFFIXES, Hdf5Dataset, is_hdf5
from rfm_labels.datasets.hub import HubFiles
from rfm_labels.datasets.lerobot import LeRobotDataset
from rfm_labels.datasets.lerobot_frames import TOLERANCE_S
from rfm_labels.datasets.lerobot_meta import INFO_FILE, Info
from rfm_labels.datasets.lerobot_rows import TASK_COLUMN
from rfm_labels.datasets.patterns import files_below, files_of_pattern, suggested_pattern
from rfm_labels.datasets.pictures_in_order import PICTURE_SUFFIXES, in_natural_order, is_picture
from rfm_labels.datasets.readers import Reader, is_reader, open_read
from rfm_labels.datasets.rlds import RldsDataset, rlds_folder
from rfm_labels.datasets.rlds_files import FEATURES_FILE
from rfm_labels.datasets.tasks_table import TABLE, read_table_of_tasks

_HUB_ID = re.compile(
    r"(?:hf://datasets/|https://(?:huggingface\.co|hf\.co)/datasets/)?([\w.-]+/[\w.-]+)(?:@([\w./-]+)|/tree/([\w.-]+))?/?"
)
_LAYOUTS = (
    f"a LeRobot dataset ({INFO_FILE}), an RLDS dataset ({FEATURES_FILE}), an HDF5 file ({', '.join(SUFFIXES)}), a "
    f"folder of videos or of folders of pictures with {TABLE}, any folder with --videos or --reader, or a Hub id "
    "org/name[@revision]"
)
_READER = "write a reader of ten lines (--reader; examples/readers)"
_GIVE_TASK = '--task "SENTENCE"'
_UNREAD = {  # remedies for layouts without a reader, by file name pattern
    r"meta_data": "a LeRobot dataset of v1: convert it to v2.0 with LeRobot 0.3",
    r".*\.tfrecord.*": f"TFRecord files without {FEATURES_FILE}, which TensorFlow Datasets 4.6 or later writes beside "
    "them: copy the whole folder of the version",
    r".*\.zarr(\.zip)?|\.z(group|array|attrs|metadata)|zarr\.json": f"Zarr arrays: {_READER}",
    r".*\.(bag|mcap|db3)": f"a rosbag: {_READER}",
}
_VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov", ".webm", ".avi")
_SUFFIXES = {"videos": _VIDEO_SUFFIXES, "HDF5 files": SUFFIXES, "pictures": PICTURE_SUFFIXES}
_KINDS = {  # the dataset's kind, its camera, and what an episode is called
    "videos": ("videos", "video", "video"),
    "folders of pictures": ("folders of frames", "frames", "folder"),
}
_ORDER = ("videos", "HDF5 files", "folders of pictures", "pictures")
_OUR_FILES = re.compile(r".*_summary\.png|.*\.[\w-]+_rewards\.hdf5")  # beside labelled episodes; HDF5: from 0.4


def open_dataset(
    source: str | Path,
    *,
    reader: str | Reader | None = None,
    videos: str | None = None,
    task: str | None = None,
    override_task: bool = False,
    several_tasks: SeveralTasks = "each",
    task_column: str | None = None,
    orient: Orientation | Mapping[str, Orientation] | None = None,
    channels: ChannelOrder | Mapping[str, ChannelOrder] | None = None,
    tolerance_s: float = TOLERANCE_S,
) -> Dataset:
    """Open the dataset at a path, or on the Hub: ``org/name[@revision]``, or its address. An existing path wins.

    Of a dataset on the Hub, only the metadata are downloaded. ``Dataset.download`` fetches what episodes need.

    reader: function that yields the episodes of the folder, each an ``Episode``, or its name, ``FILE.py:FUNCTION``
    videos: pattern for videos or pictures below the folder, such as ``{episode}/videos/{camera}.mp4`` or
        ``{episode}/colors/*_{camera}.jpg``
    task: task for episodes without their own
    override_task: True: use ``task`` for all episodes
    several_tasks: if a LeRobot episode has several tasks: ``each``: frames keep their own; ``first``: all frames get
        the first frame's, as in LeRobot's own scripts
    task_column: in a LeRobot dataset, the row column that names the tasks: sentences, sentence numbers from
        ``meta/tasks``, or LeRobot's ``language_persistent``; None: ``task_index``, checked against the metadata. In an
        RLDS dataset, the feature with the sentences
    orient: how to turn frames: one value for all cameras, or a dict by camera, in which "" stands for the others; None:
        as stored, except that HDF5 files marked as LIBERO's are turned
    channels: stored channel order, ``rgb`` or ``bgr``: one value, or a dict; None: ``rgb``
    tolerance_s: for LeRobot videos: largest gap between a row and its frame, as in LeRobot's ``tolerance_s``

    Raises DatasetError.
    """
    path, given = Path(source), TaskOverride(task, override_task, several_tasks, task_column)
    asked = AskedCorrections.of(orient, channels)
    if reader is not None or videos is not None:
        require("videos", reader is None or videos is None, "none with a reader, which names the files", videos)
        require("task_column", task_column is None, "none with a reader or a pattern", task_column)
        return (
            _by_pattern(path, videos or "", given, asked) if reader is None else open_read(reader, path, given, asked)
        )
    if (path / INFO_FILE).is_file():
        return LeRobotDataset(path, task=given, corrections=asked, tolerance_s=tolerance_s)
    if path.exists():
        return _open_path(path, given, asked)
    hub = _on_hub(source)
    return LeRobotDataset(hub.folder, hub=hub, task=given, corrections=asked, tolerance_s=tolerance_s)


def _open_path(path: Path, task: TaskOverride, corrections: AskedCorrections) -> Dataset:
    """Open a file or folder that is not LeRobot's. Raises DatasetError."""
    if folder := rlds_folder(path):
        return RldsDataset(folder, task=task, corrections=corrections)
    require("task_column", task.column is None, f"none, since {path} is no LeRobot or RLDS dataset", task.column)
    return (Hdf5Dataset if is_hdf5(path) else _open_files)(path, task=task, corrections=corrections)


def _on_hub(source: str | Path) -> HubFiles:
    """Return the files of a LeRobot dataset on the Hub. Raises DatasetError."""
    match = _HUB_ID.fullmatch(str(source))
    if match is None:
        got = "another address" if "://" in str(source) else f"none: there is no {Path(source).absolute()}"
        raise DatasetError.at(source, _LAYOUTS, got)
    hub = HubFiles(match[1], match[2] or match[3])
    if not (hub.folder / INFO_FILE).is_file():
        got = (hub.folder.is_dir() and _unread(hub.folder)) or "none: hf download it, and name its folder"
        raise DatasetError.at(match[1], f"a LeRobot dataset's {INFO_FILE}", got)
    return hub


def open_to_show(source: str) -> list[Dataset]:
    """Open what a viewer shows: a dataset, for a folder of HDF5 files one for each. Raises DatasetError.

    source: path, Hub id or address, ``READER=FOLDER`` or ``PATTERN=FOLDER``

    Accepts blank and outdated tasks. In a LeRobot dataset, a row shows the nearest frame, as a player does.
    ``Dataset.as_now`` returns the datasets as they are later.
    """
    since_ns = time.time_ns()
    return [opening().follow(opening, since_ns) for opening in _openings(source)]


def _openings(source: str) -> list[Callable[[], Dataset]]:
    how, _, folder = source.partition("=")
    no_tasks, as_stored = TaskOverride(is_needed=False), AskedCorrections()
    require("", bool(folder) or not (is_reader(how) or "{episode}" in how), f"{how}=FOLDER", source)
    if is_reader(how):
        return [partial(open_read, how, Path(folder).resolve(), no_tasks, as_stored)]
    if "{episode}" in how:
        return [partial(_by_pattern, Path(folder).resolve(), how, no_tasks, as_stored)]
    path = Path(source).resolve()
    hub = None if path.exists() else _on_hub(source)
    root = path if hub is None else hub.folder
    if (root / INFO_FILE).is_file():
        task = TaskOverride(column=TASK_COLUMN, is_needed=False)
        return [lambda: LeRobotDataset(root, hub=hub, task=task, tolerance_s=0.5 / Info.read(root).fps)]
    return [partial(_open_path, each, no_tasks, as_stored) for each in hdf5_files(path) or [path]]


def hdf5_files(folder: str | Path) -> list[Path]:
    """List the HDF5 datasets in a folder and its subfolders; empty if it is no folder, or holds other data.

    Label files and hidden files are left out. Paths sort with 2 before 10.
    """
    root = Path(folder)
    is_other = any((root / name).is_file() for name in (INFO_FILE, TABLE))
    if not root.is_dir() or is_other or set(_found(root)) - {"HDF5 files"}:
        return []
    names = [name for name in files_below(root) if name.lower().endswith(SUFFIXES) and not _OUR_FILES.fullmatch(name)]
    return [root / name for name in in_natural_order(names)]


def _open_files(path: Path, task: TaskOverride, corrections: AskedCorrections) -> EpisodeDataset:
    """Open a folder with one file or folder per episode, or its table. Raises DatasetError."""
    if path.is_file() and path.suffix.lower() != ".csv":
        raise DatasetError.at(path, _LAYOUTS, _unread(path) or "another file")
    table = path / TABLE if path.is_dir() else path
    if table.is_file():
        root, tasks = table.parent, read_table_of_tasks(table, has_tasks=task.text is None and task.is_needed)
        there = [name for name in tasks if (root / name).exists()] or list(tasks)
        pattern = next((name for name in tasks if "*" in name and not (root / name).exists()), "")
        got = f"{pattern}: name the pictures by --videos '{{episode}}/{Path(pattern).name}', and folders in the table"
        require(table, not pattern, "files and folders, and no patterns", got)
        found = {_kind_of(root / name): name for name in reversed(there)}
        kinds = {kind if kind in _KINDS else "videos": name for kind, name in found.items()}
        examples = " and ".join(f"{kind} ({name})" for kind, name in sorted(kinds.items()))
        require(table, len(kinds) == 1, "episodes of one kind", f"{examples}: write a table for each kind")
        (kind,) = kinds
        notes = _notes(table, kind, _unlisted(table, kind, tasks))
    else:
        require(path, path.is_dir(), _LAYOUTS, "neither")
        (kind, names), root, table, notes = _listed(path), path, path, []
        _check_tasks(path, task, _KINDS[kind][2])
        tasks = dict.fromkeys(names)
        if kind == "videos" and (deeper := _deeper_videos(path)):
            remedy = "list them in tasks.csv, or name them by a pattern (--videos)"
            notes = [f"videos in deeper folders get no labels: {first_names(deeper)}: {remedy}"]
    shown, camera, _ = _KINDS[kind]
    episodes = (Episode(name, {camera: root / name}, own) for name, own in tasks.items())
    return EpisodeDataset(episodes, root, shown, table, task, corrections, notes)


def _deeper_videos(folder: Path) -> list[str]:
    """The videos below the folders in a folder, without hidden ones."""
    found = (file.relative_to(folder) for file in folder.glob("*/**/*") if file.suffix.lower() in _VIDEO_SUFFIXES)
    return sorted(file.as_posix() for file in found if not any(part.startswith(".") for part in file.parts))


def _check_tasks(folder: Path, task: TaskOverride, episode: str) -> None:
    """Raise DatasetError for a folder without a table of tasks, if it needs one. episode: what it is called"""
    expected, old_table = f"{TABLE} with the task of each {episode}", folder / "tasks.json"  # as 0.4 read it
    got = f"{old_table.name}: write it as {TABLE}, with the columns video and task"
    require(folder, not old_table.is_file(), expected, got)
    got = f"none: write it, or, if all of them have one task, give it: {_GIVE_TASK}"
    require(folder, task.text is not None or not task.is_needed, expected, got)


def _by_pattern(root: Path, pattern: str, task: TaskOverride, corrections: AskedCorrections) -> EpisodeDataset:
    """Open the files that match a pattern. A table of tasks names the episodes. Raises DatasetError."""
    require(root, root.is_dir(), "the folder of the recordings", "none")
    found, table = files_of_pattern(root, pattern), root / TABLE
    tasks: Mapping[str, str | None] = dict.fromkeys(found)
    if table.is_file():
        tasks = read_table_of_tasks(table, has_tasks=task.text is None and task.is_needed)
        missing = [name for name in tasks if name not in found]
        got = f"{first_names(missing)}; there are {first_names(found)}"
        require(table, not missing, f"episodes of {pattern}", got)
    else:
        _check_tasks(root, task, "episode")
    episodes = (Episode(name, found[name], own) for name, own in tasks.items())
    notes = _notes(table, "episodes", [name for name in found if name not in tasks])
    where = table if table.is_file() else root
    return EpisodeDataset(episodes, root, f"pattern {pattern}", where, task, corrections, notes)


def _unlisted(table: Path, kind: str, names: Collection[str]) -> list[str]:
    """The episodes that lie beside the table's but are not listed."""
    listed = [table.parent / name for name in names]
    beside = {table.parent, *(each.parent for each in listed)} if kind in _SUFFIXES else {table.parent}
    found = [folder / name for folder in sorted(beside) if folder.is_dir() for name in _found(folder).get(kind, ())]
    if kind == "folders of pictures":  # ``_found`` also has folders without pictures
        found = [each for each in found if any(_is_frame(file) for file in each.iterdir())]
    known = {each.parent.resolve() / each.name: each for each in found}  # the table may name a folder in several ways
    gone = known.keys() - {each.parent.resolve() / each.name for each in listed}
    return in_natural_order(Path(os.path.relpath(known[each], table.parent)).as_posix() for each in gone)


def _notes(table: Path, kind: str, gone: Sequence[str]) -> list[str]:
    note = f"{table.name} leaves out {kind} beside it, which get no labels: {first_names(gone)}"
    return [note] if gone else []


def _kind_of(path: Path) -> str | None:
    """What an episode's file or folder is, by name; None: another file."""
    if path.is_dir():
        return "folders of pictures"
    return next((kind for kind, suffixes in _SUFFIXES.items() if path.suffix.lower() in suffixes), None)


def _listed(folder: Path) -> tuple[str, list[str]]:
    """The kind and names of the episodes in a folder. Raises DatasetError for several kinds, or none."""
    found = _found(folder)
    examples = " and ".join(f"{kind} ({names[0]})" for kind, names in found.items())
    got = f"{examples}: list the episodes of one kind in tasks.csv"
    require(folder, len(found) < 2, "episodes of one kind", got)
    if not any(kind in _KINDS for kind in found):
        other = "other files" if _names_in(folder) else "an empty folder"
        remedy = f"put a video or a folder of pictures for each episode in it, or {_READER}"
        raise DatasetError.at(folder, _LAYOUTS, _unread(folder) or f"{other}: {remedy}")
    return next(iter(found.items()))


def _found(folder: Path) -> dict[str, list[str]]:
    """Names that may be episodes, by kind, without hidden files and label files."""
    names = [name for name in in_natural_order(_names_in(folder)) if name != SIGNALS_FOLDER]
    kinds = {name: _kind_of(folder / name) for name in names if not _OUR_FILES.fullmatch(name)}
    found = {kind: [name for name in kinds if kinds[name] == kind] for kind in _ORDER}
    folders = [folder / name for name in found["folders of pictures"]]
    if not any(_is_frame(file) for each in folders for file in each.iterdir()):
        found["folders of pictures"] = []
        if any(found[kind] for kind in found if kind != "pictures"):  # a picture beside other episodes is no frame
            found["pictures"] = []
    return {kind: names for kind, names in found.items() if names}


def _is_frame(file: Path) -> bool:
    return is_picture(file) and not _OUR_FILES.fullmatch(file.name)


def _names_in(folder: Path) -> list[str]:
    return [each.name for each in folder.iterdir() if not each.name.startswith(".")]


def _unread(path: Path) -> str | None:
    """Describe a known layout without a reader, and the remedy; None: unknown layout."""
    found = [path] if path.is_file() else [each for below in ("*", "*/*") for each in path.glob(below)]
    names = [path.name, *(each.name for each in found)]
    for pattern, what in _UNREAD.items():
        if any(re.fullmatch(pattern, name, re.IGNORECASE) for name in names):
            return what
    if path.is_file():
        is_video = path.suffix.lower() in _VIDEO_SUFFIXES
        return f"a video: label its folder, with {_GIVE_TASK} or with tasks.csv in it" if is_video else None
    if hdf5_files(path):
        remedy = "rfm-client label takes the folder, open_dataset each file"
        return f"a folder of HDF5 files, each a dataset of its own: {remedy}"
    if any(_is_frame(file) for file in path.iterdir()):
        return "pictures outside of the folder of an episode"
    kinds = {**dict.fromkeys(_VIDEO_SUFFIXES, "videos"), **dict.fromkeys(PICTURE_SUFFIXES, "pictures")}
    deeper = next((name for name in files_below(path) if Path(name).suffix.lower() in kinds), None)
    if deeper is None:
        return None
    suffix, pattern = Path(deeper).suffix, suggested_pattern(path, deeper)
    remedy = f"name the episode and the camera in their paths, perhaps --videos '{pattern}'"
    if suffix.lower() in _VIDEO_SUFFIXES:  # folders may be cameras, tasks, outcomes
        each = f"{{episode}}{suffix}"
        remedy = f"--videos '{each}' if each is an episode" + f"; else {remedy}" * (pattern != each)
    return f"{kinds[suffix.lower()]} in deeper folders ({deeper}): {remedy}; or {_READER}"
