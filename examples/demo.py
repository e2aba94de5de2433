# SPDX-License-Identifier: MIT
"""A first look: what the served demo checkpoint says about clips of the toy world that it was not trained on.

python examples/demo.py                              # serves model_repository meanwhile
python examples/demo.py --url grpc://localhost:8001  # asks a running server
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from rich.console import Console

from rfm.launch.temporary import stopped_by_signals, temporary_server
from rfm_client import PreferenceSample, ProgressSample, RewardClient, Sample, SimilaritySample, Trajectory
from rfm_client.cli.show import Panel, plot, scores_table
from rfm_commands.demo import show_metrics
from toy_world import Clip, Task, make_clip
from toy_world.video import write_video

TASK, OTHER_TASK = Task("red", "bowl"), Task("green", "plate")
REPOSITORY = Path(__file__).parents[1] / "model_repository"


class Clips(NamedTuple):
    """Clips of a task, each in a scene of its own. wrong_sentence: a success at another task under this one's name."""

    success: Clip
    failure: Clip
    rewound: Clip
    wrong_sentence: Clip
    second_success: Clip

    @classmethod
    def of(cls, seed: int) -> Clips:
        """The same clips for the same seed."""
        return cls(
            make_clip("success", TASK, seed),
            make_clip("dropped", TASK, seed + 1),
            make_clip("rewound", TASK, seed + 2),
            make_clip("success", TASK, seed + 3, shown=OTHER_TASK),
            make_clip("success", TASK, seed + 4),
        )


def demo(
    url: Annotated[str | None, typer.Option(help="A server that runs, instead of the repository's.")] = None,
    repository: Annotated[Path, typer.Option(help="Triton model repository.")] = REPOSITORY,
    seed: Annotated[int, typer.Option(help="Of the clips.")] = 2_000_000,
    output: Annotated[Path, typer.Option(help="Folder for picture, clips and log.")] = Path("demo_output"),
) -> None:
    """Progress, success, preference and similarity of toy-world clips: a table and a picture. The clips are kept."""
    output.mkdir(parents=True, exist_ok=True)
    console = Console()
    clips = Clips.of(seed)
    if url is not None:
        show_clips(url, clips, output / "rewards.png", console)
    else:
        with stopped_by_signals(), temporary_server(repository, output / "tritonserver.log") as endpoints:
            show_clips(endpoints.grpc_url, clips, output / "rewards.png", console)
            show_metrics(endpoints, console)
    for name, clip in clips._asdict().items():
        write_video(output / f"{name}.mp4", clip.frames)
    console.print(f"the clips as videos: {output}/*.mp4")


def show_clips(url: str, clips: Clips, picture: Path, console: Console) -> None:
    """Asks about all clips in one call, prints a table and draws a picture of the answers."""
    success, failure, rewound, wrong, second = (
        Trajectory(frames=clip.frames, task=clip.task.sentence()) for clip in clips
    )
    samples: dict[str, Sample] = {
        "a success": ProgressSample(success),
        "a failure: dropped": ProgressSample(failure),
        "rewound: done and undone": ProgressSample(rewound),
        "another task is done": ProgressSample(wrong),
        "success or failure": PreferenceSample(success, failure),
        "two successes": SimilaritySample(success, second),
        "success and another task": SimilaritySample(success, wrong),
    }
    with RewardClient(url) as client:
        results = client.evaluate(list(samples.values()))
    answers = dict(zip(samples, results, strict=True))
    console.print(scores_table(f'"{success.task}", asked at {url}', list(answers.items())))
    panels = [
        Panel.of(name, answers[name], sample.trajectory.frames)
        for name, sample in samples.items()
        if isinstance(sample, ProgressSample)
    ]
    preference, same, different = results[-3:]
    title = (
        f'"{success.task}"\nP(success preferred to failure) {preference.preference:.3f}      '
        f"similarity of two successes {same.similarity:.1f}, of success and another task {different.similarity:.1f}"
    )
    plot(picture, panels, title, columns=2)
    console.print(f"picture: {picture}")


if __name__ == "__main__":
    typer.run(demo)
