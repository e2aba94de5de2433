# SPDX-License-Identifier: MIT
"""Change which version of a checkpoint's models a running server serves, without losing a request.

Files and server change in step, so that a restart serves the same versions. A checkpoint with encoders has three
models: encoder and scorer (the parts), and an ensemble, whose configuration names each part's version. The steps:

1. Each part serves the new version beside the old. Triton warms up the new version first; if that fails, the new
   version gets no request.
2. Each part's new version answers a probe that names it.
3. The ensemble changes to the new version. Triton finishes the old version's requests.
4. Each part serves the new version alone. Triton again finishes the old version's requests. Every model then
   answers a last probe.

If a step fails, the server loads the old versions with their own configurations again. Their files are
put back even if the server is gone, so that a restart serves the old versions. A server that comes back within RETURN_S
gets a request to load them.

The highest ready version answers requests without a version: the new version from step 1 on, in a rollback from step 4
on. A model has one configuration for all its versions, so Triton in step 1 loads the old version again, with the new
configuration. For a moment there must be room for three copies.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.text_format import ParseError
from tritonclient.grpc import model_config_pb2 as pb

from rfm.serve.repository import CONFIG_FILE, fault_in, models_in, no_models
from rfm.serve.repository_api import RepositoryApi, RepositoryApiError
from rfm_client import PreferenceSample, ProgressSample, RewardError, Sample
from rfm_client.contract import wire
from rfm_client.contract.errors import LocatedError
from rfm_client.contract.samples import random_trajectory
from rfm_client.contract.wire import encoder_name, frames_name
from rfm_export.errors import ExportError
from rfm_export.layout import description_in
from rfm_export.pbtxt import serving_versions
from rfm_export.publish import alone, config_of, read_config, replace_config, staging

RETURN_S = 600.0  # large checkpoints take minutes to load
POLL_S = 1.0
PROBE_FRAMES = 2
PROBE_SEED = 0
PROBE_TASK = "pick up the red cup"
EMBEDDINGS = (wire.VIDEO_EMBEDDINGS, wire.TEXT_EMBEDDING)

Configs = Mapping[str, pb.ModelConfig]


class RolloutError(ExportError):
    """A version that cannot be served, and why."""


def models_of(repository: Path, name: str) -> list[str]:
    """Return the models that ``rfm export --name NAME`` made, parts before their ensemble. Raises RolloutError."""
    names = (encoder_name(name), name, frames_name(name))
    models = [model for model in names if (repository / model / CONFIG_FILE).is_file()]
    if not models:
        there = ", ".join(names_of(repository))
        raise RolloutError(f"{repository}: expected one of {there}, got {name}" if there else no_models(repository))
    return models


def names_of(repository: Path) -> list[str]:
    """Return the names of all exports in the repository, as in ``rfm export --name``."""
    endings = frames_name(""), encoder_name("")
    return sorted({model.removesuffix(endings[0]).removesuffix(endings[1]) for model in models_in(repository)})


def previous_version(repository: Path, name: str, server: RepositoryApi) -> int:
    """Return the version folder before the served version. Raises RolloutError, RepositoryApiError."""
    models = models_of(repository, name)
    served = [version for model in models for version in server.ready_versions(model)]
    if not served:
        raise RolloutError.at(name, "to be served", "no version that is")
    each = [{int(path.name) for path in (repository / model).glob("*") if path.name.isdecimal()} for model in models]
    older = [version for version in set.intersection(*each) if version < max(served)]
    if not older:
        raise RolloutError.at(repository / models[0], f"a version before {max(served)}", "none")
    return max(older)


@dataclass(frozen=True)
class Rollout:
    """A change of NAME's version on a server. report: receives a line for each step"""

    repository: Path
    name: str
    server: RepositoryApi
    report: Callable[[str], None]

    def to(self, version: int) -> None:
        """Serve ``version`` alone. Raises RolloutError, or before any change RepositoryApiError."""
        with alone(self.repository):
            self._to(version)

    def _to(self, version: int) -> None:
        models = models_of(self.repository, self.name)
        served = {model: self.server.ready_versions(model) for model in models}
        try:
            new = self._configs(models, dict.fromkeys(models, version))
            # A model that is not served keeps its configuration in the repository.
            old = {model: read_config(self.repository, model) for model in models if not served[model]}
            old |= self._configs(models, {model: max(served[model]) for model in models if served[model]})
            for model in models:
                self._check_served(model, served[model])
        except (OSError, ParseError) as error:
            raise RolloutError.at(f"{self.name} version {version}", "an exported version", error) from error
        check_files(self.repository, new)
        try:
            self._switch(new, served, version)
        except (LocatedError, RewardError, OSError) as error:
            became = self._go_back(old, served)
            raise RolloutError(f"{self.name} version {version}: {error} ({became})") from error
        except BaseException:  # a signal to stop
            self.report(self._go_back(old, served))
            raise

    def _switch(self, new: Configs, served: Mapping[str, Sequence[int]], version: int) -> None:
        parts = [model for model, config in new.items() if config.platform != "ensemble"]
        for model in parts:
            self._serve(new[model], sorted({version, *served[model]}))
            probe(self.server, new[model], version)
        for model in (*(model for model in new if model not in parts), *parts):
            self._serve(new[model], [version])
            self.server.wait_gone(model, kept=[version])
            probe(self.server, new[model], version)

    def _check_served(self, model: str, versions: Sequence[int]) -> None:
        """Raise RolloutError if the server serves other weights than the repository has in these versions."""
        here = [description_in(config_of(self.repository, model, version)).weights_digest for version in versions]
        if here and (served := description_in(self.server.config(model)).weights_digest) not in here:
            where, remedy = self.repository / model, "name the server's own repository (--repository)"
            raise RolloutError.at(where, f"the weights that the server serves, {served}", f"{here[-1]}: {remedy}")

    def _go_back(self, old: Configs, served: Mapping[str, Sequence[int]]) -> str:
        """Serve the old versions again. Return the outcome in words."""
        self.report(f"going back; waits up to {RETURN_S:.0f} s for a server that restarts")
        ends_s = time.monotonic() + RETURN_S
        failed: dict[str, str | None] = dict.fromkeys(reversed(list(served)))  # the ensemble before its parts
        while True:
            failed = {model: why for model in failed if (why := self._put_back(old[model], served[model]))}
            if not failed or time.monotonic() >= ends_s:
                break
            time.sleep(POLL_S)
        if failed:
            why = "; ".join(f"{model}: {error}" for model, error in failed.items())
            return f"expected to serve again what it served, got: {why}"
        return f"served as before: {'; '.join(f'{model}: {_words(versions)}' for model, versions in served.items())}"

    def _put_back(self, config: pb.ModelConfig, versions: Sequence[int]) -> str | None:
        """Restore a model's file and served versions. Return why this failed, or None.

        A failure means that there is no server, or that other models come first.
        """
        try:
            self._write(serving_versions(config, versions) if versions else config)
            if versions:
                self.server.load(config.name)
            else:
                self.server.unload(config.name)
        except (RepositoryApiError, OSError) as error:
            return str(error)
        return None

    def _serve(self, config: pb.ModelConfig, versions: Sequence[int]) -> None:
        self._write(serving_versions(config, versions))
        self.report(f"{config.name}: loading {_words(versions)}")
        began_s = time.monotonic()
        self.server.load(config.name)
        self.report(f"{config.name}: loaded {_words(versions)} after {time.monotonic() - began_s:.0f} s")

    def _write(self, config: pb.ModelConfig) -> None:
        with staging(self.repository, [config.name]) as scratch:
            replace_config(self.repository, config, scratch)

    def _configs(self, models: Sequence[str], versions: Mapping[str, int]) -> dict[str, pb.ModelConfig]:
        return {model: config_of(self.repository, model, versions[model]) for model in models if model in versions}


def probe(server: RepositoryApi, config: pb.ModelConfig, version: int) -> None:
    """Raise RewardError or RepositoryApiError unless the version answers synthetic samples with numbers.

    A model that answers in words may also refuse a sample because its answer holds no score.
    """
    reads = _dims(config.input)
    widths = None if wire.FRAMES in reads else (reads[wire.VIDEO_EMBEDDINGS], reads[wire.TEXT_EMBEDDING])
    trajectory = random_trajectory(np.random.default_rng(PROBE_SEED), PROBE_FRAMES, widths, task=PROBE_TASK)
    if wire.VIDEO_EMBEDDINGS in _dims(config.output):
        embeddings = server.infer(config.name, version, wire.encode_frames(trajectory), EMBEDDINGS)
        wire.decode_embeddings(embeddings, trajectory)
        return
    description = description_in(config)
    samples: list[Sample] = [ProgressSample(trajectory)]
    if description.has_preference:
        samples.append(PreferenceSample(trajectory, trajectory))
    for sample in samples:
        outputs = wire.outputs_for([sample], description.scores)
        try:
            scores = server.infer(config.name, version, wire.encode_samples([sample]), outputs)
        except RepositoryApiError as error:
            if not (description.may_not_answer and error.is_refusal):
                raise
        else:
            wire.decode_results(scores, [sample])


def check_files(repository: Path, models: Mapping[str, pb.ModelConfig | None]) -> None:
    """Raise RolloutError for a model with incomplete files. models: configurations; None: as in the file"""
    for model, config in models.items():
        if (fault := fault_in(repository, model, config)) is not None:
            raise RolloutError(fault)


def _dims(tensors: Iterable[Any]) -> dict[str, int]:
    """Return each tensor's last dimension, by name."""
    return {tensor.name: tensor.dims[-1] for tensor in tensors}


def _words(versions: Sequence[int]) -> str:
    return f"version {' and '.join(map(str, versions))}" if versions else "none"
