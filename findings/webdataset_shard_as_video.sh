#!/bin/sh
# A WebDataset shard, a tar of JPEG and JSON files such as robot recordings are shipped in, opens as a video: FFmpeg scans
# for the first bytes of JPEG, calls the tar "mjpeg" and decodes the pictures of all cameras as one video of 25 frames a
# second, in the order of the tar. No error, no warning, and no mark on a frame. The suffix does not matter. Who gives a
# reader of videos the wrong path gets cameras and episodes that alternate.
#
# Seen with av 15.1.0, 18.1.0 and 19.0.2, webdataset 1.0.2, Python 3.12: two cameras of two steps give four frames, front,
# wrist, front, wrist. Needs Python 3.12 and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > shard.py <<'PYTHON'
import io
import sys

import av
import numpy as np
import webdataset
from PIL import Image

LEVELS = {"front": 60, "wrist": 180}


def jpeg(level):
    content = io.BytesIO()
    Image.fromarray(np.full((16, 16, 3), level, np.uint8)).save(content, "JPEG")
    return content.getvalue()


with webdataset.TarWriter("shard.tar") as shard:
    for step in range(2):
        pictures = {f"{camera}.jpg": jpeg(level) for camera, level in LEVELS.items()}
        shard.write({"__key__": f"{step:06d}", **pictures, "step.json": {"step": step}})
with av.open("shard.tar") as container:
    kind, rate = container.format.name, container.streams.video[0].average_rate
    frames = list(container.decode(video=0))
found = kind, float(rate), [round(float(frame.to_ndarray(format="rgb24").mean())) for frame in frames]
print(f"av {av.__version__}: {found}, corrupt: {[frame.is_corrupt for frame in frames]}")
expected = "mjpeg", 25.0, [*LEVELS.values()] * 2
sys.exit(found != expected or any(frame.is_corrupt for frame in frames))
PYTHON
for version in 15.1.0 18.1.0 19.0.2; do
  python3 -m venv --clear venv
  venv/bin/pip install --quiet --disable-pip-version-check "av==$version" webdataset==1.0.2 numpy==2.3.5 pillow==12.0.0
  venv/bin/python shard.py
done
