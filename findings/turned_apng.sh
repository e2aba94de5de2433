#!/bin/sh
# An animated PNG whose EXIF data turn it (orientation 6) is decoded in three ways by three releases of PyAV. 15.1.0 gives
# no frame a display matrix; 18.1.0 raises "31 is not a valid Type" when the side data are read; 19.0.2 gives the matrix
# to the first frame alone. Who turns frames by it gets one upright picture and then turned ones, in one video.
#
# Seen with av 15.1.0, 18.1.0 and 19.0.2, numpy 2.3.5, Pillow 12.0.0, Python 3.12, three frames of 16 x 8 pixels.
# Needs Python 3.12 and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > turned.py <<'PYTHON'
import sys

import av
import numpy as np
from PIL import Image

EXPECTED = {
    "15.1.0": "False False False",
    "18.1.0": "ValueError: 31 is not a valid Type",
    "19.0.2": "True False False",
}
ORIENTATION, QUARTER_TURN = 0x0112, 6
exif = Image.Exif()
exif[ORIENTATION] = QUARTER_TURN
first, *others = (Image.fromarray(np.full((8, 16, 3), grey, np.uint8)) for grey in (40, 120, 200))
first.save("turned.png", save_all=True, append_images=others, exif=exif)
with Image.open("turned.png") as picture:
    assert (picture.n_frames, picture.getexif()[ORIENTATION]) == (3, QUARTER_TURN)
with av.open("turned.png") as container:
    try:
        found = " ".join(str(frame.side_data.get("DISPLAYMATRIX") is not None) for frame in container.decode(video=0))
    except ValueError as error:
        found = f"ValueError: {error}"
print(f"av {av.__version__}: {found}")
sys.exit(found != EXPECTED[av.__version__])
PYTHON
for version in 15.1.0 18.1.0 19.0.2; do
  python3 -m venv --clear venv
  venv/bin/pip install --quiet --disable-pip-version-check "av==$version" numpy==2.3.5 pillow==12.0.0
  venv/bin/python turned.py
done
