# SPDX-License-Identifier: MIT
"""``rfm models`` and the admin key, on a real server: what is served changes, and nobody's request is lost."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import tritonclient.grpc
import tritonclient.http
from prometheus_client.parser import text_string_to_metric_families
from tritonclient.grpc import model_config_pb2 as pb
from tritonclient.utils import InferenceServerException

import goldens
import rfm_export
import rollout
from commands import EXIT_S, command, wait_for_http
from engines import load_engine, serve_config
from paths import ROOT
from rfm.engine import Engine
from rfm.supervise.admin_key import VARIABLE, AdminKeyError, take_key
from rfm.supervise.installation import ServerStartError, find_installation
from rfm.supervise.process import Endpoints, TritonServer
from rfm.supervise.repository_api import RepositoryApi, RepositoryApiError
from rfm_client import ModelNotFoundError, ProgressSample, RewardClient, ServerError
from rfm_client.status import read_status
from rfm_commands import rollout as rfm_rollout
from rfm_commands.rollout import Rollout, RolloutError
from rfm_export.publish import read_config
from rollout import NAME, RFM, WITH_ENCODERS, callers, difference, models
from trajectories import random_trajectory

pytestmark = [pytest.mark.triton, pytest.mark.slow]

KEY = "a-key-that-only-tests-know"
PLAIN = goldens.config("c1_t1_disc10")  # embeddings alone
TOLERANCE = 1e-5
CONNECTIONS = 24  # of each protocol; Triton has 8 threads for HTTP
DEADLINE_S = 20.0
POLL_S = 0.02
LARGE_BYTES = 5 * 2**20
WAITS_AT_IMPORT = """
import time, pathlib
pathlib.Path({begun!r}).touch()
while not pathlib.Path({may_end!r}).exists():
    time.sleep(0.02)
"""


@dataclass(frozen=True)
class Running:
    """A server with the reference checkpoint with encoders as ``rfm``, which asks for KEY."""

    repository: Path
    endpoints: Endpoints
    key_file: Path
    log: Path

    def models(self, command: str, *words: str) -> str:
        """Output of ``rfm models COMMAND``, which succeeds."""
        done = models(command, self.repository, self.endpoints.grpc_url, self.key_file, *words)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def refused(self, command: str, *words: str) -> str:
        """What it says where it fails."""
        done = models(command, self.repository, self.endpoints.grpc_url, self.key_file, *words)
        assert done.returncode == 1, done.stdout
        (line,) = done.stderr.splitlines()
        return line

    def served_by_restart(self, model: str) -> list[int]:
        return list(read_config(self.repository, model).version_policy.specific.versions)

    def client(self, model: str) -> RewardClient:
        return RewardClient(self.endpoints.grpc_url, model=model, retry=False)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("running")
    repository, key_file = folder / "repository", folder / "key"
    key_file.touch(0o600)
    key_file.write_text(f"{KEY}\n")
    rollout.export(WITH_ENCODERS.checkpoint, repository)
    log = folder / "tritonserver.log"
    with (
        log.open("wb") as lines,
        TritonServer(repository, Endpoints.free(), find_installation(), log=lines, admin_key=KEY) as server,
    ):
        yield Running(repository, server.endpoints, key_file, log)
    assert KEY not in log.read_text()


def export_plain(repository: Path, name: str, checkpoint: Path = PLAIN.checkpoint) -> int:
    return rfm_export.export(checkpoint, repository, serve_config(PLAIN, name))


@pytest.fixture(scope="module")
def other_plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rollout.other_checkpoint(tmp_path_factory.mktemp("plain") / "other", PLAIN.checkpoint)


# rfm models


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


def test_a_large_configuration_is_loaded_and_told(running: Running) -> None:
    """Larger than gRPC's own limit of a message, 4 MiB."""
    export_plain(running.repository, "large")
    with RepositoryApi(running.endpoints.grpc_url, KEY) as server:
        server.load("large")
        config = server.config("large", 1)
        config["parameters"]["padding"] = {"string_value": "x" * LARGE_BYTES}
        server.load("large", config)
        assert len(server.config("large", 1)["parameters"]["padding"]["string_value"]) == LARGE_BYTES
        server.unload("large")


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


def test_two_checkpoints_stand_side_by_side_under_two_names(running: Running, other_plain: Path) -> None:
    for name, checkpoint in {"a": PLAIN.checkpoint, "b": other_plain}.items():
        export_plain(running.repository, name, checkpoint)
        running.models("load", name)
    sample = ProgressSample(random_trajectory(1, 5))
    expected = [load_engine(PLAIN.name), Engine.from_checkpoint(other_plain)]
    for name, engine in zip(("a", "b"), expected, strict=True):
        with running.client(name) as client:
            assert difference(client.evaluate([sample])[0], engine.evaluate([sample])[0]) <= TOLERANCE
    assert difference(*(engine.evaluate([sample])[0] for engine in expected)) > rollout.CLEARLY


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


@pytest.mark.parametrize("loads", range(5))
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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        pytest.param(("rollout", "nobody", "1"), "repository: expected a model nobody (rfm export --name)", id="name"),
        pytest.param(
            ("rollout", NAME, "77"), "rfm version 77: expected an exported version, got [Errno 2]", id="version"
        ),
        pytest.param(("load", "nobody"), "expected a model nobody", id="load"),
    ],
)
def test_what_is_not_there_is_told_and_nothing_changes(running: Running, words: tuple[str, ...], message: str) -> None:
    before = running.models("list")
    assert message in running.refused(*words)
    assert running.models("list") == before


# the admin key


@pytest.mark.parametrize("shown", [None, "another-key-of-16-or-more"], ids=["none", "another"])
def test_the_server_changes_nothing_without_its_key(running: Running, tmp_path: Path, shown: str | None) -> None:
    http = tritonclient.http.InferenceServerClient(running.endpoints.http_url.removeprefix("http://"))
    grpc = tritonclient.grpc.InferenceServerClient(running.endpoints.grpc_url.removeprefix("grpc://"))
    name = "rfm-admin-key"
    headers = [{}, {}] if shown is None else [{name: shown}, {f"triton-grpc-protocol-{name}": shown}]
    for client, header in zip((http, grpc), headers, strict=True):
        for call, arguments in {
            "get_model_repository_index": (),
            "load_model": (NAME,),
            "unload_model": (NAME,),
            "update_log_settings": ({"log_verbose_level": 1},),
            "update_trace_settings": (None, {"trace_rate": "1"}),
        }.items():
            with pytest.raises(InferenceServerException, match="restricted, expecting header"):
                getattr(client, call)(*arguments, headers=header)
        client.close()
    key_file = tmp_path / "key"
    key_file.touch(0o600)
    key_file.write_text(shown or "")
    words = ["--url", running.endpoints.grpc_url, *(["--admin-key-file", str(key_file)] if shown else [])]
    done = subprocess.run([str(RFM), "models", "list", *words], capture_output=True, text=True, check=False)
    expected = f"admin key: expected that of the server at {running.endpoints.grpc_url}"
    hint = f"(--admin-key-file or {VARIABLE}), got {'another' if shown else 'none'}"
    assert (done.returncode, done.stderr) == (1, f"rfm: {expected} {hint}\n")


@pytest.mark.parametrize(
    ("content", "mode", "message"),
    [
        pytest.param(None, 0, "expected a text file at FILE, got: No such file or directory", id="missing"),
        pytest.param("k" * 16, 0o604, "FILE: expected mode 640 or less of a root's file, got 604", id="others"),
        pytest.param("k" * 16, 0o660, "FILE: expected mode 640 or less of a root's file, got 660", id="group writes"),
        pytest.param("k" * 15, 0o600, "FILE: expected at least 16 characters, got 15", id="short"),
        pytest.param("k" * 16 + "ü", 0o600, "FILE: expected visible ASCII characters without spaces", id="characters"),
    ],
)
def test_a_key_file_that_cannot_be_used_is_told(
    tmp_path: Path, content: str | None, mode: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "key"
    if content is not None:
        file.write_text(content)
        file.chmod(mode)
    owned_by(0, monkeypatch)
    with pytest.raises(AdminKeyError) as caught:
        take_key(file, {})
    assert str(caught.value).startswith("--admin-key-file: " + message.replace("FILE", str(file)))
    assert "kkk" not in str(caught.value)


def owned_by(user: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever runs the tests, files are ``user``'s."""
    told = Path.stat

    def stat_as(path: Path, **options: Any) -> os.stat_result:
        status = list(told(path, **options))
        status[stat.ST_UID] = user
        return os.stat_result(status)

    monkeypatch.setattr(Path, "stat", stat_as)


@pytest.mark.parametrize(
    ("user", "mode", "taken"), [(0, 0o440, True), (0, 0o400, True), (7, 0o400, True), (7, 0o440, False)]
)
def test_the_group_may_read_a_secret_of_root_s_alone(
    tmp_path: Path, user: int, mode: int, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Kubernetes mounts it: links to a file of root's, which the pod's group reads."""
    (tmp_path / "data").write_text(f"{KEY}\n")
    (tmp_path / "data").chmod(mode)
    (tmp_path / "key").symlink_to("data")
    owned_by(user, monkeypatch)
    if taken:
        assert take_key(tmp_path / "key", {VARIABLE: "other"}) == KEY
    else:
        with pytest.raises(AdminKeyError, match="expected mode 600 or less of a file, got 440"):
            take_key(tmp_path / "key", {})


def test_a_folder_is_no_key(tmp_path: Path) -> None:
    with pytest.raises(AdminKeyError, match=r"expected a file, got .*, which is none"):
        take_key(tmp_path, {})


def test_a_key_is_taken_out_of_the_environment() -> None:
    environment = {VARIABLE: KEY}
    assert take_key(None, environment) == KEY
    assert environment == {}
    assert take_key(None, environment) is None


def test_rfm_serve_takes_the_key_of_the_environment_and_options_of_tritonserver(tmp_path: Path) -> None:
    """Its children have the key among Triton's arguments alone; nothing that is logged has it."""
    repository, endpoints = tmp_path / "repository", Endpoints.free()
    export_plain(repository, "rfm")
    trace = tmp_path / "trace.json"
    more = ["--", "--trace-config=rate=1", "--trace-config=level=TIMESTAMPS", f"--trace-config=triton,file={trace}"]
    environment = {**os.environ, VARIABLE: KEY}
    log = tmp_path / "log"
    with log.open("w") as lines:
        process = subprocess.Popen(
            [*command(repository, endpoints), *more, "--log-verbose=1"], env=environment, stdout=lines, stderr=lines
        )
        try:
            wait_for_http(process, endpoints)
            with RewardClient(endpoints.grpc_url) as client:
                client.progress(random_trajectory(0, 3))
            words = ["models", "list", "--url", endpoints.grpc_url]
            done = subprocess.run([str(RFM), *words], env=environment, capture_output=True, text=True, check=False)
            assert done.stdout.split() == ["rfm", "1", "READY"], done.stderr
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            for child in children:
                assert KEY not in Path(f"/proc/{child}/environ").read_text()
            assert children
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(EXIT_S)
    assert KEY not in log.read_text()
    assert "COMPUTE_START" in trace.read_text()


@pytest.mark.parametrize("argument", ["--http-port=1", "--http-po=1", "--model-store=/"])
def test_options_that_rfm_serve_sets_are_refused(argument: str) -> None:
    with pytest.raises(
        ServerStartError, match=f"expected an option that rfm serve leaves open, got {argument.split('=')[0]}$"
    ):
        server_with(argument).start()


@pytest.mark.parametrize("argument", ["trace", "--trace-config", "-x=1"])
def test_what_is_no_option_is_refused(argument: str) -> None:
    with pytest.raises(ServerStartError, match=f"tritonserver: expected --option=value, got {argument.split('=')[0]}$"):
        server_with(argument).start()


def server_with(argument: str) -> TritonServer:
    repository = ROOT / "model_repository"
    return TritonServer(repository, Endpoints.free(), find_installation(), more_arguments=[argument])


# status


def test_status_and_prometheus_agree_on_a_known_load(running: Running) -> None:
    """Without the key: the repository's index is not asked for."""
    export_plain(running.repository, "counted")
    running.models("load", "counted")
    url, metrics_url = running.endpoints.grpc_url, running.endpoints.metrics_url
    before = {protocol: counted(running, protocol) for protocol in ("grpc", "http")}
    assert before["grpc"] == before["http"]
    with RewardClient(url, model="counted") as client:
        for index in range(7):
            client.evaluate([ProgressSample(random_trajectory(index, 2 + index))] * 3)
    for protocol in ("grpc", "http"):
        status = counted(running, protocol)
        assert status[0] - before[protocol][0] == 7
        assert status[1] - before[protocol][1] == 21
    with urllib.request.urlopen(metrics_url) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    told = {
        sample.name: sample.value
        for family in families
        for sample in family.samples
        if sample.labels.get("model") == "counted"
    }
    requests, samples = counted(running, "grpc")
    assert told["nv_inference_request_success_total"] == requests
    assert told["nv_inference_count_total"] == samples


def counted(running: Running, protocol: str) -> tuple[int, int]:
    """Requests and samples."""
    url = running.endpoints.grpc_url if protocol == "grpc" else running.endpoints.http_url
    status = read_status(url, metrics_url=running.endpoints.metrics_url)
    (model,) = (model for model in status.models if model.name == "counted")
    assert (model.state, model.version, status.ready) == ("READY", "1", True)
    assert {"rfm", "rfm_encoder", "rfm_frames"} <= {model.name for model in status.models}
    return model.requests_succeeded, model.samples
