# SPDX-License-Identifier: MIT
"""Records of TFRecord files, checked, and the ``tf.train.Example`` in them. Needs ``rfm-labels[rlds]``, no TensorFlow.

A record: uint64 length, CRC of the length, content, CRC of the content; little-endian. A CRC is CRC-32C, rotated by 15
bits, plus a constant. Format: tensorflow/core/lib/io/record_writer.h and tensorflow/core/example/example.proto.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

from rfm_client.options import git_lfs_pointer
from rfm_labels.datasets.faults import DatasetError, require

NEEDED = 'RLDS datasets need google-crc32c and protobuf: pip install ./client "./apps/labels[rlds]"'

_HEAD = struct.Struct("<QI")
_CRC = struct.Struct("<I")
_CRC_CONSTANT = 0xA282EAD8
_AGAIN = "copy or download the file again, or leave the episode out (--episodes)"
_SCHEMA = {  # fields of the messages: name, type, message
    "BytesList": [("value", "BYTES", "")],
    "FloatList": [("value", "FLOAT", "")],
    "Int64List": [("value", "INT64", "")],
    "Feature": [(f"{kind}_list", "MESSAGE", f"{kind.title()}List") for kind in ("bytes", "float", "int64")],
    "FeatureEntry": [("key", "STRING", ""), ("value", "MESSAGE", "Feature")],
    "Features": [("feature", "MESSAGE", "FeatureEntry")],
    "Example": [("features", "MESSAGE", "Features")],
}
_REPEATED = ("BytesList", "FloatList", "Int64List", "Features")


class RecordFile:
    """A TFRecord file with random access. Opening it reads nothing.

    num_records: as the metadata of the dataset say
    """

    def __init__(self, file: Path, num_records: int) -> None:
        self.file = file
        self._num_records = num_records
        self._starts = [0]  # of the records found so far, and of the next

    def record(self, number: int) -> bytes:
        """Return a record. Raises DatasetError if it or a length before it is damaged, or the file has others."""
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
            raise DatasetError.at(self.file, f"a file with {self._num_records} episodes", got) from error
        except OSError as error:
            raise DatasetError.at(self.file, "a readable file", error.strerror) from error

    def _checked(self, opened: BinaryIO, number: int, start: int) -> bytes:
        length = self._length(opened, number, start)
        content, crc = opened.read(length), opened.read(_CRC.size)
        where = f"{self.file}: record {number}"
        require(where, len(crc) == _CRC.size, f"{length} bytes and a CRC", f"the end of the file: {_AGAIN}")
        is_whole = _CRC.unpack(crc)[0] == _masked_crc(content)
        require(where, is_whole, "content of the stored CRC", f"another: the file is damaged; {_AGAIN}")
        has_more = number == self._num_records - 1 and bool(opened.read(1))
        got = "more: the file is not the one of dataset_info.json; copy or download both again"
        require(self.file, not has_more, f"{self._num_records} records, as dataset_info.json says", got)
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
    """Raise ImportError without the packages that read records."""
    try:
        import google.protobuf  # noqa: F401
        import google_crc32c  # noqa: F401
    except ImportError as error:
        raise ImportError(NEEDED) from error


def features_of(record: bytes, where: object) -> Mapping[str, Any]:
    """Return the features of a ``tf.train.Example`` by name, as messages ``Feature``. Raises DatasetError."""
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
    """The message type, in a pool of its own: TensorFlow in the same process registers the same names."""
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
