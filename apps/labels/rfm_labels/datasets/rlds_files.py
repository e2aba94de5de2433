# SPDX-License-Identifier: MIT
"""Read RLDS files, as written by TensorFlow Datasets. Needs ``rfm-labels[rlds]``, no TensorFlow.

The metadata are in ``dataset_info.json`` and ``features.json``. An episode is one record in a TFRecord file: uint64
length, length CRC, content, content CRC; little-endian. A CRC is CRC-32C, rotated by 15 bits, plus a constant. The
content is a ``tf.train.Example``.

Format: tensorflow/core/lib/io/record_writer.h and tensorflow/core/example/example.proto.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

from rfm_client.options import git_lfs_pointer
from rfm_labels.datasets.dataset import LEAST_SIZE_PX
from rfm_labels.datasets.faults import DatasetError, json_object, require

NEEDED = 'RLDS datasets need google-crc32c and protobuf: pip install ./client "./apps/labels[rlds]"'
_HEAD = struct.Struct("<QI")
_CRC = struct.Struct("<I")
_CRC_CONSTANT = 0xA282EAD8
_AGAIN = "copy or download the file again, or leave the episode out (--episodes)"
_SCHEMA = {  # message fields: name, type, message
    "BytesList": [("value", "BYTES", "")],
    "FloatList": [("value", "FLOAT", "")],
    "Int64List": [("value", "INT64", "")],
    "Feature": [(f"{kind}_list", "MESSAGE", f"{kind.title()}List") for kind in ("bytes", "float", "int64")],
    "FeatureEntry": [("key", "STRING", ""), ("value", "MESSAGE", "Feature")],
    "Features": [("feature", "MESSAGE", "FeatureEntry")],
    "Example": [("features", "MESSAGE", "Features")],
}
_REPEATED = ("BytesList", "FloatList", "Int64List", "Features")
FEATURES_FILE = "features.json"
INSTRUCTIONS = ("natural_language_instruction", "language_instruction", "instruction")  # as upstream's guide reads them
_INFO_FILE = "dataset_info.json"
_OBSERVATION = "steps/observation/"
_TEMPLATE = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
_COLOURS = "3 channels of uint8"
_INSTRUCTION = re.compile(rf"({'|'.join(INSTRUCTIONS)})(?:_(\d+))?")  # DROID numbers further sentences


class RecordFile:
    """A TFRecord file with random access. Opening it reads nothing.

    num_records: according to the dataset's metadata
    """

    def __init__(self, file: Path, num_records: int) -> None:
        self.file = file
        self.num_records = num_records
        self._starts = [0]  # offsets of the records found so far, and of the next

    def record(self, number: int) -> bytes:
        """Return a record. Raises DatasetError for a damaged record, a damaged length before it, or extra records."""
        try:
            with self.file.open("rb") as opened:
                starts = list(self._starts)  # a copy, since threads share the file
                for before in range(len(starts) - 1, number):
                    length = self._length(opened, before, starts[before])
                    starts.append(starts[before] + _HEAD.size + length + _CRC.size)
                self._starts = starts
                return self._checked(opened, number, starts[number])
        except FileNotFoundError as error:
            got = "none: copy or download it, or leave its episodes out (--episodes)"
            raise DatasetError.at(self.file, f"a file with {self.num_records} episodes", got) from error
        except OSError as error:
            raise DatasetError.at(self.file, "a readable file", error.strerror) from error

    def _checked(self, opened: BinaryIO, number: int, start: int) -> bytes:
        length = self._length(opened, number, start)
        content, crc = opened.read(length), opened.read(_CRC.size)
        where = f"{self.file}: record {number}"
        require(where, len(crc) == _CRC.size, f"{length} bytes and a CRC", f"the end of the file: {_AGAIN}")
        is_whole = _CRC.unpack(crc)[0] == _masked_crc(content)
        require(where, is_whole, "content of the stored CRC", f"another: the file is damaged; {_AGAIN}")
        has_more = number == self.num_records - 1 and bool(opened.read(1))
        got = "more: the file is not the one of dataset_info.json; copy or download both again"
        require(self.file, not has_more, f"{self.num_records} records, as dataset_info.json says", got)
        return content

    def _length(self, opened: BinaryIO, number: int, start: int) -> int:
        opened.seek(start)
        head = opened.read(_HEAD.size)
        where = f"{self.file}: record {number}"
        require(where, len(head) == _HEAD.size, "a record", f"the end of the file: {_AGAIN}")
        length, crc = _HEAD.unpack(head)
        if crc != _masked_crc(head[:8]):
            got = git_lfs_pointer(self.file) or f"another: the file is damaged; {_AGAIN}"
            raise DatasetError.at(where, "a length of the stored CRC", got)
        return int(length)


def check_packages() -> None:
    """Raise ImportError if the packages for reading records are missing."""
    try:
        import google.protobuf  # noqa: F401
        import google_crc32c  # noqa: F401
    except ImportError as error:
        raise ImportError(NEEDED) from error


def features_of(record: bytes, where: object) -> Mapping[str, Any]:
    """Return the ``Feature`` messages in a ``tf.train.Example`` by name. Raises DatasetError."""
    from google.protobuf.message import DecodeError

    example = _example_type()()
    try:
        example.ParseFromString(record)
    except DecodeError as error:
        raise DatasetError.at(where, "a tf.train.Example", error) from error
    return {entry.key: entry.value for entry in example.features.feature}


def _masked_crc(content: bytes) -> int:
    import google_crc32c

    crc = int(google_crc32c.value(content))
    return ((crc >> 15 | crc << 17) + _CRC_CONSTANT) & 0xFFFFFFFF


@lru_cache
def _example_type() -> Any:
    """The message type, in a private pool: TensorFlow in the same process registers the same names."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="example.proto", package="rfm", syntax="proto3")
    for name, fields in _SCHEMA.items():
        message = file.message_type.add(name=name)
        for number, (of, kind, other) in enumerate(fields, 1):
            label = field.LABEL_REPEATED if name in _REPEATED else field.LABEL_OPTIONAL
            added = message.field.add(name=of, number=number, label=label, type=field.Type.Value(f"TYPE_{kind}"))
            if other:
                added.type_name = f".rfm.{other}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("rfm.Example"))


@dataclass(frozen=True)
class RldsInfo:
    """What the metadata say.

    source: name and version
    files: files with their splits, in split order
    cameras: 8-bit colour picture features, by name below ``steps/observation``
    left_out: other pictures there, with the reason
    instructions: features that hold the task, per step or per episode, best first
    notes: lines for the caller
    """

    source: str
    files: Sequence[tuple[str, RecordFile]]
    cameras: Mapping[str, str]
    left_out: Mapping[str, str]
    instructions: Sequence[str]
    notes: Sequence[str]

    @classmethod
    def read(cls, root: Path, task_column: str | None = None) -> RldsInfo:
        """Read the metadata in ``root``. Raises DatasetError.

        task_column: feature with the task, or the last part of its path; None: those in ``INSTRUCTIONS``
        """
        info = json_object(root / _INFO_FILE)
        features = _features(root / FEATURES_FILE)
        shown = {name.removeprefix(_OBSERVATION): each for name, each in features.items() if _shown(name, each)}
        faults = {name: _fault(each) for name, each in shown.items()}
        cameras = {name: _OBSERVATION + name for name, fault in faults.items() if not fault}
        reasons = "; ".join(f"{name}: {fault}" for name, fault in faults.items()) or "none"
        require(f"{root / FEATURES_FILE}: {_OBSERVATION}", bool(cameras), f"a picture with {_COLOURS}", reasons)
        texts = [name for name, each in features.items() if _is_text(each)]
        instructions = sorted(filter(_rank, texts), key=_rank)
        if task_column is not None:
            instructions = [name for name in texts if task_column in (name, name.split("/")[-1])][:1]
            require("task_column", bool(instructions), f"one of {', '.join(texts)}", repr(task_column))
        first, *others = instructions or [""]
        return cls(
            source=f"{info.get('name')}/{info.get('version')}",
            files=_files(root, info),
            cameras=cameras,
            left_out={name: fault for name, fault in faults.items() if fault},
            instructions=instructions,
            notes=[f"tasks: from {first}, where it is blank from {', '.join(others)}"] if others else [],
        )


def _files(root: Path, info: Mapping[str, Any]) -> list[tuple[str, RecordFile]]:
    where, kind = root / _INFO_FILE, info.get("fileFormat", "tfrecord")
    remedy = f"{kind}: write it again with file_format='tfrecord' (tfds convert_format)"
    require(f"{where}: fileFormat", kind == "tfrecord", "tfrecord", remedy)
    splits = info.get("splits")
    require(f"{where}: splits", isinstance(splits, list) and bool(splits), "at least one split", splits)
    return [file for split in splits or () for file in _files_of(root, str(info.get("name")), split)]


def _files_of(root: Path, dataset: str, split: Any) -> Iterator[tuple[str, RecordFile]]:
    where = f"{root / _INFO_FILE}: splits"
    is_known = isinstance(split, dict) and isinstance(split.get("shardLengths"), list) and bool(split.get("name"))
    require(where, is_known, "name and shardLengths of each split", split)
    lengths, template = split["shardLengths"], str(split.get("filepathTemplate") or _TEMPLATE)
    for number, length in enumerate(lengths):
        index, total = f"{number:05d}", f"{len(lengths):05d}"
        words = {"DATASET": dataset, "SPLIT": split["name"], "FILEFORMAT": "tfrecord", "SHARD_INDEX": index}
        words |= {"NUM_SHARDS": total, "SHARD_X_OF_Y": f"{index}-of-{total}"}
        name = template
        for word, value in words.items():
            name = name.replace(f"{{{word}}}", value)
        require(f"{where}: {split['name']}", Path(name).name == name, "files in the folder of the version", name)
        is_count = str(length).isdecimal()
        require(f"{where}: {split['name']}: shardLengths", is_count, "a number of episodes", repr(length))
        yield split["name"], RecordFile(root / name, int(length))


def _features(file: Path) -> Mapping[str, Mapping[str, Any]]:
    """The features with values, by path. Raises DatasetError."""
    expected = "features as TensorFlow Datasets 4.6 or later writes them"
    try:
        features = dict(_leaves(json_object(file)))
        for feature in features.values():
            _shape(feature.get("image", feature.get("tensor", {})))
    except (AttributeError, TypeError, ValueError) as error:
        raise DatasetError.at(file, expected, f"{error}: copy the file again") from error
    require(file, bool(features), expected, "none: write the dataset again with a later version")
    return features


def _leaves(feature: Any, name: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Features with values by path, such as ``steps/observation/image``."""
    if not isinstance(feature, dict):
        return
    if name == "steps" and "sequence" in feature:
        yield from _leaves(feature["sequence"].get("feature"), name)
    elif "featuresDict" in feature:
        for key, each in feature["featuresDict"].get("features", {}).items():
            yield from _leaves(each, f"{name}/{key}".lstrip("/"))
    elif name:
        yield name, feature


def _shown(name: str, feature: Mapping[str, Any]) -> bool:
    """True if the observation may be a picture."""
    shape = _shape(feature.get("tensor", {}))
    is_array = len(shape) in (2, 3) and all(size >= LEAST_SIZE_PX for size in shape[:2])
    return name.startswith(_OBSERVATION) and ("image" in feature or "video" in feature or is_array)


def _shape(value: Mapping[str, Any]) -> list[int]:
    return [int(size) for size in value.get("shape", {}).get("dimensions", ())]


def _fault(feature: Mapping[str, Any]) -> str:
    """Why a feature is no camera; empty if it is one."""
    if "image" not in feature:
        return "an array or a video: expected a JPEG or PNG file for each step"
    image = feature["image"]
    kind, shape = image.get("dtype", "uint8"), _shape(image)
    is_colour = kind == "uint8" and shape[-1:] == [3]
    return "" if is_colour else f"{kind} {shape}: expected {_COLOURS}"


def _rank(name: str) -> tuple[int, ...]:
    """Sort key that puts the best instruction first; empty for other features."""
    match = _INSTRUCTION.fullmatch(name.split("/")[-1])
    if match is None:
        return ()
    return int(match[2] or 0), INSTRUCTIONS.index(match[1]), not name.startswith("steps/"), name.count("/")


def _is_text(feature: Mapping[str, Any]) -> bool:
    return "text" in feature or feature.get("tensor", {}).get("dtype") == "string"
