# SPDX-License-Identifier: MIT
"""Servers whose end is not what a test is about, and servers of one small model."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tritonclient.grpc

from rfm.launch.installation import find_installation
from rfm.launch.triton_server import Endpoints, TritonServer

CRASHES: list[Path] = []  # repositories whose Triton has ended with SIGABRT, by itself, or whose start was repeated


class BriefServer(TritonServer):
    """A server that is killed when its test is over: Triton takes a second for each model process to end in order."""

    _num_stops = 0

    def start_ready(self, served: Mapping[str, Mapping[str, Any]] | None = None) -> None:
        before = self._num_stops
        super().start_ready(served)
        if self._num_stops > before:  # the first start hung for a minute: too long for callers with a deadline
            CRASHES.append(self.repository)

    def stop(self) -> None:
        self._num_stops += 1
        super().stop()

    def __exit__(self, *raised: Any) -> None:
        if self.exit_status == -signal.SIGABRT:
            CRASHES.append(self.repository)
        if self.exit_status is None:
            self.kill()
        super().__exit__(*raised)


class OneModelServer(BriefServer):
    """A server of the demo's ``rfm`` alone; with more arguments, and killed if asked."""

    def __init__(self, repository: Path, endpoints: Endpoints, *arguments: str) -> None:
        log = (repository.parent / "tritonserver.log").open("ab")
        super().__init__(repository, endpoints, find_installation(), log=log, more_arguments=arguments)
        self._own_log = log

    def signal(self, number: signal.Signals) -> None:
        os.killpg(os.getpgid(self.pid), number)

    def kill(self) -> None:
        super().kill()
        self.stop()

    def __enter__(self) -> TritonServer:
        try:
            return super().__enter__()
        except BaseException:
            self._own_log.close()
            raise

    def __exit__(self, *raised: Any) -> None:
        super().__exit__(*raised)
        self._own_log.close()  # not in `stop`: a start that Triton has spoilt is stopped and repeated


def answered(endpoints: Endpoints) -> int:
    with tritonclient.grpc.InferenceServerClient(endpoints.grpc_url.removeprefix("grpc://")) as client:
        stats = client.get_inference_statistics("rfm").model_stats[0]
    return int(stats.inference_stats.success.count)
