# SPDX-License-Identifier: MIT
"""Exports for ``rfm serve org/name`` and ``rfm try``, one repository for all that decides an export, in a cache.

``exported`` runs this module in a process of its own, so that PyTorch's memory, also on GPUs, is free before Triton
starts.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from rfm.config import ExportConfig
from rfm.parameters import EXPORT_VERSION
from rfm.serve.processes import ProcessGroup, how_it_ended
from rfm.serve.repository import CONFIG_FILE, checkpoint_in, has_checkpoint, models_in
from rfm.serve.triton_server import stopped_by_signals
from rfm_commands.command import RfmCommand, fail, say, timed_steps

if TYPE_CHECKING:
    from rfm.published.hub import Found

CACHE = Path(".cache")  # in the home folder, as the XDG base directory specification says
NOTES = "notes.txt"  # what the export told the user, beside its repository
DIGEST_DIGITS = 12


def is_checkpoint(word: str) -> bool:
    """True for a folder with a checkpoint's files and no models, and for org/name if there is no such folder."""
    folder = Path(word)
    if folder.exists():
        is_served = (folder / CONFIG_FILE).exists() or bool(models_in(folder))
        return not is_served and has_checkpoint(folder)
    return "/" in word and not word.startswith(("/", ".", "~"))


def exported(settings: ExportConfig) -> Path:
    """Return the repository in the cache that serves ``settings.checkpoint``, exported before if necessary.

    Raises typer.Exit after a message, SystemExit after a signal.
    """
    folder = Path(str(settings.checkpoint))
    if not has_checkpoint(folder) and (inner := checkpoint_in(folder)):
        fail(f"checkpoint: expected a checkpoint, got {folder}, a folder that holds one; name {inner}")
    if models_in(folder):
        fail(f"checkpoint: expected a checkpoint, got {folder}, a repository: name it with --repository")
    command = [sys.executable, "-m", __name__, json.dumps(vars(settings))]
    with stopped_by_signals():
        group = ProcessGroup(command, stdout=subprocess.PIPE)
        try:
            answer, _ = group.process.communicate()
        finally:
            group.end()
    status = group.process.returncode
    if status < 0:
        fail(f"the export was {how_it_ended(status)}; the system does so if memory runs out")
    if status:
        raise typer.Exit(status)  # it has written why
    return Path(os.fsdecode(answer).removesuffix("\n"))


def cache_folder(environment: Mapping[str, str]) -> Path:
    """Return the folder with all cached exports."""
    named = environment.get("XDG_CACHE_HOME")
    return (Path(named) if named else Path.home() / CACHE) / "rfm"


def find_or_export(settings: ExportConfig, folder: Path) -> Path:
    """Return the repository in ``folder`` that these settings have, exported if it is missing.

    Writes lines for the user: before a new export, what it takes; what an export told; which one it is.
    Raises CheckpointError, ExportError.
    """
    import rfm_export
    from rfm.published import hub
    from rfm_commands.forecast import needs
    from rfm_export.publish import alone, staging
    from rfm_export.source import check_gpus, num_gpus

    check_gpus(settings.num_gpus)
    source, told = str(settings.checkpoint), dict[str, None]()

    def tell(line: str) -> None:
        if line not in told:
            told[line] = None
            say(line)

    with timed_steps() as begin:
        found, gpus = hub.look(source, tell), num_gpus(settings)
        name = Path(source).expanduser().absolute().name.partition("@")[0]
        digest = _digest(source, found, settings, gpus)
        home = folder / f"{name}-{digest}"
        repository, notes = home / "models", home / NOTES

        def is_same() -> bool:
            return _digest(source, hub.look(source, tell), settings, gpus) == digest

        if not repository.exists():
            home.mkdir(parents=True, exist_ok=True)
            with alone(home, lambda: say(f"another start exports {source}: waiting")), staging(home, ()) as scratch:
                if not repository.exists():
                    expected = list(needs(found, settings, gpus, folder))
                    for need in expected:
                        say(need.line)
                    for need in expected:
                        need.check()
                    if found.missing_bytes:
                        begin("downloading")
                        hub.find(source, tell)
                    if not found.missing_bytes or is_same():
                        num_before = len(told)
                        rfm_export.export(source, scratch / "models", settings, say=tell, begin=begin)
                        if is_same():
                            notes.write_text("".join(f"{line}\n" for line in [*told][num_before:]))
                            (scratch / "models").rename(repository)
    if not repository.exists():  # a better tag came, or the new files name a folder of this machine
        say(f"{source}: other files decide its export now: looking again")
        return find_or_export(settings, folder)
    for line in notes.read_text().splitlines() if notes.exists() else ():  # older exports have none
        tell(line)
    say(f"{source}: served from its export {repository}")
    return repository


def _digest(source: str, found: Found, settings: ExportConfig, gpus: int) -> str:
    """Return digits for all that decides an export. A part on the Hub counts by its name alone."""
    from rfm.published.hub import digests
    from rfm.published.provenance import is_folder, source_name
    from rfm.published.rewind import IMAGE_ENCODER, TEXT_ENCODER

    named = settings.image_encoder or IMAGE_ENCODER, settings.text_encoder or TEXT_ENCODER, settings.base_model
    parts = [Path(source).expanduser() for source in named if source and is_folder(source)]
    decides = {
        **vars(settings),
        "checkpoint": source_name(source),
        "identity": [found.identity, *map(digests, parts)],
        "num_gpus": gpus,
        "version": (importlib.metadata.version("rfm-triton"), EXPORT_VERSION),
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:DIGEST_DIGITS]


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(cls=RfmCommand)
def main(settings: str) -> None:
    """Print the repository for these settings, as JSON."""
    with stopped_by_signals(), redirect_stdout(sys.stderr):
        repository = find_or_export(ExportConfig(**json.loads(settings)), cache_folder(os.environ))
    print(repository)


if __name__ == "__main__":
    app()
