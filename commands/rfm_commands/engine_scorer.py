# SPDX-License-Identifier: MIT
"""A scorer with a checkpoint in this process, without a server."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import torch
from safetensors import SafetensorError

from rfm import published
from rfm.engine import Engine
from rfm.engine.device import computation
from rfm.engine.execution import Execution
from rfm.engine.family import Checkpoint, FrameEncoders, config_fields
from rfm.files import CheckpointError, settings_digest, weights_digest
from rfm.published.run_config import PROGRESS, SUCCESS
from rfm_client import FRAME_SCORES, ProgressResult, ProgressSample, RewardError, Trajectory
from rfm_client.contract.samples import EncoderSample, UInt8Array
from rfm_export.source import device_named
from rfm_labels import CheckpointFacts


class EngineScorer:
    """Scores with an engine, one call at a time: while a thread scores, the others decode. T frames, H x W pixels.

    The first call moves the checkpoint to the device.

    notes: lines for the user, from ``rfm.published.notes`` for progress and success
    """

    def __init__(self, source: str, *, device: str = "cpu", dtype: torch.dtype | None = None, **options: Any) -> None:
        """Load a checkpoint folder or Hugging Face id.

        dtype: the network's type; None: float32 on the CPU, else the checkpoint's own
        options: as in ``rfm.published.read``
        Raises ExportError for a missing device, and what ``rfm.published.read`` raises.
        """
        on = device_named(device)
        loaded = published.read(source, **options)
        self._checkpoint, self._encoders = loaded.checkpoint, loaded.encoders()
        if self._encoders is None and self._checkpoint.description.widths is not None:  # else each episode would say so
            remedy = "name them with --image-encoder and --text-encoder"
            raise CheckpointError.at(source, "encoders, since it scores embeddings", "none", remedy)
        settings = {"device": on.type, **{name: _named(value) for name, value in options.items()}}
        settings |= {} if dtype is None else {"dtype": str(dtype)}
        newer = [name for name in self._checkpoint.description.more_scores if FRAME_SCORES[name].is_newer]
        settings |= {f"marks_{name}": True for name in newer}  # as in ``ClientScorer``
        folders = _folders(source, options)
        computed = computation(self._checkpoint, dtype, on_gpu=on.type != "cpu")
        self._facts = replace(_facts(source, self._checkpoint, self._encoders, folders, settings), computation=computed)
        self.notes = published.notes(folders[0], loaded, (PROGRESS, SUCCESS))
        self._device, self._dtype = on, dtype
        self._lock = threading.Lock()

    def checkpoint(self) -> CheckpointFacts:
        """Return facts about the checkpoint."""
        return self._facts

    def encode(self, frames: UInt8Array, task: str) -> Trajectory:
        """Return embeddings for the task and frames, uint8 [T, H, W, 3]. Raises RewardError."""
        with self._lock:
            encoders = self._engine.encoders
            assert encoders is not None  # callers encode only if the facts say ``encodes``
            encoder_sample = EncoderSample((Trajectory(frames=frames, task=task),))
            (outcome,) = encoders.encode([encoder_sample], Execution(), None)
        return cast(EncoderSample, _result(outcome)).trajectories[0]

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        """Return each sample's result. Raises RewardError for the first failure."""
        with self._lock:
            outcomes = self._engine.evaluate(samples)
        return [cast(ProgressResult, _result(outcome)) for outcome in outcomes]

    @cached_property
    def _engine(self) -> Engine:
        return Engine.of(self._checkpoint, encoders=self._encoders, device=self._device, dtype=self._dtype)


def _facts(
    source: str,
    checkpoint: Checkpoint,
    encoders: FrameEncoders | None,
    folders: Sequence[Path],
    settings: Mapping[str, Any],
) -> CheckpointFacts:
    description = checkpoint.description
    name, _, tag = source.partition("@")
    is_local = Path(source).is_dir()
    return CheckpointFacts.of(
        description,
        source="/".join(Path(source).resolve().parts[-2:]) if is_local else name,
        revision=None if is_local else tag or None,
        weights_digest=weights_digest([*folders[1:], folders[0]]),  # encoders first, as served
        settings_digest=_settings_digest(checkpoint, encoders, folders, settings),
        frame_size=description.frame_size if encoders is None else encoders.description.frame_size,
        encodes=encoders is not None,
        is_causal=getattr(checkpoint.config, "causal_mask", None) is True,
        weights=getattr(checkpoint.config, "weights", None),
        has_progress=description.has_progress,
    )


def _settings_digest(
    checkpoint: Checkpoint, encoders: FrameEncoders | None, folders: Sequence[Path], settings: Mapping[str, Any]
) -> str:
    """Digest everything that decides scores except the folders' weights, including encoder weights from the Hub."""
    settings = {**settings, "network": config_fields(checkpoint.config)}
    if encoders is None:
        return settings_digest(folders, settings)
    try:
        with TemporaryDirectory(prefix="rfm-label-") as written:
            encoders.save(Path(written))
            settings["encoders"] = weights_digest([Path(written)])
            return settings_digest([*folders, Path(written)], settings)
    except (OSError, SafetensorError) as error:  # safetensors reports a full disk as SafetensorError
        expected = "a folder of temporary files with room for a copy of the encoders"
        raise CheckpointError.at("TMPDIR", expected, error, "name another one with it") from error


def _named(value: Any) -> Any:
    """Return the option, but None for a local folder, whose files count instead."""
    return None if isinstance(value, str) and Path(value).is_dir() else value


def _folders(source: str, options: dict[str, Any]) -> list[Path]:
    """Return the local folders whose weights decide the scores, the checkpoint's first."""
    named = [options.get(name) for name in ("image_encoder", "text_encoder", "base_model")]
    found = published.find(source, lambda line: None)  # ``published.read`` has already reported the line
    return [found, *(Path(folder) for folder in named if folder and Path(folder).is_dir())]


def _result(outcome: Any) -> Any:
    if isinstance(outcome, RewardError):
        raise outcome
    return outcome
