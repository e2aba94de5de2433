# SPDX-License-Identifier: MIT
"""What ``rfm serve`` looks after: the versions and models that are served now, and Triton itself."""

from __future__ import annotations

import os
import re
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rollout
from patients import Callers, make_repository, trajectory
from rfm.launch.http import Http
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints, TritonServer
from rfm.launch.repository_api import RepositoryApi, RepositoryApiError
from rfm.supervise import triton_watch
from rfm.supervise.served_models import NOT_LOADED, SILENT, ServedModels
from rfm.supervise.status import NO_REASON, Status
from rfm.supervise.triton_watch import TritonWatch
from rfm_commands.rollout import Rollout
from rfm_serve import MODEL, Serving, kill_while_idle, serving, wait_for

pytestmark = [pytest.mark.triton, pytest.mark.slow]


KEY = "a-key-that-only-tests-know"
OTHER = f"{MODEL}_b"
HANG_S = 3
SHORT_SILENCE_S = 6.0
LOOP_S = 180.0  # within which a model that cannot be loaded is in a crash loop
DIES_AT_ITS_START = "\n\nimport os\n\nos._exit(1)\n"
WARMS_UP_SLOWLY = f"""

_answer = TritonPythonModel.answer
_answered = []


def slow(self, questions, execution):
    import time

    if not _answered:
        _answered.append(True)
        time.sleep({2 * HANG_S})
    return _answer(self, questions, execution)


TritonPythonModel.answer = slow
"""


@contextmanager
def administered(repository: Path, **settings: int) -> Iterator[tuple[Serving, RepositoryApi]]:
    """The repository is served, with these settings, and ready; and the API that changes what is."""
    key_file, config = repository.parent / "key", repository.parent / "serve.yaml"
    key_file.touch(0o600)
    key_file.write_text(KEY)
    config.write_text("".join(f"{name}: {value}\n" for name, value in settings.items()))
    with serving(repository, f"--admin-key-file={key_file}", f"--config={config}") as served:
        served.wait_ready()
        with RepositoryApi(served.endpoints.grpc_url, KEY) as api:
            yield served, api


def change(file: Path, pattern: str, wanted: str) -> None:
    text, count = re.subn(pattern, wanted, file.read_text())
    assert count == 1, pattern
    file.write_text(text)


def restarts_of(served: Serving, what: str) -> float:
    return served.metric("rfm_serve_restarts_total", what=what)


def test_what_was_served_is_healed_and_not_what_was_exported_since(tmp_path: Path) -> None:
    repository, samples = tmp_path / "repository", rollout.questions()
    rollout.export(rollout.WITH_ENCODERS.checkpoint, repository)
    expected = rollout.answers(rollout.WITH_ENCODERS.checkpoint, samples)
    parts = (MODEL, "rfm_encoder", "rfm_frames")
    with administered(repository) as (served, api):
        rollout.export(rollout.other_checkpoint(tmp_path / "other"), repository)
        for process in served.model_processes:
            kill_while_idle(process)
        served.wait_ready(False)
        served.wait_ready()
        assert [api.ready_versions(part) for part in parts] == [[1]] * 3
        with served.client() as client:
            for got, wanted in zip(client.evaluate(samples), expected, strict=True):
                assert rollout.difference(got, wanted) <= rollout.TOLERANCE
        assert restarts_of(served, MODEL) == 1
        Rollout(repository, MODEL, api, lambda _: None).to(2)
        assert [api.ready_versions(part) for part in parts] == [[2]] * 3
        served.wait_ready()
        # An ensemble that names a version which is served no more is not ready, though each of its parts is.
        newer = api.config(MODEL, 2)
        api.load(MODEL, {**newer, "version_policy": {"specific": {"versions": [1]}}})
        wait_for(lambda: served.reasons() == {MODEL: NO_REASON, "rfm_encoder": NO_REASON, "rfm_frames": NOT_LOADED})
        assert not served.is_ready()
        api.load(MODEL, newer)
        served.wait_ready()
        api.unload("rfm_frames")
        wait_for(lambda: served.reasons() == {MODEL: NO_REASON, "rfm_encoder": NO_REASON})


def test_a_version_that_loads_and_fails_or_takes_long_costs_the_other_nothing(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    repository = make_repository(tmp_path)
    model = repository / MODEL
    shutil.copytree(model / "1", model / "2")
    code = (model / "2" / "model.py").read_text()
    with administered(repository, hang_s=HANG_S) as (served, api), served.client() as client:
        change(model / "config.pbtxt", r"versions: 1", "versions: 1 versions: 2")
        with Callers(client, references) as callers:
            (model / "2" / "model.py").write_text(code + DIES_AT_ITS_START)
            with pytest.raises(RepositoryApiError):
                api.load(MODEL)
            callers.wait_for_all()
            (model / "2" / "model.py").write_text(code + WARMS_UP_SLOWLY)
            started_s = time.monotonic()
            api.load(MODEL)
            assert time.monotonic() - started_s > HANG_S
            callers.wait_for_all()
        assert (callers.lost, callers.wrong) == ([], [])
        assert api.ready_versions(MODEL) == [1, 2]
        assert restarts_of(served, MODEL) == 0
        # From now on both count.
        served.wait_ready()
        (process,) = [process for process in served.model_processes if process.version == 2]
        kill_while_idle(process)
        wait_for(lambda: restarts_of(served, MODEL) == 1)
        served.wait_ready()
        assert api.ready_versions(MODEL) == [1, 2]


def test_models_come_and_go(tmp_path: Path) -> None:
    repository = make_repository(tmp_path)
    with administered(repository) as (served, api):
        shutil.copytree(repository / MODEL, repository / OTHER)
        change(repository / OTHER / "config.pbtxt", f'name: "{MODEL}"', f'name: "{OTHER}"')
        api.load(OTHER)
        wait_for(lambda: served.reasons() == {MODEL: NO_REASON, OTHER: NO_REASON})
        heal(served, OTHER, lambda: None)
        code = repository / OTHER / "1" / "model.py"
        text = code.read_text()
        code.write_text(text + "\nraise ValueError('broken')\n")
        heal(served, OTHER, lambda: wait_for(lambda: "broken" in served.reasons()[OTHER]) and code.write_text(text))
        api.unload(OTHER)
        wait_for(lambda: served.reasons() == {MODEL: NO_REASON})
        assert served.metric("rfm_serve_ready", model=OTHER) == 0
        api.load(OTHER)
        wait_for(lambda: served.reasons() == {MODEL: NO_REASON, OTHER: NO_REASON})
        with served.client(model=OTHER) as client:
            assert np.isfinite(client.progress(trajectory(0)).progress).all()


def test_a_triton_that_is_started_again_serves_what_it_served_and_not_what_was_exported_since(tmp_path: Path) -> None:
    repository, samples = tmp_path / "repository", rollout.questions()
    rollout.export(rollout.WITH_ENCODERS.checkpoint, repository)
    expected = rollout.answers(rollout.WITH_ENCODERS.checkpoint, samples)
    parts = (MODEL, "rfm_encoder", "rfm_frames")
    with administered(repository) as (served, api):
        rollout.export(rollout.other_checkpoint(tmp_path / "other"), repository)
        os.kill(served.triton, signal.SIGKILL)
        served.wait_ready(False)
        served.wait_ready()
        assert served.reasons() == dict.fromkeys(parts, NO_REASON)
        assert [api.ready_versions(part) for part in parts] == [[1]] * 3
        with served.client() as client:
            for got, wanted in zip(client.evaluate(samples), expected, strict=True):
                assert rollout.difference(got, wanted) <= rollout.TOLERANCE
        assert restarts_of(served, "triton") == 1
        assert restarts_of(served, MODEL) == 0


def test_a_model_that_cannot_be_loaded_again_is_not_ready_and_the_others_serve(tmp_path: Path) -> None:
    repository = make_repository(tmp_path)
    shutil.copytree(repository / MODEL, repository / OTHER)
    change(repository / OTHER / "config.pbtxt", f'name: "{MODEL}"', f'name: "{OTHER}"')
    code = repository / OTHER / "1" / "model.py"
    text = code.read_text()

    def is_given_up() -> bool:
        reason = served.reasons().get(OTHER, "")
        return reason.startswith("it is loaded anew every 5 minutes, after: ") and "broken" in reason

    with administered(repository) as (served, api), served.client() as client:
        code.write_text("raise ValueError('broken')\n")
        kill_while_idle(served.model_processes_of(OTHER)[0])
        wait_for(is_given_up, LOOP_S)
        assert served.reasons()[MODEL] == NO_REASON
        assert served.metric("rfm_serve_not_ready", model=OTHER, reason=served.reasons()[OTHER]) == 1
        assert np.isfinite(client.progress(trajectory(0)).progress).all()
        assert [line for line in served.said if line.startswith(f"rfm: model {OTHER}: expected to run, got 6 ends")]
        # Nor does it keep them from being served when Triton is started again.
        os.kill(served.triton, signal.SIGKILL)
        wait_for(lambda: restarts_of(served, "triton") == 1)
        wait_for(lambda: served.reasons()[MODEL] == NO_REASON and "broken" in served.reasons()[OTHER])
        assert np.isfinite(client.progress(trajectory(0)).progress).all()
        wait_for(is_given_up, LOOP_S)
        code.write_text(text)
        api.load(OTHER)
        served.wait_ready()
        assert restarts_of(served, MODEL) == 0


def heal(served: Serving, model: str, meanwhile: Callable[[], Any]) -> None:
    before = restarts_of(served, model)
    (process,) = served.model_processes_of(model)
    kill_while_idle(process)
    served.wait_ready(False)
    meanwhile()
    served.wait_ready()
    assert restarts_of(served, model) == before + 1
    assert served.model_processes_of(model) != [process]


def test_a_triton_that_does_not_answer_is_started_again(tmp_path: Path) -> None:
    with serving(make_repository(tmp_path), "--triton-silent-s=3") as served:
        served.wait_ready()
        os.kill(served.triton, signal.SIGSTOP)
        wait_for(lambda: restarts_of(served, "triton") == 1)
        wait_for(lambda: served.metric("rfm_serve_canary_ok") == served.metric("rfm_serve_ready") == 0, 1.0)
        served.wait_ready()
        assert restarts_of(served, MODEL) == 0
    assert served.said == ["rfm: triton is started again: no answer for 3 s"]


def test_a_triton_that_is_silent_for_less_than_its_time_goes_on(tmp_path: Path) -> None:
    """Readiness tells it meanwhile."""
    with serving(make_repository(tmp_path), "--triton-silent-s=60") as served:
        served.wait_ready()
        triton, stopped_s = served.triton, time.monotonic()
        os.kill(triton, signal.SIGSTOP)
        wait_for(lambda: served.reasons() == {MODEL: SILENT})
        wait_for(lambda: time.monotonic() - stopped_s > SHORT_SILENCE_S)
        os.kill(triton, signal.SIGCONT)
        served.wait_ready()
        assert served.triton == triton
    assert served.said == []


def test_a_triton_has_to_miss_several_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long one look takes, and however little time is given."""
    server = SimpleNamespace(endpoints=Endpoints.free(), admin_key=KEY, pid=os.getpid())
    asked: list[str] = []
    monkeypatch.setattr(triton_watch, "INTERVAL_S", 0.0)
    monkeypatch.setattr(Http, "request", lambda *words, **_: asked.append(words[2]) or refuse())
    watch = TritonWatch(server, 1e-9)  # type: ignore[arg-type]
    wait_for(lambda: watch.look() or watch.is_silent)
    assert not watch.is_answered
    assert 3 <= len(asked) / 2 <= 4  # two doors; the fourth look has begun, perhaps


def refuse() -> None:
    raise ConnectionRefusedError


def test_a_look_that_fails_unexpectedly_is_logged_once_and_counts_as_no_answer(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    server = SimpleNamespace(endpoints=Endpoints.free(), admin_key=KEY, pid=os.getpid())
    monkeypatch.setattr(triton_watch, "INTERVAL_S", 0.0)
    monkeypatch.setattr(Http, "request", lambda *_, **__: [].pop())
    watch = TritonWatch(server, 1e-9)  # type: ignore[arg-type]
    wait_for(lambda: watch.look() or watch.is_silent)
    assert caplog.messages == ["rfm-triton-watch: an unexpected error"]
    assert "IndexError: pop from empty list" in caplog.text


def test_what_is_exported_while_triton_starts_does_not_matter(tmp_path: Path) -> None:
    repository = make_repository(tmp_path)
    server = TritonServer(repository, Endpoints.free(), find_installation())
    try:
        server.start()
        shutil.copytree(repository / MODEL, repository / OTHER)
        change(repository / OTHER / "config.pbtxt", f'name: "{MODEL}"', f'name: "{OTHER}"')
        server.wait_ready()
    finally:
        server.stop()


def test_a_triton_that_is_gone_is_the_supervisor_s_to_see() -> None:
    about = Status()
    about.record({MODEL: "it is loaded"})
    server = SimpleNamespace(endpoints=Endpoints.free(), admin_key=KEY, pid=os.getpid())
    served = ServedModels(server, about, print, canary_s=1.0, hang_s=1.0, triton_silent_s=1.0, restored={})  # type: ignore[arg-type]
    try:
        wait_for(lambda: served.look() or served.is_silent)
        assert served.look() == []
        assert not about.ready[0]
    finally:
        served.close()
