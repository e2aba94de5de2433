# SPDX-License-Identifier: MIT
"""Show the progress of a labelling run on standard error."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from rfm_client import RewardError
from rfm_labels.datasets.dataset import DatasetEpisode
from rfm_labels.options import Watch

SPEED_OVER_S = 600.0  # an episode may take minutes

Say: TypeAlias = Callable[[str], None]


class ProgressBar(Watch):
    """Lines on standard error and, on a terminal, a bar with frames a second and the time left."""

    def __init__(self, say: Say) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeRemainingColumn
        from rich.text import Text

        class Rate(TextColumn):
            def render(self, task: Task) -> Text:
                return Text(f"{task.speed:.1f}/s" if task.speed else "")

        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(""), TimeRemainingColumn())
        self._say = say
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
        self._say(f"note: {text}")

    def checking(self, num_episodes: int) -> None:
        """Begin to count checked episodes."""
        self._begin("checking episodes", num_episodes, 0)

    def checked(self, episode: DatasetEpisode) -> None:
        """Advance the bar by an episode."""
        self._advance(1)

    def begin(self, num_frames: int, num_finished: int) -> None:
        """Begin to count labelled frames."""
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
