# SPDX-License-Identifier: MIT
"""A gRPC server in this process that scores with real engines, for tests that need true answers and no Triton.

Requests cross a real socket in Triton's protocol, and the exporter's configurations and ``model.py`` answer them. It has
no queue, no batches and no statistics: tests of those need the fixture ``served``.
"""

from __future__ import annotations

import importlib.util
import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
import torch
from tritonclient.grpc import service_pb2, service_pb2_grpc
from tritonclient.grpc.model_config_pb2 import ModelConfig
from tritonclient.utils import deserialize_bytes_tensor, np_to_triton_dtype, triton_to_np_dtype

import goldens
from engines import serve_config
from paths import ROOT
from rfm.config import ExportConfig
from rfm.engine import Execution
from rfm.engine.threads import use_threads
from rfm_client import InvalidSampleError, RewardClient, RewardError
from rfm_client.contract.wire import Tensors
from rfm_export.layout import CONFIG_FILE, Version, generated_files, generated_models
from rfm_export.pbtxt import parse
from rfm_export.source import read_for_export

DEMO = ROOT / "model_repository"
TEMPLATES = ROOT / "export" / "rfm_export" / "templates"


class Model:
    """A model's configuration and, unless it is an ensemble, its ``model.py`` with the weights in ``version``."""

    def __init__(self, config: ModelConfig, version: Path) -> None:
        self.config = config
        if config.backend:
            template = TEMPLATES / ("rfm_encoder" if config.name.endswith("_encoder") else "rfm") / "model.py"
            spec = importlib.util.spec_from_file_location(f"{template.parent.name}_model", template)
            assert spec is not None and spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            self.model = module.TritonPythonModel()
            settings = {name: each.string_value for name, each in config.parameters.items()}
            self.model.load(version, torch.device("cpu"), settings)

    def answer(self, tensors: Tensors, outputs: list[str], execution: Execution) -> Tensors:
        """Return the outputs of a request. Raises its first error."""
        prepared = []
        questions = self.model.decode(
            {spec.name: tensors[spec.name] for spec in self.config.input if spec.name in tensors}
        )
        for index, question in enumerate(questions):
            with _located(index, len(questions)):
                prepared.append(self.model.prepare(question)[0])
        answers = self.model.answer(prepared, execution)
        for index, each in enumerate(answers):
            with _located(index, len(answers)):
                if isinstance(each, RewardError):
                    raise each
        return dict(self.model.encode(answers, tensors, outputs))


@contextmanager
def _located(index: int, count: int) -> Iterator[None]:
    try:
        yield
    except InvalidSampleError as error:
        raise (error.inside(f"samples[{index}]") if count > 1 else error) from None


class EngineServer(service_pb2_grpc.GRPCInferenceServiceServicer):
    """Serves what the fixture ``served`` does, each checkpoint loaded when first asked. A context manager.

    folder: for the checkpoints' files
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._models, self._working = folder, dict[str, Model](), threading.Lock()
        self._loaded = set[str]()
        self.encoded = Counter[str]()  # frames that were encoded, by model

    def __enter__(self) -> EngineServer:
        workers = ThreadPoolExecutor(8, initializer=partial(use_threads, 1))
        sizes = [("grpc.max_send_message_length", -1), ("grpc.max_receive_message_length", -1)]
        self._server = grpc.server(workers, options=sizes)
        service_pb2_grpc.add_GRPCInferenceServiceServicer_to_server(self, self._server)
        self.url = f"grpc://127.0.0.1:{self._server.add_insecure_port('127.0.0.1:0')}"
        self._server.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop(None).wait()

    def client(self, model: str = "c1_t1_disc10", **options: Any) -> RewardClient:
        return RewardClient(self.url, model=model, **options)

    def forget_features(self) -> None:
        """Empty the caches of frames, as a restart does."""
        with self._working:  # an abandoned request may still load a checkpoint
            for model in self._models.values():
                holder = getattr(model.model, "engine", model.model) if model.config.backend else None
                if holder is not None and holder.cache is not None:
                    holder.cache.clear()

    def _load(self, name: str) -> None:
        """Load the checkpoint with this name, and its encoders."""
        if name == "rfm":
            configs = [parse((folder / CONFIG_FILE).read_text()) for folder in sorted(DEMO.glob("rfm*"))]
            self._models |= {each.name: Model(each, DEMO / each.name / "1") for each in configs}
        elif name in {config.name for config in (*goldens.SERVED, *goldens.ON_DEMAND)}:
            config = goldens.config(name)
            self.add(config.checkpoint, serve_config(config, name))

    def add(self, checkpoint: Path, settings: ExportConfig) -> None:
        """Serve the export of a checkpoint, too."""
        source = read_for_export(checkpoint, settings, None, None, lambda _: None, other_machine=True)
        version = Version(1, source.settings, source.num_gpus, source.family.name)
        source.checkpoint.save(version.checkpoint_folder(source.description, self._folder))
        if source.encoders is not None:
            source.encoders.save(version.encoders_folder(self._folder))
        models = generated_models(source.description, source.of_encoders, version)
        generated_files(models, self._folder)  # notes the digests of weights
        for each in models:
            self._models[each.name] = Model(each.config, self._folder / each.name / "1")

    def _find(self, name: str, context: grpc.ServicerContext) -> Model:
        with self._working:
            checkpoint = name.removesuffix("_frames").removesuffix("_encoder")
            if checkpoint not in self._loaded:
                self._loaded.add(checkpoint)
                self._load(checkpoint)
        if name not in self._models:
            context.abort(grpc.StatusCode.NOT_FOUND, f"Request for unknown model: '{name}' is not found")
        return self._models[name]

    def ServerReady(self, request: Any, context: Any) -> Any:  # noqa: N802  Triton's name, as those below
        return service_pb2.ServerReadyResponse(ready=True)

    def ServerMetadata(self, request: Any, context: Any) -> Any:  # noqa: N802
        return service_pb2.ServerMetadataResponse(name="triton", version="engines")

    def RepositoryIndex(self, request: Any, context: Any) -> Any:  # noqa: N802
        index = service_pb2.RepositoryIndexResponse
        return index(models=[index.ModelIndex(name=name, version="1", state="READY") for name in list(self._models)])

    def ModelReady(self, request: Any, context: Any) -> Any:  # noqa: N802
        return service_pb2.ModelReadyResponse(ready=bool(self._find(request.name, context)))

    def ModelMetadata(self, request: Any, context: Any) -> Any:  # noqa: N802
        return service_pb2.ModelMetadataResponse(name=self._find(request.name, context).config.name, versions=["1"])

    def ModelConfig(self, request: Any, context: Any) -> Any:  # noqa: N802
        return service_pb2.ModelConfigResponse(config=self._find(request.name, context).config)

    def ModelStatistics(self, request: Any, context: Any) -> Any:  # noqa: N802
        stats = [service_pb2.ModelStatistics(name=name, version="1") for name in list(self._models)]
        return service_pb2.ModelStatisticsResponse(model_stats=stats)

    def ModelInfer(self, request: Any, context: Any) -> Any:  # noqa: N802
        model, outputs = self._find(request.model_name, context), [each.name for each in request.outputs]
        for name in {each.name for each in request.inputs} - {spec.name for spec in model.config.input}:
            told = f"unexpected inference input '{name}' for model '{request.model_name}'"  # in Triton's words
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, told)
        tensors = {
            spec.name: _read(spec, content)
            for spec, content in zip(request.inputs, request.raw_input_contents, strict=True)
        }
        answer = service_pb2.ModelInferResponse(model_name=request.model_name, model_version="1", id=request.id)
        try:
            with self._working:
                steps = [self._models[step.model_name] for step in model.config.ensemble_scheduling.step] or [model]
                for step in steps:
                    names = outputs if step is steps[-1] else [spec.name for spec in step.config.output]
                    tensors |= step.answer(tensors, names, execution := Execution())
                    self.encoded[step.config.name] += execution.num_encoded
        except RewardError as error:
            is_sample = isinstance(error, InvalidSampleError)
            context.abort(grpc.StatusCode.INVALID_ARGUMENT if is_sample else grpc.StatusCode.INTERNAL, str(error))
        for name in outputs:
            array = tensors[name]
            answer.outputs.add(name=name, datatype=np_to_triton_dtype(array.dtype), shape=array.shape)
            answer.raw_output_contents.append(array.tobytes())
        return answer


def _read(spec: Any, content: bytes) -> np.ndarray[Any, Any]:
    if spec.datatype == "BYTES":
        return np.asarray(deserialize_bytes_tensor(content)).reshape(spec.shape)
    return np.frombuffer(content, triton_to_np_dtype(spec.datatype)).reshape(spec.shape)


@pytest.fixture(scope="session")
def engines(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EngineServer]:
    """The checkpoints of ``served``, without Triton."""
    with EngineServer(tmp_path_factory.mktemp("engines")) as server:
        yield server
