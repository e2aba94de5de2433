# SPDX-License-Identifier: MIT
"""A folder of PNG or JPEG files for each episode, a file for each frame: 2.png before 10.png. Needs Pillow."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rfm_client import UInt8Array
from rfm_client.frames import pillow
from rfm_labels.datasets.episode_files import EpisodeFiles, in_natural_order
from rfm_labels.datasets.frame_names import in_order_of_numbers
from rfm_labels.datasets.protocol import DatasetEpisode, DatasetError, digest_of, require
from rfm_labels.datasets.stored_pictures import check_picture, decoded_picture, turn_mark
from rfm_labels.datasets.video_frames import video_identity

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")

_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
_LEAVE_OUT = "remove it, or leave it out (--episodes)"


class FrameFolders(EpisodeFiles):
    """Episodes in folders of pictures."""

    kind = "folders of frames"
    cameras = ("frames",)

    def length(self, file: Path) -> int:
        return len(_pictures_in(file))

    def decoder(self, camera: str) -> str | None:
        return pillow()

    def identity(self, episode: DatasetEpisode, camera: str, *, verify: bool) -> str:
        files = _pictures_in(self.root / episode.name)
        stored = ((file, video_identity(file, verify=verify)) for file in files)
        return digest_of(f"{file.name} {identity}{turn_mark(file)}".encode() for file, identity in stored)

    def check(self, episode: DatasetEpisode, camera: str) -> int:
        num_bytes = 0
        for file in self._files(episode):
            check_picture(str(file), file)
            num_bytes += file.stat().st_size
        return num_bytes

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        return (decoded_picture(str(file), file) for file in self._files(episode))

    def _files(self, episode: DatasetEpisode) -> list[Path]:
        folder = self.root / episode.name
        files = _pictures_in(folder)
        require(folder, len(files) == episode.num_frames, f"{episode.num_frames} frames", len(files))
        return files


def is_picture(file: Path) -> bool:
    """True for a PNG or JPEG file, by its name; False for a hidden one."""
    return file.suffix.lower() in PICTURE_SUFFIXES and not file.name.startswith(".") and file.is_file()


def _pictures_in(folder: Path) -> list[Path]:
    """The frames of an episode, in order. Raises DatasetError without frames, or for frames of several kinds."""
    try:
        found = [each for each in folder.iterdir() if not each.name.startswith(".")]
    except OSError as error:
        raise DatasetError.at(folder, "a folder of PNG or JPEG files", error.strerror) from error
    names = in_natural_order([each.name for each in found if is_picture(each)])
    folders = in_natural_order([each.name for each in found if each.is_dir()])
    got = f"an empty folder: {_LEAVE_OUT}" if not found else f"other files: {_LEAVE_OUT}"
    if folders:
        remedy = f"list the folders of one camera in tasks.csv ({folder.name}/{folders[0]})"
        got = f"the folders {', '.join(folders[:3])}: {remedy}, or leave it out (--episodes)"
    require(folder, bool(names), "PNG or JPEG files", got)
    by_format = {_FORMATS[Path(name).suffix.lower()]: name for name in reversed(names)}
    told = " and ".join(f"{kind} ({name})" for kind, name in sorted(by_format.items()))
    require(folder, len(by_format) == 1, "frames of one format", f"{told}: give each format a folder of its own")
    return [folder / name for name in in_order_of_numbers(folder, names)]
