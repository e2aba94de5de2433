# SPDX-License-Identifier: MIT
"""Frames of trajectories: videos, pictures and arrays, sampling rules, orientation, colours, sizes."""

from rfm_client.contract.hub_access import HubError, cached_snapshot
from rfm_client.frames.blank_frames import BlankFrames, what_is_shown
from rfm_client.frames.camera_fusion import FUSES, Fuse
from rfm_client.frames.fit_to_checkpoint import fitted
from rfm_client.frames.inputs import ARRAY_SUFFIXES, BROKEN_NPY, load_trajectory
from rfm_client.frames.lerobot_videos import check_local_video
from rfm_client.frames.orientation import (
    CHANNEL_ORDERS,
    ORIENTATIONS,
    ChannelOrder,
    Channels,
    Correction,
    Corrections,
    Orient,
    Orientation,
    PerCamera,
    Value,
)
from rfm_client.frames.pictures import decoded_picture, exif_turn, opened_picture, pillow, upright_picture
from rfm_client.frames.resize import as_jpeg, load_pillow, resize_frames
from rfm_client.frames.sampling import RULES, Rule, Sampling, of_prefixes, prefix_samples, trained_rule
from rfm_client.frames.video import frame_times_s, read_video
from rfm_client.frames.video_decoding import (
    DAMAGED,
    UNDAMAGED,
    Packets,
    Upright,
    decoder,
    import_av,
    judged,
    read_packets,
    video_stream,
)

__all__ = [
    "ARRAY_SUFFIXES",
    "BROKEN_NPY",
    "CHANNEL_ORDERS",
    "DAMAGED",
    "FUSES",
    "ORIENTATIONS",
    "RULES",
    "UNDAMAGED",
    "BlankFrames",
    "ChannelOrder",
    "Channels",
    "Correction",
    "Corrections",
    "Fuse",
    "HubError",
    "Orient",
    "Orientation",
    "Packets",
    "PerCamera",
    "Rule",
    "Sampling",
    "Upright",
    "Value",
    "as_jpeg",
    "cached_snapshot",
    "check_local_video",
    "decoded_picture",
    "decoder",
    "exif_turn",
    "fitted",
    "frame_times_s",
    "import_av",
    "judged",
    "load_pillow",
    "load_trajectory",
    "of_prefixes",
    "opened_picture",
    "pillow",
    "prefix_samples",
    "read_packets",
    "read_video",
    "resize_frames",
    "trained_rule",
    "upright_picture",
    "video_stream",
    "what_is_shown",
]
