# SPDX-License-Identifier: MIT
"""Write video.mcap: two topics of foxglove.CompressedVideo. Needs mcap-protobuf-support, foxglove-schemas-protobuf, av."""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from mcap_protobuf.writer import Writer

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "support"))
from pictures import numbered  # noqa: E402 - frames that show their number

NUM_FRAMES, FPS = 6, 10

if __name__ == "__main__":
    with (HERE / "video.mcap").open("wb") as opened, Writer(opened) as writer:
        for topic in ("/camera/front", "/camera/wrist"):
            encoder = av.CodecContext.create("libx264", "w")
            frames = numbered(NUM_FRAMES)
            encoder.width, encoder.height, encoder.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
            encoder.time_base, encoder.options = Fraction(1, FPS), {"tune": "zerolatency", "crf": "10"}
            for t, frame in enumerate(frames):
                shown = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
                shown.pts, time_ns = t, 1_764_000_000_000_000_000 + t * 10**9 // FPS
                for packet in encoder.encode(shown):  # one for each frame, without delay
                    message = CompressedVideo(data=bytes(packet), format="h264", frame_id=topic)
                    message.timestamp.FromNanoseconds(time_ns)
                    writer.write_message(topic=topic, message=message, log_time=time_ns, publish_time=time_ns)
