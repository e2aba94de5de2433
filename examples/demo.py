# SPDX-License-Identifier: MIT
"""Score toy-world clips, unseen in training, with the served demo checkpoint.

python examples/demo.py                              # serves model_repository meanwhile
python examples/demo.py --url grpc://localhost:8001  # asks a running server
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from rfm.serve.triton_server import stopped_by_signals, temporary_server
from rfm_client import PreferenceSample, ProgressSample, RewardClient, Sample, SimilaritySample, Trajectory
from rfm_client.cli.pictures import Panel, plot
from rfm_client.cli.scoring import heading
from rfm_client.cli.show import PAGE_PORT, PAGE_URL, command, next_steps, score_step, scores_table
from rfm_client.contract.description import PUBLIC_CHECKPOINT
from rfm_client.contract.wire import DEFAULT_MODEL
from rfm_client.frames.inputs import load_trajectory
from rfm_commands.try_video import steps_without_server
from toy_world import Clip, Task, make_clip
from toy_world.video import FPS, write_video

TASK, OTHER_TASK = Task("red", "bowl"), Task("green", "plate")
REPOSITORY = Path(__file__).parents[1] / "model_repository"


class Clips(NamedTuple):
    """One clip per kind for a task, each in its own scene.

    wrong_sentence: another task's success, with this task's sentence
    """

    success: Clip
    failure: Clip
    rewound: Clip
    wrong_sentence: Clip
    second_success: Clip

    @classmethod
    def of(cls, seed: int) -> Clips:
        """Make clips from a seed."""
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
    seed: Annotated[int, typer.Option(help="Seed of the clips.")] = 2_000_000,
    output: Annotated[Path, typer.Option(help="Folder for picture, clips and log.")] = Path("demo_output"),
) -> None:
    """Show progress, success, preference and similarity of toy-world clips in a table and a picture. Keep the clips."""
    output.mkdir(parents=True, exist_ok=True)
    trajectories = [filmed(clip, output / f"{name}.mp4") for name, clip in Clips.of(seed)._asdict().items()]
    if url is not None:
        show_clips(url, trajectories, output / "rewards.png")
        page = command("rfm-client", "gateway", "--port", PAGE_PORT, "--triton", url)
        steps = next_steps(score_step(url, [DEFAULT_MODEL]), (f"serve the page at {PAGE_URL}", page))
    else:
        with stopped_by_signals(), temporary_server(repository, output / "tritonserver.log") as endpoints:
            show_clips(endpoints.grpc_url, trajectories, output / "rewards.png")
        public = ("for your own videos, serve a public checkpoint", command("rfm", "serve", PUBLIC_CHECKPOINT))
        steps = next_steps(*steps_without_server([_short(repository)], output / "success.mp4", TASK.sentence()), public)
    typer.echo(f"The curves are in {output / 'rewards.png'}, the clips in {output}/*.mp4.\n{steps}")


def filmed(clip: Clip, file: Path) -> Trajectory:
    """Write a clip as a video and read it back, so that ``rfm-client score`` and the page give the same scores."""
    write_video(file, clip.frames)
    return load_trajectory(file, task=clip.task.sentence())


def show_clips(url: str, trajectories: Sequence[Trajectory], picture: Path) -> None:
    """Score the clips, in the order of ``Clips``, with one call. Print a table and draw a picture."""
    success, failure, rewound, wrong, second = trajectories
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
        info = client.model_info(frames=True)
    answers = dict(zip(samples, results, strict=True))
    print(scores_table(f'"{success.task}"', list(answers.items())))
    panels = [
        Panel.of(name, answers[name], sample.trajectory.frames, np.arange(sample.trajectory.num_frames) / FPS)
        for name, sample in samples.items()
        if isinstance(sample, ProgressSample)
    ]
    preference, same, different = results[-3:]
    title = (
        f"{heading(success.task, [info])}\nP(success preferred to failure) = {preference.preference:.3f}; "
        f"similarity of two successes {same.similarity:.1f}, of success and another task {different.similarity:.1f}"
    )
    plot(picture, panels, title, columns=2)


def _short(folder: Path) -> Path:
    """The folder as one would type it here."""
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


if __name__ == "__main__":
    typer.run(demo)
