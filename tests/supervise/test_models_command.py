# SPDX-License-Identifier: MIT
"""rfm models: versions of a running server are loaded, rolled out and rolled back."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
from tritonclient.grpc import model_config_pb2 as pb

import rollout
from administered import KEY, PLAIN, Running, export_plain
from engines import load_engine
from rfm.launch.repository_api import RepositoryApi, RepositoryApiError
from rfm_client import ModelNotFoundError, ProgressSample, RewardClient, ServerError
from rfm_commands import rollout as rfm_rollout
from rfm_commands.rollout import Rollout, RolloutError
from rfm_export.publish import read_config
from rollout import NAME, RFM, WITH_ENCODERS, callers, difference
from trajectories import random_trajectory

pytestmark = [pytest.mark.triton, pytest.mark.slow]

CONNECTIONS = 24  # of each protocol; Triton has 8 threads for HTTP
DEADLINE_S = 20.0
POLL_S = 0.02


WAITS_AT_IMPORT = """
import time, pathlib
pathlib.Path({begun!r}).touch()
while not pathlib.Path({may_end!r}).exists():
    time.sleep(0.02)
"""


@pytest.fixture(scope="module")
def other_plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rollout.other_checkpoint(tmp_path_factory.mktemp("plain") / "other", PLAIN.checkpoint)


def test_a_name_is_loaded_listed_and_unloaded_beside_the_others(running: Running) -> None:
    export_plain(running.repository, "listed")
    assert running.models("load", "listed") == "listed: 1 ready\n"
    listed = [line.split() for line in running.models("list").splitlines()]
    assert ["listed", "1", "READY"] in listed
    assert ["rfm_frames", "1", "READY"] in listed
    assert running.models("unload", "listed") == "listed: unloaded\n"
    assert ["listed", "1", "UNAVAILABLE", "unloaded"] in [line.split() for line in running.models("list").splitlines()]
    with running.client("listed") as client, pytest.raises((ModelNotFoundError, ServerError)):
        client.progress(random_trajectory(0, 3))
    running.models("load", "listed")
    with running.client("listed") as client:
        assert np.isfinite(client.progress(random_trajectory(0, 3)).progress).all()


@contextmanager
def loading(running: Running, name: str, folder: Path) -> Iterator[None]:
    """Within it Triton is loading a model: its process waits for a file that comes at the end."""
    export_plain(running.repository, name)
    begun, may_end = folder / "begun", folder / "may_end"
    model_file = running.repository / name / "1" / "model.py"
    future, _, rest = model_file.read_text().partition("from __future__ import annotations\n")
    wait = WAITS_AT_IMPORT.format(begun=str(begun), may_end=str(may_end))
    model_file.write_text(f"{future}from __future__ import annotations\n{wait}{rest}")
    with ThreadPoolExecutor(1) as thread, RepositoryApi(running.endpoints.grpc_url, KEY) as server:
        load = thread.submit(server.load, name)
        try:
            while not begun.exists():
                assert not load.done(), load.result()
                time.sleep(POLL_S)
            yield
        finally:
            may_end.touch()
        load.result()
        assert server.ready_versions(name) == [1]


def test_callers_are_answered_while_another_model_loads(running: Running, tmp_path: Path) -> None:
    """All of several connections for each thread that Triton has for HTTP. The load ends after they have been answered."""
    trajectory = random_trajectory(1, 5, *rollout.WIDTHS)
    urls = (running.endpoints.http_url, running.endpoints.grpc_url) * CONNECTIONS
    with ExitStack() as stack, ThreadPoolExecutor(len(urls)) as threads:
        clients = [stack.enter_context(RewardClient(url, model=NAME, retry=False)) for url in urls]

        def ask(client: RewardClient) -> bool:
            return bool(np.isfinite(client.progress(trajectory, timeout_s=DEADLINE_S).progress).all())

        assert all(threads.map(ask, clients))  # they are connected: new connections would keep away from a busy thread
        with loading(running, "held", tmp_path):
            assert all(threads.map(ask, clients))
            # What is told over gRPC does not wait either.
            assert ["held", "1", "LOADING"] in [line.split() for line in running.models("list").splitlines()]
    running.models("unload", "held")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        pytest.param(("rollout", "nobody", "1"), ", got nobody", id="name"),
        pytest.param(
            ("rollout", NAME, "77"), "rfm version 77: expected an exported version, got [Errno 2]", id="version"
        ),
        pytest.param(("load", "nobody"), ", got nobody", id="load"),
    ],
)
def test_what_is_not_there_is_told_and_nothing_changes(running: Running, words: tuple[str, ...], message: str) -> None:
    before = running.models("list")
    assert message in running.refused(*words)
    assert running.models("list") == before


@pytest.mark.parametrize(
    ("url", "words", "message"),
    [
        ("http://127.0.0.1:8000", (), "url: expected grpc://host:port (its gRPC port, 8001) or with TLS grpcs://"),
        ("127.0.0.1:8001", (), "url: expected grpc://host:port or http://host:port"),
        ("grpc://127.0.0.1:1", (), "grpc://127.0.0.1:1: failed to connect to all addresses"),
        ("grpcs://h:1", ("--ca-file", "/nowhere"), "ca_file: expected certificates (PEM) at /nowhere"),
        ("grpc://h:1", ("--ca-file", __file__), "ca_file: expected certificates (PEM)"),
    ],
)
def test_a_server_that_cannot_be_reached_is_told(url: str, words: tuple[str, ...], message: str) -> None:
    line = [str(RFM), "models", *words, "list", "--url", url]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    (told,) = done.stderr.splitlines()
    assert told.startswith(f"rfm: {message}")


def test_a_rollout_and_a_rollback_lose_no_request_and_mix_no_versions(running: Running, tmp_path: Path) -> None:
    other, samples = rollout.other_checkpoint(tmp_path / "other"), rollout.questions()
    expected = {"1": rollout.answers(WITH_ENCODERS.checkpoint, samples), "2": rollout.answers(other, samples)}
    assert min(difference(*pair) for pair in zip(expected["1"], expected["2"], strict=True)) > rollout.CLEARLY
    rollout.export(other, running.repository)
    parts = ("rfm", "rfm_encoder", "rfm_frames")
    with (
        callers(running.endpoints.http_url, samples, expected, count=rollout.CALLERS // 2) as over_http,
        callers(running.endpoints.grpc_url, samples, expected, count=rollout.CALLERS // 2) as tally,
    ):
        assert tally.by_version.keys() == over_http.by_version.keys() == {"1"}  # an export alone changes nothing
        assert running.models("rollout", NAME, "2").endswith("rfm: version 2 is served\n")
        assert [running.served_by_restart(part) for part in parts] == [[2]] * 3
        by_first = tally.by_version["1"]
        assert tally.by_version["2"] > 0
        with running.client(NAME) as client:
            source = client.model_info().source
        assert source == f"{tmp_path.name}/other"
        assert running.models("rollback", NAME).endswith("rfm: version 1 is served\n")
        assert [running.served_by_restart(part) for part in parts] == [[1]] * 3
        assert tally.by_version["1"] > by_first
        with running.client(NAME) as client:
            assert client.model_info().source == "enc_c1_t1_disc10/checkpoint"
    for each in (tally, over_http):
        assert (each.failed, each.unlike) == ([], [])
        assert each.asked == each.answered > rollout.CALLERS
        assert each.by_version.keys() == {"1", "2"}
    assert "expected a version before 1, got none" in running.refused("rollback", NAME)


def break_weights(version: Path) -> None:
    file = version / "checkpoint" / "model.safetensors"
    weights = safetensors.torch.load_file(file)
    weights["progress_head.4.weight"] *= 1.5  # numbers all the same
    safetensors.torch.save_file(weights, file, {"format": "pt"})


def break_settings(version: Path) -> None:
    (version / "checkpoint" / "config.json").write_text("{")


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        pytest.param(break_weights, "/2: expected the weights that were exported (", id="weights"),
        pytest.param(break_settings, "/2/checkpoint/config.json: expected JSON, got Expecting property", id="settings"),
    ],
)
def test_a_broken_version_is_never_asked_and_the_old_one_stays(
    running: Running, other_plain: Path, damage: Callable[[Path], None], reason: str
) -> None:
    name = damage.__name__
    export_plain(running.repository, name)
    running.models("load", name)
    export_plain(running.repository, name, other_plain)
    damage(running.repository / name / "2")
    sample = ProgressSample(random_trajectory(1, 5))
    expected = load_engine(PLAIN.name).evaluate([sample])
    with callers(running.endpoints.grpc_url, [sample], {"1": expected}, model=name) as tally:
        line = running.refused("rollout", name, "2")
    assert line.startswith(f"rfm: {name} version 2: ")
    assert reason in line
    assert line.endswith(f"(served as before: {name}: version 1)")
    assert (tally.failed, tally.unlike, set(tally.by_version)) == ([], [], {"1"})
    assert running.served_by_restart(name) == [1]
    assert served_versions(running, name) == ["1"]
    with running.client(NAME) as client:
        assert client.is_ready()  # what failed is no reason to ask nobody here


def test_a_rollout_that_fails_at_its_end_goes_back_and_loses_no_request(
    running: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ensemble has gone over to the new version, and fails the probe."""
    name, ensemble = "late", "late_frames"
    rollout.export(WITH_ENCODERS.checkpoint, running.repository, name)
    running.models("load", name)
    other, samples = rollout.other_checkpoint(tmp_path / "other"), rollout.questions()
    rollout.export(other, running.repository, name)
    expected = {"1": rollout.answers(WITH_ENCODERS.checkpoint, samples), "2": rollout.answers(other, samples)}
    probe = rfm_rollout.probe

    def failing(server: RepositoryApi, config: pb.ModelConfig, version: int) -> None:
        if config.name == ensemble:
            raise RepositoryApiError("made up")
        probe(server, config, version)

    monkeypatch.setattr(rfm_rollout, "probe", failing)
    parts = ("late_encoder", "late", ensemble)
    with callers(running.endpoints.grpc_url, samples, expected, model=name) as tally:
        with (
            RepositoryApi(running.endpoints.grpc_url, KEY) as server,
            pytest.raises(RolloutError, match=r"made up \(served as before: late_encoder: version 1; late: version 1"),
        ):
            Rollout(running.repository, name, server, lambda line: None).to(2)
        assert [served_versions(running, part) for part in parts] == [["1"]] * 3
        assert [running.served_by_restart(part) for part in parts] == [[1]] * 3
    assert (tally.failed, tally.unlike) == ([], [])
    assert tally.asked == tally.answered > rollout.CALLERS
    running.models("unload", name)


@dataclass
class GoingAway:
    """A server that answers until it has loaded ``loads`` models, and again when it was asked ``misses`` times more."""

    served: dict[str, list[int]]
    loads: int
    misses: int
    loaded: list[str] = field(default_factory=list)

    def ready_versions(self, model: str) -> list[int]:
        return self.served[model]

    def load(self, model: str) -> None:
        self._answer()
        self.loaded.append(model)

    def unload(self, model: str) -> None:
        self._answer()
        self.loaded.append(f"not {model}")

    def wait_gone(self, model: str, kept: list[int]) -> None:
        pass

    def _answer(self) -> None:
        if len(self.loaded) >= self.loads and self.misses:
            self.misses -= 1
            raise RepositoryApiError("no answer")


@pytest.fixture(scope="module")
def three_models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Encoder, scorer and ensemble, of which version 1 is served and version 2 was exported."""
    repository = tmp_path_factory.mktemp("three") / "repository"
    rollout.export(WITH_ENCODERS.checkpoint, repository)
    rollout.export(WITH_ENCODERS.checkpoint, repository)
    return repository


PARTS = ("rfm_encoder", "rfm", "rfm_frames")


@pytest.mark.parametrize("loads", [0, 2, 4])
@pytest.mark.parametrize("returns", [True, False], ids=["and comes back", "for good"])
def test_a_server_that_goes_away_leaves_what_a_restart_serves(
    three_models: Path, monkeypatch: pytest.MonkeyPatch, loads: int, returns: bool
) -> None:
    """``rfm_frames`` was not served."""
    monkeypatch.setattr(rfm_rollout, "probe", lambda *_: None)
    monkeypatch.setattr(rfm_rollout, "RETURN_S", 60.0 if returns else 0.0)
    monkeypatch.setattr(rfm_rollout, "POLL_S", 0.0)
    server = GoingAway({"rfm_encoder": [1], "rfm": [1], "rfm_frames": []}, loads, 9 if returns else 10**9)
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


def served_versions(running: Running, model: str) -> list[str]:
    rows = [line.split() for line in running.models("list").splitlines()]
    return [row[1] for row in rows if row[0] == model and row[2:] == ["READY"]]
