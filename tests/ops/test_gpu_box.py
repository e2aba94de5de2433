# SPDX-License-Identifier: MIT
"""The guide "Deploy a server": the commands make keys and a certificate, and a real nginx serves with the guide's file."""

from __future__ import annotations

import configparser
import getpass
import json
import re
import shlex
import shutil
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.client import HTTPSConnection
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from tritonclient.grpc import InferenceServerClient
from tritonclient.utils import InferenceServerException

import clip
from in_process import rfm, rfm_parsed
from paths import ROOT
from rfm_client import AccessDeniedError, RewardClient, ServerUnavailableError, Trajectory
from servers import Endpoints, Quiet, serving, wait_for, web_server
from tolerances import TOLERANCE

GUIDE = (ROOT / "docs" / "guides" / "deploy.md").read_text()
PAGE = ROOT / "apps" / "page" / "rfm_page" / "static"
NAME, IP = "localhost", "127.0.0.1"  # the box, as clients call it in these tests
PORTS = {"grpc": 8001, "http": 8000, "gateway": 8100, "proxy": 8443}  # in the guide and the files
FRAMES = np.random.default_rng(0).integers(0, 256, (16, 256, 256, 3), np.uint8)  # 3 MiB: nginx alone takes 1 MiB
FILMED = Trajectory(frames=FRAMES, task=clip.TASK)


def commands(heading: str) -> str:
    """Return the indented shell commands of a section."""
    (text,) = re.findall(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", GUIDE, re.MULTILINE | re.DOTALL)
    return "\n".join(re.findall(r"^ {4}(.*)$", text, re.MULTILINE))


def shell(script: str, box: Path) -> subprocess.CompletedProcess[str]:
    """Run commands of the guide in ``box/keys`` without root, with ``box/etc`` for /etc and this machine's name."""
    script = script.replace("/etc/", f"{box}/etc/").replace("gpu-box.lan", NAME).replace("192.0.2.10", IP)
    words = ["bash", "-c", f'set -eu\nsudo() {{ "$@"; }}\n{script}']
    return subprocess.run(words, cwd=box / "keys", capture_output=True, text=True)


@pytest.fixture
def papers(openssl: str, tmp_path: Path) -> Path:
    """The folder after steps 5 and 6, which run openssl, for two callers."""
    (tmp_path / "docker").symlink_to(ROOT / "docker")
    (tmp_path / "etc" / "nginx" / "conf.d").mkdir(parents=True)
    begin, _, step = commands("5. A key").partition("\n")
    subprocess.run(["bash", "-c", begin], cwd=tmp_path, check=True)
    for caller in ("alice", "bob"):
        assert shell(step.replace("caller=alice", f"caller={caller}"), tmp_path).returncode == 0
    assert shell(commands("6. A certificate"), tmp_path).stdout.count("server.pem: OK") == 2
    (copy,) = re.findall("^sudo cp .*$", commands("7. nginx"), re.MULTILINE)
    assert shell(copy, tmp_path).returncode == 0
    return tmp_path


@contextmanager
def proxy(nginx: str, folder: Path, ports: dict[str, int]) -> Iterator[None]:
    """Run nginx with the guide's file on other ports and with folders in ``folder``."""
    text = (folder / "etc" / "nginx" / "conf.d" / "rfm.conf").read_text()
    for name, port in ports.items():
        text, count = re.subn(rf"([ :]){PORTS[name]}([ ;])", rf"\g<1>{port}\2", text)
        assert count, name
    text = (
        re.sub(r"listen (?=\d)", f"listen {IP}:", text)
        .replace("listen [::]:", "listen [::1]:")
        .replace("/etc/", f"{folder}/etc/")
        .replace("/var/log/nginx/", f"{folder}/")
    )
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    paths = "".join(f"{kind}_temp_path {folder}/{kind};" for kind in kinds)
    (folder / "nginx.conf").write_text(
        f"user {getpass.getuser()}; daemon off; pid {folder}/nginx.pid; error_log {folder}/error.log;"
        f"events {{}} http {{ {paths} {text} }}"
    )
    process = subprocess.Popen([nginx, "-e", folder / "error.log", "-c", folder / "nginx.conf"])
    try:
        wait_for(lambda: (folder / "nginx.pid").exists() or process.poll() is not None)
        assert process.poll() is None, (folder / "error.log").read_text()
        yield
    finally:
        process.terminate()
        process.wait(60)


@pytest.mark.nightly
@pytest.mark.triton
def test_nginx_passes_on_the_requests_that_scoring_needs_with_a_key_and_nothing_else(nginx: str, papers: Path) -> None:
    repository = shutil.copytree(ROOT / "model_repository", papers / "my_models")
    gateway, authority = Endpoints.free().http_port, papers / "keys" / "ca.pem"
    alice, bob = ((papers / "keys" / f"{name}.key").read_text().strip() for name in ("alice", "bob"))
    context, port = ssl.create_default_context(cafile=authority), Endpoints.free().http_port

    def client(scheme: str, **options: Any) -> RewardClient:
        return RewardClient(
            f"{scheme}://{NAME}:{port}", **{"ca_file": authority, "api_key": alice, "retry": False, **options}
        )

    def http(**headers: str) -> httpx.Client:
        return httpx.Client(base_url=f"https://{IP}:{port}", verify=context, headers=headers, timeout=60)

    with serving(repository, "--gateway-port", str(gateway)) as served:
        ends = served.endpoints
        ports = {"grpc": ends.grpc_port, "http": ends.http_port, "gateway": gateway, "proxy": port}
        with proxy(nginx, papers, ports):
            for scheme, told in (("grpcs", "502: start the server"), ("https", "it is down or still loads")):
                with client(scheme) as asked, pytest.raises(ServerUnavailableError, match=told):
                    asked.progress(FILMED)  # not denied, so a client may try again
            served.wait_ready()
            with http() as stranger:
                wait_for(lambda: stranger.get("/health").status_code == 200)
                for name in ("", "docs", *(f"viewer/{file.name}" for file in PAGE.glob("*.[cj]s*"))):
                    assert stranger.get(f"/{name}").status_code == 200, name
                for path in {*stranger.get("/openapi.json").json()["paths"], "/metrics"} - {"/health"}:
                    assert stranger.get(path).status_code == 401, path
            with served.client() as direct:
                expected = direct.progress(FILMED)
            for scheme in ("grpcs", "https"):
                with client(scheme) as asked:
                    got = asked.progress(FILMED)
                np.testing.assert_allclose(got.progress, expected.progress, atol=TOLERANCE)  # type: ignore[union-attr]
                denied = ({"api_key": None}, {"api_key": alice[:-1]}, {"ca_file": None})
                for options in denied:
                    with client(scheme, **options) as asked, pytest.raises(AccessDeniedError):
                        asked.progress(FILMED)
            address, shown = f"{NAME}:{port}", {"authorization": f"Bearer {alice}"}
            with closing(InferenceServerClient(address, ssl=True, root_certificates=authority)) as asking:
                for refused in (asking.unload_model, asking.load_model, asking.get_trace_settings):
                    with pytest.raises(InferenceServerException, match="403"):
                        refused("rfm", headers=shown)
            words = ["--repository", repository, "--url", f"grpcs://{address}", "--ca-file", authority]
            done = rfm("models", "unload", "rfm", *map(str, words), "--api-key-file", str(papers / "keys/alice.key"))
            assert done.stderr.endswith("status: 403: a proxy refuses this call: ask Triton's own port (--url)\n")
            with http(**shown) as caller:
                for path in ("repository/models/rfm/unload", "systemsharedmemory/region/a/register", "../v2/logging"):
                    assert caller.post(f"/v2/{path}", json={}).status_code == 403
            origin = {"host": "gpu-box.lan:8443", "origin": "https://gpu-box.lan:8443", "Sec-Fetch-Site": "same-origin"}
            for url, headers in ((f"any:{bob}@{NAME}", {}), (NAME, {**origin, "X-API-Key": bob})):
                answer = httpx.post(f"https://{url}:{port}/evaluate_batch", headers=headers, verify=context)
                assert answer.status_code == 422  # like a wrong body
    log = (papers / "access.log").read_text()
    assert '"alice" "POST /inference.GRPCInferenceService/ModelInfer' in log
    assert not {key for key in (alice, bob) if key in log}


def test_nginx_passes_forms_to_triton_as_octet_streams_and_refuses_large_bodies_in_json(
    nginx: str, papers: Path
) -> None:
    """With a stand-in for Triton."""

    class Told(Quiet, BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.send_header("X-Type", self.headers["Content-Type"])
            self.end_headers()

    key, port = (papers / "keys" / "alice.key").read_text().strip(), Endpoints.free().http_port
    context = ssl.create_default_context(cafile=papers / "keys" / "ca.pem")
    form = {"Content-Type": "application/x-www-form-urlencoded", "Authorization": f"Bearer {key}"}
    with web_server(Told) as url, proxy(nginx, papers, {"http": httpx.URL(url).port or 0, "proxy": port}):
        infer = f"https://{IP}:{port}/v2/models/rfm/infer"
        answer = httpx.post(infer, content=b"{}", headers=form, verify=context)
        with closing(HTTPSConnection(IP, port, context=context)) as connection:
            connection.request("POST", "/v2/models/rfm/infer", headers={**form, "Content-Length": str(2**30)})
            refused = connection.getresponse()
            told = json.loads(refused.read())
    assert (answer.status_code, answer.headers["X-Type"]) == (200, "application/octet-stream")
    limit = "body: expected at most client_max_body_size of nginx, got more"
    assert (refused.status, told) == (413, {"error": limit, "detail": limit})


def test_nginx_does_not_start_with_an_empty_key(nginx: str, papers: Path) -> None:
    with (papers / "etc/rfm/keys.map").open("a") as keys:
        keys.write('"Bearer " mallory;\n')
    with pytest.raises(AssertionError, match='conflicting parameter "bearer "'), proxy(nginx, papers, {}):
        pass


def test_keys_are_for_their_readers_alone_made_once_and_taken_back_one_by_one(papers: Path) -> None:
    for name in ("keys", "keys/ca.key", "keys/server.key", "keys/alice.key", "etc/rfm/server.key", "etc/rfm/keys.map"):
        assert (papers / name).stat().st_mode & 0o077 == 0, name
    keys, authority = papers / "etc/rfm/keys.map", (papers / "keys/ca.pem").read_bytes()
    before = keys.read_text()
    assert [line.split()[2] for line in before.splitlines()] == ["alice;", "alice;", "bob;", "bob;"]
    refused = shell("set +e\n" + commands("5. A key").partition("\n")[2], papers)
    assert "cannot overwrite existing file" in refused.stderr
    assert keys.read_text() == before
    assert shell(commands("6. A certificate"), papers).stdout.count("server.pem: OK") == 2  # a renewal
    assert (papers / "keys/ca.pem").read_bytes() == authority
    (command,) = re.findall("`(sudo sed .*?keys.map)`", GUIDE)
    assert shell(command, papers).returncode == 0
    assert keys.read_text().splitlines() == before.splitlines()[2:]


def test_the_systemd_unit_runs_rfm_serve_as_nginx_and_the_guide_expect() -> None:
    parser = configparser.RawConfigParser(strict=False)
    parser.read(ROOT / "docker" / "systemd" / "rfm-serve.service")
    program, name, *arguments = shlex.split(parser["Service"]["execstart"])
    given = rfm_parsed(name, *arguments)
    assert (program, name, given["gateway_port"]) == ("/opt/rfm/bin/rfm", "serve", PORTS["gateway"])
    assert (given["http_port"], given["grpc_port"]) == (None, None)  # Triton's own
    credential, _, key_file = parser["Service"]["loadcredential"].partition(":")
    assert given["admin_key_file"] == Path("${CREDENTIALS_DIRECTORY}") / credential
    assert f" {key_file} " in GUIDE
    assert f"--repository {arguments[0]} " in GUIDE
