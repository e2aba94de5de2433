# SPDX-License-Identifier: MIT
"""Full memory and full disks for ``make chaos``: small mounts of its own, in a mount namespace that ends with it."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import rfm_export
from callers import Callers, Exam, direct, progress_samples
from chaos_site import CHECKPOINT, HEALED_S, Row, site
from rfm.config import ExportConfig
from rfm.triton_model.weights import check_digest
from rfm_client.contract.model_info import DIGEST_PARAMETER
from rfm_client.transport.shared_memory import FOLDER
from rfm_export.publish import read_config
from rfm_serve import RFM

SHM_SIZE = "24m"
CALLERS = 8
ROOM_FOR_EXPORTS = 1.5
INSIDE_S = 300
FULL_S = 5.0
SHARING = """
import sys, numpy as np
from rfm_client import ProgressSample, RewardClient, Trajectory
video, text = np.zeros((32, 64), np.float32), np.zeros(32, np.float32)
asked = [ProgressSample(Trajectory(video_embeddings=video, text_embedding=text))] * 64
with RewardClient(sys.argv[1], shared_memory=True) as client:
    for _ in range(3):
        client.evaluate(asked)
"""  # 64 samples of 8 KiB are one input that is shared


def namespace() -> list[str] | None:
    """What a command runs behind to have mounts of its own; None: it may not."""
    for words in (["unshare", "--mount"], ["unshare", "--map-root-user", "--mount"]):
        with suppress(FileNotFoundError):
            tried = subprocess.run([*words, "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False)
            if tried.returncode == 0:
                return words
    return None


def run(fault: str, folder: Path) -> list[Row]:
    """The rows of a fault in a namespace of its own; none if there can be none."""
    words = namespace()
    if words is None:
        print(f"{fault}: left out: this user may make no mount namespace (unshare --mount)")
        return []
    output = folder / "rows.json"
    script = Path(__file__).with_name("chaos.py")
    with output.open("wb") as rows:
        subprocess.run([*words, sys.executable, script, "--inside", fault], stdout=rows, check=True, timeout=INSIDE_S)
    return [Row(**row) for row in json.loads(output.read_text().splitlines()[-1])]


def inside(fault: str, folder: Path) -> int:
    """What is run there."""
    print(json.dumps([asdict(row) for row in FAULTS[fault](folder)]))
    return 0


@contextmanager
def _mounted(where: Path, size: str | int) -> Iterator[None]:
    """Within it, ``where`` is a small file system of its own."""
    where.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", where], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", where], check=True)


def full_shared_memory(folder: Path) -> list[Row]:
    """Clients that share memory send through the socket instead, and all are served."""
    with _mounted(FOLDER, SHM_SIZE), site(folder / "site") as served:
        url = served.served.endpoints.grpc_url
        with Callers(direct(url), Exam.of(CHECKPOINT, progress_samples()), CALLERS) as callers:
            filler = FOLDER / "filler"
            _fill(filler)
            started_s = time.monotonic()
            sharing = subprocess.run(
                [sys.executable, "-c", SHARING, url], capture_output=True, text=True, timeout=90, check=False
            )
            while time.monotonic() - started_s < FULL_S:
                callers.wait_for_all()
            filler.unlink()
            healed_s = served.served.wait_ready()
            callers.wait_for_all()
        said = served.served.said
    row = Row.of("full /dev/shm", callers.tally, healed_s, "a client that shares memory used the socket")
    row.expect(sharing.returncode == 0, f"the client that shares memory: {sharing.stderr[-300:]}")
    row.expect("no shared memory, inputs go through the socket" in sharing.stderr, "it did not say so")
    row.expect(healed_s <= HEALED_S + served.start_s, f"healed after {healed_s:.1f} s")
    row.expect(not any("started again" in line for line in said), "; ".join(said))
    return [row]


def _fill(file: Path) -> None:
    """Nothing is left of the file system's room."""
    with file.open("wb", buffering=0) as filler, suppress(OSError):
        while filler.write(bytes(2**16)):
            pass
    with file.open("ab", buffering=0) as filler, suppress(OSError):
        while filler.write(bytes(1)):
            pass


def full_disk(folder: Path) -> list[Row]:
    """An export that does not fit says so, and leaves the version before as it was."""
    disk = folder / "disk"
    size = sum(file.stat().st_size for file in CHECKPOINT.rglob("*") if file.is_file())
    with _mounted(disk, int(ROOM_FOR_EXPORTS * size)):
        return [_export_without_room(disk)]


def _export_without_room(disk: Path) -> Row:
    repository = disk / "model_repository"
    version = rfm_export.export(CHECKPOINT, repository, ExportConfig(num_gpus=0))
    words = [RFM, "export", "--checkpoint", CHECKPOINT, "--repository", repository]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=INSIDE_S)
    row = Row("full disk at export", told=f"the export failed, and said so; version {version} is whole")
    row.expect(done.returncode == 1 and "No space left" in done.stderr, f"{done.returncode}: {done.stderr[-300:]}")
    config = read_config(repository, "rfm")
    row.expect(list(config.version_policy.specific.versions) == [version], "another version would be served")
    check_digest(repository / "rfm" / str(version), config.parameters[DIGEST_PARAMETER].string_value)
    left = [str(path) for path in repository.rglob(".export-*")]
    row.expect(not left, f"left behind: {left}")
    return row


FAULTS: dict[str, Callable[[Path], list[Row]]] = {"full /dev/shm": full_shared_memory, "full disk": full_disk}
