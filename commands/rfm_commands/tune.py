# SPDX-License-Identifier: MIT
"""How many instances, of how many threads and for what batches, serve a repository best here: each setting is tried."""

from __future__ import annotations

import asyncio
import itertools
import math
import os
import shutil
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml
from tritonclient.grpc import model_config_pb2 as pb

from rfm.config import ExportConfig
from rfm.launch.repository_folder import CONFIG_FILE, models_in, no_models
from rfm.launch.temporary import temporary_server
from rfm.parameters import FEATURE_CACHE_PARAMETER, THREADS_PARAMETER
from rfm_client import AsyncRewardClient, ProgressSample, RewardClient, Sample
from rfm_client.cli.toy import SampleKind, Toy
from rfm_client.contract import wire
from rfm_commands.config import File
from rfm_commands.unused_settings import exported_settings
from rfm_export.errors import ExportError
from rfm_export.pbtxt import Interface, python_config, render
from rfm_export.publish import read_config

AS_FAST = 0.95  # of the highest rate: closer than that, rates do not separate settings
INSTANCES_PER_GPU = (1, 2, 3)
BATCH_SIZES = (8, 32, 128)
NUM_SAMPLES = 64
NUMBER_BYTES = 8  # of a frame's first pixels, which hold how many samples were sent before it
NUM_FRAMES = 16  # of a sample, where the checkpoint does not say on how many it was trained


@dataclass(frozen=True)
class Setting:
    """Values of the keys of these names in the section ``export``."""

    instances: int
    torch_threads: int
    max_batch_size: int


@dataclass(frozen=True)
class Trial:
    """What a setting gave, as medians of the rounds. samples_per_s: of all callers; p50_ms: of one caller alone."""

    setting: Setting
    samples_per_s: float
    p50_ms: float


@dataclass(frozen=True)
class Sweep:
    """Trials on a copy of a repository, whose own files stay as they are.

    name: of its models; callers: at a time, with one sample each; seconds: of each measurement
    report: is called with a line for each measurement
    """

    repository: Path
    name: str
    callers: int = 32
    seconds: float = 3.0
    rounds: int = 3
    use_frames: bool = False
    tritonserver: Path | None = None
    report: Callable[[str], None] = print

    def best(self) -> Setting:
        """Instances and threads first, then the size of batches for the best of those.

        Raises ServerStartError, RewardError if it cannot score made-up samples, ExportError if it is no repository or
        ``seconds`` are too few for an answer.
        """
        trials = self._trials(self._instances())
        best = quickest(trials)
        sizes = [replace(best.setting, max_batch_size=n) for n in BATCH_SIZES if n != best.setting.max_batch_size]
        fastest = max(self._trials(sizes), key=lambda trial: trial.samples_per_s)
        return fastest.setting if best.samples_per_s < AS_FAST * fastest.samples_per_s else best.setting

    def _instances(self) -> list[Setting]:
        """The settings to try: on a GPU a few instances; on the CPU as many as share its cores evenly, and one thread.

        One thread scores a small network as fast as several do, and leaves the other cores to Triton and the callers.
        """
        batched = [config for config in _configs(self.repository).values() if config.instance_group]
        if not batched:
            raise ExportError(no_models(self.repository))
        (group,), batch_size = batched[0].instance_group, batched[0].max_batch_size
        if group.kind == pb.ModelInstanceGroup.KIND_GPU:
            threads = int(batched[0].parameters[THREADS_PARAMETER].string_value)
            return [Setting(count, threads, batch_size) for count in INSTANCES_PER_GPU]
        cores = len(os.sched_getaffinity(0))
        shares = [Setting(count, cores // count, batch_size) for count in (1 << n for n in range(cores.bit_length()))]
        return list(dict.fromkeys([*shares, Setting(1, 1, batch_size)]))

    def _trials(self, settings: Sequence[Setting]) -> list[Trial]:
        """What each setting gave. They are measured in rounds, so that a machine that drifts affects all alike."""
        measured: dict[Setting, list[tuple[float, float]]] = {setting: [] for setting in settings}
        for number in range(self.rounds):
            for setting, of_setting in measured.items():
                of_setting.append(self._measured(setting))
                rate, p50_ms = of_setting[-1]
                self.report(f"round {number + 1}: {setting}: {rate:.0f} samples/s, one caller waits {p50_ms:.1f} ms")
        return [
            Trial(setting, *map(statistics.median, zip(*values, strict=True))) for setting, values in measured.items()
        ]

    def _measured(self, setting: Setting) -> tuple[float, float]:
        """Samples a second of all callers, and the median wait of a single one, in milliseconds."""
        with TemporaryDirectory(prefix="rfm-tune-") as folder:
            repository = Path(folder) / "repository"
            shutil.copytree(self.repository.resolve(), repository, copy_function=os.symlink)
            _apply(setting, repository)
            with temporary_server(repository, Path(folder) / "triton.log", self.tritonserver) as endpoints:
                url = endpoints.grpc_url
                with RewardClient(url, model=self.name) as client:
                    frames = client.model_info(frames=self.use_frames).max_frames or NUM_FRAMES
                    toy = Toy(SampleKind.progress, NUM_SAMPLES, [min(frames, NUM_FRAMES)], self.use_frames, seed=0)
                    made_up = toy.samples(client)
                    client.evaluate(made_up)  # whatever is made at first use
                samples = _unseen(made_up)
                alone = asyncio.run(_measure_latencies(url, self.name, samples, 1, self.seconds))
                together = asyncio.run(_measure_latencies(url, self.name, samples, self.callers, self.seconds))
        return len(together) / self.seconds, statistics.median(alone) * 1e3 if alone else math.inf


def quickest(trials: Sequence[Trial]) -> Trial:
    """Of the trials about as fast as the fastest, the one with the shortest wait for a single caller.

    Raises ExportError if none has answered.
    """
    fastest = max(trial.samples_per_s for trial in trials)
    if not fastest:
        raise ExportError("--seconds: expected time for an answer, got none in time with any setting")
    return min((t for t in trials if t.samples_per_s >= AS_FAST * fastest), key=lambda trial: trial.p50_ms)


def write_setting(setting: Setting, output: Path, given: File) -> None:
    """Writes the keys of a file with those of the setting, in sections. Raises OSError."""
    values = {**given.values, "export": given.values["export"] | asdict(setting)}
    sections = {section: keys for section, keys in values.items() if keys}
    output.write_text("# Measured by `rfm tune`.\n" + yaml.safe_dump(sections, sort_keys=False))


def _unseen(samples: Sequence[Sample]) -> Iterator[Sample]:
    """The samples in turn, for ever. Frames are numbered, so that no feature cache has seen one of them before."""
    for number in itertools.count():
        sample = samples[number % len(samples)]
        (trajectory,) = sample.trajectories
        if trajectory.frames is None:
            yield sample
            continue
        frames = trajectory.frames.copy()
        frames.reshape(len(frames), -1)[:, :NUMBER_BYTES] = list(number.to_bytes(NUMBER_BYTES, "little"))
        yield ProgressSample(replace(trajectory, frames=frames))


async def _measure_latencies(
    url: str, model: str, samples: Iterator[Sample], callers: int, seconds: float
) -> list[float]:
    """Latencies in seconds of what is answered within ``seconds``, once the client is connected.

    ``callers`` each ask about one sample after the other, as callers in processes of their own would.
    """
    latencies_s: list[float] = []

    async def call(end_s: float) -> None:
        for sample in samples:
            sent_s = time.perf_counter()
            if sent_s >= end_s:
                return
            await client.score(sample)
            answered_s = time.perf_counter()
            if answered_s <= end_s:
                latencies_s.append(answered_s - sent_s)

    async with AsyncRewardClient(url, model=model, max_in_flight=2 * callers) as client:
        await client.score(next(samples))
        end_s = time.perf_counter() + seconds
        await asyncio.gather(*(call(end_s) for _ in range(callers)))
    return latencies_s


def _apply(setting: Setting, repository: Path) -> None:
    """Rewrites the configurations, which are links until then, as an export of the setting would have them."""
    for name, config in _configs(repository).items():
        lay_out(config, **asdict(setting))
        file = repository / name / CONFIG_FILE
        file.unlink()
        file.write_text(render(config))


def _configs(repository: Path) -> dict[str, pb.ModelConfig]:
    return {name: read_config(repository, name) for name in models_in(repository)}


def lay_out(config: pb.ModelConfig, **changed: int) -> None:
    """Makes of an exported model's configuration what an export with other settings would write.

    changed: ``instances``, ``torch_threads``, ``max_batch_size`` of ExportConfig

    A scorer that was exported without a feature cache gets none: its configuration does not tell whether it could have
    one.
    """
    told, cache = exported_settings(config), FEATURE_CACHE_PARAMETER in config.parameters
    cache_mb = int(config.parameters[FEATURE_CACHE_PARAMETER].string_value) if cache else 0
    settings = ExportConfig(**{**told, "feature_cache_mb": cache_mb, **changed})
    config.max_batch_size = settings.max_batch_size
    if not config.instance_group:  # an ensemble
        return
    if any(output.name == wire.VIDEO_EMBEDDINGS for output in config.output):
        settings = replace(settings, instances=1) if cache_mb else settings
    elif cache and not (settings.feature_cache_mb > 0 and settings.instances == 1):
        del config.parameters[FEATURE_CACHE_PARAMETER]
        kept = [tensor for tensor in config.input if tensor.name != wire.FRAME_DIGESTS]
        del config.input[:]
        config.input.extend(kept)
    num_gpus = len(config.instance_group[0].gpus)
    new = python_config(Interface(config.name, (), ()), settings, num_gpus, version=0, warmups=[])
    config.instance_group[0].CopyFrom(new.instance_group[0])
    config.dynamic_batching.CopyFrom(new.dynamic_batching)
    for name, parameter in new.parameters.items():
        config.parameters[name].CopyFrom(parameter)
