# SPDX-License-Identifier: MIT
"""Check a reader on recordings: call it twice, decode frames twice, and compare.

python examples/check_reader.py my_reader.py:episodes recordings
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from rfm_labels import DatasetError, open_dataset
from rfm_labels.datasets.readers import read_episodes


def check(reader: str, folder: Path, num_decoded: int = 3) -> list[str]:
    """Return a line for each episode. Raises DatasetError for what changes, and for what a label run refuses.

    num_decoded: of so many episodes, spread over all of them, all frames are decoded
    """
    first, second = (open_dataset(folder, reader=reader, task="any", override_task=True) for _ in range(2))
    told = list(read_episodes(reader, folder))
    names = [[episode.name for episode in dataset.episodes] for dataset in (first, second)]
    if names[0] != names[1]:
        raise DatasetError.at(reader, f"the same episodes each time: {names[0]}", names[1])
    decoded = set(np.linspace(0, len(names[0]) - 1, num_decoded).round().astype(int).tolist())
    lines = []
    for episode in first.episodes:
        cameras, _ = first.cameras_in([episode.index])
        for camera in cameras:
            first.check(episode, camera)
            if episode.index not in decoded:
                continue
            shown = [np.stack(list(dataset.frames(episode, camera))) for dataset in (first, first, second)]
            if not (np.array_equal(shown[0], shown[1]) and np.array_equal(shown[0], shown[2])):
                raise DatasetError.at(f"{episode.name}: {camera}", "the same frames each time", "others")
        own = told[episode.index]
        about = f"task {own.task!r}, fps {own.fps}, success {own.success}"
        lines.append(f"{episode.name}: {episode.num_frames} frames of {', '.join(cameras)}; {about}")
    return lines


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python examples/check_reader.py my_reader.py:episodes FOLDER")
    try:
        print(*check(sys.argv[1], Path(sys.argv[2])), sep="\n")
    except DatasetError as error:
        sys.exit(str(error))
