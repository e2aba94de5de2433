# SPDX-License-Identifier: MIT
"""The guide "Deploy a server": the commands make keys and a certificate, and a real nginx serves with the guide's file."""

from __future__ import annotations

import configparser
import getpass
import os
import re
import shlex
import shutil
import ssl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import tritonclient.grpc
from tritonclient.utils import InferenceServerException

import clip
from commands import RFM
from in_process import rfm_parsed
from paths import ROOT
from rfm.config import ServeConfig
from rfm_client import AccessDeniedError, RewardClient, ServerUnavailableError, Trajectory
from rfm_client.serving import Credentials, ServerStatus
from servers import Endpoints, Serving, serving, wait_for
from tolerances import TOLERANCE

pytestmark = pytest.mark.slow

GUIDE = (ROOT / "docs" / "guides" / "deploy.md").read_text()
UNIT_FILE = ROOT / "docker" / "systemd" / "rfm-serve.service"
BIN = Path(sys.executable).parent
NAME, IP = "localhost", "127.0.0.1"  # the box, as clients call it in these tests
CALLER, LATER = "alice", "bob"
PORTS = {"grpc": 8001, "http": 8000, "gateway": 8100, "proxy": 8443}  # in the guide and the files
VIEWER = ROOT / "apps" / "page" / "rfm_page" / "static"
VENDORED = ROOT / "apps" / "page" / "rfm_page" / "vendored"
FRAMES = np.random.default_rng(0).integers(0, 256, (16, 256, 256, 3), np.uint8)  # 3 MiB: nginx alone takes 1 MiB
FILMED = Trajectory(frames=FRAMES, task=clip.TASK)


def section(heading: str) -> str:
    (text,) = re.findall(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", GUIDE, re.MULTILINE | re.DOTALL)
    return str(text)


def commands(heading: str) -> str:
    """Return the indented shell commands of a section."""
    return "\n".join(re.findall(r"^ {4}(.*)$", section(heading), re.MULTILINE))


def shell(script: str, box: Path) -> subprocess.CompletedProcess[str]:
    """Run commands of the guide in ``box/keys`` without root, with ``box/etc`` for /etc."""
    script = 'set -eu\nsudo() { "$@"; }\n' + script.replace("/etc/", f"{box}/etc/")
    environment = {**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}"}
    return subprocess.run(["bash", "-c", script], cwd=box / "keys", env=environment, capture_output=True, text=True)


def said(script: str, box: Path) -> str:
    done = shell(script, box)
    assert done.returncode == 0, done.stderr
    return done.stdout


def here(script: str, heading: str) -> str:
    """Return a section's commands with this machine's name and address instead of the example's."""
    assert script.count("gpu-box.lan") or script.count("192.0.2.10") or "$name" in script, heading
    return script.replace("gpu-box.lan", NAME).replace("192.0.2.10", IP)


@dataclass(frozen=True)
class Box:
    """The GPU box after step 7: ``rfm serve`` behind nginx."""

    folder: Path
    served: Serving
    port: int

    @property
    def grpc_url(self) -> str:
        return f"grpcs://{NAME}:{self.port}"

    @property
    def https_url(self) -> str:
        return f"https://{NAME}:{self.port}"

    @property
    def ca_file(self) -> Path:
        return self.folder / "keys" / "ca.pem"

    def key(self, caller: str = CALLER) -> str:
        return (self.folder / "keys" / f"{caller}.key").read_text().strip()

    def client(self, url: str, **options: Any) -> RewardClient:
        return RewardClient(url, **{"ca_file": self.ca_file, "api_key": self.key(), **options})

    def http(self, **headers: str) -> httpx.Client:
        context = ssl.create_default_context(cafile=self.ca_file)
        return httpx.Client(base_url=self.https_url, verify=context, headers=headers, timeout=60)

    def log(self) -> str:
        return (self.folder / "var" / "log" / "nginx" / "access.log").read_text()


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder after steps 5 and 6."""
    folder = tmp_path_factory.mktemp("box")
    (folder / "docker").symlink_to(ROOT / "docker")
    (folder / "etc" / "nginx" / "conf.d").mkdir(parents=True)
    begin, _, step = commands("5. A key").partition("\n")
    subprocess.run(["bash", "-c", begin], cwd=folder, check=True)
    for caller in (CALLER, LATER):
        assert f"caller={CALLER}" in step
        said(step.replace(f"caller={CALLER}", f"caller={caller}"), folder)
    told = said(here(commands("6. A certificate"), "6"), folder)
    assert told.count("server.pem: OK") == 2
    (copy,) = re.findall("^sudo cp .*$", commands("7. nginx"), re.MULTILINE)
    said(copy, folder)
    return folder


@contextmanager
def nginx(folder: Path, ports: dict[int, int]) -> Iterator[subprocess.Popen[bytes]]:
    """Run Debian's nginx with the guide's file on other ports and with folders in ``folder``."""
    program = shutil.which("nginx", path=f"{BIN}:{os.environ['PATH']}:/usr/sbin")
    assert program, "nginx: expected in PATH, got nothing (make ops-tools)"
    copied = folder / "etc" / "nginx" / "conf.d" / "rfm.conf"
    text = copied.read_text()
    for shown, free in ports.items():
        assert re.search(rf"[ :]{shown}[ ;]", text), shown
        text = re.sub(rf"([ :]){shown}([ ;])", rf"\g<1>{free}\2", text)
    text = text.replace("listen ", "listen 127.0.0.1:").replace("/etc/", f"{folder}/etc/")
    moved = folder / "etc" / "rfm.conf"
    moved.write_text(text.replace("/var/", f"{folder}/var/"))
    (folder / "var" / "log" / "nginx").mkdir(parents=True, exist_ok=True)
    paths = "".join(
        f"{name}_temp_path {folder}/{name};" for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    main = folder / "etc" / "nginx.conf"
    main.write_text(
        f"user {getpass.getuser()}; daemon off; pid {folder}/nginx.pid; error_log {folder}/error.log;"
        f"events {{}} http {{ {paths} include {moved}; }}"
    )
    process = subprocess.Popen([program, "-e", folder / "error.log", "-c", main])
    try:
        wait_for(lambda: (folder / "nginx.pid").exists() or process.poll() is not None)
        assert process.poll() is None, (folder / "error.log").read_text()
        yield process
    finally:
        process.terminate()
        process.wait(60)


@pytest.fixture(scope="module")
def box(papers: Path) -> Iterator[Box]:
    repository = shutil.copytree(ROOT / "model_repository", papers / "my_models")
    clip.write(papers / "keys" / "video.mp4")
    gateway_port, port = Endpoints.free().http_port, Endpoints.free().http_port
    with serving(repository, "--gateway-port", str(gateway_port)) as served:
        served.wait_ready()
        ends = served.endpoints
        ports = zip(PORTS.values(), (ends.grpc_port, ends.http_port, gateway_port, port), strict=True)
        with nginx(papers, dict(ports)):
            box = Box(papers, served, port)
            with box.http() as caller:
                wait_for(lambda: caller.get("/health").status_code == 200)
            yield box


def test_keys_and_certificates_are_for_their_readers_alone(papers: Path) -> None:
    for name in ("keys", "keys/ca.key", "keys/server.key", "keys/alice.key", "etc/rfm/server.key", "etc/rfm/keys.map"):
        assert (papers / name).stat().st_mode & 0o077 == 0, name
    lines = (papers / "etc/rfm/keys.map").read_text().splitlines()
    keys = {caller: (papers / "keys" / f"{caller}.key").read_text().strip() for caller in (CALLER, LATER)}
    assert lines == [f'"Bearer {key}" {caller};' for caller, key in keys.items()]


@pytest.mark.triton
def test_the_checks_of_the_guide_say_what_it_promises(box: Box) -> None:
    script = here(commands("7. nginx").partition("restart nginx\n")[2], "7").replace(
        f":{PORTS['proxy']}", f":{box.port}"
    )
    assert script.count("curl ") == 3
    healthy, refused, checkpoint = (
        said(f"name={NAME}; caller={CALLER}\n{line}", box.folder) for line in script.strip().splitlines()
    )
    assert "healthy" in healthy
    assert "key: expected" in refused
    assert "checkpoint" in checkpoint


@pytest.mark.triton
def test_the_commands_of_another_machine_get_answers_with_the_key_and_none_without(
    box: Box, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = here(commands("8. From another machine"), "8").replace(f":{PORTS['proxy']}", f":{box.port}")
    script = re.sub(r"^.*(?:venv|pip install).*\n", "", script, flags=re.MULTILINE)  # these tests have the client
    in_python = re.compile(r"^(?:from|key|client) .*$", re.MULTILINE)
    names: dict[str, Any] = {}
    monkeypatch.chdir(box.folder / "keys")
    exec("\n".join(in_python.findall(script)), names)
    with closing(names["client"]) as client:
        assert client.is_ready()
    *granted, denied = in_python.sub("", script).strip().splitlines()
    told = said("\n".join(granted), box.folder)
    assert "progress of random embeddings" in told
    export = granted[0]
    assert export.startswith("export RFM_URL=")
    refused = shell(f"{export}\n{denied}", box.folder)
    assert (refused.returncode, "access denied" in refused.stderr) == (1, True)


@pytest.mark.triton
@pytest.mark.parametrize("host", [NAME, IP])
@pytest.mark.parametrize("scheme", ["grpcs", "https"])
def test_scores_through_the_proxy_are_those_of_the_server(box: Box, scheme: str, host: str) -> None:
    with box.served.client() as direct, box.client(f"{scheme}://{host}:{box.port}") as asked:
        expected, got = direct.progress(FILMED), asked.progress(FILMED)
        np.testing.assert_allclose(got.progress, expected.progress, atol=TOLERANCE)  # type: ignore[union-attr]
    with box.client(f"{scheme}://{host}:{box.port}", shared_memory=True) as asked:  # which the proxy does not pass on
        again = asked.progress(FILMED)
        np.testing.assert_allclose(again.progress, expected.progress, atol=TOLERANCE)  # type: ignore[union-attr]
    status = ServerStatus.read(
        f"{scheme}://{host}:{box.port}", credentials=Credentials(box.ca_file, api_key=box.key(LATER))
    )
    assert {model.name for model in status.models} >= {"rfm", "rfm_frames"}


@pytest.mark.triton
@pytest.mark.parametrize("scheme", ["grpcs", "https"])
def test_who_has_no_key_or_another_authority_is_denied(box: Box, scheme: str) -> None:
    url = f"{scheme}://{NAME}:{box.port}"
    for options, told in (
        ({"api_key": None}, "401|key: expected"),
        ({"api_key": "0" * 64}, "401|key: expected"),
        ({"api_key": box.key()[:-1]}, "401|key: expected"),
        ({"ca_file": None}, "(?i)certificate.verify.failed"),
    ):
        with box.client(url, **options) as asked, pytest.raises(AccessDeniedError, match=told):
            asked.progress(FILMED)


@pytest.mark.triton
def test_nothing_that_scoring_does_not_need_is_passed_on(box: Box) -> None:
    address = box.grpc_url.removeprefix("grpcs://")
    with closing(tritonclient.grpc.InferenceServerClient(address, ssl=True, root_certificates=box.ca_file)) as asking:
        shown = {"authorization": f"Bearer {box.key()}"}
        assert asking.is_model_ready("rfm", headers=shown)
        for refused in (asking.unload_model, asking.load_model, asking.get_trace_settings):
            with pytest.raises(InferenceServerException, match="403"):
                refused("rfm", headers=shown)
        with pytest.raises(InferenceServerException, match="403"):
            asking.register_system_shared_memory("region", "/region", 64, headers=shown)
    with box.http(authorization=f"Bearer {box.key()}") as caller:
        for path in (
            "repository/models/rfm/unload",
            "repository/models/rfm/load",
            "systemsharedmemory/region/a/register",
        ):
            assert caller.post(f"/v2/{path}", json={}).status_code == 403
        for path in ("logging", "trace/setting", "systemsharedmemory/status", "models/rfm/trace/setting"):
            assert caller.get(f"/v2/{path}").status_code == 403
        assert caller.get("/v2/../v2/logging").status_code == 403
        assert caller.get("/V2/logging").status_code == 404  # the gateway's answer


@pytest.mark.triton
@pytest.mark.parametrize("header", ["X-API-Key", "Authorization"])
def test_the_gateway_is_asked_with_the_same_key(box: Box, header: str) -> None:
    sample = {"sample_type": "progress", "trajectory": {"frames": FRAMES[:2].tolist(), "task": clip.TASK}}
    key = box.key() if header == "X-API-Key" else f"Bearer {box.key()}"
    with box.http(**{header: key}) as caller:
        answer = caller.post("/evaluate_batch", json=[sample])
        assert answer.status_code == 200, answer.text
        assert np.isfinite(answer.json()["outputs_progress"]["progress_pred"][0]).all()
    with box.http(**{header: key[:-1]}) as caller:
        refused = caller.post("/evaluate_batch", json=[sample])
        assert (refused.status_code, refused.json()["detail"][:13]) == (401, "key: expected")


@pytest.mark.triton
def test_the_page_s_files_need_no_key_and_all_else_does(box: Box) -> None:
    files = [f"viewer/{file.name}" for file in VIEWER.iterdir() if file.name != "index.html"]
    files += [f"viewer/examples/{file.name}" for file in (VIEWER.parent / "examples").glob("*.mp4")]
    files += [f"viewer/uplot/{name}" for name in ("uPlot.esm.js", "uPlot.min.css")]
    files += ["", "docs", "openapi.json", "docs/show.js", "docs/swagger-ui/swagger-ui.css", "health"]
    with box.http() as stranger:
        for name in files:
            assert stranger.get(f"/{name}").status_code == 200, name
        paths = stranger.get("/openapi.json").json()["paths"]
        assert "/evaluate_batch" in paths
        for path in {*paths, "/metrics", "/viewer/served", "/viewer/datasets"} - {"/health"}:
            assert stranger.get(path).status_code == 401, path


@pytest.mark.triton
def test_the_gateway_answers_by_any_name_of_the_box_also_its_page(box: Box) -> None:
    """Browsers send this ``Host`` and, as they post, this ``Origin``."""
    name = f"gpu-box.lan:{PORTS['proxy']}"
    with box.http(host=name, origin=f"https://{name}", **{"X-API-Key": box.key()}) as caller:
        caller.headers["Sec-Fetch-Site"] = "same-origin"
        assert [caller.get(path).status_code for path in ("/health", "/", "/model_info")] == [200] * 3
        assert caller.post("/evaluate_batch", content=b"").status_code == 422  # like a wrong body


@pytest.mark.triton
def test_the_log_names_the_caller_and_no_key(box: Box) -> None:
    with box.client(box.grpc_url, api_key=box.key(LATER)) as asked:
        asked.progress(FILMED)
    wait_for(lambda: f'"{LATER}" "POST /inference.GRPCInferenceService/ModelInfer' in box.log())
    for caller in (CALLER, LATER):
        assert box.key(caller) not in box.log()


@pytest.fixture
def copied(papers: Path, tmp_path: Path) -> Path:
    """A copy of the folder after steps 5 and 6, to be changed."""
    for name in ("keys", "etc"):
        shutil.copytree(papers / name, tmp_path / name)
    return tmp_path


@pytest.mark.triton
def test_a_server_behind_the_proxy_that_is_down_is_unavailable(copied: Path) -> None:
    """Not denied, so the client tries again."""
    port = Endpoints.free().http_port
    ports = {shown: Endpoints.free().http_port for shown in (PORTS["grpc"], PORTS["http"], PORTS["gateway"])}
    key = (copied / "keys" / f"{CALLER}.key").read_text().strip()
    with nginx(copied, {**ports, PORTS["proxy"]: port}):
        for scheme in ("grpcs", "https"):
            url = f"{scheme}://{IP}:{port}"
            with (
                RewardClient(url, ca_file=copied / "keys" / "ca.pem", api_key=key, retry=False) as asked,
                pytest.raises(
                    ServerUnavailableError,
                    match="502: start the server" if scheme == "grpcs" else "it is down or still loads",
                ),
            ):
                asked.progress(FILMED)


def test_nginx_does_not_start_with_an_empty_key(copied: Path) -> None:
    with (copied / "etc/rfm/keys.map").open("a") as keys:
        keys.write('"Bearer " mallory;\n')
    with pytest.raises(AssertionError, match='conflicting parameter "bearer "'), nginx(copied, {}):
        pass


def test_a_caller_s_second_key_is_refused_while_the_first_counts(copied: Path) -> None:
    keys = copied / "etc/rfm/keys.map"
    before = keys.read_text()
    refused = shell("set +e\n" + commands("5. A key").partition("\n")[2], copied)
    assert "cannot overwrite existing file" in refused.stderr
    assert keys.read_text() == before


def test_step_6_once_more_keeps_the_authority(copied: Path) -> None:
    before = (copied / "keys/ca.pem").read_bytes()
    assert said(here(commands("6. A certificate"), "6"), copied).count("server.pem: OK") == 2
    assert (copied / "keys/ca.pem").read_bytes() == before


def test_a_key_that_is_taken_back_leaves_the_others(copied: Path) -> None:
    (command,) = re.findall("`(sudo sed .*?keys.map)`", section("Later"))
    said(command, copied)
    (line,) = (copied / "etc/rfm/keys.map").read_text().splitlines()
    assert line.endswith(f'" {LATER};')


def test_a_renewal_without_the_authority_s_key_leaves_the_certificate_as_it_was(copied: Path) -> None:
    certificate = copied / "etc/rfm/server.pem"
    before = certificate.read_bytes()
    (copied / "keys/ca.key").unlink()
    step = here(commands("6. A certificate"), "6")
    done = shell(f"set +e\nname={NAME}\nip={IP}\n{step[step.index('printf') :]}", copied)
    assert "ca.key" in done.stderr
    assert certificate.read_bytes() == before


def unit() -> configparser.SectionProxy:
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(UNIT_FILE)
    return parser["Service"]


def test_the_unit_runs_what_nginx_and_the_guide_expect() -> None:
    program, name, *arguments = shlex.split(unit()["ExecStart"])
    assert (program, name) == ("/opt/rfm/bin/rfm", "serve")
    given = rfm_parsed(name, *arguments)
    default = Endpoints.of(ServeConfig(), PORTS["gateway"])
    assert (default.http_port, default.grpc_port) == (PORTS["http"], PORTS["grpc"])
    assert (given["http_port"], given["grpc_port"], given["gateway_port"]) == (None, None, PORTS["gateway"])
    assert arguments[0] == "/srv/rfm/my_models"
    assert f"--repository {arguments[0]} " in GUIDE
    assert f"/usr/bin/python3 -m venv {Path(program).parents[1]} " in GUIDE


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd is not installed")
def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    """With programs that this machine has."""
    text = UNIT_FILE.read_text().replace("/opt/rfm/bin/rfm", str(RFM)).replace("/usr/bin/nvidia-modprobe", "/bin/true")
    copy = tmp_path / UNIT_FILE.name
    copy.write_text(text)
    done = subprocess.run(["systemd-analyze", "verify", copy], capture_output=True, text=True)
    assert (done.returncode, [line for line in done.stderr.splitlines() if copy.name in line]) == (0, [])


def test_the_export_with_the_image_alone_is_a_command_of_it() -> None:
    (run,) = re.findall(r"^docker run (.*?[^\\])$", commands("3. Export"), re.MULTILINE | re.DOTALL)
    words = shlex.split(run.replace("\\\n", " "))
    image = next(index for index, word in enumerate(words) if word.startswith("rfm-triton:"))
    assert words[words.index("--entrypoint") + 1] == "rfm"
    name, *arguments = words[image + 1 :]
    given = rfm_parsed(name, *arguments)
    mounts = [words[index + 1].split(":") for index, word in enumerate(words) if word == "-v"]
    assert {mount[1]: mount[0] for mount in mounts} == {
        str(given["config_file"]): "$PWD/docker/serve.yaml",
        str(given["repository"].parent): "/srv/rfm",
        words[words.index("HF_HOME=/huggingface")].partition("=")[2]: "~/.cache/huggingface",
    }
