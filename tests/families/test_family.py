# SPDX-License-Identifier: MIT
"""Foreign families, and configurations without a family."""

from __future__ import annotations

import os
import shutil
import sysconfig
import venv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import tritonclient.grpc
from tritonclient.utils import InferenceServerException, np_to_triton_dtype

import rfm_export
import toy_family
from paths import ROOT
from repositories import description_of
from rfm import families, published
from rfm.config import ExportConfig
from rfm.files import CheckpointError
from rfm.serve.installation import Installation
from rfm_client import (
    InferenceFailedError,
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardClient,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract import wire
from servers import find_installation, start_triton

TESTS = ROOT / "tests" / "support"
DEMO = ROOT / "model_repository"
TOY = ExportConfig(name="toy", num_gpus=0, torch_threads=1)
SLOPE = torch.tensor([[4.0, 0.0, -1.0]])  # of red, green and blue


def video(red: list[float]) -> Trajectory:
    """Frames that are red to these degrees 0..1, and else black."""
    frames = np.zeros((len(red), 6, 8, 3), np.uint8)
    frames[..., 0] = np.round(255 * np.array(red))[:, None, None]
    return Trajectory(frames=frames, task="paint it red")


def progress(red: list[float]) -> np.ndarray:
    """Return the toy checkpoint's progress for ``video(red)``."""
    return 1 / (1 + np.exp(2 - 4 * np.round(255 * np.array(red)) / 255))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("toy") / "checkpoint"
    weights = {"line.weight": SLOPE, "line.bias": torch.tensor([-2.0])}
    toy_family.ToyCheckpoint(toy_family.ToyConfig(), weights).save(folder)
    return folder


@dataclass(frozen=True)
class Running:
    """A server with the toy checkpoint as ``toy``, and the demo's as ``rfm``, whose configurations name no family."""

    repository: Path
    url: str


def with_family(installation: Installation, folder: Path) -> Installation:
    """A server whose Python environment also has the toy family."""
    venv.create(folder)
    (packages,) = folder.glob("lib/python*/site-packages")
    ours = sysconfig.get_path("purelib")
    (packages / "toy.pth").write_text(f"import site; site.addsitedir({ours!r})\n{TESTS}\n")
    path = os.pathsep.join([str(folder / "bin"), installation.environment.get("PATH", os.environ["PATH"])])
    return replace(installation, environment={**installation.environment, "PATH": path})


@pytest.fixture(scope="module")
def running(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("served")
    repository = shutil.copytree(DEMO, folder / "model_repository")
    rfm_export.export(checkpoint, repository, TOY, family=toy_family.__name__)
    installation = with_family(find_installation(), folder / "environment")
    with start_triton(repository, installation) as server:
        yield Running(repository, server.endpoints.grpc_url)


@pytest.mark.slow
@pytest.mark.triton
def test_a_family_from_elsewhere_is_served_on_raw_frames(running: Running) -> None:
    first, second = [0.1, 0.5, 0.9], [0.8, 0.2]
    samples = [
        ProgressSample(video(first)),
        ProgressSample(video(first), frame_steps=2),
        PreferenceSample(video(first), video(second)),
    ]
    with RewardClient(running.url, model="toy") as client:
        whole, dense, pair = client.evaluate(samples)
        np.testing.assert_allclose(whole.progress, progress(first), atol=1e-6)
        np.testing.assert_allclose(dense.progress, progress(first), atol=1e-6)
        np.testing.assert_allclose(pair.second.progress, progress(second), atol=1e-6)
        logits = 4 * np.round(255 * np.array([0.9, 0.2])) / 255
        assert pair.preference == pytest.approx(1 / (1 + np.exp(logits[1] - logits[0])), abs=1e-6)
        with pytest.raises(InvalidSampleError, match="sample_type: expected progress or preference, got similarity"):
            client.evaluate([SimilaritySample(video(first), video(second))])
    assert rfm_export.check(running.repository, TOY) == []
    assert description_of(running.repository / "toy").network == {
        "class": "Redness",
        "module": "toy_family",
        "types": {"line": "Linear"},
        "config": {"num_colours": 3},
        "parameters": {"line": 4},
    }


@pytest.mark.slow
@pytest.mark.triton
def test_a_score_that_is_no_number_is_an_error_to_every_client(running: Running) -> None:
    """A client that reads tensors itself must not take NaN for a score, nor Triton's metrics for a success."""
    green = np.zeros((2, 6, 8, 3), np.uint8)
    green[1, ..., 1] = 255
    bad = ProgressSample(Trajectory(frames=green, task="paint it red"))
    inputs = []
    for name, array in wire.encode_samples([bad]).items():
        inputs.append(tritonclient.grpc.InferInput(name, array.shape, np_to_triton_dtype(array.dtype)))
        inputs[-1].set_data_from_numpy(array)
    with tritonclient.grpc.InferenceServerClient(running.url.removeprefix("grpc://")) as triton:
        with pytest.raises(InferenceServerException, match="not finite"):
            triton.infer("toy_frames", inputs)
        counts = triton.get_inference_statistics("toy_frames").model_stats[0].inference_stats
    assert counts.fail.count > 0
    with RewardClient(running.url, model="toy") as client, pytest.raises(InferenceFailedError):
        client.evaluate([ProgressSample(video([0.5])), bad])


@pytest.mark.parametrize(
    ("name", "now"), [("rfm.vlm", "rfm.families.robometer"), ("rfm.rewind", "rfm.families.rewind")]
)
def test_exports_of_0_4_name_packages_of_before(name: str, now: str) -> None:
    assert families.named(name).name == now


NO_FAMILY = {
    "unknown": (None, "model_type: expected rewind_transformer, got redness"),
    "not there": ("no.such.package", "can be imported, got no.such.package: No mod"),
    "no family": ("json", "family: expected a package with a FAMILY, got json"),
}


@pytest.mark.parametrize(("family", "message"), NO_FAMILY.values(), ids=NO_FAMILY)
def test_a_checkpoint_of_no_known_family_is_refused(checkpoint: Path, family: str | None, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        published.load(checkpoint, family=family)


def test_a_family_without_encoders_has_none_to_load() -> None:
    with pytest.raises(CheckpointError, match=r"family: expected one with encoders, got rfm\.families\.robometer"):
        families.encoders_of("rfm.families.robometer")
