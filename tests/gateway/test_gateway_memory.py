# SPDX-License-Identifier: MIT
"""What requests may make the gateway hold in memory. Without a server: nothing of this reaches one."""

from __future__ import annotations

import asyncio
import json
import tracemalloc
from collections.abc import Iterator
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi import HTTPException
from fastapi.exceptions import RequestValidationError
from PIL import Image
from starlette.datastructures import UploadFile
from starlette.requests import Request

from rfm_client.contract.model_info import ModelInfo
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.loop_thread import LoopThread
from rfm_gateway.body import MAX_SAMPLES, NPY_ENDPOINT, BodyLimits, read_json, read_multipart
from rfm_gateway.body import _of_form as of_form
from rfm_gateway.body import _of_json as of_json
from rfm_gateway.conversion import Conversion, Served
from rfm_gateway.folder import AllowedFolder, NamedFiles
from rfm_gateway.memory import Memory
from rfm_gateway.schema import SAMPLES

KIB, MIB = 2**10, 2**20
WAIT_S = 30
ROOM_BYTES = 2**40
NUMBERS = np.random.default_rng(0).standard_normal((64, 768)).tolist()


def of(field: str, array: str) -> bytes:
    return b'[{"sample_type": "progress", "trajectory": {"%b": %b}}]' % (field.encode(), array.encode())


def many(value: str, size: int = MIB) -> str:
    return f"[{','.join([value] * (size // (len(value) + 1)))}]"


BODIES = {
    "numbers": of("video_embeddings", json.dumps(NUMBERS)),
    "short numbers": of("video_embeddings", f"[{many('1e1')}]"),
    "digits": of("frames", f"[[{many('[0,0,0]')}]]"),
    "rows of one": of("video_embeddings", many("[5.1]")),
    "empty lists": of("metadata", many("[]")),
    "empty lists for samples": many("[]").encode(),
    "numbers for samples": many("5").encode(),
    "empty objects": of("metadata", many("{}")),
    "empty objects for samples": many("{}").encode(),
    "objects": of("metadata", many('{"":1}')),
    "objects of many keys": of("metadata", many(json.dumps({f"k{i}": 300 + i for i in range(43)}))),
    "other keys": of("metadata", json.dumps({f"{i:x}": None for i in range(90_000)})),
    "words": of("metadata", json.dumps([f"{i:x}" for i in range(120_000)])),
    "wide words": of("metadata", json.dumps("\U0001f916" + "a" * MIB)),
    "wide words in UTF-8": of("metadata", json.dumps("\U0001f916" + "a" * MIB, ensure_ascii=False)).replace(b" ", b""),
    "samples without anything": many('{"sample_type":"progress","trajectory":{}}').encode(),
    "samples of errors": many('{"sample_type":"progress","trajectory":{"task":1,"frames":1}}', MIB // 2).encode(),
}


@pytest.mark.parametrize("body", BODIES.values(), ids=BODIES)
def test_json_takes_no_more_memory_than_it_is_counted_for(body: bytes) -> None:
    with Memory(ROOM_BYTES).share() as share:
        tracemalloc.start()
        try:
            of_json(body, share)
        except RequestValidationError:
            pass
        finally:
            _, peak_bytes = tracemalloc.get_traced_memory()
            tracemalloc.stop()
        assert peak_bytes <= share.held_bytes + MIB


def test_a_file_of_numbers_is_read_once_however_often_it_is_named() -> None:
    content = BytesIO()
    np.save(content, np.zeros((MIB // 8, 1)))
    sample = {"sample_type": "progress", "trajectory": {"video_embeddings": {"__numpy_file__": "array"}}}
    fields = {f"sample_{number}": json.dumps(sample) for number in range(40)}
    upload = UploadFile(content, size=content.tell())
    with Memory(ROOM_BYTES).share() as share:
        tracemalloc.start()
        batch = of_form(fields, {"array": upload}, share)
        _, peak_bytes = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak_bytes <= MIB + share.held_bytes + MIB
    assert len(batch.samples) == 40


def test_a_field_of_letters_that_no_text_has_is_refused() -> None:
    with Memory(ROOM_BYTES).share() as share, pytest.raises(RequestValidationError, match="expected JSON"):
        of_form({"sample_0": "\udc00"}, {}, share)


def test_words_for_numbers_are_refused_before_numpy_sees_them() -> None:
    """It would make an array each of whose elements is as wide as the longest."""
    body = of("video_embeddings", json.dumps(["a" * 20_000, *["b"] * 10_000]))
    tracemalloc.start()
    try:
        with Memory(ROOM_BYTES).share() as share, pytest.raises(RequestValidationError) as refused:
            of_json(body, share)
        assert tracemalloc.get_traced_memory()[1] < 10 * MIB
    finally:
        tracemalloc.stop()
    (told,) = refused.value.errors()
    assert told["msg"] == "expected numbers, got something else"


def test_more_samples_than_are_told_of_are_refused() -> None:
    with Memory(ROOM_BYTES).share() as share, pytest.raises(RequestValidationError) as refused:
        of_json(b"[%b5]" % (b"5," * MAX_SAMPLES), share)
    (told,) = refused.value.errors()
    assert told["msg"] == f"expected at most {MAX_SAMPLES} samples, got {MAX_SAMPLES + 1}"


def request_of(body: bytes) -> Request:
    async def receive() -> Any:
        return {"type": "http.request", "body": body}

    return Request({"type": "http", "method": "POST", "path": "/evaluate_batch", "headers": []}, receive)


@pytest.fixture
def loop() -> Iterator[LoopThread]:
    thread = LoopThread("requests")
    yield thread

    async def nothing() -> None:
        pass

    thread.stop(nothing)


def refusal(loop: LoopThread, limits: BodyLimits, body: bytes) -> tuple[int, str]:
    with limits.admitted(request_of(body)) as admitted, pytest.raises(HTTPException) as refused:
        loop.wait(read_json(admitted))
    return refused.value.status_code, refused.value.detail


def test_bodies_count_as_what_they_become(loop: LoopThread) -> None:
    limits = BodyLimits(MIB, 32 * MIB)
    numbers = of("video_embeddings", json.dumps(NUMBERS[:32]))
    count = 0
    with ExitStack() as held, pytest.raises(HTTPException, match="503: body: expected room for it") as refused:
        while count < 100:
            loop.wait(read_json(held.enter_context(limits.admitted(request_of(numbers)))))
            count += 1
    assert refused.value.headers == {"Retry-After": "1"}
    assert 10 < count < 40  # 32 MiB; a body is half of one, and takes twice as much
    with limits.admitted(request_of(numbers)) as admitted:  # what was held is free again
        loop.wait(read_json(admitted))
    too_large = of("metadata", many("{}", MIB - KIB))
    expected = "body: expected one that takes at most 33554432 bytes of memory, got more"
    assert refusal(loop, limits, too_large) == (413, expected)


def test_a_largest_body_of_black_pixels_has_room() -> None:
    with BodyLimits(MIB, 32 * MIB).admitted(request_of(b"")) as admitted:
        of_json(of("frames", f"[[{many('[0,0,0]', MIB - KIB)}]]"), admitted.share)


def form_of(parts: int, headers: bytes = b"") -> Request:
    names = (b'--b\r\nContent-Disposition: form-data; name="p%d"; filename="p"\r\n' % number for number in range(parts))
    body = b"".join(name + headers + b"\r\n1\r\n" for name in names) + b"--b--\r\n"

    async def receive() -> Any:
        return {"type": "http.request", "body": body}

    content_type = [(b"content-type", b"multipart/form-data; boundary=b")]
    return Request({"type": "http", "method": "POST", "path": NPY_ENDPOINT, "headers": content_type}, receive)


@pytest.mark.parametrize(("parts", "headers"), [(1_000, b""), (100, b"a: b\r\n" * 6)], ids=["parts", "headers"])
def test_parts_take_no_more_memory_than_they_are_counted_for(loop: LoopThread, parts: int, headers: bytes) -> None:
    with BodyLimits(ROOM_BYTES, ROOM_BYTES).admitted(form_of(parts, headers)) as admitted:
        tracemalloc.start()
        try:
            with pytest.raises(RequestValidationError, match="expected at least one sample"):
                loop.wait(read_multipart(admitted))
            _, peak_bytes = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak_bytes <= admitted.share.held_bytes + MIB


def test_parts_that_take_too_much_memory_are_refused(loop: LoopThread) -> None:
    with BodyLimits(2 * MIB, 2 * MIB).admitted(form_of(2_000)) as admitted, pytest.raises(HTTPException) as refused:
        loop.wait(read_multipart(admitted))
    assert refused.value.status_code == 413


def test_a_request_waits_for_memory_that_others_hold(loop: LoopThread) -> None:
    memory = Memory(2 * MIB)

    async def waits() -> None:
        with memory.share() as late:
            with memory.share() as early:
                await early.reserve(MIB, Deadline(WAIT_S))
                early.take(MIB)
                assert early.held_bytes == MIB
                waiting = asyncio.create_task(late.reserve(2 * MIB, Deadline(WAIT_S)))
                await asyncio.sleep(0)
                assert not waiting.done()
            await waiting
            late.take(2 * MIB)
            with memory.share() as other, pytest.raises(HTTPException, match="503: body: expected room for it in time"):
                await other.reserve(1, Deadline(0.01))
            with pytest.raises(HTTPException, match="413"):
                late.take(1)

    loop.wait(waits())


# Files that a request names

INFO = ModelInfo("rfm", ("1",), 64, None, None, video_dim=None, text_dim=None, progress_bins=None)


@pytest.fixture
def shelf(tmp_path: Path) -> Path:
    """Images and embeddings of a MiB each, of which one is small as it lies there."""
    Image.fromarray(np.zeros((512, 683, 3), np.uint8)).save(tmp_path / "black.png")
    embeddings = np.zeros((256, 1024), np.float32)
    np.save(tmp_path / "plain.npy", embeddings)
    np.savez_compressed(tmp_path / "packed.npz", video_embeddings=embeddings, text_embedding=embeddings[0])
    assert (tmp_path / "packed.npz").stat().st_size < 100 * KIB
    return tmp_path


def convert(shelf: Path, memory: Memory, *trajectories: dict[str, Any]) -> None:
    """As one request, which may name files of 2.5 MiB together."""
    samples = [{"sample_type": "progress", "trajectory": {"task": "lift", **each}} for each in trajectories]
    with memory.share() as share:
        files = NamedFiles(AllowedFolder(shelf, 5 * MIB // 2), share)
        texts = {"lift": np.zeros(4, np.float32)}
        Conversion(Served(INFO, INFO), texts, files, 0).samples(SAMPLES.validate_python(samples, context={}))


ONE, PLAIN, PACKED = {"frames": ["black.png"]}, {"embeddings_path": "plain.npy"}, {"embeddings_path": "packed.npz"}
SETS = {
    "images": ([ONE] * 2, [ONE] * 3, "frames"),
    "images of one trajectory": ([{"frames": ["black.png"] * 2}], [{"frames": ["black.png"] * 3}], "frames"),
    "arrays": ([PLAIN] * 2, [PLAIN] * 3, "embeddings_path"),
    "packed arrays": ([PACKED] * 2, [PACKED] * 3, "embeddings_path"),
    "both": ([ONE, PLAIN], [ONE, PLAIN, PACKED], "embeddings_path"),
}


@pytest.mark.parametrize(("fit", "too_many", "where"), SETS.values(), ids=SETS)
def test_all_files_of_a_request_share_one_limit(shelf: Path, fit: Any, too_many: Any, where: str) -> None:
    convert(shelf, Memory(ROOM_BYTES), *fit)
    with pytest.raises(RequestValidationError) as refused:
        convert(shelf, Memory(ROOM_BYTES), *too_many)
    (told,) = refused.value.errors()
    assert told["loc"] == ["body", "samples", len(too_many) - 1, "trajectory", where]
    assert told["msg"] == "expected files of at most 2621440 bytes in one request, when they are decoded, got more"


def test_files_count_as_held_as_long_as_the_request_lasts(shelf: Path) -> None:
    memory = Memory(3 * MIB)
    with memory.share() as share:
        share.take(2 * MIB)
        with pytest.raises(HTTPException, match="503"):
            convert(shelf, memory, ONE, PLAIN)
    convert(shelf, memory, ONE, PLAIN)
    convert(shelf, memory, PLAIN, ONE)


def test_a_request_that_is_over_takes_nothing_more() -> None:
    """A thread may still work for one whose caller has left."""
    memory = Memory(MIB)
    with memory.share() as late:
        pass
    with pytest.raises(HTTPException, match="503"):
        late.take(1)
    with memory.share() as share:
        share.take(MIB)
