# SPDX-License-Identifier: MIT
"""A small world in which a gripper puts blocks into a bowl or onto a plate, rendered from a seed."""

from toy_world.clips import NUM_FRAMES, Clip, forward, make_clip
from toy_world.motion import FAILURES, KINDS, pick_and_place, resting
from toy_world.render import render
from toy_world.scene import random_scene
from toy_world.tasks import TASKS, VERBS, Task

__all__ = [
    "FAILURES",
    "KINDS",
    "NUM_FRAMES",
    "TASKS",
    "VERBS",
    "Clip",
    "Task",
    "forward",
    "make_clip",
    "pick_and_place",
    "random_scene",
    "render",
    "resting",
]
