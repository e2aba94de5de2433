# SPDX-License-Identifier: MIT
"""Keys, origins, and the folder whose files requests may name."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import requests
from PIL import Image

from gateway_requests import (
    BLACK,
    FILM,
    FILM_DIMS,
    FORM,
    FRAMES_AT,
    SEED_PAYLOAD,
    TINY,
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
from gateways import Gateway, running

pytestmark = pytest.mark.triton


KEY = "open sesame"


ORIGIN = "http://lab.example"


KEYS: dict[str, tuple[dict[str, str], bool]] = {
    "X-API-Key": ({"X-API-Key": KEY}, True),
    "Bearer": ({"Authorization": f"Bearer {KEY}"}, True),
    "none": ({}, False),
    "another": ({"X-API-Key": "sesame"}, False),
    "another bearer": ({"Authorization": "Bearer sesame"}, False),
    "another scheme": ({"Authorization": f"Basic {KEY}"}, False),
    "no letters": ({"X-API-Key": "\xfc"}, False),
}


@pytest.fixture(scope="module", params=["file", "variable"])
def keyed(
    request: pytest.FixtureRequest, triton: Triton, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Gateway]:
    folder = tmp_path_factory.mktemp("keyed")
    (folder / "key.txt").write_text(f"{KEY}\n")
    if request.param == "file":
        options, environment = ["--api-key-file", str(folder / "key.txt")], {"RFM_GATEWAY_API_KEY": "another"}
    else:
        options, environment = [], {"RFM_GATEWAY_API_KEY": KEY}
    with running(triton.endpoints, folder, TINY, "--cors-origin", ORIGIN, *options, **environment) as started:
        yield started
        assert KEY not in started.log


@pytest.mark.parametrize(("headers", "is_right"), KEYS.values(), ids=KEYS)
def test_only_the_key_opens(keyed: Gateway, headers: dict[str, str], is_right: bool) -> None:
    responses = [
        requests.post(f"{keyed.url}/evaluate_batch", SEED_PAYLOAD, headers=headers),
        requests.post(f"{keyed.url}/evaluate_batch_npy", FORM, files={"a": b""}, headers=headers),
        *(requests.get(f"{keyed.url}/{path}", headers=headers) for path in ("gpu_status", "model_info", "metrics")),
    ]
    for response in responses:
        if is_right:
            assert response.ok
        else:
            assert failure(response, 401) == "key: expected X-API-Key or Authorization: Bearer, got another or none"


def test_health_and_documentation_need_no_key(keyed: Gateway) -> None:
    for path in ("health", "docs", "openapi.json"):
        assert requests.get(f"{keyed.url}/{path}").ok


def test_browsers_may_ask_from_the_named_origin_alone(keyed: Gateway, tiny: Gateway) -> None:
    allowed = "Access-Control-Allow-Origin"
    preflight = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "x-api-key"}
    url = f"{keyed.url}/evaluate_batch"
    response = requests.options(url, headers=preflight | {"Origin": ORIGIN})
    assert (response.status_code, response.headers[allowed]) == (200, ORIGIN)
    response = requests.post(url, SEED_PAYLOAD, headers={"Origin": ORIGIN, "X-API-Key": KEY})
    assert (response.status_code, response.headers[allowed]) == (200, ORIGIN)
    assert allowed not in requests.options(url, headers=preflight | {"Origin": "http://other.example"}).headers
    assert allowed not in requests.get(f"{keyed.url}/health", headers={"Origin": "http://other.example"}).headers
    assert allowed not in requests.get(f"{tiny.url}/health", headers={"Origin": ORIGIN}).headers


@pytest.mark.parametrize("host", ["0.0.0.0", "127.0.0.1"])
def test_an_open_address_without_a_key_is_warned_of(triton: Triton, tmp_path: Path, host: str) -> None:
    warning = "WARNING rfm_gateway: 0.0.0.0 is no loopback address, and no key is required"
    with running(triton.endpoints, tmp_path, TINY, "--host", host) as gateway:
        assert (warning in gateway.log) is (host == "0.0.0.0")
    with running(triton.endpoints, tmp_path, TINY, "--host", host, RFM_GATEWAY_API_KEY=KEY) as gateway:
        assert warning not in gateway.log


@pytest.fixture(scope="module")
def shelf(triton: Triton, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Gateway, Path]]:
    """A gateway that may read a folder."""
    outside = tmp_path_factory.mktemp("shelf")
    folder = outside / "allowed"
    (folder / "episode").mkdir(parents=True)
    for index, frame in enumerate(filmed(1, 3)["frames"]):
        Image.fromarray(frame).save(folder / "episode" / f"{index}.png")
    Image.fromarray(filmed(1, 1, size_px=40)["frames"][0]).save(folder / "larger.png")
    given = embedded(1, 3, FILM_DIMS)
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
    with running(triton.endpoints, outside, FILM, "--allow-folder", str(folder)) as started:
        yield started, folder


def test_images_and_arrays_in_the_allowed_folder_are_read(shelf: tuple[Gateway, Path]) -> None:
    gateway, folder = shelf
    frames = filmed(1, 3)["frames"]
    names = ["link.png", "episode/1.png", str(folder / "episode" / "2.png")]
    assert answered(ask_json(gateway, [of_frames(names)])) == expected(gateway, [of_frames(frames)])
    given = embedded(1, 3, FILM_DIMS)
    whole = progress({"embeddings_path": "episode.npz"})
    parts = progress({"embeddings_path": "episode.npy", "text_embedding": given["text_embedding"]})
    answer = answered(ask_json(gateway, [whole, preference(parts["trajectory"], whole["trajectory"])]))
    assert answer == expected(gateway, [progress(given), preference(given, given)])


OUTSIDE = ["../outside.png", "episode/../../outside.png", "/etc/passwd", "link_to_outside.png"]


NOWHERE = ["folder_outside/outside.png", "missing.png", "episode", "", "circle", "a\0b", "a" * 5000]


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
def test_no_other_image_is_opened(shelf: tuple[Gateway, Path], name: str, wanted: str) -> None:
    response = ask_json(shelf[0], [of_frames(["episode/0.png", name])])
    check_refused(response, (["samples", 0, *FRAMES_AT, 1], re.escape(f"expected {wanted}, got {name}")))


@pytest.mark.parametrize(("name", "wanted"), BAD_FILES, ids=[name for name, _ in BAD_FILES])
def test_no_other_array_is_opened(shelf: tuple[Gateway, Path], name: str, wanted: str) -> None:
    response = ask_json(shelf[0], [progress({"embeddings_path": name, "task": "lift"})])
    at = ["samples", 0, "trajectory", "embeddings_path"]
    check_refused(response, (at, re.escape(f"expected {wanted}, got {name}")))


def test_files_that_do_not_fit_are_refused(shelf: tuple[Gateway, Path]) -> None:
    response = ask_json(shelf[0], [of_frames(["episode/0.png", "larger.png"])])
    check_refused(response, (["samples", 0, *FRAMES_AT], "expected images of one size, got different ones"))
    response = ask_json(shelf[0], [progress({"embeddings_path": "frames.npy", "task": "lift"})])
    check_refused(
        response, (["samples", 0, "trajectory", "embeddings_path"], "expected a file of embeddings, got frames")
    )


def test_many_images_are_refused_before_they_fill_the_memory(triton: Triton, tmp_path: Path) -> None:
    folder = tmp_path / "shelf"
    folder.mkdir()
    Image.fromarray(np.zeros((600, 600, 3), np.uint8)).save(folder / "black.png")  # a megabyte, when it is decoded
    limits = ("--allow-folder", str(folder), "--max-body-mib", "2")
    with running(triton.endpoints, tmp_path, FILM, *limits) as gateway:
        response = ask_json(gateway, [of_frames(["black.png"] * 3)])
        check_refused(
            response,
            (["samples", 0, *FRAMES_AT], "expected files of at most 2097152 bytes in one request, .*, got more"),
        )
