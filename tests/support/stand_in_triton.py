# SPDX-License-Identifier: MIT
"""A Triton that starts at once, has real model processes, and answers what ``rfm serve`` asks.

Empty files in the folder above the repository change it: ``hangs`` and ``fails`` say what becomes of probes, ``busy``
lets the count of requests grow. A model with the file ``loading-MODEL`` also loads a version 2. The configuration that
the last load read is in ``loaded-MODEL``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

CONFIG = {
    "backend": "python",
    "instance_group": [{"count": 1}],
    "input": [{"name": "num_frames", "dims": [2]}, {"name": "sample_type", "dims": [1]}],
    "output": [{"name": "progress"}],
}
CONFIG_FILE = 'name: "%s"\nbackend: "python"\nversion_policy { specific { versions: 1 } }\n'


class Answer(BaseHTTPRequestHandler):
    repository = Path()
    folder = Path(__file__).parent  # above the repository
    processes: dict[str, subprocess.Popen[bytes]] = {}  # noqa: RUF012  of all connections
    count = 0

    @classmethod
    def load(cls, model: str) -> None:
        (cls.folder / f"loaded-{model}").write_text((cls.repository / model / "config.pbtxt").read_text())
        words = ["triton_python_backend_stub", str(cls.repository / model / "1" / "model.py")]
        cls.processes[model] = subprocess.Popen(words, executable=sys.executable)
        with suppress(OSError):  # the log has no room
            print("a stand-in has loaded", model, flush=True)

    def do_GET(self) -> None:
        if self.path == "/metrics":
            Answer.count += self._is("busy")
            lines = [f'nv_inference_request_success{{model="{model}"}} {Answer.count}' for model in self.processes]
            self._reply(200, "\n".join(lines))
        else:
            told = {"version": "2.51.0"} if self.path == "/v2" else {**CONFIG, "name": self.path.split("/")[3]}
            self._reply(200, told)

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.path == "/v2/repository/index":
            self._reply(200, [entry for folder in self.repository.iterdir() for entry in self._versions(folder.name)])
        elif self.path.endswith(("/load", "/unload")):
            *_, model, what = self.path.split("/")
            if what == "load":
                self.load(model)
            else:
                process = self.processes.pop(model)
                process.kill()
                process.wait()
            self._reply(200, {})
        else:
            while self._is("hangs"):
                time.sleep(0.01)
            self._reply(500 if self._is("fails") else 200, {})

    def _versions(self, model: str) -> list[dict[str, str]]:
        if model not in self.processes:
            return [{"name": model, "version": "1", "state": "UNAVAILABLE", "reason": "unloaded"}]
        loading = [{"name": model, "version": "2", "state": "LOADING"}] if self._is(f"loading-{model}") else []
        return [{"name": model, "version": "1", "state": "READY"}, *loading]

    def _is(self, name: str) -> bool:
        return (self.folder / name).exists()

    def _reply(self, status: int, content: Any) -> None:
        body = (content if isinstance(content, str) else json.dumps(content)).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        pass


def repository(folder: Path, *models: str) -> Path:
    """A repository of these models. A model with the file ``deadly-MODEL`` ends."""
    for model in models:
        version = folder / "models" / model / "1"
        version.mkdir(parents=True)
        (version.parent / "config.pbtxt").write_text(CONFIG_FILE % model)
        deadly = f"pathlib.Path({str(folder / f'deadly-{model}')!r})"
        (version / "model.py").write_text(f"import pathlib, time\nwhile not {deadly}.exists():\n    time.sleep(0.02)\n")
    return folder / "models"


def installation(folder: Path) -> Any:
    """The program that stands in for Triton."""
    from rfm.serve.installation import Installation

    program = folder / "tritonserver"
    program.write_text(f"#!{sys.executable}\n{Path(__file__).read_text()}")
    program.chmod(0o755)
    return Installation(program)


def main(*words: str) -> None:
    options = [word.removeprefix("--").partition("=") for word in words]
    given = {name: value for name, _, value in options}
    Answer.repository = Path(given["model-repository"])
    for name, _, value in options:
        if name == "load-model":
            Answer.load(value)
    for port in ("metrics-port", "http-port"):
        server = ThreadingHTTPServer(("127.0.0.1", int(given[port])), Answer)
        threading.Thread(target=server.serve_forever).start()


if __name__ == "__main__":
    main(*sys.argv[1:])
