# SPDX-License-Identifier: MIT
"""The options of labelling, as a dataclass and as options of a command: one table for ``rfm-client`` and ``rfm``."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from rfm_client.cli.options import finite, usage_errors
from rfm_client.data.camera_fusion import Fuse
from rfm_client.data.orientation import ORIENTATIONS, Orient
from rfm_client.data.sampling import Rule
from rfm_client.labelling.options import (
    DEFAULT_WORKERS,
    FORMATS,
    Format,
    LabelOptions,
    Mode,
    parse_episodes,
    parse_shard,
)
from rfm_client.labelling.ray_engine import RayOptions

Engine = Literal["threads", "ray"]

_LISTED = "KEY[,KEY...]"


@dataclass(frozen=True, kw_only=True)
class LabelFlags:
    """What a command is told of a labelling run; ``LabelOptions`` says what each means."""

    output: Annotated[
        Path | None, typer.Option(help="Folder of the labels; else the dataset's own.", show_default=False)
    ] = None
    name: Annotated[str, typer.Option(help="Name of the reward: NAME_progress.parquet.")] = "rfm"
    alias: Annotated[
        str | None,
        typer.Option(help="Write the progress file under this name, too: sarm_progress is what LeRobot reads."),
    ] = None
    format: Annotated[
        str | None,
        typer.Option(
            metavar=",".join(FORMATS),
            help="Files to write; else progress,signals, of an HDF5 file hdf5.",
            show_default=False,
        ),
    ] = None
    cameras: Annotated[
        str | None, typer.Option(metavar=_LISTED, help="Cameras to score; else all but depth ones.", show_default=False)
    ] = None
    fuse: Annotated[Fuse, typer.Option(help="How the scores of several cameras become one.")] = "mean"
    sampling: Annotated[
        Rule | None,
        typer.Option(
            help="Rule by which frame t's prefix is sampled; else that of the checkpoint's training.",
            show_default=False,
        ),
    ] = None
    frames: Annotated[
        int | None,
        typer.Option(
            min=1, help="Frames that the rule shows the model; else as many as in training.", show_default=False
        ),
    ] = None
    mode: Annotated[
        Mode, typer.Option(help="prefix: frame t is scored on the frames up to t. whole: all frames together.")
    ] = "prefix"
    resize: Annotated[
        bool, typer.Option("--resize", help="Make frames as small as the checkpoint reads them, then send.")
    ] = False
    task: Annotated[
        str | None,
        typer.Option(help="What is to be done in the episodes that do not say it, as a sentence.", show_default=False),
    ] = None
    override_task: Annotated[
        bool, typer.Option("--override-task", help="Put --task in the place of the tasks that episodes have.")
    ] = False
    orient: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[CAMERA=]" + "|".join(ORIENTATIONS),
            help="Turn stored pictures upright, of all cameras or of one; may be repeated. Else as stored; LIBERO's "
            "HDF5 files flip-vertical.",
            show_default=False,
        ),
    ] = None
    episodes: Annotated[
        str | None, typer.Option(metavar="0:100,205", help="Some of the episodes, by number.", show_default=False)
    ] = None
    limit: Annotated[int | None, typer.Option(min=1, help="At most so many episodes.", show_default=False)] = None
    shard: Annotated[
        str | None,
        typer.Option(
            metavar="I/N",
            help="Label part I of N alone, from 0; run without it to write the files.",
            show_default=False,
        ),
    ] = None
    parts: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER|URL",
            help="Where finished episodes are kept; else .NAME_parts in the output.",
            show_default=False,
        ),
    ] = None
    workers: Annotated[int, typer.Option(min=1, help="Episodes under way at a time.")] = DEFAULT_WORKERS
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace labels of another recipe; those of the same are kept.")
    ] = False
    in_place: Annotated[bool, typer.Option("--in-place", help="Write the labels into the HDF5 file itself.")] = False
    engine: Annotated[Engine, typer.Option(help="threads: in this process. ray: by actors of a Ray cluster.")] = (
        "threads"
    )
    address: Annotated[
        str | None, typer.Option(help="Ray cluster; else one that is found, or made here.", show_default=False)
    ] = None
    actors: Annotated[int, typer.Option(min=1, help="Ray actors, each with a scorer.")] = 1
    num_gpus_per_actor: Annotated[
        float, typer.Option(min=0, callback=finite, help="GPUs of its node that a Ray actor takes.")
    ] = 0.0
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check everything, measure a few episodes, write nothing.")
    ] = False
    report: Annotated[bool, typer.Option("--report", help="Only show the summary of labels that are there.")] = False
    picture: Annotated[bool, typer.Option(help="Draw the summary: NAME_summary.png in the output.")] = True
    rrd: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Record frames and scores of each labelled episode for Rerun's viewer: a .rrd file each.",
            show_default=False,
        ),
    ] = None

    @property
    def ray(self) -> RayOptions:
        """Where and how many Ray actors label."""
        return RayOptions(self.address, self.actors, self.num_gpus_per_actor)

    @property
    def opening(self) -> dict[str, Any]:
        """With what ``open_dataset`` opens the dataset. Raises typer.BadParameter for an orientation that is none."""
        with usage_errors("DATASET"):
            orient = Orient.parse(self.orient or ())
        return {"task": self.task, "override_task": self.override_task, "orient": orient}

    def options(self) -> LabelOptions:
        """The options of the run. Raises typer.BadParameter for what contradicts itself."""
        with usage_errors("DATASET"):
            return LabelOptions(
                output=self.output,
                name=self.name,
                alias=self.alias,
                formats=_formats(self.format),
                cameras=tuple(self.cameras.split(",")) if self.cameras else (),
                sampling=self.sampling,
                frames=self.frames,
                mode=self.mode,
                fuse=self.fuse,
                resize=self.resize,
                episodes=parse_episodes(self.episodes) if self.episodes else None,
                limit=self.limit,
                shard=parse_shard(self.shard) if self.shard else None,
                parts=self.parts,
                workers=self.workers,
                overwrite=self.overwrite,
                in_place=self.in_place,
            )


def with_label_flags(command: Callable[..., None]) -> Callable[..., None]:
    """Gives a command that takes ``flags: LabelFlags`` an option for each of them."""

    @functools.wraps(command)
    def run(**options: Any) -> None:
        flags = LabelFlags(**{each.name: options.pop(each.name) for each in fields(LabelFlags)})
        command(**options, flags=flags)

    own = get_type_hints(command, include_extras=True)
    kept = [
        parameter.replace(annotation=own[name], kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(command).parameters.items()
        if name != "flags"
    ]
    hints = get_type_hints(LabelFlags, include_extras=True)
    added = [
        inspect.Parameter(each.name, inspect.Parameter.KEYWORD_ONLY, default=each.default, annotation=hints[each.name])
        for each in fields(LabelFlags)
        if each.default is not MISSING
    ]
    run.__signature__ = inspect.Signature([*kept, *added])  # type: ignore[attr-defined]  # what typer reads
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in (*kept, *added)}
    return run


def _formats(text: str | None) -> tuple[Format, ...]:
    names = text.split(",") if text else []
    for name in names:
        if name not in FORMATS:
            raise ValueError(f"format: expected some of {', '.join(FORMATS)}, got {name!r}")
    return tuple(name for name in FORMATS if name in names)
