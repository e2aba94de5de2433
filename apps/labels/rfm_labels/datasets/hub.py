# SPDX-License-Identifier: MIT
"""Files of a dataset on the Hugging Face Hub, downloaded when they are needed. Needs huggingface_hub."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from rfm_client.frames import cached_snapshot, hub_errors
from rfm_client.options import counted
from rfm_labels.datasets.faults import DatasetError

ASK_BYTES = 10e9  # downloads above this need a confirmation
_METADATA = ["meta/*", "meta_data/*"]  # the second: LeRobot v1, which a message names
_NAMES_AT_A_TIME = 500  # per request for sizes


@dataclass(frozen=True)
class DownloadSize:
    """The size of a download. ``str`` tells users."""

    num_files: int
    num_bytes: int

    @property
    def is_large(self) -> bool:
        """True if users are asked first."""
        return self.num_bytes > ASK_BYTES

    def __str__(self) -> str:
        size = f"{self.num_bytes / 1e9:.2f} GB" if self.num_bytes >= 1e9 else f"{self.num_bytes / 1e6:.1f} MB"
        return f"{size} in {counted(self.num_files, 'file')}"


class HubFiles:
    """A dataset's files at one commit.

    name: ``org/name``
    folder: the commit's folder in the Hub's cache, which holds the files downloaded so far
    """

    def __init__(self, name: str, revision: str | None) -> None:
        """Download the metadata. Raises DatasetError, or ImportError without huggingface_hub."""
        self.name = name
        try:
            self.folder = cached_snapshot(name, "dataset", revision, _METADATA)
        except ImportError as error:
            raise ImportError("datasets of the Hub need huggingface-hub: pip install ./client ./apps/labels") from error
        except OSError as error:
            raise DatasetError.at(name, "a local dataset or one of the Hub", f"none: {error}") from error
        self.commit = self.folder.name  # a snapshot's folder is named after the commit
        self._asked: set[str] = set()  # names that were downloaded, or that the Hub lacks

    def sizes(self, files: Iterable[Path]) -> Mapping[str, int]:
        """Return the sizes in bytes of those files that are not here yet but on the Hub, by name. Raises DatasetError.

        files: paths in ``folder``
        """
        names = iter(self._missing(files))
        found: dict[str, int] = {}
        while some := list(islice(names, _NAMES_AT_A_TIME)):
            found |= self._sizes(some)
        return found

    def _sizes(self, names: Sequence[str]) -> Mapping[str, int]:
        from huggingface_hub import HfApi
        from huggingface_hub.hf_api import RepoFile

        with self._fetching(names), hub_errors():
            files = HfApi().get_paths_info(self.name, list(names), repo_type="dataset", revision=self.commit)
        return {file.path: file.size for file in files if isinstance(file, RepoFile)}

    def download(self, files: Iterable[Path]) -> None:
        """Download those files that are not here yet; the Hub may lack some. Raises DatasetError."""
        self._download([glob.escape(name) for name in self._missing(files)])

    def download_folder(self, folder: Path) -> None:
        """Download a folder. Raises DatasetError."""
        self._download([f"{folder.relative_to(self.folder)}/*"])

    def _download(self, patterns: Sequence[str]) -> None:
        if needed := [pattern for pattern in patterns if pattern not in self._asked]:
            with self._fetching(needed):
                cached_snapshot(self.name, "dataset", self.commit, needed)
            self._asked.update(needed)

    def _missing(self, files: Iterable[Path]) -> list[str]:
        return [file.relative_to(self.folder).as_posix() for file in dict.fromkeys(files) if not file.exists()]

    @contextmanager
    def _fetching(self, names: Sequence[str]) -> Iterator[None]:
        """Turn the Hub's errors into DatasetError."""
        try:
            yield
        except OSError as error:
            raise DatasetError.at(self.name, f"{names[0]} and {len(names) - 1} more files", error) from error
