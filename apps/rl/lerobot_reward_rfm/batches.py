# SPDX-License-Identifier: MIT
"""Convert a LeRobot batch to trajectories: images to uint8, tasks, padding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lerobot_reward_rfm.configuration_rfm import RfmRewardConfig
from rfm_client import InvalidSampleError, Trajectory, as_array, as_trajectory
from rfm_client.options import is_blank, require

IMAGES = "images [B, 3, H, W], one frame a sample, or [B, T, 3, H, W]"


def trajectories_of(batch: Mapping[str, Any], config: RfmRewardConfig) -> list[Trajectory]:
    """Return each sample's trajectory: the frames without padding, uint8 [T, H, W, 3], and the task.

    Raises InvalidSampleError for images, tasks or padding that do not fit.
    """
    images, pads = images_of(batch, config.image_key), padding_of(batch, config.image_key)
    tasks = tasks_of(batch, len(images), config.default_task)
    return [
        trajectory_of(images[at], tasks[at], None if pads is None else pads[at], config, at)
        for at in range(len(images))
    ]


def trajectory_of(
    images: Any, task: str, pad: npt.NDArray[np.bool_] | None, config: RfmRewardConfig, index: int
) -> Trajectory:
    """Return one sample's trajectory. images: [T, 3, H, W] or [T, H, W, 3]. index: the sample's, for errors"""
    step = {config.image_key: images} if pad is None else {config.image_key: images, f"{config.image_key}_is_pad": pad}
    try:
        trajectory = as_trajectory(step, task=task)
    except InvalidSampleError as error:
        raise InvalidSampleError(
            f"sample {index} of the batch: {error}. Give images as the dataset or the camera has them, "
            "before any normalization"
        ) from error
    return replace(trajectory, frames=config.correction.applied(trajectory.positions))


def images_of(batch: Mapping[str, Any], key: str) -> Any:
    """Return the camera's images from the batch, [B, T, ...]. Raises InvalidSampleError."""
    keys = ", ".join(sorted(name for name in batch if str(name).startswith("observation.image"))) or "none"
    require("batch", key in batch, f"images under {key!r} (the configuration's image_key)", keys, InvalidSampleError)
    images = batch[key]
    if not hasattr(images, "shape"):
        images = as_array(images)
    shape = list(images.shape)
    require(key, len(shape) in (4, 5) and shape[0] > 0, IMAGES, shape, InvalidSampleError)
    return images if len(shape) == 5 else images[:, None]


def padding_of(batch: Mapping[str, Any], key: str) -> npt.NDArray[np.bool_] | None:
    """Return which frames are padding, bool [B, T]; None: the batch does not say, so none is."""
    pads = batch.get(f"{key}_is_pad")
    if pads is None:
        return None
    mask: npt.NDArray[np.bool_] = as_array(pads).astype(bool)
    shape = list(images_of(batch, key).shape[:2])
    require(f"{key}_is_pad", list(mask.shape) == shape, f"bool {shape}", list(mask.shape), InvalidSampleError)
    return mask


def tasks_of(batch: Mapping[str, Any], num: int, default: str | None) -> list[str]:
    """Return each sample's task. Raises InvalidSampleError for a missing task, or too few or too many."""
    task = batch.get("task")
    tasks: list[Any] = [task] * num if task is None or isinstance(task, str) else list(task)
    require(
        "task", len(tasks) == num, f"one sentence, or one for each of {num} samples", len(tasks), InvalidSampleError
    )
    tasks = [default if default is not None and is_blank(each) else each for each in tasks]
    for index, each in enumerate(tasks):
        is_sentence = isinstance(each, str) and not is_blank(each)
        remedy = 'a sentence: add "task" to the batch, or set default_task'
        require(f"task of sample {index}", is_sentence, remedy, repr(each), InvalidSampleError)
    return tasks
