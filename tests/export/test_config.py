# SPDX-License-Identifier: MIT
from __future__ import annotations

from pathlib import Path

import pytest

from rfm.config import ConfigError, ServeConfig


def test_the_fastapi_servers_file_is_accepted(tmp_path: Path) -> None:
    file = tmp_path / "eval_config_server.yaml"
    file.write_text(
        "model_path: org/name\nnum_gpus: null\nmax_workers: 4\nbatch_size: 16\nserver_url: http://localhost\nserver_port: 8010\n"
    )
    config = ServeConfig.from_yaml(file)
    assert (config.model_path, config.num_gpus, config.max_workers) == ("org/name", None, 4)
    assert (config.batch_size, config.max_batch_size) == (16, 64)  # the original never reads it
    assert (config.host, config.server_port) == ("127.0.0.1", 8010)


@pytest.mark.parametrize(
    ("url", "host"), [("http://0.0.0.0/", "0.0.0.0"), ("10.0.0.1", "10.0.0.1"), ("localhost", "127.0.0.1")]
)
def test_server_url_is_an_address(url: str, host: str) -> None:
    assert ServeConfig(server_url=url).host == host


def test_an_empty_file_is_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "serve.yaml").write_text("# nothing\n")
    assert ServeConfig.from_yaml(tmp_path / "serve.yaml") == ServeConfig()


BAD = {
    "unknown key": (
        "num_gpu: 1",
        r"serve\.yaml: num_gpu: expected one of model_path, num_gpus, .*, got an unknown key",
    ),
    "text for a number": ("batch_size: many", r"serve\.yaml: batch_size: expected int or null, got 'many'"),
    "true for a number": ("num_gpus: true", r"serve\.yaml: num_gpus: expected int or null, got True"),
    "too small": ("batch_size: 0", r"serve\.yaml: batch_size: expected at least 1, got 0"),
    "too small a batch": ("max_batch_size: 0", r"serve\.yaml: max_batch_size: expected at least 1, got 0"),
    "a truth that is a number": ("resize_images: 1", r"serve\.yaml: resize_images: expected bool or null, got 1"),
    "a port that is none": ("grpc_port: 70000", r"serve\.yaml: ports: expected different ones up to 65535, got"),
    "one port twice": ("grpc_port: 8000", r"serve\.yaml: ports: expected different ones up to 65535, got"),
    "a port in the address": ("server_url: http://localhost:8000", r"server_url: expected an address without port"),
    "a name that is a path": ("name: ../rfm", r"serve\.yaml: name: expected letters, digits, _ and -, got '\.\./rfm'"),
    "a list": ("- 1", r"serve\.yaml: expected keys and values, got list"),
    "no YAML": ("a: [", r"serve\.yaml: expected a YAML file, got"),
    "code": ("model_path: !!python/object/apply:os.getcwd []", r"serve\.yaml: expected a YAML file, got"),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_a_bad_file_is_refused_with_the_key(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "serve.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        ServeConfig.from_yaml(tmp_path / "serve.yaml")


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nothing\.yaml: expected a YAML file, got"):
        ServeConfig.from_yaml(tmp_path / "nothing.yaml")
