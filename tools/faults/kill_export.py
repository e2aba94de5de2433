# SPDX-License-Identifier: MIT
"""Part of ``make chaos``: `rfm export` is killed (-9) at many moments; the repository can be served after each.

Two checkpoints with encoders are exported in turn into one repository. Some kills come at a random moment of the
export, the others right before each step of the publishing. (A process that has imported all it needs is forked for
each export: nothing happens to a repository while Python imports.) After each kill every model that Triton would load is
whole, its weights are those of its digest, and it gives the scores of one of the two; after every tenth a real Triton
says so.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from safetensors.torch import load_file, save_file

import goldens
from engines import serve_config
from rfm.engine import Engine, Outcome
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints, TritonServer
from rfm.rewind.encoders import Encoders
from rfm.triton_model.weights import check_digest
from rfm_client import ProgressResult, ProgressSample, RewardClient, Sample, Trajectory
from rfm_client.contract.model_info import DIGEST_PARAMETER
from rfm_commands.cli import app
from rfm_export.publish import read_config

CHECKPOINT = goldens.config("enc_c1_t1_disc10")
TOLERANCE = 1e-5
SERVED_EVERY = 10


class NotServableError(Exception):
    """A repository that no longer can be served as one of the checkpoints."""


@dataclass
class Trial:
    """Two checkpoints, a repository that has served the first, and what became of it so far."""

    folder: Path
    seed: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    leftovers: int = 0

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        self.repository = self.folder / "model_repository"
        self.checkpoints = [CHECKPOINT.checkpoint, _changed(CHECKPOINT.checkpoint, self.folder / "other")]
        frames = np.random.default_rng(self.seed).integers(0, 256, (3, 32, 32, 3), np.uint8)
        self.samples: list[Sample] = [ProgressSample(Trajectory(frames=frames, task="stack the cups"))]
        self.exporter = subprocess.Popen(
            [sys.executable, __file__, "--fork-exports"],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.duration_s = 0.0
        self.expected = [self._export_whole(number) for number in range(2)]
        if np.allclose(*self.expected, rtol=0, atol=TOLERANCE):
            raise NotServableError("expected two checkpoints that differ, got the same scores")

    def kills(self, count: int) -> Iterator[str]:
        """Kills the export at so many moments, and says what each met. Raises NotServableError."""
        steps = self._num_steps()
        for number in range(count):
            at_step = number // 2 % steps if number % 2 else None
            told = self._kill_at_step(number, at_step) if at_step is not None else self._kill_at_random(number)
            self.leftovers += len(list(self.repository.rglob(".export-*")))
            which = self.check()
            if number % SERVED_EVERY == SERVED_EVERY - 1:
                self.check_served()
                told += ", and Triton serves it"
            yield f"{number + 1}: {told}; checkpoint {which} is served"

    def check(self) -> int:
        """Which of the two checkpoints the repository gives now. Raises NotServableError."""
        name, versions = "rfm", {}
        for model in ("rfm", "rfm_encoder", "rfm_frames"):
            config = read_config(self.repository, model)
            versions[model] = list(config.version_policy.specific.versions)
            for version in versions[model]:
                folder = self.repository / model / str(version)
                if not any(folder.iterdir()):
                    raise NotServableError(f"{folder}: expected files, got none")
                if model != "rfm_frames":
                    check_digest(folder, config.parameters[DIGEST_PARAMETER].string_value)
            for warmup in config.model_warmup:
                for tensor in warmup.inputs.values():
                    file = self.repository / model / "warmup" / tensor.input_data_file
                    if not (tensor.zero_data or file.is_file()):
                        raise NotServableError(f"{file}: expected a file, got none")
            for step in config.ensemble_scheduling.step:
                if step.model_version not in versions[step.model_name]:
                    raise NotServableError(f"{model}: expected served versions as steps, got {step}")
        step = {
            s.model_name: str(s.model_version)
            for s in read_config(self.repository, "rfm_frames").ensemble_scheduling.step
        }
        encoder = self.repository / "rfm_encoder" / step["rfm_encoder"]
        encoders = Encoders.from_pretrained(encoder / "image_encoder", encoder / "text_encoder")
        engine = Engine.from_checkpoint(self.repository / name / step["rfm"] / "checkpoint", encoders=encoders)
        return self._which(_scores(engine.evaluate(self.samples)))

    def check_served(self) -> int:
        """The same, asked of a real Triton."""
        with (
            (self.folder / "triton.log").open("ab") as log,
            TritonServer(self.repository, Endpoints.free(), find_installation(), log=log) as server,
            RewardClient(server.endpoints.grpc_url) as client,
        ):
            return self._which(_scores(client.evaluate(self.samples)))

    def finish(self) -> int:
        """One whole export at the end: it is served, and nothing of the killed ones lies about."""
        self._export_whole(0)
        left = list(self.repository.rglob(".export-*"))
        if left:
            raise NotServableError(f"{self.repository}: expected no folders of killed exports, got {left}")
        return self.check_served()

    def close(self) -> None:
        """Ends the process that is forked."""
        self.exporter.communicate()

    def _which(self, scores: np.ndarray[Any, Any]) -> int:
        for number, expected in enumerate(self.expected):
            if np.allclose(scores, expected, rtol=0, atol=TOLERANCE):
                return number
        raise NotServableError(f"expected the scores of one of the checkpoints, got {scores}")

    def _export_whole(self, number: int) -> np.ndarray[Any, Any]:
        """The scores of what was exported."""
        started_s = time.perf_counter()
        if status := self._export(number):
            raise NotServableError(f"expected an export, got exit status {status}")
        self.duration_s = time.perf_counter() - started_s
        return _scores(_load(self.checkpoints[number]).evaluate(self.samples))

    def _kill_at_random(self, number: int) -> str:
        after_s = self.random.uniform(0, self.duration_s)
        killed = self._export(number, kill_after_s=after_s) == -signal.SIGKILL
        self.counts["killed at a random moment" if killed else "done before the kill"] += 1
        return f"killed after {after_s:.2f} s" if killed else f"done before {after_s:.2f} s"

    def _kill_at_step(self, number: int, step: int) -> str:
        if (status := self._export(number, die_at_step=step)) != -signal.SIGKILL:
            raise NotServableError(f"step {step}: expected to be killed, got exit status {status}")
        self.counts["killed before a step of publishing"] += 1
        return f"killed before step {step}"

    def _num_steps(self) -> int:
        """Of an export of the next version: the first that is not reached, found by halving."""
        reached, beyond = 0, 64
        while beyond - reached > 1:
            middle = (reached + beyond) // 2
            if self._export(0, die_at_step=middle) == -signal.SIGKILL:
                reached = middle
            else:
                beyond = middle
        return beyond

    def _export(self, number: int, **how: float) -> int:
        """Exit status of one export, of the first checkpoint or the second by turns."""
        words = [
            *("export", "--checkpoint", str(self.checkpoints[number % 2]), "--repository", str(self.repository)),
            *("--image-encoder", str(CHECKPOINT.image_encoder), "--text-encoder", str(CHECKPOINT.text_encoder)),
        ]
        assert self.exporter.stdin is not None
        assert self.exporter.stdout is not None
        self.exporter.stdin.write(json.dumps({"words": words, **how}) + "\n")
        self.exporter.stdin.flush()
        return int(self.exporter.stdout.readline())


def fork_exports() -> None:
    """The process that is forked for each export; reads how on standard input, and writes exit statuses."""
    for name in ("bert.modeling_bert", "dinov2.modeling_dinov2", "bert.tokenization_bert_fast"):
        importlib.import_module(f"transformers.models.{name}")
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])
    for line in sys.stdin:
        how = json.loads(line)
        child = os.fork()
        if child == 0:
            _export_as(how)
        if "kill_after_s" in how:
            signal.sigtimedwait([signal.SIGCHLD], how["kill_after_s"])
            os.kill(child, signal.SIGKILL)  # which does nothing to one that has ended
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _export_as(how: dict[str, Any]) -> NoReturn:
    """`rfm export`, which dies in place of a step that would change the repository, if it is told to."""
    remaining = how.get("die_at_step", math.inf)
    repository = Path(how["words"][4])

    def dying(move: Callable[[Path, Path], Path]) -> Callable[[Path, Path], Path]:
        def moved(source: Path, target: Path) -> Path:
            nonlocal remaining
            if repository in Path(target).parents:
                if remaining == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                remaining -= 1
            return move(source, target)

        return moved

    Path.rename, Path.replace = dying(Path.rename), dying(Path.replace)  # type: ignore[assignment,method-assign]
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # standard output is for exit statuses
    status = 1
    try:
        app(how["words"])
    except SystemExit as end:
        status = int(end.code or 0)
    finally:
        os._exit(status)


def _load(checkpoint: Path) -> Engine:
    from rfm import families

    serve = serve_config(CHECKPOINT)
    loaded = families.load(checkpoint, image_encoder=serve.image_encoder, text_encoder=serve.text_encoder)
    return Engine.of(loaded, encoders=loaded.encoders())


def _changed(checkpoint: Path, folder: Path) -> Path:
    """A copy with other weights."""
    shutil.copytree(checkpoint, folder, copy_function=shutil.copyfile)
    weights = load_file(folder / "model.safetensors")
    for name in ("progress_head.4.bias", "success_head.4.bias"):
        weights[name] = weights[name] + torch.linspace(0.5, 1.5, weights[name].numel()).reshape(weights[name].shape)
    save_file(weights, folder / "model.safetensors")
    return folder


def _scores(outcomes: Sequence[Outcome]) -> np.ndarray[Any, Any]:
    parts = []
    for outcome in outcomes:
        if not isinstance(outcome, ProgressResult):
            raise NotServableError(f"expected scores, got {outcome}")
        parts += [outcome.progress, outcome.success]
    return np.concatenate(parts)


def main(kills: int) -> int:
    """Prints what each kill met; 1 if the repository could not be served after one."""
    started_s = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="rfm-kill-export-") as folder:
        trial = Trial(Path(folder))
        try:
            for told in trial.kills(kills):
                print(told, flush=True)
            trial.finish()
        except NotServableError as error:
            print(f"FAILED: {error}")
            return 1
        finally:
            trial.close()
        versions = len([path for path in (trial.repository / "rfm").iterdir() if path.name.isdecimal()])
    counts = ", ".join(f"{count} {what}" for what, count in trial.counts.items())
    print(
        f"{kills} kills in {time.perf_counter() - started_s:.0f} s: {counts}; {versions} version folders; 0 repositories lost"
    )
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--fork-exports", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    sys.exit(fork_exports() if chosen.fork_exports else main(chosen.kills))
