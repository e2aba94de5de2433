# SPDX-License-Identifier: MIT
"""The configuration file: sections, options that override it, and the gateway beside the server."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from in_process import rfm
from labelling import LEROBOT
from paths import ROOT
from rfm.config import ExportConfig, ServeConfig
from rfm.serve.access import PORT_STEP, free_ports
from rfm.serve.supervisor import GatewayProcess, Supervisor
from rfm_client.options import ConfigError
from rfm_commands import cli
from rfm_commands.config import SECTIONS, Config
from rfm_gateway import GatewayConfig
from rfm_gateway.command import GatewayOptions
from servers import Endpoints

REPOSITORY = ROOT / "model_repository"

SECTIONED = """
export:
  checkpoint: org/name
  num_gpus: null
  dtype: bfloat16
serve:
  host: http://localhost
  http_port: 8010
  grpc_certificate: certificate.pem
  grpc_key: key.pem
gateway:
  port: 8100
  timeout_s: 60
  api_key_file: key.txt
  cors_origin: [http://a.example, http://b.example]
"""


def read(folder: Path, text: str) -> Config:
    (folder / "serve.yaml").write_text(text)
    return Config.from_yaml(folder / "serve.yaml")


def test_a_file_has_a_section_for_each_lifetime(tmp_path: Path) -> None:
    config = read(tmp_path, SECTIONED)
    assert config.export == ExportConfig(checkpoint="org/name", dtype="bfloat16")
    tls = {"grpc_certificate": Path("certificate.pem"), "grpc_key": Path("key.pem")}
    assert config.serve == ServeConfig(host="127.0.0.1", http_port=8010, **tls)
    origins = ("http://a.example", "http://b.example")
    assert config.gateway == GatewayConfig(8100, timeout_s=60.0, api_key_file=Path("key.txt"), cors_origin=origins)


def test_the_fastapi_servers_file_is_accepted(tmp_path: Path) -> None:
    config = read(
        tmp_path,
        "model_path: org/name\nnum_gpus: null\nmax_workers: 4\nbatch_size: 16\nserver_url: http://localhost\nserver_port: 8010\n"
        "use_frame_steps: true\n",
    )
    assert (config.export.checkpoint, config.export.num_gpus, config.serve.http_threads) == ("org/name", None, 4)
    assert (config.export.batch_size, config.export.max_batch_size) == (16, None)  # the original never reads it
    assert (config.gateway.host, config.gateway.port) == ("127.0.0.1", 8010)
    assert (config.serve.host, config.serve.http_port) == ("127.0.0.1", None)
    assert config.gateway.use_frame_steps
    assert not read(tmp_path, "").gateway.use_frame_steps


@pytest.mark.parametrize(
    ("url", "host"),
    [("http://0.0.0.0/", "0.0.0.0"), ("localhost", "127.0.0.1"), ("http://[::]/", "::"), ("0:0:0:0:0:0:0:1", "::1")],
)
def test_a_host_may_be_written_as_a_url(url: str, host: str) -> None:
    assert ServeConfig(host=url).host == host


@pytest.mark.parametrize("text", ["# nothing\n", "export:\nserve: {}\ngateway:\n"], ids=["no section", "no keys"])
def test_an_empty_file_is_the_defaults(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, text) == Config()


BAD = {  # text, and the message after the file name
    "unknown key": ("num_gpu: 1", r"num_gpu: expected one of export, .* unknown key; perhaps num_gpus or export\.num_gpus$"),
    "unknown key of a section": ("gateway: {foo: 1}", r"gateway\.foo: expected one of gateway\.port, .*, got an unknown key$"),
    "a key of another section": ("serve: {num_gpus: 1}", r"serve\.num_gpus: .*; perhaps num_gpus or export\.num_gpus$"),
    "a key in and outside its section": (
        "model_path: a\nexport: {checkpoint: b}",
        r"export\.checkpoint: expected once, got export\.checkpoint twice",
    ),
    "a section that is a list": ("serve: [1]", "serve: expected keys and values, got list"),
    "text for a number": ("batch_size: many", "batch_size: expected int or null, got 'many'"),
    "true for a number": ("num_gpus: true", "num_gpus: expected int or null, got True"),
    "a number for a file": ("serve: {grpc_key: 1}", r"serve\.grpc_key: expected str or null, got 1"),
    "numbers for texts": ("gateway: {cors_origin: [1]}", r"gateway\.cors_origin: expected list of str, got \[1\]"),
    "no number": ("gateway: {timeout_s: .nan}", r"gateway\.timeout_s: expected a finite number, got nan"),
    "a number for ever": ("gateway: {timeout_s: 1.0e+300}", r"gateway\.timeout_s: expected at most 86400\.0, got 1e\+300"),
    "another dtype": ("export: {dtype: int8}", r"export\.dtype: expected one of float32, bfloat16, float16 or null, got 'int8'"),
    "too small": ("batch_size: 0", "batch_size: expected at least 1, got 0"),
    "a truth that is a number": ("gateway: {viewer: 1}", r"gateway\.viewer: expected bool, got 1"),
    "a port that is none": ("serve: {grpc_port: 70000}", r"serve\.grpc_port: expected at most 65535, got 70000"),
    "one port twice": (
        "serve: {grpc_port: 8000, http_port: 8000}",
        r"serve\.http_port \(--http-port\) and serve\.grpc_port \(--grpc-port\): expected different ports, got 8000 for both",
    ),
    "Triton on the FastAPI server's port": (
        "server_port: 8000\nserve: {http_port: 8000}",
        r"serve\.http_port \(--http-port\) and gateway\.port \(--gateway-port\): expected different ports, got 8000 for both; "
        "leave Triton's out, and rfm serve chooses it$",
    ),
    "a port in the address": (
        "server_url: http://localhost:8000",
        "server_url: expected an IP address without a port, such as .*, got 'localhost:8000'",
    ),
    "a host by name": ("serve: {host: gpu.example}", r"serve\.host: expected an IP address .*, got 'gpu\.example'"),
    "half a certificate": ("serve: {grpc_key: a}", r"serve\.grpc_key needs serve\.grpc_certificate$"),
    "a name that is a path": ("export: {name: ../rfm}", r"export\.name: expected letters, digits, _ and -, got '\.\./rfm'"),
    "an endless name": (f"export: {{name: {'a' * 300}}}", r"export\.name: expected at most 100 characters, got 300"),
    "a batch beyond int32": ("export: {max_batch_size: 9999999999}", r"export\.max_batch_size: expected at most 2147483647"),
    "GPUs without end": ("num_gpus: 1000000000", r"num_gpus: expected at most 4096"),
    "a list": ("- 1", "expected keys and values, got list"),
    "no YAML": ("a: [", "expected a YAML file, got"),
    "code": ("model_path: !!python/object/apply:os.getcwd []", "expected a YAML file, got"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_a_bad_file_is_refused_with_the_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"/serve\.yaml: {message}"):
        read(tmp_path, text)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nothing\.yaml: expected a YAML file, got"):
        Config.from_yaml(tmp_path / "nothing.yaml")


def test_options_win_over_the_file(tmp_path: Path) -> None:
    config = read(tmp_path, SECTIONED).with_options(serve={"http_port": 9000}, gateway={"timeout_s": 5.0})
    assert (config.serve.http_port, config.serve.host, config.gateway.timeout_s) == (9000, "127.0.0.1", 5.0)
    with pytest.raises(ConfigError, match=r"^--gateway-key needs --gateway-certificate$"):
        config.with_options(gateway={"key": Path("key.pem")})
    with pytest.raises(
        ConfigError, match=r"^serve\.grpc_port .* and gateway\.port .*: expected different ports, got 9001 "
    ):
        config.with_options(gateway={"port": 9000 + 1}, serve={"grpc_port": 9000 + 1})


MOVED: dict[str, tuple[dict[str, int], int | None, tuple[int, int, int]]] = {
    "no gateway": ({}, None, (8000, 8001, 8002)),
    "a gateway elsewhere": ({}, 8100, (8000, 8001, 8002)),
    "a gateway on Triton's HTTP port": ({}, 8000, (8020, 8001, 8002)),
    "a gateway on the port of the metrics": ({}, 8002, (8000, 8001, 8022)),
    "the next one is taken, too": ({"status_port": 8020}, 8000, (8040, 8001, 8002)),
    "another port of Triton": ({"grpc_port": 8000}, None, (8020, 8000, 8002)),
    "given ports stay": ({"http_port": 9000, "grpc_port": 9001, "metrics_port": 9002}, 8000, (9000, 9001, 9002)),
}


@pytest.mark.parametrize(("given", "gateway_port", "ports"), MOVED.values(), ids=MOVED)
def test_ports_of_triton_that_nobody_gave_make_room(
    given: dict[str, int], gateway_port: int | None, ports: tuple[int, int, int]
) -> None:
    assert Endpoints.of(ServeConfig(**given), gateway_port) == Endpoints("127.0.0.1", *ports)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs ``rfm serve`` up to where it would serve, and gives the options of the gateway's command line."""
    found: dict[str, Any] = {}

    class RanError(Exception):
        pass

    def supervised(*_: Any, gateway: GatewayProcess, **__: Any) -> Supervisor:
        found["gateway"] = gateway.command
        raise RanError

    monkeypatch.setattr(cli, "Supervisor", supervised)

    def run(*words: str) -> dict[str, list[str]]:
        with pytest.raises(RanError):
            rfm("serve", REPOSITORY, *words)
        options: dict[str, list[str]] = {}
        for word in found["gateway"][3:]:
            if word.startswith("--"):
                name = word
            options.setdefault(name, []).extend([word] if word != name else [])
        return options

    return run


@pytest.fixture
def port() -> int:
    return free_ports(1)[0]


def test_every_setting_is_an_option_of_its_command() -> None:
    commands = get_command(cli.app).commands  # type: ignore[attr-defined]
    for section, kind in {**SECTIONS, "gateway": GatewayOptions}.items():
        options = {option: each for each in commands[section].params for option in each.opts}
        for name, setting in kind.settings().items():
            assert (setting.option in options) is setting.has_option, name
            assert not setting.has_option or options[setting.option].help.startswith(setting.help), name


def test_every_setting_of_a_gateway_is_an_option_of_serve(started: Any, tmp_path: Path, port: int) -> None:
    (tmp_path / "key.txt").write_text("open sesame")
    given = {
        "port": str(port),
        "host": "127.0.0.2",
        "triton": "grpc://127.0.0.1:9001",
        "metrics_url": "http://127.0.0.1:9002/metrics",
        "model": "reward",
        "api_key_file": str(tmp_path / "key.txt"),
        "cors_origin": "http://lab.example",
        "allow_host": "robot.lab.example",
        "timeout_s": "90.0",
        "max_body_mib": "1",
        "max_in_flight": "3",
        "max_waiting": "0",
        "dataset": str(LEROBOT / "toy_v21"),
    }
    files = {"certificate", "key"}  # which a gateway would read
    files |= {f"triton_{name}" for name in ("ca_file", "certificate", "key", "api_key_file")}
    switches = {"viewer", "use_frame_steps", "refuse_blank"}
    assert given.keys() | files | switches == GatewayConfig.settings().keys()
    options = {GatewayConfig.settings()[name].option: [value] for name, value in given.items()}
    words = [f"--gateway-{option.removeprefix('--')}={value}" for option, (value,) in options.items()]
    for switch in ("viewer", "no-viewer"):
        assert started(*words, f"--gateway-{switch}") == {**options, f"--{switch}": []}
    assert started(*words, "--gateway-refuse-blank") == {**options, "--viewer": [], "--refuse-blank": []}


@pytest.mark.parametrize("name", ["certificate", "triton-ca-file", "triton-certificate", "api-key-file", "dataset"])
def test_a_gateway_that_would_not_start_is_refused_before_triton_starts(name: str, port: int) -> None:
    other = {"certificate": "key", "triton-certificate": "triton-key"}.get(name)
    words = [f"--gateway-{each}=nowhere" for each in (name, other) if each]
    result = rfm("serve", REPOSITORY, f"--gateway-port={port}", *words)
    assert result.exit_code == 1
    where = "nowhere: " if name == "dataset" else ""
    assert result.stderr.startswith(f"rfm: --gateway-{name}: {where}expected ")
    assert "nowhere" in result.stderr


def test_a_gateway_before_a_model_that_is_not_there_is_refused_with_those_that_are(port: int) -> None:
    result = rfm("serve", REPOSITORY, f"--gateway-port={port}", "--gateway-model=nope")
    told = "rfm: gateway: model: expected one of rfm, got nope; --gateway-model names another\n"
    assert (result.exit_code, result.stderr) == (1, told)


@pytest.mark.parametrize(("host", "reached"), [("0.0.0.0", "127.0.0.1"), ("::", "[::1]"), ("::1", "[::1]")], ids=str)
def test_a_gateway_asks_a_server_that_listens_everywhere_at_this_machine(
    started: Any, host: str, reached: str, port: int
) -> None:
    options = started("--host", host, f"--gateway-port={port}", "--accept-known-vulnerabilities")
    assert options["--host"] == [host]
    assert options["--triton"] == [f"grpc://{reached}:8001"]
    assert options["--metrics-url"] == [f"http://{reached}:8002/metrics"]


def test_a_gateway_takes_settings_missing_in_its_section_from_the_server_s(
    started: Any, tmp_path: Path, port: int
) -> None:
    ends = Endpoints.free()
    (tmp_path / "serve.yaml").write_text(
        f"export: {{name: rfm}}\nserve: {{http_port: {ends.http_port}, grpc_port: {ends.grpc_port}, "
        f"metrics_port: {ends.metrics_port}}}\ngateway: {{port: {port}, cors_origin: [http://a, http://b]}}\n"
    )
    options = started("--config", str(tmp_path / "serve.yaml"))
    assert options["--triton"] == [ends.grpc_url]
    assert options["--metrics-url"] == [ends.metrics_url]
    assert (options["--host"], options["--port"], options["--model"]) == (["127.0.0.1"], [str(port)], ["rfm"])
    assert options["--cors-origin"] == ["http://a", "http://b"]
    assert options["--timeout"] == ["120.0"]
    (tmp_path / "serve.yaml").write_text("use_frame_steps: true\n")
    assert "--use-frame-steps" in started("--config", str(tmp_path / "serve.yaml"), f"--gateway-port={port}")


@pytest.fixture
def grpc_port(port: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """A free port in the place of Triton's default for gRPC."""
    monkeypatch.setattr(Endpoints, "grpc_port", port)
    return port


def test_a_gateway_on_a_port_of_triton_asks_triton_where_it_moved(started: Any, grpc_port: int) -> None:
    moved = f"grpc://127.0.0.1:{grpc_port + PORT_STEP}"
    assert started(f"--gateway-port={grpc_port}")["--triton"] == [moved]


WORDS: dict[str, tuple[str, str]] = {
    "no folder": ("serve", "Invalid value: give FOLDER, CHECKPOINT or --repository\n"),
    "two folders": ("serve a --repository b", "Invalid value: give FOLDER or --repository, not both"),
    "no gateway": ("serve a --gateway-dataset=nowhere", "--gateway-dataset needs --gateway-port"),
    "two checkpoints": ("export a --checkpoint b --repository c", "give CHECKPOINT or --checkpoint, not both"),
}


@pytest.mark.parametrize(("words", "message"), WORDS.values(), ids=WORDS)
def test_missing_and_conflicting_arguments_are_named(words: str, message: str) -> None:
    result = rfm(*words.split())
    assert result.exit_code == 2
    assert message in result.stderr


def test_arguments_after_two_dashes_go_to_triton() -> None:
    free = Endpoints.free()
    ports = [f"--{name}-port={getattr(free, f'{name}_port')}" for name in ("http", "grpc", "metrics")]
    result = rfm("serve", *ports, REPOSITORY, "--", "--http-port=1")
    told = "rfm: tritonserver: expected an option that rfm serve leaves open, got --http-port\n"
    assert (result.exit_code, result.stderr) == (1, told)


def test_an_export_needs_a_checkpoint() -> None:
    nothing = rfm("export", "--repository", "nowhere")
    told = "rfm: CHECKPOINT: expected a checkpoint, here or as export.checkpoint in --config, got none\n"
    assert (nothing.exit_code, nothing.stderr) == (1, told)


@pytest.mark.parametrize("value", [True, math.nan, math.inf, -math.inf, "5"], ids=str)
def test_a_program_gives_numbers_too(value: Any) -> None:
    with pytest.raises(ConfigError, match=f"^num_gpus: expected a whole number, got {re.escape(repr(value))}$"):
        ExportConfig(num_gpus=value)
