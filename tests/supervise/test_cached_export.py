# SPDX-License-Identifier: MIT
"""``rfm serve CHECKPOINT``: the cache of exports, and what a start says before it downloads."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import types
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import psutil
import pytest
import torch
from safetensors.torch import load_file, save_file

import goldens
import local_hub
import rfm_export
from commands import RFM, nothing_left_behind
from paths import ROOT
from rfm.config import ExportConfig
from rfm.files import CheckpointError
from rfm.published import hub
from rfm.published.hub import Found
from rfm.published.rewind import TEXT_ENCODER
from rfm_client import RewardClient
from rfm_commands.cached_export import find_or_export, is_checkpoint
from rfm_commands.forecast import needs
from rfm_export import ExportError
from servers import Endpoints, Serving

EARLY = ROOT / "examples" / "early_checkpoint"
BEGINS = "rfm: reading the checkpoint ...\n"
GB = 10**9


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with a checkpoint and its encoders."""
    return shutil.copytree(EARLY, tmp_path / "mine", copy_function=shutil.copyfile)


@pytest.fixture
def settings(files: Path) -> ExportConfig:
    encoders = {name: str(files / name) for name in ("image_encoder", "text_encoder")}
    return ExportConfig(checkpoint=str(files / "checkpoint"), num_gpus=0, **encoders)  # type: ignore[arg-type]


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "rfm"


def exports(cache: Path) -> set[Path]:
    return {*cache.glob("*/models")}


def test_only_a_checkpoint_is_taken_for_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "model_repository", "org/models")
    shutil.copytree(EARLY / "checkpoint", "org/mine")
    shutil.copytree("org/models", "org/both")
    shutil.copy("org/mine/config.json", "org/both")
    words = ("org/mine", "org/models/rfm/1/checkpoint", "org/name", "org/name/sub@v1")
    others = ("org/models", "org/models/rfm", "org/both", "org", "models", "/org/name", "./name", "~/name")
    assert [word for word in (*words, *others) if is_checkpoint(word)] == [*words]


def test_an_export_is_kept_until_something_that_decides_it_changes(
    files: Path,
    settings: ExportConfig,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The text encoder is the default, of which a folder lies here."""
    shutil.move(files / "text_encoder", files / TEXT_ENCODER)
    monkeypatch.chdir(files)
    settings = replace(settings, text_encoder=None)
    for file in ("", "checkpoint/config.json", "image_encoder/config.json", f"{TEXT_ENCODER}/config.json"):
        if file:
            changed = json.loads((files / file).read_text()) | {"license": "mit"}
            (files / file).write_text(json.dumps(changed))
        for asked in (settings, replace(settings, max_batch_size=3)):
            repository = find_or_export(asked, cache)
            told = capsys.readouterr().err
            assert BEGINS in told
            assert "rfm: download: nothing for the checkpoint itself\n" in told
            (note,) = [line for line in told.splitlines() if line.startswith("rfm: not shown by")]
            assert find_or_export(asked, cache) == repository
            served = f"rfm: {asked.checkpoint}: served from its export {repository}"
            assert capsys.readouterr().err.splitlines() == [note, served]
    assert len(exports(cache)) == 8


def test_a_pipe_in_the_place_of_weights_is_refused(files: Path, settings: ExportConfig, cache: Path) -> None:
    (weights := files / "image_encoder" / "model.safetensors").unlink(missing_ok=True)
    os.mkfifo(weights)
    with pytest.raises(CheckpointError, match=r"image_encoder/model\.safetensors: expected a file, got a pipe"):
        find_or_export(settings, cache)


def test_an_interrupted_export_is_never_served(
    settings: ExportConfig, cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It ends when all files are written; a killed one leaves its folder."""
    export = rfm_export.export

    def interrupted(source: str, repository: Path, *more: object, **options: object) -> None:
        export(source, repository, *more, **options)  # type: ignore[arg-type]
        shutil.copytree(repository.parent, repository.parent.with_name(".export-killed"))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("rfm_export.export", interrupted, raising=False)
        find_or_export(settings, cache)
    assert not exports(cache)
    repository = find_or_export(settings, cache)
    assert capsys.readouterr().err.count(BEGINS) == 2
    assert sorted(path.name for path in repository.parent.iterdir()) == ["models", "notes.txt"]


def test_of_two_starts_at_once_one_exports_and_the_other_waits(
    settings: ExportConfig, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(lambda _: find_or_export(settings, cache), range(2))
    assert first == second
    told = capsys.readouterr().err
    assert told.count(BEGINS) == 1
    assert told.count(f"rfm: another start exports {settings.checkpoint}: waiting\n") == 1


def test_a_better_tag_of_the_hub_gives_another_export_and_without_the_hub_the_cache_answers(
    files: Path, settings: ExportConfig, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings, checkpoint = replace(settings, checkpoint="org/mine"), files / "checkpoint"
    (main := checkpoint.parent / "main").mkdir()
    (main / "config.yaml").write_text("data: {max_frames: 8}")
    revisions = {"main": main, "best-p-0.5-step-1": checkpoint}
    hub_cache = checkpoint.parent / "hub"
    with local_hub.hub({"org/mine": revisions}) as endpoint, local_hub.asked(endpoint, hub_cache):
        first = find_or_export(settings, cache)
        told = capsys.readouterr().err
        size_mb = sum(file.stat().st_size for file in checkpoint.iterdir()) / 1e6
        assert f"rfm: download: {size_mb:.3g} MB, less than a second at 15 MB/s\n" in told
        assert find_or_export(settings, cache) == first
        assert BEGINS not in capsys.readouterr().err
        revisions["best-p-0.7-step-2"] = checkpoint
        second = find_or_export(settings, cache)
        assert BEGINS in capsys.readouterr().err
    with local_hub.asked(endpoint, hub_cache):
        assert find_or_export(settings, cache) == second
    told = capsys.readouterr().err
    assert told.count("rfm: org/mine@best-p-0.7-step-2 of the cache is used") == 1
    assert BEGINS not in told
    assert exports(cache) == {first, second}


@pytest.mark.parametrize(("when", "begun"), [("rfm_commands.forecast.needs", 1), ("rfm_export.export", 2)])
def test_a_better_tag_that_comes_meanwhile_is_exported_instead(
    files: Path,
    settings: ExportConfig,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    when: str,
    begun: int,
) -> None:
    """when: the step in which a training run pushes it"""
    revisions = {"main": files / "checkpoint", "best-p-0.5-step-1": files / "checkpoint"}
    step = resolve_name(when)

    def pushed(*arguments: Any, **options: Any) -> Any:
        revisions["best-p-0.7-step-2"] = files / "checkpoint"
        return step(*arguments, **options)

    monkeypatch.setattr(when, pushed)
    with local_hub.hub({"org/mine": revisions}) as endpoint, local_hub.asked(endpoint, files / "hub"):
        repository = find_or_export(replace(settings, checkpoint="org/mine"), cache)
    assert capsys.readouterr().err.count(BEGINS) == begun
    assert exports(cache) == {repository}
    assert local_hub.commit_of("best-p-0.7-step-2") in (repository / "rfm_frames" / "config.pbtxt").read_text()


@pytest.mark.parametrize("source", ["folder", "org/adapter"])
def test_a_changed_base_model_that_an_adapter_names_gives_another_export(
    tmp_path: Path, cache: Path, source: str
) -> None:
    """Where the run trained, its config.yaml names a folder."""
    golden = goldens.config("q25_peft_adapter_disc10")
    adapter = shutil.copytree(golden.checkpoint, tmp_path / "adapter")
    base = shutil.copytree(str(golden.base_model), tmp_path / "Qwen2.5-VL-3B-Instruct", copy_function=shutil.copyfile)
    run = (adapter / "config.yaml").read_text()
    (adapter / "config.yaml").write_text(re.sub("base_model_id: .*", f"base_model_id: {base}", run))
    settings = ExportConfig(checkpoint=str(adapter) if source == "folder" else source, num_gpus=0)
    with local_hub.hub({"org/adapter": {"main": adapter}}) as endpoint, local_hub.asked(endpoint, tmp_path / "hub"):
        first = find_or_export(settings, cache)
        assert find_or_export(settings, cache) == first
        (weights,) = base.glob("*.safetensors")
        tensors = load_file(weights)
        name = next(name for name, tensor in tensors.items() if tensor.ndim == 2)
        save_file(tensors | {name: tensors[name] + 0.5}, weights, {"format": "pt"})
        second = find_or_export(settings, cache)
    assert exports(cache) == {first, second}
    assert first != second


@pytest.fixture
def large(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """A Hub with 8.9 GB of weights, which nobody may download, and its cache."""
    (folder := tmp_path / "large").mkdir()
    for number, size in enumerate((5 * GB, 3_900_000_000), 1):
        with (folder / f"model-0000{number}-of-00002.safetensors").open("wb") as file:
            file.truncate(size)
    (folder / "config.json").write_text("{}")
    repositories, parameters = {"org/Large-4B": {"main": folder}}, {"BF16": 4_450_000_000}
    with (
        local_hub.hub(repositories, parameters=parameters) as endpoint,
        local_hub.asked(endpoint, tmp_path / "hub"),
    ):
        yield "org/Large-4B", tmp_path / "hub"


def test_a_start_says_what_it_takes_and_refuses_too_little_memory_before_the_download(
    large: tuple[str, Path], cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source, hub_cache = large
    monkeypatch.setattr(psutil, "virtual_memory", lambda: types.SimpleNamespace(available=16 * GB))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {*range(8)})
    with pytest.raises(ExportError) as refused:
        find_or_export(ExportConfig(checkpoint=source, num_gpus=0), cache)
    assert str(refused.value) == (
        "memory: expected at least 38.3 GB, got 16 GB free; use a machine with more, or with a GPU; rfm export tries it all the same"
    )
    told = re.sub(r"[\d.]+ GB are free", "N GB are free", capsys.readouterr().err)
    assert told.splitlines() == [
        "rfm: download: 8.9 GB, about 10 minutes at 15 MB/s",
        f"rfm: disk: 8.9 GB in {hub_cache}; N GB are free",
        f"rfm: disk: 8.9 GB in {cache}; N GB are free",
        "rfm: memory: about 51.1 GB to export, then 27.4 GB to serve; N GB are free",
        "rfm: no GPU: the CPU takes about 13 s for a sample with 8 frames of 224x224, by an estimate",
    ]
    assert not list(hub_cache.rglob("*.safetensors"))
    assert not exports(cache)


LARGE = Found((), {"model.safetensors": 8_900_000_000})
REFUSED = {
    "a disk": (0, 200, {"free": 8}, r"disk of .*: expected at least 8\.9 GB, got 8 GB free; make room, or set XDG"),
    "a GPU": (8, 200, {}, r"GPU memory: expected at least 8\.9 GB, got 8 GB free; --weights int8 halves them, or "),
    "memory beside a GPU": (80, 12, {}, r"memory: expected at least 17\.7 GB, got 12 GB free; use a machine"),
    "memory beside a small GPU": (10, 30, {}, r"memory: expected at least 38\.3 GB, got 30 GB free; use a mach"),
    "nothing": (80, 20, {}, ""),
}


@pytest.mark.parametrize(("of_gpu", "of_host", "of_disk", "message"), REFUSED.values(), ids=REFUSED)
def test_a_plain_lack_of_room_is_refused_with_a_remedy(
    cache: Path, monkeypatch: pytest.MonkeyPatch, of_gpu: int, of_host: int, of_disk: dict[str, int], message: str
) -> None:
    """With pretended sizes, in GB. of_gpu: 0: no GPU"""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (of_gpu * GB, 80 * GB))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "NVIDIA H200")
    monkeypatch.setattr(psutil, "virtual_memory", lambda: types.SimpleNamespace(available=of_host * GB))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: types.SimpleNamespace(free=of_disk.get("free", 100) * GB))
    found = [*needs(LARGE, ExportConfig(), 1 if of_gpu else 0, cache)]
    if of_gpu:
        assert found[-1].line == f"GPU: NVIDIA H200, on which the weights take about 8.9 GB; {of_gpu} GB are free"
    faults = []
    for each in found:
        try:
            each.check()
        except ExportError as error:
            faults.append(str(error))
    assert len(faults) == bool(message), faults
    assert not message or re.match(message, faults[0]), faults


@pytest.mark.parametrize(("float32_bytes", "needed"), [(0, 8.9 * GB), (4 * GB, 6.9 * GB), (None, 0)])
def test_float32_counts_half_and_weights_of_an_unknown_type_are_not_refused(
    cache: Path, monkeypatch: pytest.MonkeyPatch, float32_bytes: int | None, needed: float
) -> None:
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (8 * GB, 8 * GB))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "NVIDIA H200")
    *_, of_host, of_gpu = needs(replace(LARGE, float32_bytes=float32_bytes), ExportConfig(), 1, cache)
    assert of_gpu.needed == needed
    assert bool(of_host.needed) == bool(needed)


@pytest.mark.parametrize(("parameters", "float32_bytes"), [({"F32": 2, "BF16": 5}, 8), (None, None)])
def test_the_hub_and_the_files_tell_the_weights_type(
    files: Path, parameters: dict[str, int] | None, float32_bytes: int | None
) -> None:
    revisions = {"org/mine": {"main": files / "checkpoint"}}
    with local_hub.hub(revisions, parameters=parameters) as endpoint, local_hub.asked(endpoint, files / "hub"):
        assert hub.look("org/mine").float32_bytes == float32_bytes
        local = hub.find("org/mine")
        tensors = load_file(local / "model.safetensors").values()
        counted = sum(tensor.nbytes for tensor in tensors if tensor.dtype == torch.float32)
        assert counted
        assert hub.look("org/mine").float32_bytes == hub.look(local).float32_bytes == counted


@pytest.mark.triton
@pytest.mark.slow
def test_a_checkpoint_is_served_in_one_command(
    files: Path, settings: ExportConfig, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the FastAPI server's file names it, which needs no folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache.parent))
    (config := files / "server.yaml").write_text(f"model_path: {settings.checkpoint}\nnum_gpus: 0\n")
    encoders = ["--image-encoder", settings.image_encoder, "--text-encoder", settings.text_encoder]
    endpoints, status = Endpoints.free(), Endpoints.free().http_port
    ports = [f"--{name}-port={getattr(endpoints, f'{name}_port')}" for name in ("http", "grpc", "metrics")]
    log = files / "log"
    with nothing_left_behind(), log.open("wb") as lines:
        words = [RFM, "serve", "--config", config, f"--status-port={status}", *encoders, *ports]
        with subprocess.Popen(words, stdout=lines, stderr=lines) as process:
            try:
                Serving(process, endpoints, f"http://127.0.0.1:{status}", log).wait_ready()
                with RewardClient(endpoints.grpc_url) as client:
                    assert client.model_info(frames=True).source == "mine/checkpoint"
            finally:
                process.terminate()
    (repository,) = exports(cache)
    assert f"rfm: {settings.checkpoint}: served from its export {repository}\n" in log.read_text()
