# SPDX-License-Identifier: MIT
"""Plan a labelling run before the first frame is scored: recipe and episodes. Reports all faults at once."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

from rfm_client import InvalidSampleError, ModelInfo, RewardError, UInt8Array
from rfm_client.frames import (
    ChannelOrder,
    Correction,
    FrameFileError,
    Fuse,
    Orientation,
    Picture,
    Sampling,
    resize_frames,
)
from rfm_client.options import InvalidValueError, counted, first_names
from rfm_labels.advantage import RECAP
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode
from rfm_labels.datasets.faults import FaultsError, listed, require
from rfm_labels.datasets.stored_files import digest_of
from rfm_labels.options import LAST, QUIET, LabelOptions, Mode, ProgressRule, Watch, chosen_numbers
from rfm_labels.scorer import CheckpointFacts, Scorer

_RECIPE_FORMAT = 4  # increase when the same recipe gives other scores or other digests
_SAMPLING_REASONS = {True: "as upstream's training pads shorter clips", False: "the checkpoint's training did not pad"}
_FRAMES_REASON = "the most in training; if the checkpoint does not say, the most its network takes"


@dataclass(frozen=True)
class Goal:
    """A picture that shows the finished task.

    name: file name, or ``last``
    content: file content; empty: use the last frame
    """

    name: str
    content: bytes = field(default=b"", repr=False)

    @classmethod
    def of(cls, given: str) -> Goal:
        """Parse the goal option. Raises InvalidSampleError if the file is not a picture."""
        if given == LAST:
            return cls(given)
        try:
            goal = cls(Path(given).name, Path(given).read_bytes())
            Picture(goal.content).pixels()
        except FrameFileError as error:
            raise InvalidSampleError.like(error, where="goal") from error
        except OSError as error:
            raise InvalidSampleError.at("goal", f"a picture, or {LAST}", error) from error
        return goal

    def picture(self, frames: UInt8Array) -> UInt8Array:
        """Return the goal picture, uint8 [H, W, 3], for these frames, uint8 [T, H, W, 3]."""
        return Picture(self.content).pixels() if self.content else frames[-1]

    def document(self) -> dict[str, str]:
        """Return the goal for the provenance."""
        return {"picture": self.name, **({"digest": digest_of([self.content])} if self.content else {})}


@dataclass(frozen=True)
class Recipe:
    """All settings that decide a label, besides the frames.

    cameras: scored separately
    views: further cameras, shown beside the single entry in ``cameras``
    decoders: library and version that decode each camera, since colours differ between versions; None: stored as pixels
    corrections: for cameras whose frames are turned, or stored as BGR
    progress_rule: derives progress from remaining seconds; None: the checkpoint predicts progress
    """

    checkpoint: CheckpointFacts
    cameras: tuple[str, ...]
    decoders: Mapping[str, str | None]
    corrections: Mapping[str, Correction]
    sampling: Sampling
    mode: Mode
    fuse: Fuse
    resize: bool
    progress_rule: ProgressRule | None = None
    views: tuple[str, ...] = ()
    goal: Goal | None = None

    @classmethod
    def of(cls, options: LabelOptions, dataset: Dataset, checkpoint: CheckpointFacts) -> Recipe:
        """Derive the recipe from the options, the dataset and the checkpoint.

        Raises DatasetError for an unknown camera, InvalidSampleError if the sampling rule needs a frame count, or if
        the checkpoint needs the whole episode and the mode is not ``whole``.
        """
        numbers = chosen_numbers(dataset, replace(options, shard=None))
        cameras, views = chosen_cameras(dataset, options, numbers)
        require(dataset.source, bool(cameras), "at least one camera", "none")
        if checkpoint.needs_whole_episode and options.mode != "whole":
            why = "of this model, whose scores are relative to the whole episode"
            raise InvalidSampleError.at("mode", f"whole {why}", f"{options.mode}; give --mode whole")
        _check_progress(options.progress_rule, checkpoint)
        _check_views(options, cameras, checkpoint)
        decoded = (*cameras, *views)
        rule = "all" if options.mode == "whole" else options.sampling
        padding = checkpoint.trained_padding
        try:
            sampling = Sampling.of(rule, options.frames, checkpoint.max_frames, trained_padding=padding)
        except InvalidValueError as error:
            remedy = "leave --frames out" if rule == "all" else "name them (--frames), or show all (--sampling all)"
            problem = f"{error.problem}: {remedy}"
            raise InvalidSampleError(problem, error.where) from error
        return cls(
            checkpoint,
            cameras,
            decoders={camera: dataset.decoder(camera) for camera in decoded},
            corrections={camera: each for camera, each in dataset.corrections.items() if camera in decoded},
            sampling=sampling,
            mode=options.mode,
            fuse=options.fuse,
            resize=options.resize,
            progress_rule=options.progress_rule,
            views=views,
            goal=None if options.goal is None else Goal.of(options.goal),
        )

    @property
    def decoded_cameras(self) -> tuple[str, ...]:
        """The cameras and the views, without repetition."""
        return tuple(dict.fromkeys((*self.cameras, *self.views)))

    @property
    def orientations(self) -> Mapping[str, Orientation]:
        """Orientation by camera, for turned cameras."""
        return {camera: each.orient for camera, each in self.corrections.items() if each.orient != "none"}

    @property
    def channels(self) -> Mapping[str, ChannelOrder]:
        """Stored channel order by camera, for cameras that do not store RGB."""
        return {camera: each.channels for camera, each in self.corrections.items() if each.channels != "rgb"}

    def resized(self, frames: UInt8Array) -> UInt8Array:
        """Return frames, uint8 [T, H, W, 3], in the size in which they are sent."""
        size = self.checkpoint.frame_size if self.resize else None
        return frames if size is None else resize_frames(frames, size)

    def in_one_pass(self, num_frames: int) -> bool:
        """True if one pass over ``num_frames`` frames scores every frame."""
        rule, frames = self.sampling.rule, self.sampling.frames
        shows_all = rule == "all" or (rule == "rint" and frames is not None and num_frames <= frames)
        return self.mode == "whole" or (shows_all and self.checkpoint.is_causal)

    def document(self) -> dict[str, Any]:
        """Return the recipe for the provenance."""
        newer = {  # omitted when empty: older labels have no such field
            "channels": dict(self.channels),
            "progress_rule": self.progress_rule,
            "views": list(self.views),
            "goal": self.goal and self.goal.document(),
        }
        return {
            "format": _RECIPE_FORMAT,
            "checkpoint": self.checkpoint.document(),
            "cameras": list(self.cameras),
            "decoders": dict(self.decoders),
            "orientations": dict(self.orientations),
            "sampling": asdict(self.sampling),
            "mode": self.mode,
            "fuse": self.fuse if len(self.cameras) > 1 else None,
            "resize": str(self.checkpoint.frame_size) if self.resize else None,
            "verify": False,  # of older labels: True for videos identified by content
            **{name: value for name, value in newer.items() if value},
        }

    def explanation(self, options: LabelOptions) -> list[str]:
        """Explain each decision and the reason for it, one per line."""
        lines = [f"cameras: {', '.join(self.cameras)} ({'asked for' if options.cameras else 'all but depth cameras'})"]
        lines += [f"views: {', '.join(self.views)} (shown beside it)"] if self.views else []
        lines += [] if self.goal is None else [f"goal: {self.goal.name}"]
        if self.mode == "whole":
            lines.append("mode: whole: the score of frame t may depend on later frames, unless the network is causal")
        else:
            who = "asked for" if options.sampling else _SAMPLING_REASONS[self.checkpoint.trained_padding]
            lines.append(f"sampling: {self.sampling.rule} ({who})")
        if self.sampling.frames is not None:
            lines.append(f"frames: {self.sampling.frames} ({'asked for' if options.frames else _FRAMES_REASON})")
        lines += [warning] if (warning := ModelInfo.warning_of(self.checkpoint.weights_digest)) else []
        return lines + [f"fuse: {self.fuse} of {len(self.cameras)} cameras"] * (len(self.cameras) > 1)

    def check_lengths(self, episodes: Sequence[DatasetEpisode]) -> None:
        """Raise DatasetError if the recipe shows whole episodes and one exceeds the checkpoint's frame limit."""
        limit = self.checkpoint.max_frames
        shows_all = self.mode == "whole" or self.sampling.frames is None
        if not (episodes and shows_all and limit is not None):
            return
        lengths = {episode: max(count for _, count in episode.stretches) for episode in episodes}
        longest = max(episodes, key=lambda episode: lengths[episode])
        remedy = "use mode prefix and a rule with a number of frames"
        if self.checkpoint.needs_whole_episode:
            remedy = "name a checkpoint that takes more (--as topreward,max_frames=N)"
        fit = [episode.index for episode in episodes if lengths[episode] <= limit]
        rest = f"; to label the {len(fit)} that are short enough: --episodes {listed(fit)}" if fit else ""
        got = f"{lengths[longest]}: {remedy}{rest}"
        require(longest.name, len(fit) == len(episodes), f"at most {limit} frames, as the checkpoint takes", got)


def part_key(number: int, digest: str) -> str:
    """Return the name of an episode's part, without suffix."""
    return f"episode-{number:06d}-{digest}"


@dataclass(frozen=True)
class Item:
    """One episode to label. digest: over everything that decides its labels."""

    episode: DatasetEpisode
    digest: str

    @property
    def key(self) -> str:
        """The part's name, without suffix."""
        return part_key(self.episode.index, self.digest)


@dataclass(frozen=True)
class Plan:
    """The recipe, and the episodes to label, in frame order.

    dataset: kind, source, revision and the caller's task, for the provenance
    horizon: frames over which advantages are taken; None: no advantages
    """

    items: Sequence[Item]
    recipe: Recipe
    dataset: Mapping[str, Any]
    horizon: int | None = None

    @property
    def num_frames(self) -> int:
        """Frames in all episodes."""
        return sum(item.episode.num_frames for item in self.items)

    @property
    def episodes(self) -> list[DatasetEpisode]:
        """The episodes to label."""
        return [item.episode for item in self.items]

    @property
    def names(self) -> dict[int, str]:
        """The names of the episodes that have names of their own, by number."""
        return {each.index: name for each in self.episodes if (name := each.own_name)}

    def digests(self) -> dict[str, str]:
        """Return item digests by episode number."""
        return {str(item.episode.index): item.digest for item in self.items}

    def provenance(self) -> dict[str, Any]:
        """Return the labels' writer, dataset and recipe, without user and time: equal runs give equal provenance."""
        digest = digest_of(item.digest.encode() for item in self.items)
        version = importlib.metadata.version("rfm-client")
        dataset = {**self.dataset, "digest": digest}
        advantage = {} if self.horizon is None else {"advantage": {"rule": RECAP, "frames": self.horizon}}
        return {"writer": f"rfm-client {version}", "dataset": dataset, **self.recipe.document(), **advantage}


def chosen_cameras(
    dataset: Dataset, options: LabelOptions, numbers: Sequence[int]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the cameras to score, and the views to show beside them. Raises DatasetError for an unknown camera."""
    views = dataset.chosen_cameras(options.views, numbers) if options.views else ()
    cameras = dataset.chosen_cameras(options.cameras, numbers)
    return cameras if options.cameras else tuple(camera for camera in cameras if camera not in views), views


def make_plan(dataset: Dataset, recipe: Recipe, episodes: Iterable[DatasetEpisode]) -> Plan:
    """Plan these episodes without reading video frames. Raises DatasetError if a file is missing."""
    document = json.dumps(recipe.document(), sort_keys=True)
    items = []
    for episode in episodes:
        about = f"{episode.index} {episode.first_index} {episode.num_frames} {episode.task}"
        about += f" {episode.tasks}" if episode.tasks else ""
        videos = [f"{each} {dataset.identity(episode, each)}" for each in recipe.decoded_cameras]
        items.append(Item(episode, digest_of(part.encode() for part in (document, about, *videos))))
    described: dict[str, Any] = {"kind": dataset.kind, "source": dataset.source, "revision": dataset.revision}
    if (given := dataset.given_task).text is not None:
        described["task"] = {"text": given.text, "overrides": given.overrides}
    return Plan(items, recipe, described)


def _check_progress(rule: ProgressRule | None, checkpoint: CheckpointFacts) -> None:
    """Raise InvalidSampleError unless exactly one of checkpoint and rule provides progress."""
    if checkpoint.has_progress and rule is not None:
        raise InvalidSampleError.at("progress_rule", "none with this model, which predicts progress", rule)
    if not checkpoint.has_progress and rule is None:
        known = " or ".join(get_args(ProgressRule))
        expected = f"{known} with this model, which predicts remaining seconds and no progress"
        raise InvalidSampleError.at("progress_rule", expected, f"none; give --progress-rule {known}")


def _check_views(options: LabelOptions, cameras: Sequence[str], checkpoint: CheckpointFacts) -> None:
    """Raise InvalidSampleError for views or a goal that the checkpoint cannot read, or views with several cameras."""
    for name in ("views", "goal"):
        value = getattr(options, name)
        if value and not checkpoint.reads_views:
            got = value if name == "goal" else ", ".join(value)
            raise InvalidSampleError.at(name, "none with this model, which reads one camera and no goal", got)
    if options.views and len(cameras) > 1:
        expected, remedy = "a single camera, beside which the views are shown", "choose one (--cameras)"
        raise InvalidSampleError.at("views", expected, ", ".join(cameras), remedy)


def checked_episodes(
    dataset: Dataset, options: LabelOptions, watch: Watch = QUIET, *, tables_only: bool = False
) -> list[DatasetEpisode]:
    """Return the chosen episodes after checking tables and frames, without decoding. Other episodes are not read.

    tables_only: True: do not check frames
    Raises FaultsError with all faults, including other shards' faults, because every shard needs the same episodes;
    DatasetError for an episode that the dataset lacks.
    """
    numbers, everywhere = (chosen_numbers(dataset, each) for each in (options, replace(options, shard=None)))
    cameras, views = chosen_cameras(dataset, options, everywhere)
    episodes: list[DatasetEpisode] = []
    faults: dict[int, RewardError] = {}
    watch.checking(len(numbers))
    for number in numbers:
        try:
            episode = dataset.episode(number)
            for before in episodes[-1:]:
                end = before.first_index + before.num_frames
                expected = f"{end} or more, since {before.name} ends at {end - 1}"
                got = f"{episode.first_index}: renumber the rows in the order of the episodes"
                require(f"{episode.name}: index", episode.first_index >= end, expected, got)
            for camera in () if tables_only else dict.fromkeys((*cameras, *views)):
                dataset.check(episode, camera)
            episodes.append(episode)
            watch.checked(episode)
        except RewardError as fault:
            faults[number] = fault
    if faults and options.shard is not None:
        checked_episodes(dataset, replace(options, shard=None))  # raises
    if faults:
        raise FaultsError.of(faults, numbers)
    if options.shard is None:  # episodes in another shard may need the task
        dataset.given_task.check_used(episodes)
    return episodes


@contextmanager
def all_faults(dataset: Dataset, options: LabelOptions) -> Iterator[None]:
    """Replace an error from the block by all faults in tables and frames, if there are any."""
    try:
        yield
    except RewardError:
        checked_episodes(dataset, options)
        raise


def plan_labels(dataset: Dataset, scorer: Scorer, options: LabelOptions, watch: Watch = QUIET) -> Plan:
    """Check tables and options, report decisions to ``watch``, and return the plan. Frames are checked later.

    Raises DatasetError, RewardError if the scorer does not answer, ValueError if the sampling rule needs a frame count.
    """
    recipe = Recipe.of(options, dataset, scorer.checkpoint())
    dataset.download(chosen_numbers(dataset, options), recipe.decoded_cameras, watch.downloading)
    with all_faults(dataset, options):
        episodes = checked_episodes(dataset, options, watch, tables_only=True)
    recipe.check_lengths(episodes)
    several = sum(bool(episode.tasks) for episode in episodes)
    if several:
        how = "each stretch of frames with one task is scored by itself (--several-tasks first: all by the first task)"
        watch.note(f"tasks: they change within {counted(several, 'episode')}: {how}")
        if "progress" in options.formats:
            own = "the scores are in the column progress"
            watch.note(f"progress_sparse: the sum of the gains in an episode's tasks, as LeRobot's RA-BC needs; {own}")
    notes = " ".join(dataset.notes)
    cameras, faults = dataset.cameras_in(chosen_numbers(dataset, replace(options, shard=None)))
    unused = {
        name: f"{word} by name or mark, without colours; --cameras includes it"
        for name, word in dataset.unused_cameras(cameras).items()
    }
    turned = [f"orient: {name} {turn} (asked for)" for name, turn in recipe.orientations.items() if name not in notes]
    swapped = [f"channels: {name} {order} (asked for)" for name, order in recipe.channels.items()]
    left_out = [] if options.cameras else [f"left out: {name}: {why}" for name, why in {**faults, **unused}.items()]
    tasks = _task_lines(dataset, episodes)
    for line in (*recipe.explanation(options), *left_out, *dataset.notes, *turned, *swapped, *tasks):
        watch.note(line)
    with all_faults(dataset, options):
        return replace(make_plan(dataset, recipe, episodes), horizon=options.advantage)


def _task_lines(dataset: Dataset, episodes: Sequence[DatasetEpisode]) -> list[str]:
    """Return a line about episodes that use the caller's task, and one about tasks that are not sentences."""
    given, lines = dataset.given_task, []
    if given.overrides:
        lines.append(f"tasks: --task for all {counted(len(episodes), 'episode')}")
    elif given.text is not None:
        num_given = sum(any(task == given.text for task, _ in episode.stretches) for episode in episodes)
        num_others = len(episodes) - num_given
        lines.append(f"tasks: {counted(num_given, 'episode')} with that of --task, {num_others} with others")
    known = dict.fromkeys(task for episode in episodes for task, _ in episode.stretches)
    words = [task for task in known if task.isascii() and len(task.split()) == 1]  # such as ``pick_place_cup``
    if words:
        what = f"{len(words)} of {len(known)} are a single word, not a sentence ({first_names(words, 3)})"
        remedy = "--task with --override-task gives all episodes a sentence"
        lines.append(f"tasks: {what}; {remedy}, --task-column reads another column (LeRobot)")
    return lines
