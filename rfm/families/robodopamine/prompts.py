# SPDX-License-Identifier: MIT
"""Which frames Robo-Dopamine compares, its prompts with eight images per frame pair, and what its answers mean.

An answer says how far the images AFTER are from those BEFORE, in percent: ``<score>+37%</score>``. Every sampled frame
except the first is AFTER in one question per mode; BEFORE is the previous sampled frame (incremental, benchmark), frame
0 (forward), or the goal (backward).
Sources: ``examples/inference.py`` and, for ``benchmark``, ``eval/evaluation_grm.py`` in ``FlagOpen/Robo-Dopamine``;
``robometer/evals/baselines/robodopamine.py``, which has one camera and no goal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np

from rfm.engine.predictor import check_type
from rfm.files import CheckpointError
from rfm.qwen.backbone import Box, Indices, positions
from rfm.qwen.batch import VlmRow
from rfm.qwen.collator import IMAGE_PAD, KEPT_TEXTS, VISION_END, VISION_START, expanded, video_of
from rfm.qwen.images import MERGE, BoundedImages
from rfm.qwen.video import VlmVideo
from rfm.qwen.written import WritingCollator, WritingConfig
from rfm_client.contract import InvalidSampleError, Sample, Trajectory
from rfm_client.contract.samples import UInt8Array

Question: TypeAlias = Literal["incremental", "benchmark", "forward", "backward"]
Mode: TypeAlias = Literal["incremental", "benchmark", "forward", "backward", "mean"]
QUESTIONS: Mapping[Mode, tuple[Question, ...]] = {
    "incremental": ("incremental",),
    "benchmark": ("benchmark",),
    "forward": ("forward",),
    "backward": ("backward",),
    "mean": ("incremental", "forward", "backward"),
}
BEGIN, END = "<score>", "</score>"
MOST_PERCENT = 100


def sampled_frames(num_frames: int, interval: int) -> Indices:
    """Return the frames that are compared, int64: every ``interval``-th, and the last."""
    frames: Indices = np.unique(np.append(np.arange(0, num_frames, interval), num_frames - 1))
    return frames


def parsed(answer: str) -> float | None:
    """Return the score in an answer, -1..1; None: the answer holds no score.

    Parses like the original: the text behind the last ``<score>``, up to the first ``</score>``, without ``%``, as
    Python's ``float``. The original takes an unreadable answer as 0, and ``nan`` as 1.
    """
    text = answer.rpartition(BEGIN)[2].partition(END)[0]
    try:
        percent = float(text.replace("%", "").strip())
    except ValueError:
        return None
    if math.isnan(percent):
        return None
    return max(-MOST_PERCENT, min(MOST_PERCENT, percent)) / MOST_PERCENT


def fused(scores: Sequence[float], question: Question) -> list[float]:
    """Return the progress at each frame AFTER, from the scores in order.

    As in the original, progress is not clipped: a score with the wrong sign leaves 0..1. In ``benchmark`` it stays
    inside, since the first step begins at 0. The first step in ``incremental`` is the score itself.
    """
    if question == "forward":
        return [*scores]
    if question == "backward":
        return [1 + score for score in scores]
    progress = [0.0]
    for score in scores:
        before = progress[-1]
        share = 1 - before if score >= 0 else before
        is_whole = len(progress) == 1 and question == "incremental"
        progress.append(before + (1 if is_whole else share) * score)
    return progress[1:]


def hops(scores: Sequence[float], question: Question) -> list[float]:
    """Return each frame's change: the score if BEFORE was the previous frame, otherwise the change in progress."""
    if question in ("incremental", "benchmark"):
        return [*scores]
    progress = fused(scores, question)
    return [after - before for before, after in zip([0.0, *progress], progress, strict=False)]


IMAGE = VISION_START + IMAGE_PAD + VISION_END
PLACEHOLDER = "<image>"  # for an image in the originals' prompts
Images: TypeAlias = Sequence[tuple[VlmVideo, int]]  # the images' videos and indices, in the prompt's order
GOAL_SIDE_PX, GOAL_GREY = 224, 128  # for a sample without a goal
NUM_WRISTS = 2
PARTS = (
    """
You are a rigorous, impartial vision evaluator for robot task progress. Your job is to judge whether the AFTER image set moves closer to the task objective than the BEFORE image set, using the provided reference examples only as anchors.

<Task>
`{task}`

REFERENCE EXAMPLES (for visual anchoring only; not necessarily this run's actual START/END):
- REFERENCE START — Robot Front Image (task just starting): """,  # noqa: E501
    "\n- REFERENCE END — Robot Front Image (task fully completed): ",
    "\n</Task>\n\nBEFORE Robot Front Image: ",
    "\nBEFORE Robot Left Wrist Image: ",
    "\nBEFORE Robot Right Wrist Image: ",
    "\n\nAFTER Robot Front Image: ",
    "\nAFTER Robot Left Wrist Image: ",
    "\nAFTER Robot Right Wrist Image: ",
    """

Goal
Compare the BEFORE and AFTER three-view sets and judge whether AFTER moves closer to accomplishing the task than BEFORE, using the REFERENCE START/END images as conceptual anchors.

Progress Estimation (no formulas)
1) Calibrate using the references:
   - REFERENCE START = “just beginning”; REFERENCE END = “fully completed.”
   - Visually estimate how far BEFORE and AFTER are along this START→END continuum.
2) Direction:
   - AFTER better than BEFORE → positive score.
   - AFTER worse than BEFORE → negative score.
   - Essentially the same → 0.
3) Normalize to an integer percentage in [-100%, +100%]:
   - For improvements, scale the improvement relative to what remained from BEFORE to END.
   - For regressions, scale the deterioration relative to how far BEFORE had progressed from START.
   - Clip to [-100%, +100%] and round to the nearest integer percent.

Evaluation Criteria (apply across all three views)
1) Task Alignment: Evidence directly tied to `{task}`.
2) Completeness & Accuracy: Correct pose, contact, placement, orientation, grasp quality, absence of collisions, stability, etc.
3) View-Specific Evidence & Consistency:
   - Use the **Front** view for global layout, object pose, approach path, end-state geometry, and scene-level constraints.
   - Use the **Left/Right Wrist** views to inspect **fine-grained gripper state** (finger closure, contact location/area, slippage, wedge/misalignment, object deformation, cable/wire/cloth entanglement, unintended contact, occluded collisions).
   - When views disagree, prioritize the view that provides **decisive cues** for the criterion at hand. In particular, wrist views often **override** for grasp/contact validity and safety.
   - If any single view shows a failure that invalidates success (e.g., mis-grasp, collision, unsafe/unstable pose), let that override when judging progress.
4) Ignore Irrelevant Factors: Lighting, color shifts, background clutter, or UI/watermarks that don't affect task success.
5) Ambiguity: If evidence is genuinely inconclusive or conflicting without decisive cues, treat progress as unchanged → 0%.

Output Format (STRICT)
Return ONLY one line containing the score wrapped in <score> tags, as an integer percentage with a percent sign:
<score>+NN%</score>  or  <score>-NN%</score>  or  <score>0%</score>
""",  # noqa: E501
)
NUM_IMAGES = len(PARTS) - 1  # per question


@dataclass(frozen=True)
class RoboDopamineConfig(WritingConfig):
    """The configuration of Robo-Dopamine.

    least_px, most_px: pixels per image
    mode: what frames are compared with, and how progress follows from that; mean: average over incremental, forward,
        backward
    interval: frames from one compared frame to the next; the last is always compared
    """

    max_new_tokens: int = 48  # a score has about 10
    least_px: int = field(kw_only=True)
    most_px: int = field(kw_only=True)
    mode: Mode = "incremental"
    interval: int = 1

    reward_model: ClassVar[str] = "robodopamine"
    multi_image: ClassVar[bool] = True

    def check(self) -> None:
        """Raise CheckpointError for a user's setting that makes no sense."""
        if self.mode not in QUESTIONS:
            raise CheckpointError.at("--as: mode", f"one of {', '.join(QUESTIONS)}", repr(self.mode))
        if self.interval < 1:
            raise CheckpointError.at("--as: interval", "at least 1 frame", self.interval)


@dataclass(frozen=True, eq=False)
class ImagesRow(VlmRow):
    """A question about images."""

    images: Images = field(kw_only=True)

    @property
    def shown(self) -> Iterator[tuple[VlmVideo, Indices]]:
        """The images' videos and indices."""
        return ((video, np.array([frame])) for video, frame in self.images)


class RoboDopamineCollator(WritingCollator):
    """The collator for Robo-Dopamine: one conversation per frame pair and mode."""

    images: BoundedImages

    def __init__(self, config: RoboDopamineConfig, tokenizer: Any, images: BoundedImages) -> None:
        super().__init__(config, tokenizer, images, BEGIN)
        self._text = lru_cache(KEPT_TEXTS)(self._task_text)

    def example(self) -> str:
        """Return the prompt for an example task."""
        return self._text("TASK")

    def check_template(self) -> None:
        """Raise CheckpointError unless a prompt has its images."""
        got = self.example().count(IMAGE)
        if got != NUM_IMAGES:
            raise CheckpointError.at("chat template", f"{NUM_IMAGES} images in a prompt", got)

    def num_patches(self, video: VlmVideo) -> int:
        """Return how many patches a video's shown frames have."""
        return super().num_patches(video) * len(video.conversations)

    def _questions(self, text: str, asked: Sequence[Images]) -> list[VlmRow]:
        """Return the rows for questions whose images have equal sizes and therefore equal tokens.

        text: text from the chat template
        """
        grids = [self.grid(video) for video, _ in asked[0]]
        ids = expanded(self._chat.tokens(text), self.visual_pad, [grid.tokens_per_group for grid in grids])
        starts = self._positions(ids, VISION_START) + 1
        boxes = [
            Box(int(start), 1, grid.rows // MERGE, grid.columns // MERGE)
            for start, grid in zip(starts, grids, strict=True)
        ]
        at = positions(len(ids), boxes)
        return [
            ImagesRow(ids, _different(images), ([],), len(ids) - 1, False, position_ids=at, images=images)
            for images in asked
        ]

    def _check_task(self, task: str) -> None:
        super()._check_task(task)
        if PLACEHOLDER in task:
            raise InvalidSampleError.at("task", f"text without {PLACEHOLDER}", repr(task))

    def rows(self, sample: Sample) -> list[VlmRow]:
        """Return a progress sample's conversations, mode by mode, in frame order.

        Raises InvalidSampleError.
        """
        check_type(sample, self.config)
        (trajectory,) = sample.trajectories
        self._check(sample, trajectory)
        frames = sampled_frames(trajectory.num_frames, self.config.interval)
        videos, rows = Videos.of(trajectory, frames), list[VlmRow]()
        for question in QUESTIONS[self.config.mode]:
            asked = [videos.images(question, before, after) for before, after in pairwise(frames.tolist())]
            rows += self._questions(self._text(trajectory.task), asked)
        return rows

    def _check(self, sample: Sample, trajectory: Trajectory) -> None:
        self._check_task(trajectory.task)
        if steps := getattr(sample, "frame_steps", 0):
            expected = "0 (Robo-Dopamine compares frames: send two, and read hop)"
            raise InvalidSampleError.at("frame_steps", expected, str(steps))
        if trajectory.num_frames == 1:
            raise InvalidSampleError.at("num_frames", "at least 2 (Robo-Dopamine compares frames)", "1")
        if len(trajectory.views) not in (0, NUM_WRISTS):
            expected = "none, or those of the left and the right wrist (give the same frames twice for a missing one)"
            raise InvalidSampleError.at("views", expected, str(len(trajectory.views)))

    def _task_text(self, task: str) -> str:
        """Return the chat template's text for a question, with an image between consecutive PARTS."""
        content: list[dict[str, str]] = []
        for part in PARTS:
            content += [{"type": "image"}] * bool(content)
            content.append({"type": "text", "text": part.replace("{task}", task)})
        conversation = [{"role": "user", "content": content}]
        return str(self.tokenizer.apply_chat_template(conversation, tokenize=False, add_generation_prompt=True))


def _different(images: Images) -> tuple[VlmVideo, ...]:
    return tuple(dict.fromkeys(video for video, _ in images))


def each_alone(frames: Sequence[UInt8Array] | UInt8Array, shown: Indices, named: Any = None) -> VlmVideo:
    """Return a video in which each frame in ``shown``, int64 [N], is an image. named: as in ``VlmVideo``."""
    return VlmVideo(frames, 1, [np.array([frame]) for frame in shown], named)


@dataclass(frozen=True, eq=False)
class Videos:
    """A sample's images, eight of which appear in a question."""

    front: VlmVideo
    goal: VlmVideo
    wrists: tuple[VlmVideo, VlmVideo]

    @classmethod
    def of(cls, trajectory: Trajectory, compared: Indices) -> Videos:
        """Return a trajectory's images, where only the frames ``compared`` are read."""
        grey = np.full((GOAL_SIDE_PX, GOAL_SIDE_PX, 3), GOAL_GREY, np.uint8)
        goal = grey if trajectory.goal is None else trajectory.goal
        video = video_of(trajectory, 0)
        front = each_alone(video.frames, compared, video.named)
        wrists = [each_alone(view, compared) for view in trajectory.views]
        left, right = wrists or (front, front)
        return cls(front, each_alone(goal[np.newaxis], np.array([0])), (left, right))

    def images(self, question: Question, before: int, after: int) -> list[tuple[VlmVideo, int]]:
        """Return video and index for all images in a question: the task's start and end, BEFORE, AFTER.

        before: the frame compared before ``after``
        """
        views = (self.front, *self.wrists)
        end = self.goal, 0
        compared = [(view, 0 if question == "forward" else before) for view in views]
        shown_before = [end] * len(views) if question == "backward" else compared
        return [(self.front, 0), end, *shown_before, *((view, after) for view in views)]
