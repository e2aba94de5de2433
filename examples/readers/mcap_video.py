# SPDX-License-Identifier: MIT
"""MCAP files with topics of foxglove.CompressedVideo in H.264, a file for each episode.

pip install mcap mcap-protobuf-support av
rfm-client label recordings --task "..." --reader examples/readers/mcap_video.py:episodes
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import av
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from rfm_client import UInt8Array
from rfm_labels import Episode


def episodes(folder: Path) -> Iterator[Episode]:
    """Yield each file, with a camera for each topic of videos."""
    for file in sorted(folder.glob("*.mcap")):
        with file.open("rb") as opened:
            summary = make_reader(opened).get_summary()
        videos = {each.id for each in summary.schemas.values() if each.name == "foxglove.CompressedVideo"}
        topics = [each.topic for each in summary.channels.values() if each.schema_id in videos]
        yield Episode(file.stem, {topic: partial(frames, file, topic) for topic in topics})


def frames(file: Path, topic: str) -> Iterator[UInt8Array]:
    """Decode a topic's frames."""
    decoder = av.CodecContext.create("h264", "r")
    with file.open("rb") as opened:
        for message in make_reader(opened, decoder_factories=[DecoderFactory()]).iter_decoded_messages([topic]):
            for frame in decoder.decode(av.Packet(message.decoded_message.data)):
                yield frame.to_ndarray(format="rgb24")
    yield from (frame.to_ndarray(format="rgb24") for frame in decoder.decode(None))
