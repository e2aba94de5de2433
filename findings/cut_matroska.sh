#!/bin/sh
# A Matroska or WebM video that a broken copy cut short decodes without an error in PyAV 18.1.0: fewer frames
# come back, and nothing says so. The same cut of an MP4 is an error. Who labels recordings by frame gets labels for the
# part that is there, as if the episode had ended.
#
# Seen with av 18.1.0 and numpy 2.3.5, Python 3.11, 60 frames of 64 x 48 in H.264 (WebM: VP9), files cut to 60 %.
# Needs Python 3.11 or newer and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check av==18.1.0 numpy==2.3.5
cd "$folder"
cat > cut.py <<'PYTHON'
import av
import numpy as np

FRAMES, SHARE = 60, 0.6


def write(name: str, codec: str) -> None:
    noise = np.random.default_rng(0)
    with av.open(name, "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(FRAMES):
            picture = noise.integers(0, 256, (48, 64, 3), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture)))
        container.mux(stream.encode())


def decoded(name: str) -> str:
    try:
        with av.open(name) as container:
            return f"{sum(1 for _ in container.decode(video=0))} frames, no error"
    except av.FFmpegError as error:
        return type(error).__name__


seen = {}
for name, codec in {"whole.mp4": "libx264", "whole.mkv": "libx264", "whole.webm": "libvpx-vp9"}.items():
    write(name, codec)
    cut = name.replace("whole", "cut")
    with open(name, "rb") as whole, open(cut, "wb") as part:
        content = whole.read()
        part.write(content[: int(SHARE * len(content))])
    assert decoded(name) == f"{FRAMES} frames, no error"
    seen[cut] = decoded(cut)
    print(f"{cut}: {seen[cut]}")
assert seen["cut.mp4"] == "InvalidDataError", seen
for name in ("cut.mkv", "cut.webm"):
    count, _, told = seen[name].partition(" ")
    assert told == "frames, no error" and 0 < int(count) < FRAMES, seen
PYTHON
"$folder/venv/bin/python" cut.py
