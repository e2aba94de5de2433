# SPDX-License-Identifier: MIT
"""The key to Triton's admin APIs, and options of tritonserver."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

import pytest
import tritonclient.grpc
import tritonclient.http
from tritonclient.utils import InferenceServerException

from commands import REPOSITORY
from in_process import rfm
from rfm.serve.access import VARIABLE, take_key
from rfm.serve.installation import Installation, ServerStartError, find_installation
from rfm.serve.triton_server import MAX_HTTP_BYTES, TritonServer, size_limits
from rfm_client.options import InvalidValueError
from servers import KEY, Endpoints, Served

ADMINISTRATION: dict[str, tuple[Any, ...]] = {
    "get_model_repository_index": (),
    "load_model": ("rfm",),
    "unload_model": ("rfm",),
    "update_log_settings": ({"log_verbose_level": 1},),
    "update_trace_settings": (None, {"trace_rate": "1"}),
}


@pytest.mark.parametrize("shown", [None, "another-key-of-16-or-more"], ids=["none", "another"])
def test_the_server_changes_nothing_without_its_key(served: Served, tmp_path: Path, shown: str | None) -> None:
    for module, protocol, prefix in (
        (tritonclient.http, "http", ""),
        (tritonclient.grpc, "grpc", "triton-grpc-protocol-"),
    ):
        headers = {} if shown is None else {f"{prefix}rfm-admin-key": shown}
        with module.InferenceServerClient(served.url(protocol).partition("://")[2]) as client:
            for call, arguments in ADMINISTRATION.items():
                with pytest.raises(InferenceServerException, match="restricted, expecting header"):
                    getattr(client, call)(*arguments, headers=headers)
    key_file, url = tmp_path / "key", served.url("grpc")
    key_file.touch(0o600)
    key_file.write_text(shown or "")
    words = ["--url", url, *(["--admin-key-file", str(key_file)] if shown else [])]
    done = rfm("models", "list", *words)
    hint = f"(--admin-key-file or {VARIABLE}), got {'another' if shown else 'none'}; "
    hint += "a server started without one takes none: start it again with --admin-key-file"
    assert (done.exit_code, done.stderr) == (1, f"rfm: admin key: expected that of the server at {url} {hint}\n")


@pytest.mark.parametrize(
    ("content", "user", "mode", "message"),
    [
        pytest.param(None, 0, 0, "expected a text file at FILE, got No such file or directory", id="missing"),
        pytest.param("k" * 16, 0, 0o604, "FILE: expected mode 640 or less, got 604; chmod 640 FILE", id="others"),
        pytest.param("k" * 16, 0, 0o660, "FILE: expected mode 640 or less, got 660", id="group"),
        pytest.param("k" * 16, 7, 0o440, "FILE: expected mode 600 or less, got 440", id="a user's group"),
        pytest.param("k" * 15, 0, 0o600, "FILE: expected at least 16 characters, got 15", id="short"),
        pytest.param("k" * 16 + "ü", 0, 0o600, "FILE: expected visible ASCII characters without", id="characters"),
        pytest.param("", 0, -1, "expected a file, got FILE, which is none", id="folder"),
    ],
)
def test_an_unusable_key_file_is_refused_without_showing_the_key(
    tmp_path: Path, content: str | None, user: int, mode: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "key"
    if mode < 0:
        file.mkdir()
    elif content is not None:
        file.write_text(content)
        file.chmod(mode)
    owned_by(user, monkeypatch)
    with pytest.raises(InvalidValueError) as caught:
        take_key(file, {})
    assert str(caught.value).startswith("--admin-key-file: " + message.replace("FILE", str(file)))
    assert "kkk" not in str(caught.value)


def owned_by(user: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are ``user``'s, with any user who runs the tests."""
    told = Path.stat

    def stat_as(path: Path, **options: Any) -> os.stat_result:
        status = list(told(path, **options))
        status[stat.ST_UID] = user
        return os.stat_result(status)

    monkeypatch.setattr(Path, "stat", stat_as)


@pytest.mark.parametrize(("user", "mode"), [(0, 0o440), (0, 0o400), (7, 0o400)])
def test_the_group_may_read_a_secret_of_root_s_alone(
    tmp_path: Path, user: int, mode: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Links to a file of root's that the pod's group reads, as Kubernetes mounts it."""
    (tmp_path / "data").write_text(f"{KEY}\n")
    (tmp_path / "data").chmod(mode)
    (tmp_path / "key").symlink_to("data")
    owned_by(user, monkeypatch)
    assert take_key(tmp_path / "key", {VARIABLE: "other"}) == KEY


def test_a_key_is_taken_out_of_the_environment() -> None:
    environment = {VARIABLE: KEY}
    assert take_key(None, environment) == KEY
    assert environment == {}
    assert take_key(None, environment) is None


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("--http-port=1", "an option that rfm serve leaves open"),
        ("--http-po=1", "an option that rfm serve leaves open"),
        ("--model-store=/", "an option that rfm serve leaves open"),
        ("--grpc-use-ssl=true", "an option that rfm serve leaves open"),
        ("trace", "--option=value"),
        ("--trace-config", "--option=value"),
    ],
)
def test_options_that_rfm_serve_sets_and_arguments_that_are_no_options_are_refused(
    argument: str, expected: str
) -> None:
    server = TritonServer(REPOSITORY, Endpoints.free(), find_installation(), more_arguments=[argument])
    with pytest.raises(ServerStartError, match=f"tritonserver: expected {expected}, got {argument.split('=')[0]}$"):
        server.start_ready()


def test_the_limit_of_request_sizes_is_set_if_triton_has_the_option(tmp_path: Path) -> None:
    knows = tmp_path / "tritonserver"
    knows.write_bytes(b"\x00OPTION\x00http-max-input-size\x00")
    assert size_limits(Installation(knows), []) == [f"--http-max-input-size={MAX_HTTP_BYTES}"]
    assert size_limits(Installation(knows), ["--http-max-input-size=1"]) == []
    assert size_limits(find_installation(), []) == []  # 2.51 has no such option, and would not start with it
