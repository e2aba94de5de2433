# SPDX-License-Identifier: MIT
"""The folder whose files requests may name."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gateway_requests import (
    BLACK,
    ENCODER_DIMS,
    ENCODERS,
    Triton,
    answered,
    ask_json,
    check_refused,
    embedded,
    expected,
    failure,
    filmed,
    of_frames,
    preference,
    progress,
)
from gateways import Gateway, StandIn, TestClient, inside

WIDE = np.zeros((256, 1000), np.float32)
FRAMES_AT, PATH_AT = ["samples", 0, "trajectory", "frames"], ["samples", 0, "trajectory", "embeddings_path"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that a gateway may read, with links to files outside."""
    outside = tmp_path_factory.mktemp("shelf")
    folder = outside / "allowed"
    (folder / "episode").mkdir(parents=True)
    for index, frame in enumerate(filmed(1, 3)["frames"]):
        Image.fromarray(frame).save(folder / "episode" / f"{index}.png")
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(filmed(1, 3)["frames"][0]).save(folder / "turned.png", exif=exif)
    Image.fromarray(filmed(1, 1, size_px=40)["frames"][0]).save(folder / "larger.png")
    given = embedded(1, 3, ENCODER_DIMS)
    arrays = {name: given[name] for name in ("video_embeddings", "text_embedding")}
    for file in (folder / "episode.npz", outside / "outside.npz"):
        np.savez(file, **arrays)
    np.save(folder / "episode.npy", arrays["video_embeddings"])
    np.save(folder / "frames.npy", BLACK)
    np.save(folder / "pickled.npy", np.array([[1, {}]], object), allow_pickle=True)
    np.savez(folder / "nan.npz", **(arrays | {"video_embeddings": arrays["video_embeddings"] + np.nan}))
    (folder / "text.png").write_text("no image")
    (folder / "text.npz").write_text("no arrays")
    shutil.copy(folder / "episode" / "0.png", outside / "outside.png")
    (folder / "link.png").symlink_to("episode/0.png")
    for name in ("outside.png", "outside.npz"):
        (folder / f"link_to_{name}").symlink_to(outside / name)
    (folder / "folder_outside").symlink_to(outside)
    (folder / "circle").symlink_to("circle")
    Image.fromarray(np.zeros((512, 682, 3), np.uint8)).save(folder / "black.png")  # with the next two: a mebibyte each
    np.save(folder / "plain.npy", WIDE)
    np.savez_compressed(folder / "packed.npz", video_embeddings=WIDE, text_embedding=WIDE[0])
    return folder


@pytest.fixture(scope="module")
def gateway(folder: Path) -> Iterator[TestClient]:
    triton = StandIn(dims=ENCODER_DIMS)
    triton.is_open.set()
    with inside(triton=triton, allow_folder=folder, max_body_mib=1) as client:
        yield client


@pytest.mark.triton
def test_images_and_arrays_in_the_allowed_folder_are_read(triton: Triton, encoders: Gateway, folder: Path) -> None:
    frames, given = filmed(1, 3)["frames"], embedded(1, 3, ENCODER_DIMS)
    names = ["link.png", "episode/1.png", str(folder / "episode" / "2.png")]
    turned = np.rot90(frames[[0, 0]], -1, axes=(1, 2))  # as EXIF data say
    whole = progress({"embeddings_path": "episode.npz"})
    parts = progress({"embeddings_path": "episode.npy", "text_embedding": given["text_embedding"]})
    asked = {
        "images": ([of_frames(names)], [of_frames(frames)]),
        "turned": ([of_frames(["turned.png"] * 2)], [of_frames(turned)]),
        "embeddings": (
            [whole, preference(parts["trajectory"], whole["trajectory"])],
            [progress(given), preference(given, given)],
        ),
    }
    with inside(triton=triton.endpoints.grpc_url, model=ENCODERS, allow_folder=folder) as client:
        for samples, same in asked.values():
            assert answered(ask_json(client, samples)) == expected(encoders, same)


OUTSIDE = ["../outside.png", "episode/../../outside.png", "/etc/passwd", "link_to_outside.png"]
NOWHERE = ["folder_outside/outside.png", "missing.png", "episode", "circle", "a\0b", "a" * 5000]
BAD_IMAGES = [
    *((name, "a file in the allowed folder") for name in (*OUTSIDE, *NOWHERE)),
    *((name, "an image file") for name in ("text.png", "episode.npy")),
]
BAD_FILES = [
    *((f"{name}outside.npz", "a file in the allowed folder") for name in ("../", "link_to_", "folder_outside/")),
    *((name, "a file of embeddings [T, D]") for name in ("pickled.npy", "text.npz", "nan.npz")),
    ("larger.png", ".npy or .npz"),
]


@pytest.mark.parametrize(("name", "wanted"), BAD_IMAGES, ids=[repr(name)[:30] for name, _ in BAD_IMAGES])
def test_no_other_image_is_opened(gateway: TestClient, name: str, wanted: str) -> None:
    response = ask_json(gateway, [of_frames(["episode/0.png", name])])
    check_refused(response, ([*FRAMES_AT, 1], re.escape(f"expected {wanted}, got {name}")))


@pytest.mark.parametrize(("name", "wanted"), BAD_FILES, ids=[name for name, _ in BAD_FILES])
def test_no_other_array_is_opened(gateway: TestClient, name: str, wanted: str) -> None:
    response = ask_json(gateway, [progress({"embeddings_path": name, "task": "lift"})])
    check_refused(response, (PATH_AT, re.escape(f"expected {wanted}, got {name}")))


def test_files_that_do_not_fit_are_refused(gateway: TestClient) -> None:
    response = ask_json(gateway, [of_frames(["episode/0.png", "larger.png"])])
    check_refused(response, (FRAMES_AT, "expected images of one size, got different ones"))
    response = ask_json(gateway, [progress({"embeddings_path": "frames.npy", "task": "lift"})])
    check_refused(response, (PATH_AT, "expected a file of embeddings, got frames"))


def test_files_are_refused_before_they_fill_the_memory(gateway: TestClient) -> None:
    """There is room for two mebibytes."""
    message = "body: expected files of at most 2097152 bytes in one request, when they are decoded, got more; "
    image = of_frames(["black.png"])
    plain, packed = (progress({"embeddings_path": name, "task": "lift"}) for name in ("plain.npy", "packed.npz"))
    answered(ask_json(gateway, [image, image]))
    assert ask_json(gateway, [plain, packed]).status_code == 422  # the widths are others
    too_many = [of_frames(["black.png"] * 3)], [image] * 3, [plain] * 3, [packed] * 3, [image, plain, packed]
    for samples in too_many:
        assert failure(ask_json(gateway, samples), 413).startswith(message)
