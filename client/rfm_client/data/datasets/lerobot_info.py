# SPDX-License-Identifier: MIT
"""``meta/info.json`` of a LeRobot dataset: its version, cameras, frame rate and where its files are."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from rfm_client.data.datasets.other_layouts import described
from rfm_client.data.datasets.protocol import DatasetError

INFO_FILE = Path("meta", "info.json")
VERSIONS = ("v2.0", "v2.1", "v3.0")

_OF_PICTURES = ("info", "video_info")  # what a feature says of its pictures, by the version of the writer
_DEPTH_MARKS = ("video.is_depth_map", "is_depth_map")


@dataclass(frozen=True)
class Info:
    """What a LeRobot dataset says of itself.

    films, images: keys of its cameras whose frames are in video files, and of those whose frames are in its tables
    depth: keys of those of both whose pictures are depth maps
    total_frames: of all episodes
    data_path, video_path: templates of the paths of its files
    """

    version: str
    fps: float
    films: tuple[str, ...]
    images: tuple[str, ...]
    depth: tuple[str, ...]
    total_episodes: int
    total_frames: int
    chunks_size: int
    data_path: str
    video_path: str | None

    @classmethod
    def read(cls, root: Path) -> Info:
        """The information in ``root``. Raises DatasetError."""
        file = root / INFO_FILE
        if not file.exists():
            raise DatasetError.at(file, "a LeRobot dataset's meta/info.json", described(root) or "none")
        document = _read_json(file)
        features = _field(file, document, "features", dict)
        kinds = {key: feature.get("dtype") for key, feature in features.items() if isinstance(feature, dict)}
        version = _field(file, document, "codebase_version", str)
        if version not in VERSIONS:
            raise DatasetError.at(f"{file}: codebase_version", f"one of {', '.join(VERSIONS)}", repr(version))
        fps = float(_field(file, document, "fps", (int, float)))
        if not 0 < fps < math.inf:
            raise DatasetError.at(f"{file}: fps", "a number above 0", repr(fps))
        films = tuple(key for key, kind in kinds.items() if kind == "video")
        return cls(
            version=version,
            fps=fps,
            films=films,
            images=tuple(key for key, kind in kinds.items() if kind == "image"),
            depth=tuple(key for key, kind in kinds.items() if kind in ("video", "image") and _is_depth(features[key])),
            total_episodes=_field(file, document, "total_episodes", int),
            total_frames=_field(file, document, "total_frames", int),
            chunks_size=_field(file, document, "chunks_size", int),
            data_path=_field(file, document, "data_path", str),
            video_path=_field(file, document, "video_path", str) if films else None,
        )

    def path(self, root: Path, template: str | None, **values: Any) -> Path:
        """The file that a template names, inside ``root``. Raises DatasetError."""
        try:
            path = (template or "").format(**values)
        except (LookupError, ValueError) as error:
            raise DatasetError.at(INFO_FILE, f"a path of {', '.join(values)}", repr(template)) from error
        if not path or Path(path).is_absolute() or ".." in Path(path).parts:
            raise DatasetError.at(INFO_FILE, "a path inside the dataset", repr(path))
        return root / path


def _is_depth(feature: Mapping[str, Any]) -> bool:
    told = [feature[name] for name in _OF_PICTURES if isinstance(feature.get(name), dict)]
    return any(each.get(mark) is True for each in told for mark in _DEPTH_MARKS)


def _read_json(file: Path) -> Mapping[str, Any]:
    try:
        document = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError.at(file, "a readable JSON file", str(error)) from error
    if not isinstance(document, dict):
        raise DatasetError.at(file, "a JSON object", type(document).__name__)
    return document


def _field(file: Path, document: Mapping[str, Any], name: str, kind: Any) -> Any:
    value = document.get(name)
    if not isinstance(value, kind) or isinstance(value, bool):
        kinds = cast("tuple[type, ...]", kind if isinstance(kind, tuple) else (kind,))
        expected = " or ".join(each.__name__ for each in kinds)
        raise DatasetError.at(f"{file}: {name}", expected, "none" if value is None else repr(value))
    return value
