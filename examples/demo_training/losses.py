# SPDX-License-Identifier: MIT
"""Training questions about a batch of groups, and losses for the answers.

Each clip is embedded once. Rows reuse the embeddings: played forwards, rewound or stopped, under any task.
G groups, R rows, T frames per row or clip, H x W pixels, K progress bins, Dv frame embedding width, Dt text embedding
width, S hint values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from demo_training.groups import CLIP_FRAMES, FAILURE, OTHER_TASK, SECOND_SUCCESS, SUCCESS, Groups
from demo_training.networks import Learner
from rfm.families.rewind.network import RewindBatch
from toy_world.tasks import TASKS, VERBS

LENGTHS = (4, 17)  # frames per row, without the upper bound
_LONG_ROWS_SHARE, _LONGEST = 0.2, 33
_PLACE_WEIGHT, _TASK_WEIGHT = 3.0, 8.0  # for hints about the world's state, and about progress and success
_SUCCESS_POSITIVE_WEIGHT = 2.0

# Rows: (clip, playback, task). "any": a random task out of all six.
_SINGLES = (
    (SUCCESS, "forward", "own"),
    (SUCCESS, "forward", "other"),
    (SUCCESS, "rewound", "any"),
    (SECOND_SUCCESS, "rewound", "own"),
    (SECOND_SUCCESS, "stopped", "any"),
    (FAILURE, "forward", "own"),
    (FAILURE, "forward", "any"),
    (OTHER_TASK, "forward", "own"),
    (OTHER_TASK, "forward", "other"),
    (OTHER_TASK, "forward", "any"),
)
NOISE, OTHER_NOISE, RANDOM, OTHER_RANDOM = range(4, 8)  # clips without a scene: noise frames, random embeddings
_NOISE_FRAMES = 6  # per noise clip, repeated to CLIP_FRAMES

# (first clip, playback, second clip, playback): the first is better.
_PREFERENCES = (
    (SUCCESS, "forward", FAILURE, "forward"),
    (SECOND_SUCCESS, "forward", FAILURE, "forward"),
    (SUCCESS, "forward", OTHER_TASK, "forward"),
    (SECOND_SUCCESS, "forward", OTHER_TASK, "forward"),
    (SUCCESS, "forward", SECOND_SUCCESS, "rewound"),
    (SECOND_SUCCESS, "forward", SUCCESS, "stopped"),
    (SUCCESS, "forward", NOISE, "forward"),
)
# Neither is better, in either order. The last pair also has random text embeddings.
_UNDECIDED = (
    (SUCCESS, "forward", SECOND_SUCCESS, "forward"),
    (NOISE, "forward", OTHER_NOISE, "forward"),
    (RANDOM, "forward", OTHER_RANDOM, "forward"),
)
# (reference, other, 1 if the same task is done)
_SIMILARITIES = (
    (SUCCESS, SECOND_SUCCESS, 1.0),
    (SECOND_SUCCESS, SUCCESS, 1.0),
    (SUCCESS, OTHER_TASK, 0.0),
    (SECOND_SUCCESS, OTHER_TASK, 0.0),
    (SUCCESS, FAILURE, 0.0),
)


class _Video(NamedTuple):
    """R trajectories: embeddings float32 [R, T, Dv], progress and success float32 [R, T]."""

    embeddings: Tensor
    progress: Tensor
    success: Tensor


@dataclass(frozen=True)
class Questions:
    """Draws questions about groups.

    embeddings: float32 [G, 8, T, Dv], for the groups' 4 clips and 4 clips without a scene
    texts: float32 [6, Dt], for the tasks
    """

    groups: Groups
    embeddings: Tensor
    texts: Tensor
    random: np.random.Generator

    def losses(self, learner: Learner) -> dict[str, Tensor]:
        """Return the mean loss for each kind of answer."""
        losses = self._single_losses(learner)
        for name, loss in self._pair_losses(learner).items():
            losses[name] = losses.get(name, torch.zeros(())) + loss
        return losses

    def _single_losses(self, learner: Learner) -> dict[str, Tensor]:
        length = self._length()
        tasks = [self._task(which) for _, _, which in _SINGLES]
        video = self._joined([self._video(c, how, t, length) for (c, how, _), t in zip(_SINGLES, tasks, strict=True)])
        num_frames = np.tile([length, 0], (len(video.embeddings), 1))
        output = learner.network(
            RewindBatch.of(
                learner.network.config, self.texts[torch.cat(tasks)], video.embeddings.flatten(0, 1), num_frames
            )
        )
        return _frame_losses(output.progress, output.success, video)

    def _pair_losses(self, learner: Learner) -> dict[str, Tensor]:
        lengths = self._length(), self._length()
        own = self.groups.task
        firsts, seconds, labels = [], [], []
        for better, how_better, worse, how_worse in (*_PREFERENCES, *_UNDECIDED):
            pair = [(better, how_better), (worse, how_worse)]
            swapped = bool(self.random.random() < 0.5)
            (first, how_first), (second, how_second) = pair[::-1] if swapped else pair
            firsts.append(self._video(first, how_first, own, lengths[0]))
            seconds.append(self._video(second, how_second, own, lengths[1]))
            labels.append(0.0 if swapped else 1.0)
        labels[-len(_UNDECIDED) :] = [0.5] * len(_UNDECIDED)
        for reference, other, same in _SIMILARITIES:
            firsts.append(self._video(reference, "forward", own, lengths[0]))
            seconds.append(self._video(other, "forward", own, lengths[1]))
            labels.append(same)
        return self._pairs(learner, self._joined(firsts), self._joined(seconds), torch.tensor(labels))

    def _pairs(self, learner: Learner, first: _Video, second: _Video, labels: Tensor) -> dict[str, Tensor]:
        num_groups = len(self.groups.task)
        labels = labels.repeat_interleave(num_groups)
        texts = self.texts[self.groups.task.repeat(len(labels) // num_groups)]
        num_preferences = (len(_PREFERENCES) + len(_UNDECIDED)) * num_groups
        is_similarity = torch.arange(len(labels)) >= num_preferences
        is_random = (torch.arange(len(labels)) >= num_preferences - num_groups) & ~is_similarity
        texts = torch.where(is_random[:, None], torch.randn_like(texts), texts)
        lengths = [first.progress.shape[1], second.progress.shape[1]]
        batch = RewindBatch.of(
            learner.network.config,
            texts,
            torch.cat([first.embeddings, second.embeddings], dim=1).flatten(0, 1),
            np.tile(lengths, (len(labels), 1)),
            is_similarity=is_similarity,
        )
        output = learner.network(batch)
        progress, success = (
            scores.unflatten(0, (len(labels), -1)).split(lengths, dim=1) for scores in (output.progress, output.success)
        )
        losses = _frame_losses(progress[0], success[0], first)
        for name, loss in _frame_losses(progress[1], success[1], second).items():
            losses[name] = (losses[name] + loss) / 2
        answers = F.binary_cross_entropy_with_logits(output.query, labels, reduction="none")
        return losses | {"preference": answers[~is_similarity].mean(), "similarity": answers[is_similarity].mean()}

    def _video(self, clip: int, how: str, task: Tensor, length: int) -> _Video:
        """Return one trajectory per group. how: ``forward``, ``stopped`` or ``rewound``."""
        moments = torch.from_numpy(np.stack([_moments(how, length, self.random) for _ in range(len(task))]))
        groups = torch.arange(len(task))[:, None]
        truths = (truth[groups, clip, moments, task[:, None]] for truth in (self.groups.progress, self.groups.success))
        return _Video(self.embeddings[groups, clip, moments], *truths)

    def _task(self, which: str) -> Tensor:
        if which == "any":
            return torch.from_numpy(self.random.integers(len(TASKS), size=len(self.groups.task)))
        return self.groups.task if which == "own" else self.groups.other_task

    def _length(self) -> int:
        below = _LONGEST if self.random.random() < _LONG_ROWS_SHARE else LENGTHS[1]
        return int(self.random.integers(LENGTHS[0], below))

    @staticmethod
    def _joined(videos: Sequence[_Video]) -> _Video:
        return _Video(*(torch.cat(parts) for parts in zip(*videos, strict=True)))


def noise_clips(num_groups: int, size_px: tuple[int, int], random: np.random.Generator) -> Tensor:
    """Return noise clips with random grain, contrast and brightness, uint8 [G, 2, 6, H, W, 3].

    size_px: H and W
    """
    height, width = size_px
    clips = np.empty((num_groups, 2, _NOISE_FRAMES, height, width, 3), np.uint8)
    for clip in clips.reshape(-1, *clips.shape[2:]):
        grain = int(random.choice([1, 1, 4, 16]))
        coarse = random.integers(0, 256, (_NOISE_FRAMES, height // grain, width // grain, 3))
        contrast, light = random.uniform(0.3, 1), random.uniform(0, 1)
        fine = coarse.repeat(grain, axis=1).repeat(grain, axis=2)
        clip[:] = fine * contrast + 255 * light * (1 - contrast)
    return torch.from_numpy(clips)


def with_noise(groups: Groups, embeddings: Tensor, noise: Tensor) -> tuple[Groups, Tensor]:
    """Add clips without a scene, which have no progress and no success, to groups and embeddings.

    embeddings: float32 [G, 4, T, Dv]; in the result [G, 8, T, Dv]
    noise: float32 [G, 2, 6, Dv], embeddings from ``noise_clips``
    """
    shown = noise.repeat(1, 1, CLIP_FRAMES // _NOISE_FRAMES, 1)
    embeddings = torch.cat([embeddings, shown, torch.randn_like(shown)], dim=1)
    nothing = torch.zeros_like(groups.progress)
    progress, success = (torch.cat([truth, nothing], dim=1) for truth in (groups.progress, groups.success))
    return groups._replace(progress=progress, success=success), embeddings


def hint_loss(learner: Learner, embeddings: Tensor, hints: Tensor) -> Tensor:
    """Return the loss, float32 [], for hints, float32 [..., S], read from embeddings, float32 [..., Dv]."""
    read = learner.hint_head(embeddings)
    errors = (read - torch.where(hints.isnan(), read.detach(), hints)).square()
    num_tasks = 2 * len(TASKS)
    return _PLACE_WEIGHT * errors[..., :-num_tasks].mean() + _TASK_WEIGHT * errors[..., -num_tasks:].mean()


def drawn_verb(random: np.random.Generator) -> str:
    """Return a random verb from VERBS."""
    return str(random.choice(VERBS))


def _frame_losses(progress_logits: Tensor, success_logits: Tensor, video: _Video) -> dict[str, Tensor]:
    bins = progress_logits.shape[-1]
    targets = _two_hot(video.progress, bins)
    weight = torch.tensor(_SUCCESS_POSITIVE_WEIGHT)
    success = F.binary_cross_entropy_with_logits(success_logits.flatten(), video.success.flatten(), pos_weight=weight)
    progress = F.cross_entropy(progress_logits.reshape(-1, bins), targets.flatten(0, 1))
    return {"progress": progress, "success": success}


def _two_hot(progress: Tensor, bins: int) -> Tensor:
    """Map progress [R, T] to bin weights [R, T, K]: two neighbouring bins, weighted to average the progress."""
    position = progress * (bins - 1)
    return F.relu(1 - (position[..., None] - torch.arange(bins)).abs())


def _moments(how: str, length: int, random: np.random.Generator) -> np.ndarray:
    """Return int64 [length]: a row's frames, as indices into a clip with CLIP_FRAMES frames."""
    last = CLIP_FRAMES - 1
    if how == "stopped":
        last = int(random.integers(1, CLIP_FRAMES - 4))
        shares = np.minimum(np.linspace(0, random.uniform(1, 2.5), length), 1)
    elif how == "rewound":
        turn = random.uniform(0.65, 1)
        back = random.uniform(0, turn - 0.3)
        way = np.linspace(0, 2 * turn - back, length)
        shares = np.where(way > turn, 2 * turn - way, way)
    else:
        shares = np.linspace(0, 1, length)
    return (shares * last).round().astype(np.int64)
