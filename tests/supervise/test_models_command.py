# SPDX-License-Identifier: MIT
"""rfm models: versions of a running server are loaded, rolled out and rolled back, and outlive a restart."""

from __future__ import annotations

import os
import re
import shutil
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import safetensors.torch
from tritonclient.grpc.model_config_pb2 import ModelConfig
from typer.testing import Result

import goldens
import rfm_export
import rollout
from engines import load_engine, serve_config
from in_process import rfm
from reward_models import ROOT
from rfm.config import ExportConfig
from rfm.serve.repository_api import RepositoryApi, RepositoryApiError
from rfm_client import ModelNotFoundError, ProgressSample, RewardClient, ServerError
from rfm_commands import rollout as rfm_rollout
from rfm_commands.rollout import Rollout, RolloutError
from rfm_export.layout import description_in
from rfm_export.publish import read_config
from rollout import NAME, WITH_ENCODERS, callers
from servers import Serving, administered, wait_for
from trajectories import random_trajectory

pytestmark = [pytest.mark.triton, pytest.mark.slow]

PLAIN = goldens.config("c1_t1_disc10")  # embeddings alone
PARTS = ("rfm_encoder", "rfm", "rfm_frames")


@dataclass(frozen=True)
class Running:
    """An ``rfm serve`` with the reference checkpoint with encoders as ``rfm``, which asks for KEY."""

    served: Serving
    repository: Path

    def ask(self, command: str, *words: str) -> Result:
        options = [f"--url={self.served.endpoints.grpc_url}", f"--admin-key-file={self.repository.parent / 'key'}"]
        return rfm(
            "models", command, *words, *options, *([] if command == "list" else [f"--repository={self.repository}"])
        )

    def models(self, command: str, *words: str) -> str:
        """Return the output of ``rfm models COMMAND``."""
        done = self.ask(command, *words)
        assert done.exit_code == 0, done.output
        return done.stdout

    def refused(self, command: str, *words: str) -> str:
        """Return the message of a failed command."""
        done = self.ask(command, *words)
        assert done.exit_code == 1, done.output
        (line,) = done.stderr.splitlines()
        return line

    def listed(self) -> list[list[str]]:
        return [line.split() for line in self.models("list").splitlines()]

    def ready(self, model: str) -> list[str]:
        return [row[1] for row in self.listed() if row[0] == model and row[2:] == ["READY"]]

    def served_by_restart(self, model: str) -> list[int]:
        return list(read_config(self.repository, model).version_policy.specific.versions)

    def client(self, model: str) -> RewardClient:
        return self.served.client(model=model, retry=False)

    def export_plain(self, name: str, checkpoint: Path = PLAIN.checkpoint) -> None:
        rfm_export.export(checkpoint, self.repository, serve_config(PLAIN, name))


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    repository = tmp_path_factory.mktemp("running") / "repository"
    rollout.export(WITH_ENCODERS.checkpoint, repository)
    with administered(repository) as served:
        yield Running(served, repository)


@pytest.mark.nightly
@pytest.mark.parametrize("family", ["rynnvalue", "robodopamine"])
def test_a_model_whose_progress_may_be_missing_is_rolled_out(running: Running, family: str) -> None:
    """The small Robo-Dopamine also writes answers without a score."""
    checkpoint = {"rynnvalue": "bro_symlog_bf16_tied", "robodopamine": "grm_qwen3vl_bf16_tied"}[family]
    options = {"robot_description": "an arm"} if family == "rynnvalue" else {"reward_model": family}
    config = ExportConfig(name=family, num_gpus=0, **options)  # type: ignore[arg-type]
    for version in ("1", "2"):
        rfm_export.export(ROOT / family / checkpoint / "checkpoint", running.repository, config)
        if version == "1":
            running.models("load", family)
    assert running.models("rollout", family, "2").endswith(f"{family}: version 2 is served\n")
    running.models("unload", family)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("rollout", "nobody", "1"), ", got nobody"),
        (("rollout", NAME, "77"), "rfm version 77: expected an exported version, got "),
        (("rollback", NAME), "expected a version before 1, got none"),
    ],
    ids=["name", "version", "none before"],
)
def test_an_unknown_name_or_version_is_refused_and_nothing_changes(
    running: Running, words: tuple[str, ...], message: str
) -> None:
    before = running.models("list")
    assert message in running.refused(*words)
    assert running.models("list") == before


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("http://127.0.0.1:8000", "'--url': expected grpc://host:port (its gRPC port, 8001) or with TLS grpcs://"),
        ("127.0.0.1:8001", "'--url': expected grpc://host:port or http://host:port"),
        ("grpc://127.0.0.1:1 grpc://127.0.0.1:2", "'--url': expected one server, got grpc://127.0.0.1:1 grpc"),
    ],
)
def test_another_url_than_a_server_s_for_grpc_is_refused(url: str, message: str) -> None:
    for words, variables in ((["--url", url], {}), ([], {"RFM_URL": url})):
        done = rfm("models", "list", *words, env={"COLUMNS": "300", **variables})
        assert done.exit_code == 2
        assert message in done.stderr.splitlines()[-1]


def test_a_broken_version_is_never_asked_and_a_good_one_is_rolled_out(running: Running, tmp_path: Path) -> None:
    """No call is lost, and the other models stay."""
    name, sample = "fragile", ProgressSample(random_trajectory(1, 5))
    running.export_plain(name)
    tomorrow_s = time.time() + 86400
    os.utime(running.repository / name / "config.pbtxt", (tomorrow_s, tomorrow_s))  # the clock was set back since
    assert re.fullmatch(f"{name}: loading\n{name}: 1 ready after \\d+ s\n", running.models("load", name))
    running.export_plain(name, rollout.other_checkpoint(tmp_path / "other", PLAIN.checkpoint))
    expected = load_engine(PLAIN.name).evaluate([sample])
    weights = running.repository / name / "2" / "checkpoint" / "model.safetensors"
    changed = safetensors.torch.load_file(weights)
    changed["progress_head.4.weight"] *= 1.5  # numbers all the same
    safetensors.torch.save_file(changed, weights, {"format": "pt"})
    with callers(running.served.endpoints.grpc_url, [sample], {"1": expected, "3": expected}, model=name) as tally:
        line = running.refused("rollout", name, "2")
        assert line.startswith(f"rfm: {name} version 2: ")
        assert "/2: expected the weights that were exported (" in line
        assert line.endswith(f"(served as before: {name}: version 1)")
        (running.repository / name / "2" / "model.py").unlink()  # as in a folder that was copied in part
        assert f"/{name}/2/model.py: expected the model's program, got none" in running.refused("rollout", name, "2")
        assert (running.served_by_restart(name), running.ready(name)) == ([1], ["1"])
        running.export_plain(name)
        assert running.models("rollout", name, "3").endswith(f"{name}: version 3 is served\n")
        assert (running.served_by_restart(name), running.ready(name)) == ([3], ["3"])
        with running.client(name) as client:
            assert client.model_info().versions == ("3",)  # Triton's configuration names 1, too
        wait_for(lambda: tally.by_version["3"])
    assert (tally.failed, tally.unlike, set(tally.by_version)) == ([], [], {"1", "3"})
    with running.client(NAME) as client:
        assert client.is_ready()  # a failed call is no reason to stop
    assert running.models("unload", name) == f"{name}: unloaded\n"
    listed = running.listed()
    assert [name, "3", "UNAVAILABLE", "unloaded"] in listed
    assert ["rfm_frames", "1", "READY"] in listed
    with running.client(name) as client, pytest.raises((ModelNotFoundError, ServerError)):
        client.progress(random_trajectory(0, 3))


def test_a_crash_before_or_in_a_rollout_leaves_the_versions_that_were_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Callers are told to ask again, and the rollout leaves no second version loaded."""
    repository, sample = tmp_path / "repository", ProgressSample(random_trajectory(1, 5, *rollout.WIDTHS))
    other = rollout.other_checkpoint(tmp_path / "other")
    rollout.export(WITH_ENCODERS.checkpoint, repository)
    expected = {
        version: rollout.answers(checkpoint, [sample])
        for version, checkpoint in {"1": WITH_ENCODERS.checkpoint, "2": other}.items()
    }
    with administered(repository) as served, served.api() as api:
        rollout.export(other, repository)
        running = Running(served, repository)

        def crash_at_last(server: RepositoryApi, config: ModelConfig, version: int) -> None:
            probe(server, config, version)
            if config.name == "rfm":  # both parts serve both versions
                os.kill(served.triton, signal.SIGKILL)
                probe(server, config, version)

        def versions() -> dict[str, tuple[list[int], list[int]]]:
            state = served.ready().json()["models"]
            return {part: (state[part]["versions"], state[part]["versions_in_file"]) for part in PARTS}

        with callers(served.endpoints.grpc_url, [sample], expected) as tally:
            os.kill(served.triton, signal.SIGKILL)
            wait_for(lambda: served.restarts("triton") == 1)
            served.wait_ready()
            assert versions() == dict.fromkeys(PARTS, ([1], [2]))
            probe = rfm_rollout.probe
            monkeypatch.setattr(rfm_rollout, "probe", crash_at_last)
            with pytest.raises(RolloutError, match="served as before: rfm_encoder: version 1; rfm: version 1; "):
                Rollout(repository, NAME, api, lambda line: None).to(2)
            monkeypatch.setattr(rfm_rollout, "probe", probe)
            wait_for(lambda: versions() == dict.fromkeys(PARTS, ([1], [1])), told=versions)
            assert running.models("rollout", NAME, "2").endswith(f"{NAME}: version 2 is served\n")
            wait_for(lambda: tally.by_version["2"])
        wait_for(lambda: versions() == dict.fromkeys(PARTS, ([2], [2])))
    assert tally.unlike == []
    assert {error.partition("(")[0] for error in tally.failed} == {"ServerUnavailableError"}


@dataclass
class GoingAway:
    """A server that answers until it has loaded ``loads`` models, and again when it was asked ``misses`` times more."""

    served: dict[str, list[int]]
    loads: int
    misses: int
    repository: Path
    loaded: list[str] = field(default_factory=list)

    def ready_versions(self, model: str) -> list[int]:
        return self.served[model]

    def config(self, model: str) -> ModelConfig:
        return read_config(self.repository, model)

    def load(self, model: str) -> None:
        if len(self.loaded) >= self.loads and self.misses:
            self.misses -= 1
            raise RepositoryApiError("no answer")
        self.loaded.append(model)

    def unload(self, model: str) -> None:
        self.load(f"not {model}")

    def wait_gone(self, model: str, kept: list[int]) -> None:
        pass


@pytest.fixture(scope="module")
def three_models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Encoder, scorer and ensemble with a served version 1 and an exported version 2."""
    repository = tmp_path_factory.mktemp("three") / "repository"
    rollout.export(WITH_ENCODERS.checkpoint, repository)
    rollout.export(WITH_ENCODERS.checkpoint, repository)
    return repository


def test_each_model_is_probed_once_more_when_its_old_version_is_gone(
    three_models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Unloading(GoingAway):
        def wait_gone(self, model: str, kept: list[int]) -> None:
            self.loaded.append("the old version is gone")

    server = Unloading({part: [1] for part in PARTS}, 10**9, 0, three_models)
    monkeypatch.setattr(rfm_rollout, "probe", lambda *_: server.loaded.append("probe"))
    Rollout(shutil.copytree(three_models, tmp_path / "copy"), NAME, server, lambda line: None).to(2)  # type: ignore[arg-type]
    asked = zip(server.loaded, [*server.loaded[1:], ""], strict=True)
    assert [after for before, after in asked if before == "the old version is gone"] == ["probe"] * 3


def test_another_repository_than_the_servers_is_refused(three_models: Path, tmp_path: Path) -> None:
    own = shutil.copytree(three_models, tmp_path / "own")
    config = own / "rfm_encoder" / "config.pbtxt"
    digest = description_in(read_config(own, "rfm_encoder")).weights_digest
    config.write_text(config.read_text().replace(str(digest), "0" * 16))
    server = GoingAway({part: [1] for part in PARTS}, 0, 0, own)
    with pytest.raises(
        RolloutError, match=rf"{three_models}/rfm_encoder: expected the weights .* 0{{16}}, got {digest}"
    ):
        Rollout(three_models, NAME, server, lambda line: None).to(2)  # type: ignore[arg-type]
    assert server.loaded == []


@pytest.mark.parametrize("loads", [0, 2, 4])
@pytest.mark.parametrize("returns", [True, False], ids=["and comes back", "for good"])
def test_a_server_lost_during_a_rollout_leaves_the_earlier_versions_for_a_restart(
    three_models: Path, monkeypatch: pytest.MonkeyPatch, loads: int, returns: bool
) -> None:
    """``rfm_frames`` was not served."""
    monkeypatch.setattr(rfm_rollout, "probe", lambda *_: None)
    monkeypatch.setattr(rfm_rollout, "RETURN_S", 60.0 if returns else 0.0)
    monkeypatch.setattr(rfm_rollout, "POLL_S", 0.0)
    server = GoingAway({"rfm_encoder": [1], "rfm": [1], "rfm_frames": []}, loads, 9 if returns else 10**9, three_models)
    ensemble = (three_models / "rfm_frames" / "config.pbtxt").read_bytes()
    with pytest.raises(RolloutError) as caught:
        Rollout(three_models, NAME, server, lambda line: None).to(2)  # type: ignore[arg-type]
    assert [list(read_config(three_models, part).version_policy.specific.versions) for part in PARTS[:2]] == [[1], [1]]
    assert (three_models / "rfm_frames" / "config.pbtxt").read_bytes() == ensemble
    message = str(caught.value)
    assert message.startswith("rfm version 2: no answer (")
    if returns:
        assert set(server.loaded[loads:]) == {"rfm_encoder", "rfm", "not rfm_frames"}
        assert message.endswith("(served as before: rfm_encoder: version 1; rfm: version 1; rfm_frames: none)")
    else:
        why = "; ".join(f"{part}: no answer" for part in reversed(PARTS))
        assert message.endswith(f"(expected to serve again what it served, got: {why})")
