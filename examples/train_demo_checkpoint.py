# SPDX-License-Identifier: MIT
"""Train the demo's checkpoint on the toy world: a small ReWiND with its encoders, end to end, on the CPU.

    python examples/train_demo_checkpoint.py FOLDER

First the image encoder learns to predict the state of the world and the tasks, through a temporary head. Then text
encoder and transformer learn progress, success, preference and similarity on its embeddings, with videos rewound as in
ReWiND (https://arxiv.org/abs/2505.10911). Finally all parts learn together.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor
from torch.utils.data import DataLoader

from demo_training.groups import Groups, GroupsDataset
from demo_training.losses import Questions, drawn_verb, hint_loss, noise_clips, with_noise
from demo_training.networks import Learner, num_parameters, seeded_learner, write_checkpoint

ENCODER_STEPS = 1400
FROZEN_STEPS = 900
JOINT_STEPS = 500
GROUPS_PER_STEP = 8
PEAK_LEARNING_RATE = 1.5e-3
WARMUP_STEPS = 100
WEIGHT_DECAY = 0.01
MAX_GRADIENT_NORM = 1.0
JOINT_ENCODER_SHARE = 0.2  # learning rate factor for the pretrained image encoder in the joint steps
LOG_EVERY = 50
SAVE_EVERY = 250


@dataclass(frozen=True)
class Plan:
    """How many steps the image encoder learns alone, stays frozen, and learns together with the other parts."""

    encoder: int
    frozen: int
    joint: int

    @property
    def total(self) -> int:
        """Steps in all three stages."""
        return self.encoder + self.frozen + self.joint

    def rate(self, step: int) -> float:
        """Return a step's share of the peak learning rate: warm-up and cosine decay in each stage.

        The first stage trains the encoder, the second covers all other steps.
        """
        begin, end = (0, self.encoder) if step < self.encoder else (self.encoder, self.total)
        down = 0.5 * (1 + math.cos(math.pi * (step - begin) / max(end - begin, 1)))
        return min(1.0, (step - begin + 1) / WARMUP_STEPS) * (0.02 + 0.98 * down)

    def encoder_rate(self, step: int) -> float:
        """Return the image encoder's share of the peak learning rate."""
        return self.rate(step) * (1.0 if step < self.encoder else JOINT_ENCODER_SHARE)


def train(
    folder: Annotated[Path, typer.Argument(help="Where the checkpoint goes; must not exist.")],
    seed: int = 0,
    encoder_steps: Annotated[int, typer.Option(help="Steps that only the image encoder learns in.")] = ENCODER_STEPS,
    frozen_steps: Annotated[int, typer.Option(help="Steps that all but the image encoder learn in.")] = FROZEN_STEPS,
    joint_steps: Annotated[int, typer.Option(help="Steps that everything learns in.")] = JOINT_STEPS,
    groups: Annotated[int, typer.Option(help="Groups of four clips in a step.")] = GROUPS_PER_STEP,
    threads: Annotated[int, typer.Option(help="torch threads; one more process renders.")] = 1,
) -> None:
    """Train, and write the checkpoint, its encoders and training.json (losses) into FOLDER."""
    if folder.exists():
        raise typer.BadParameter(f"expected a folder that does not exist, got {folder}")
    torch.set_num_threads(threads)
    started_s = time.perf_counter()
    learner = seeded_learner(seed)
    plan = Plan(encoder_steps, frozen_steps, joint_steps)
    dataset = GroupsDataset(seed, plan.total, groups, encoder_steps)
    loader = DataLoader(dataset, batch_size=None, num_workers=1, prefetch_factor=8)
    log = _run(learner, loader, plan, folder)
    write_checkpoint(learner, folder)
    parts = ("image_model", "text_model", "network")
    record = {
        "seed": seed,
        "steps": asdict(plan),
        "groups_per_step": groups,
        "minutes": round((time.perf_counter() - started_s) / 60, 1),
        "parameters": {part: num_parameters(getattr(learner, part)) for part in parts},
        "losses": log,
    }
    (folder / "training.json").write_text(json.dumps(record, indent=1) + "\n")
    typer.echo(f"{folder}: {record['parameters']}, {record['minutes']} minutes")


def _run(learner: Learner, loader: DataLoader[Groups], plan: Plan, folder: Path) -> list[dict[str, float]]:
    """Run all steps. Return mean losses for every LOG_EVERY steps and at each stage's end."""
    random = np.random.default_rng(torch.initial_seed())
    optimizer, schedule = _optimizer(learner, plan)
    recent: list[dict[str, float]] = []
    log: list[dict[str, float]] = []
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns) as bar:
        shown = bar.add_task("", total=plan.total)
        for done, groups in enumerate(loader):
            losses = _losses(learner, groups, random, plan, done)
            optimizer.zero_grad()
            torch.stack(list(losses.values())).sum().backward()
            torch.nn.utils.clip_grad_norm_(learner.parameters(), MAX_GRADIENT_NORM)
            optimizer.step()
            schedule.step()
            recent.append({name: loss.item() for name, loss in losses.items()})
            step = done + 1
            bar.update(shown, completed=step)
            if step % LOG_EVERY == 0 or step in (plan.encoder, plan.encoder + plan.frozen, plan.total):
                log.append({"step": step, **_mean(recent)})
                recent.clear()
                text = " ".join(f"{name} {value:.4g}" for name, value in log[-1].items())
                bar.update(shown, description=text)
                bar.console.print(text, highlight=False, soft_wrap=True)
            if step % SAVE_EVERY == 0 and plan.encoder < step < plan.total:  # kept if the run is cut short
                write_checkpoint(learner, folder / f"step_{step}")
    return log


def _optimizer(learner: Learner, plan: Plan) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LambdaLR]:
    encoder = [*learner.image_model.parameters(), *learner.hint_head.parameters()]
    others = [*learner.text_model.parameters(), *learner.network.parameters()]
    parts = [{"params": encoder}, {"params": others}]
    optimizer = torch.optim.AdamW(parts, lr=PEAK_LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    return optimizer, torch.optim.lr_scheduler.LambdaLR(optimizer, [plan.encoder_rate, plan.rate])


def _losses(learner: Learner, groups: Groups, random: np.random.Generator, plan: Plan, step: int) -> dict[str, Tensor]:
    is_frozen = plan.encoder <= step < plan.encoder + plan.frozen
    with torch.set_grad_enabled(not is_frozen):
        embeddings = learner.embed_frames(groups.frames)
        losses = {} if is_frozen else {"hints": hint_loss(learner, embeddings, groups.hints)}
        if step >= plan.encoder:
            height, width = groups.frames.shape[-3:-1]
            noise = learner.embed_frames(noise_clips(len(groups.task), (height, width), random))
            groups, embeddings = with_noise(groups, embeddings, noise)
    if step >= plan.encoder:
        questions = Questions(groups, embeddings, learner.embed_tasks(drawn_verb(random)), random)
        losses |= questions.losses(learner)
    return losses


def _mean(losses: list[dict[str, float]]) -> dict[str, float]:
    return {name: sum(each[name] for each in losses) / len(losses) for name in losses[0]}


if __name__ == "__main__":
    typer.run(train)
