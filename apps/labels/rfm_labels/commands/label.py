# SPDX-License-Identifier: MIT
"""``rfm-client label``: label every frame in a dataset. ``rfm label`` reuses this code."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, get_args

import typer

from rfm_client import RewardError
from rfm_client.command_line import ExitCode, JsonOutput, ServerOptions, print_facts, print_table, report, with_options
from rfm_client.frames import ChannelOrder, Orientation
from rfm_client.options import ConfigError, Settings, counted, first_names, setting
from rfm_labels.audit import audit
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode, SeveralTasks, parsed_by_camera
from rfm_labels.datasets.faults import DatasetError, FaultsError, UnusedTaskError, listed, require
from rfm_labels.datasets.hdf5 import label_prefix
from rfm_labels.datasets.hub import ASK_BYTES, DownloadSize
from rfm_labels.datasets.lerobot_frames import TOLERANCE_S
from rfm_labels.datasets.opening import hdf5_files, open_dataset
from rfm_labels.label_files import LabelFile, equal_files, find_label_files, read_blank, reward_name
from rfm_labels.labelling import Outputs, Report, planned
from rfm_labels.labelling import label as label_dataset
from rfm_labels.metadata import blank_lines
from rfm_labels.options import DEFAULTS, LabelOptions, RayOptions, Watch, check_name
from rfm_labels.plan import checked_episodes
from rfm_labels.ray_engine import Connect, label_with_ray
from rfm_labels.scorer import ClientScorer, Scorer
from rfm_labels.summary import summarise
from rfm_labels.writing import remove_files

NOTE = "note: "  # a note that several files share is printed once
SPEED_OVER_S = 600.0  # an episode may take minutes
Printer: TypeAlias = Callable[[str], None]
_CAMERA_OPTIONS = ("orient", "channels")  # options with a value per camera
DatasetArgument = Annotated[
    str,
    typer.Argument(
        metavar="DATASET",
        help="LeRobot folder, or Hub id org/name@revision or its address; HDF5 file, or a folder of them; RLDS folder; "
        "folder of videos or of folders of pictures, with tasks.csv; any folder with --videos or --reader.",
    ),
]


class ProgressBar(Watch):
    """Writes notes to standard error and, on a terminal, shows a bar with speed and remaining time.

    accepts: True: download any number of bytes; False: ask in a terminal, else refuse, above ASK_BYTES
    """

    def __init__(self, say: Printer, *, accepts: bool = False) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeRemainingColumn
        from rich.text import Text

        class Rate(TextColumn):
            def render(self, task: Task) -> Text:
                return Text(f"{task.speed:.1f}/s" if task.speed else "")

        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(""), TimeRemainingColumn())
        self._say, self._accepts = say, accepts
        self.notes: list[str] = []
        self._bar = Progress(
            *columns,
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=SPEED_OVER_S,
        )
        self.num_begun = 0

    def __enter__(self) -> ProgressBar:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def note(self, text: str) -> None:
        """Write the text on a line."""
        self.notes.append(text)
        self._say(NOTE + text)

    def downloading(self, num_files: int, num_bytes: int) -> None:
        """Write how much is downloaded. Raises ConfigError, or typer.Abort after a "no", for a large download."""
        size = DownloadSize(num_files, num_bytes)
        self.note(f"downloading {size}, all that the chosen episodes and cameras need")
        if not size.is_large or self._accepts:
            return
        self._bar.stop()
        remedy = "choose fewer episodes (--episodes, --limit) or cameras (--cameras)"
        _confirm(f"Download {size}?", f"--yes for more than {ASK_BYTES / 1e9:g} GB", f"none for {size}", remedy)
        self._bar.start()

    def checking(self, num_episodes: int) -> None:
        """Start counting checked episodes."""
        self._begin("checking episodes", num_episodes, 0)

    def checked(self, episode: DatasetEpisode) -> None:
        """Advance the bar by an episode."""
        self._advance(1)

    def begin(self, num_frames: int, num_finished: int) -> None:
        """Start counting labelled frames."""
        if num_finished:
            self.note(f"{num_finished} of {num_frames} frames are labelled already")
        self.num_begun = num_frames
        self._begin("labelling frames", num_frames, num_finished)

    def scored(self, episode: DatasetEpisode) -> None:
        """Advance the bar by the episode's frames."""
        self._advance(episode.num_frames)

    def failed(self, episode: DatasetEpisode, error: RewardError) -> None:
        """Write a line with the reason."""
        text = str(error)
        self._say(text if text.startswith(episode.name) else f"{episode.name}: {text}")
        self._advance(episode.num_frames)

    def _begin(self, text: str, total: int, completed: int) -> None:
        for task in self._bar.task_ids:
            self._bar.remove_task(task)
        self._bar.add_task(text, total=total, completed=completed)

    def _advance(self, by: int) -> None:
        for task in self._bar.task_ids:
            self._bar.advance(task, by)


def _confirm(question: str, expected: str, got: str, remedy: str = "") -> None:
    """Ask in a terminal. Raises typer.Abort after a "no", ConfigError without a terminal."""
    if not sys.stdin.isatty():
        raise ConfigError.at("yes", expected, got, remedy)
    typer.confirm(question, abort=True)


@dataclass(frozen=True)
class EpisodeTexts(Settings):
    """Task, orientation and channels of a dataset's episodes. Raises ConfigError."""

    TITLE: ClassVar[str] = "Dataset"

    reader: str | None = setting(
        None, "Function that yields the episodes of any folder: my_reader.py:episodes.", metavar="FILE.py:FUNCTION"
    )
    videos: str | None = setting(
        None, "Videos or pictures of any folder: '{episode}/videos/{camera}.mp4'.", metavar="PATTERN"
    )
    task: str | None = setting(None, "Task sentence of the episodes that have none.")
    override_task: bool = setting(False, "Put --task in the place of the tasks that episodes have.")
    several_tasks: SeveralTasks = setting(
        "each",
        "LeRobot episodes with several tasks. each: each stretch of frames with one task is scored by itself. "
        "first: all frames by the first frame's task.",
    )
    task_column: str | None = setting(
        None,
        "LeRobot column with the tasks: sentences, or numbers of sentences. Default: task_index, checked against the "
        "metadata. RLDS: feature with the tasks.",
        metavar="NAME",
    )
    orient: tuple[str, ...] = setting(
        (),
        "Turn stored pictures upright, of all cameras or of one; may be repeated. Else as stored; LIBERO's HDF5 files "
        "flip-vertical.",
        metavar="[CAMERA=]" + "|".join(get_args(Orientation)),
    )
    channels: tuple[str, ...] = setting(
        (),
        "Channel order of stored pictures, for all cameras or one; may be repeated. Default: rgb.",
        metavar="[CAMERA=]" + "|".join(get_args(ChannelOrder)),
    )
    tolerance_s: float = setting(
        TOLERANCE_S,
        "LeRobot videos: most seconds between a row and its frame, as LeRobot's tolerance_s. A larger value accepts "
        "rows with times from a clock.",
        least=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.override_task and not self.task:
            raise ConfigError.of_two("override_task", "needs", "task")
        for option in _CAMERA_OPTIONS:
            parsed_by_camera(option, getattr(self, option))

    @property
    def opening(self) -> dict[str, Any]:
        """Keyword arguments for ``open_dataset``."""
        given = {each.name: getattr(self, each.name) for each in fields(self)}
        return given | {option: parsed_by_camera(option, given[option]) for option in _CAMERA_OPTIONS}


@dataclass(frozen=True)
class RunOptions(JsonOutput):
    """Engine, trial run and report of a labelling command."""

    TITLE: ClassVar[str] = "Run"

    engine: Literal["threads", "ray"] = setting("threads", "threads: in this process. ray: by actors of a Ray cluster.")
    dry_run: bool = setting(
        False, "Check everything, count, list doubts (blank or frozen cameras, stale files), write nothing."
    )
    json: str | None = setting(None, "With --dry-run: write it as JSON to FILE; - prints it.", metavar="FILE|-")
    report: bool = setting(False, "Only show the summary of labels that are there.")
    list_labels: bool = setting(False, "Only list the labels that are there.", flag="--list")
    remove: str | None = setting(
        None, "Only delete the label files of this name. Finished episodes stay (--parts).", metavar="NAME"
    )
    yes: bool = setting(
        False,
        f"Do not ask before a download above {ASK_BYTES / 1e9:g} GB, or before --remove if the parts are gone.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_name("remove", self.remove)
        chosen = [name for name in ("dry_run", "report", "list_labels", "remove") if getattr(self, name)]
        if len(chosen) > 1:
            raise ConfigError.of_two(chosen[0], "excludes", chosen[1])
        if self.json is not None and not self.dry_run:
            raise ConfigError.of_two("json", "needs", "dry_run")


@with_options
def label(
    dataset: DatasetArgument,
    texts: EpisodeTexts,
    labels: LabelOptions,
    run: RunOptions,
    ray: RayOptions,
    server: ServerOptions,
) -> None:
    """Label every frame of a dataset by asking running servers.

    `rfm label` writes the same files with a checkpoint in its own process, without a server.

    The label files have the forms that training code reads, such as LeRobot's.

    Run the same command again to label the missing episodes.

    Example: rfm-client label my_dataset --url grpc://gpu-box:8001
    """

    @contextmanager
    def connect() -> Iterator[Scorer]:
        with server.connected() as client:
            yield ClientScorer(client)

    raise typer.Exit(LabelCommand(dataset, texts, labels, run, ray, connect, report).run())


@dataclass(frozen=True)
class LabelCommand:
    """Runs a labelling command: label, try, or only show the summary.

    source: as in ``open_dataset``
    connect: returns a context with a scorer
    say: prints a line for the user
    """

    source: str
    texts: EpisodeTexts
    labels: LabelOptions
    options: RunOptions
    ray: RayOptions
    connect: Connect
    say: Printer

    def run(self) -> ExitCode:
        """Run as the options say. Raises RewardError, OSError and ImportError."""
        if not (self.texts.reader or self.texts.videos) and (files := hdf5_files(self.source)):
            return self._run_each(files)
        if self.options.remove:
            self._remove([self])
        elif self.options.report:
            self._report()
        elif self.options.dry_run:
            self._try()
        elif self.options.list_labels:
            self._list()
        else:
            return self._tell(self._label())
        return ExitCode.OK

    def _run_each(self, files: Sequence[Path]) -> ExitCode:
        """Run for each HDF5 file in a folder, once all can be opened. Raises DatasetError if one cannot."""
        require(
            "json", self.options.json is None, "none for a folder of HDF5 files; name one of them", self.options.json
        )
        stems = [file.stem for file in files]
        twice = [str(file) for file in files if stems.count(file.stem) > 1]
        got = f"{', '.join(twice)}: leave out --output, and labels lie beside their files"
        has_room = self.labels.output is None or not twice
        require("output", has_room, "a folder for files whose names differ", got)
        commands = [replace(self, source=str(file)) for file in files]
        if self.options.remove:
            self._remove(commands)
            return ExitCode.OK
        codes, notes = [], Counter[str]()

        def say_once(line: str) -> None:
            is_note = line.startswith(NOTE)
            notes[line] += is_note
            if not is_note or notes[line] == 1:
                self.say(line)

        reads_frames = not (self.options.report or self.options.list_labels)
        commands = self._checked(commands) if reads_frames else commands
        shared = reads_frames and self.options.engine == "threads"  # Ray's actors connect by themselves
        with self.connect() if shared else nullcontext() as scorer:
            connect = self.connect if scorer is None else lambda: nullcontext(scorer)
            for command in commands:
                self.say(f"{command.source}")
                try:
                    codes.append(replace(command, say=say_once, connect=connect).run())
                except DatasetError as error:
                    if not self.options.report:
                        raise
                    self.say(f"{error}")  # no labels there; others may have some
                    codes.append(ExitCode.FAILED)
        for line, count in notes.items():
            if count > 1:
                self.say(f"{NOTE}{count} of {len(files)} files: {line.removeprefix(NOTE)}")
        return next((code for code in codes if code is not ExitCode.OK), ExitCode.OK)

    def _checked(self, commands: Sequence[LabelCommand]) -> list[LabelCommand]:
        """Return the commands, keeping --task only for the files that need it.

        Raises FaultsError with the faults in all files, UnusedTaskError if no file needs --task.
        """
        lines, unused, checked = [], [], []
        for command in commands:
            try:
                dataset = command._dataset()
                checked_episodes(dataset, self.labels)
            except UnusedTaskError as error:
                unused.append(error)
                command = replace(command, texts=replace(command.texts, task=None))
            except RewardError as error:
                messages = str(error).splitlines() if isinstance(error, FaultsError) else [str(error)]
                lines += [line if command.source in line else f"{command.source}: {line}" for line in messages]
            checked.append(command)
        if lines:
            raise FaultsError("\n".join(lines))
        if len(unused) == len(commands):
            raise unused[0]
        return checked

    def _label(self) -> Report:
        watch = ProgressBar(self.say, accepts=self.options.yes)
        try:
            with watch:
                if self.options.engine == "ray":
                    opening = self.texts.opening
                    return label_with_ray(self.source, self.connect, self.labels, watch, ray=self.ray, **opening)
                dataset = self._dataset()
                with self.connect() as scorer:
                    return label_dataset(dataset, scorer, self.labels, watch)
        except (RewardError, OSError, KeyboardInterrupt):
            if watch.num_begun:
                self.say("finished episodes stay: run the same command again for the rest")
            raise

    def _try(self) -> None:
        """Check everything, list doubts, write no labels."""
        self.options.begin()
        dataset = self._dataset()
        with self.connect() as scorer, ProgressBar(self.say, accepts=self.options.yes) as watch:
            plan = planned(dataset, scorer, Outputs.of(dataset, self.labels), watch)
            cameras = plan.recipe.decoded_cameras
            doubts = audit(dataset, plan.episodes, cameras, watch)
        tasks = sorted({task for item in plan.items for task, _ in item.episode.stretches})
        source = dataset.source + (f"@{dataset.revision}" if dataset.revision else "")
        document = {"dataset": source, "kind": dataset.kind, "episodes": len(plan.items), "frames": plan.num_frames}
        document |= {"cameras": list(cameras), "tasks": tasks, "notes": watch.notes}
        self.options.write_json(document | {"doubts": [asdict(doubt) for doubt in doubts]})
        if not self.options.prints_tables:
            return
        decoded = f"of {counted(len(cameras), 'camera')}: {plan.num_frames * len(cameras)} to be decoded"
        rows = [
            ("dataset", f"{dataset.kind}: {source}"),
            ("episodes", str(len(plan.items))),
            ("frames", f"{plan.num_frames}, {decoded}"),
            ("tasks", f"{len(tasks)}: {'; '.join(tasks[:5])}{' ...' * (len(tasks) > 5)}"),
            ("doubts", "none" if not doubts else str(len(doubts))),
        ]
        print_facts(rows)
        for doubt in doubts:
            typer.echo(f"doubt: {doubt}")

    def _tell(self, report: Report) -> ExitCode:
        if report.failures:
            failed = f"{counted(len(report.failures), 'episode')} failed"
            self.say(f"{failed}, so no file was written; the others are kept in {report.parts}")
            gone = {failure.episode.index for failure in report.failures}
            others = [item.episode.index for item in report.plan.items if item.episode.index not in gone]
            if others and self.labels.shard is None:
                self.say(f"to write the files without them: --episodes {listed(others)}")
            return ExitCode.FAILED
        if report.summary is None:
            self.say(f"this shard is labelled; the same command without --shard writes the files from {report.parts}")
            return ExitCode.OK
        print_facts(report.summary.rows())
        for file in report.files:
            typer.echo(f"{file}")
        return ExitCode.OK

    def _report(self) -> None:
        """Show the summary for existing labels; the source is a dataset or a label file."""
        path = Path(self.source)
        if label_prefix(path) or path.is_dir() or self.labels.output is not None:
            outputs = self._outputs(self.labels)
            files = [*outputs.progress, *outputs.signals]
            path = next((file for file in files if file.exists()), files[0])
            if not path.exists() and (others := self._there()):
                expected = f"--name with one of the labels {', '.join(others)}"
                raise DatasetError.at(outputs.folder, expected, repr(self.labels.name))
        summary = summarise(path)
        for line in blank_lines(read_blank(path), len(summary.episodes)):
            self.say(NOTE + line)
        print_facts(summary.rows())

    def _outputs(self, labels: LabelOptions) -> Outputs:
        """Where the label files are, without opening the dataset. Raises DatasetError for one that is not local."""
        path = Path(self.source)
        remedy = "none: name the folder of its labels with --output"
        require(self.source, path.exists() or labels.output is not None, "a local dataset", remedy)
        return Outputs(labels.output or (path if path.is_dir() else path.parent), labels, label_prefix(path))

    def _list(self) -> None:
        """List the labels that are there."""
        there = self._there()
        name_of, rows = {file: name for name, file in there.items()}, []
        for file, first in equal_files(list(name_of)).items():
            each, same = LabelFile.read(file), "-" if first == file else name_of[first]  # as an alias is
            rows.append((name_of[file], each.checkpoint or "-", str(len(each.digests) or "-"), same))
        if rows:
            print_table("", ("labels", "checkpoint", "episodes", "equals"), rows)
        else:
            folder = self._outputs(self.labels).folder
            self.say(f"{self.source}: no labels in {folder}: label it first, or name their --output")

    def _there(self) -> dict[str, Path]:
        """The label files that are there, by name."""
        outputs = self._outputs(self.labels)
        files = find_label_files(Path(self.source), outputs.folder)
        return {reward_name(file).removeprefix(outputs.prefix): file for file in files}

    def _remove(self, commands: Sequence[LabelCommand]) -> None:
        """Delete the label files of a name of these datasets. Raises DatasetError, or typer.Abort after a "no"."""
        for option in ("name", "episodes", "filter_key", "limit", "shard"):
            if getattr(self.labels, option) != getattr(DEFAULTS, option):
                raise ConfigError.of_two("remove", "excludes", option)
        name = self.options.remove or ""
        places = [command._outputs(replace(self.labels, name=name)) for command in commands]
        files = [(place, file) for place in places for file in place.before() or place.before(alias=name)]
        if not files:
            there = dict.fromkeys(each for command in commands for each in command._there())
            expected = f"one of the labels {', '.join(there)}" if there else "labels"
            raise DatasetError.at(places[0].folder, expected, repr(name) if there else "none")
        for _, file in files:
            require(file.path, bool(file.provenance), "labels of rfm-client", "others: delete the file yourself")
        parts = {file.path: place.parts_of(file) for place, file in files}
        lost = [path for path, where in parts.items() if not where]
        if lost and not self.options.yes:
            got = f"{first_names(lost)}, whose finished episodes are gone"
            _confirm(f"Delete {got}?", "--yes for labels that must be scored again", f"none for {got}")
        remove_files([file.path for _, file in files])
        for _, file in files:
            typer.echo(f"deleted {file.path}, labels of {counted(len(file.digests), 'episode')} by {file.checkpoint}")
        gone = [file.digests for _, file in files if file.digests]
        folders = dict.fromkeys(place.folder for place, _ in files)
        for path in (path for folder in folders for path in sorted(folder.glob("[!.]*.parquet"))):
            if LabelFile.read(path).digests in gone:
                other = reward_name(path).rpartition(".")[2]
                self.say(f"note: {path} has the same labels and stays; --remove {other} deletes it")
        if not lost:
            self.say(f"the command that made them writes them again from {', '.join(dict.fromkeys(parts.values()))}")

    def _dataset(self) -> Dataset:
        return open_dataset(self.source, **self.texts.opening)
