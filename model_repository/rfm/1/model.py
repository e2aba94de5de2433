# SPDX-License-Identifier: MIT
"""Triton <-> Engine: samples of the wire contract in, their rewards out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import torch

from rfm.engine import Engine, Outcome
from rfm.execution import Execution
from rfm.parameters import BUDGET_PARAMETER, DTYPE_PARAMETER, FAMILY_PARAMETER, SAMPLE_TOKENS_PARAMETER
from rfm.triton_model.batch_model import BatchModel
from rfm.version_folder import CHECKPOINT_FOLDER
from rfm_client.contract import Result, Sample, wire


class TritonPythonModel(BatchModel[Sample, Result]):
    """One instance: one engine on one device."""

    def load(self, version: Path, device: torch.device, settings: Mapping[str, str]) -> None:
        self.engine = Engine.from_checkpoint(
            version / CHECKPOINT_FOLDER,
            family=settings.get(FAMILY_PARAMETER),  # older configurations do not name it
            device=device,
            dtype=getattr(torch, settings[DTYPE_PARAMETER]) if settings[DTYPE_PARAMETER] else None,
            token_budget=int(settings[BUDGET_PARAMETER]),
            max_sample_tokens=int(settings[SAMPLE_TOKENS_PARAMETER]),
        )

    def decode(self, tensors: wire.Tensors) -> list[Sample]:
        return wire.decode_samples(tensors)

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Outcome]:
        return self.engine.evaluate(questions, execution)

    def encode(self, answers: Sequence[Result], tensors: wire.Tensors, outputs: Collection[str]) -> wire.Tensors:
        return wire.encode_results(answers, wire.num_positions(tensors), outputs)
