# SPDX-License-Identifier: MIT
"""What decides the content of labels, besides the frames: checkpoint, cameras, sampling. And who decided it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rfm_client.data.camera_fusion import Fuse
from rfm_client.data.datasets.protocol import Dataset, DatasetError, Episode, chosen_cameras
from rfm_client.data.orientation import Orientation
from rfm_client.data.sampling import Sampling
from rfm_client.labelling.options import LabelOptions, Mode
from rfm_client.labelling.scorer import CheckpointFacts

RECIPE_FORMAT = 3  # another one wherever the same recipe would give other scores
OF_TRAINING = {True: "as upstream's training pads shorter clips", False: "the checkpoint's training did not pad"}
OF_CHECKPOINT = "the most in training; if the checkpoint does not say, the most its network takes"


@dataclass(frozen=True)
class Recipe:
    """How an episode's frames become labels.

    decoders: what decodes each camera's pictures, since versions differ in colours; None: they are stored as pixels
    orientations: of the cameras that are turned
    """

    checkpoint: CheckpointFacts
    cameras: tuple[str, ...]
    decoders: Mapping[str, str | None]
    orientations: Mapping[str, Orientation]
    sampling: Sampling
    mode: Mode
    fuse: Fuse
    resize: bool

    @classmethod
    def of(cls, options: LabelOptions, dataset: Dataset, checkpoint: CheckpointFacts) -> Recipe:
        """The recipe that the options, or else the dataset and the checkpoint, decide. Raises DatasetError for a camera
        that is not there, ValueError if nobody says how many frames the rule shows.
        """
        if not dataset.cameras:
            raise DatasetError.at(dataset.source, "at least one camera", "none")
        cameras = chosen_cameras(dataset, options.cameras)
        rule = "all" if options.mode == "whole" else options.sampling
        sampling = Sampling.of(rule, options.frames, checkpoint.max_frames, trained_padding=checkpoint.trained_padding)
        return cls(
            checkpoint,
            cameras,
            decoders={camera: dataset.decoder(camera) for camera in cameras},
            orientations={camera: turn for camera, turn in dataset.orientations.items() if camera in cameras},
            sampling=sampling,
            mode=options.mode,
            fuse=options.fuse,
            resize=options.resize,
        )

    def in_one_pass(self, num_frames: int) -> bool:
        """Whether one pass over an episode of so many frames gives every frame's score."""
        rule, frames = self.sampling.rule, self.sampling.frames
        shows_all = rule == "all" or (rule == "rint" and frames is not None and num_frames <= frames)
        return self.mode == "whole" or (shows_all and self.checkpoint.is_causal)

    def document(self) -> dict[str, Any]:
        """The recipe as provenance tells it."""
        told = asdict(self.sampling)
        return {
            "format": RECIPE_FORMAT,
            "checkpoint": self.checkpoint.document(),
            "cameras": list(self.cameras),
            "decoders": dict(self.decoders),
            "orientations": dict(self.orientations),
            "sampling": told,
            "mode": self.mode,
            "fuse": self.fuse if len(self.cameras) > 1 else None,
            "resize": str(self.checkpoint.frame_size) if self.resize else None,
        }

    def told(self, options: LabelOptions) -> list[str]:
        """What is done, a line each, with who decided it."""
        of_rule = "asked for" if options.sampling else OF_TRAINING[self.checkpoint.trained_padding]
        of_frames = "asked for" if options.frames else OF_CHECKPOINT
        one = len(self.cameras) == 1
        of_cameras = "asked for" if options.cameras else "all but depth cameras"
        lines = [f"cameras: {', '.join(self.cameras)} ({of_cameras})"]
        if self.mode == "whole":
            lines.append("mode: whole: the score of frame t may depend on later frames, unless the network is causal")
        else:
            lines.append(f"sampling: {self.sampling.rule} ({of_rule})")
        if self.sampling.frames is not None:
            lines.append(f"frames: {self.sampling.frames} ({of_frames})")
        return lines if one else [*lines, f"fuse: {self.fuse} of {len(self.cameras)} cameras"]

    def check_lengths(self, episodes: Sequence[Episode]) -> None:
        """Raises DatasetError for an episode that the checkpoint cannot take at once, where it must."""
        limit = self.checkpoint.max_frames
        longest = max(episodes, key=lambda episode: episode.num_frames)
        shows_all = self.mode == "whole" or self.sampling.frames is None
        if shows_all and limit is not None and longest.num_frames > limit:
            got = f"{longest.num_frames}: use mode prefix and a rule with a number of frames"
            raise DatasetError.at(longest.name, f"at most {limit} frames, as the checkpoint takes", got)
