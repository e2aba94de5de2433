# SPDX-License-Identifier: MIT
from __future__ import annotations

import functools
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import goldens
import numpy as np
import pytest
import torch

import rfm_export
from rfm import families
from rfm.config import ServeConfig
from rfm.engine import Engine
from rfm.rewind.predictor import RewindPredictor
from rfm.supervise.installation import find_installation
from rfm.supervise.process import Endpoints, TritonServer
from rfm_client import RewardClient, Trajectory
from rfm_export.layout import CONFIG_FILE
from rfm_export.pbtxt import parse, render

torch.set_num_threads(1)
os.environ["ONEDNN_MAX_CPU_ISA"] = "AVX512_CORE"  # as the references were computed: AMX rounds bfloat16 elsewhere


def serve_config(config: goldens.Config, name: str = "rfm") -> ServeConfig:
    """How the tests export a reference checkpoint."""
    return ServeConfig(
        name=name,
        num_gpus=0,
        torch_threads=1,
        image_encoder=str(config.image_encoder) if config.image_encoder else None,
        text_encoder=str(config.text_encoder) if config.text_encoder else None,
        base_model=str(config.base_model) if config.base_model else None,
    )


@functools.cache
def load_engine(name: str) -> Engine:
    """The engine of a reference checkpoint, with its encoders if it has some."""
    config = goldens.config(name)
    sources = {
        option: str(source)
        for option in ("base_model", "image_encoder", "text_encoder")
        if (source := getattr(config, option)) is not None
    }
    checkpoint = families.load(config.checkpoint, **sources)
    return Engine.of(checkpoint, encoders=checkpoint.encoders())


def rewind_of(name: str) -> RewindPredictor:
    """What of a reference checkpoint's engine is ReWiND's own."""
    predictor = load_engine(name).predictor
    assert isinstance(predictor, RewindPredictor)
    return predictor


@pytest.fixture
def engine() -> Callable[[str], Engine]:
    return load_engine


@dataclass(frozen=True)
class Served:
    """A running server with every reference checkpoint under its own name."""

    repository: Path
    endpoints: Endpoints

    def url(self, protocol: str) -> str:
        return self.endpoints.grpc_url if protocol == "grpc" else self.endpoints.http_url

    def client(self, protocol: str, model: str = "c1_t1_disc10") -> RewardClient:
        return RewardClient(self.url(protocol), model=model)


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    repository = folder / "model_repository"
    for config in (*goldens.REWIND, *goldens.WITH_ENCODERS, *goldens.VLM):
        rfm_export.export(config.checkpoint, repository, serve_config(config, config.name))
    with (
        (folder / "tritonserver.log").open("wb") as log,
        TritonServer(repository, Endpoints.free(), find_installation(), log=log) as server,
    ):
        yield Served(repository, server.endpoints)


@pytest.fixture(params=["grpc", "http"])
def protocol(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def random_trajectory(seed: int, num_frames: int, video_dim: int = 768, text_dim: int = 384) -> Trajectory:
    """Embeddings in the widths of the upstream checkpoints."""
    random = np.random.default_rng(seed)
    return Trajectory(
        video_embeddings=random.standard_normal((num_frames, video_dim), np.float32),
        text_embedding=random.standard_normal(text_dim, np.float32),
    )


def forget_input(repository: Path, model: str, name: str) -> None:
    """The model's configuration becomes one from before it had this input."""
    file = repository / model / CONFIG_FILE
    config = parse(file.read_text())
    inputs = [tensor for tensor in config.input if tensor.name != name]
    assert len(inputs) < len(config.input)
    del config.input[:]
    config.input.extend(inputs)
    for step in config.ensemble_scheduling.step:
        step.input_map.pop(name, None)
    file.write_text(render(config))


def kill_model(repository: Path, model: str = "rfm") -> None:
    """Kills each process of a model that a server of ``repository`` runs."""
    model_file = f"{repository}/{model}/1/model.py"
    killed = []
    for command in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has ended meanwhile
            if model_file in command.read_text():
                killed.append(command)
                os.kill(int(command.parent.name), signal.SIGKILL)
    assert killed
