# SPDX-License-Identifier: MIT
"""Trajectory frames: videos and pictures, colours and orientation, sampling rules.

The type aliases are ``Literal`` types: ``typing.get_args(Rule)`` lists the rules.
"""

from rfm_client.contract.hub_access import cached_snapshot, hub_errors
from rfm_client.frames.blank_frames import BlankFrames
from rfm_client.frames.fit_to_checkpoint import resize_frames
from rfm_client.frames.orientation import ChannelOrder, Correction, Fuse, Orientation
from rfm_client.frames.pictures import FrameFileError, Picture
from rfm_client.frames.sampling import Rule, Sampling
from rfm_client.frames.video import frame_times_s, read_video
from rfm_client.frames.video_file import Video

__all__ = [
    "BlankFrames",
    "ChannelOrder",
    "Correction",
    "FrameFileError",
    "Fuse",
    "Orientation",
    "Picture",
    "Rule",
    "Sampling",
    "Video",
    "cached_snapshot",
    "frame_times_s",
    "hub_errors",
    "read_video",
    "resize_frames",
]
