# SPDX-License-Identifier: MIT
"""Refuse LeRobot video files that hold more than one episode.

Up to v2.1, each episode and camera has its own video. Since v3.0, a file holds many episodes in a row. Read as a single
video, it would be scored as a long episode. It is refused unless the dataset has only this episode. A file of one
episode may still have frames without a row, such as those of a discarded take, and is refused, too. Tables are not
read, because that needs pyarrow.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.frames.pictures import FrameFileError
from rfm_client.frames.video_decoding import import_av, read_packets

_INSTEAD = (
    "label the dataset with rfm-client label, or name the part of the file that is one episode: start_s and end_s of "
    "load_trajectory, in seconds since the first frame of the file (from_timestamp in meta/episodes, else 0, and "
    "length / fps later)"
)
_EPISODE = re.compile(r"episode_(\d+)")  # name of such a video
_VIDEO_AN_EPISODE = re.compile(r"v[12]\.")
_SHARED_FILE = re.compile(r"/videos/[^/]+/chunk-\d+/file-\d+\.\w+$")  # the layout of v3.0


def check_local_video(source: str | Path) -> None:
    """Raise InvalidSampleError for a file in which a LeRobot dataset keeps several episodes, or one and other frames.

    The layout of its path decides if no folder above it has a dataset's ``meta/info.json``.
    """
    given = Path(source).absolute()
    for file in dict.fromkeys((given, given.resolve())):  # a download may consist of links into a cache
        for folder in file.parents:
            info = _info(folder / "meta" / "info.json")
            if info is not None:
                _check_dataset(info, file, folder)
                return
    _check_layout(given.as_posix())


def check_video_behind(url: str) -> None:
    """Raise InvalidSampleError if a URL's path has the layout of a file of several episodes."""
    _check_layout(unquote(urlsplit(url).path))


def _check_layout(path: str) -> None:
    if _SHARED_FILE.search(path):
        raise _refusal("a file in the layout of LeRobot v3.0, which holds many episodes")


def _info(file: Path) -> dict[str, object] | None:
    """The metadata of a LeRobot dataset; None: the folder holds no such dataset."""
    try:
        info = json.loads(file.read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidSampleError.at("meta/info.json", "a readable JSON file", f"{error} ({file})") from error
    return info if isinstance(info, dict) and "codebase_version" in info else None


def _check_dataset(info: dict[str, object], video: Path, root: Path) -> None:
    version, total = info["codebase_version"], info.get("total_episodes")
    if (isinstance(version, str) and _VIDEO_AN_EPISODE.match(version)) or total == 1:
        length = info.get("total_frames") if total == 1 else _length(root / "meta" / "episodes.jsonl", video)
        count = _num_frames(video)
        if isinstance(length, int) and count is not None and count > length:
            raise _refusal(f"{count} frames, of which the episode has {length}")
        return
    of_camera = root / Path(*video.relative_to(root).parts[:2])  # videos/<camera>
    files = [file for file in of_camera.rglob(f"*{video.suffix}") if file.is_file()]
    held = f"{total}" if files == [video] else f"some of the dataset's {total}"
    raise _refusal(f"a LeRobot {version} file that holds {held} episodes")


def _length(file: Path, video: Path) -> object:
    """The length of the episode in a video, as a file of JSON lines tells it; None: it does not."""
    name = _EPISODE.fullmatch(video.stem)
    if name is None:
        return None
    try:
        lines = [json.loads(line) for line in file.read_text(encoding="utf-8").split("\n") if line.strip()]
    except (OSError, ValueError, RecursionError):  # the labels' reader tells of it
        return None
    told = {line.get("episode_index"): line.get("length") for line in lines if isinstance(line, dict)}
    return told.get(int(name[1]))


def _num_frames(video: Path) -> int | None:
    """The number of frames of a video; None: it cannot be read, which its reader tells."""
    try:
        with video.open("rb") as file:
            return read_packets(file).count
    except (FrameFileError, import_av().FFmpegError, OSError):
        return None


def _refusal(got: str) -> InvalidSampleError:
    return InvalidSampleError.at("video", "a video of one episode", f"{got}: {_INSTEAD}")
