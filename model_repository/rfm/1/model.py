# SPDX-License-Identifier: MIT
"""Triton's model for a scorer: samples in the wire contract go in, scores come out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import torch

from rfm import families
from rfm.engine import Engine, Outcome, Prepared
from rfm.engine.execution import Execution
from rfm.parameters import (
    BUDGET_PARAMETER,
    CHECKPOINT_FOLDER,
    DTYPE_PARAMETER,
    FAMILY_PARAMETER,
    FEATURE_CACHE_PARAMETER,
    GRAPHS_PARAMETER,
    SAMPLE_TOKENS_PARAMETER,
)
from rfm.triton_model.batch_model import BatchModel
from rfm_client.contract import Result, RewardError, Sample, wire


class TritonPythonModel(BatchModel[Sample, Result]):
    """An instance: an engine on a device."""

    def load(self, version: Path, device: torch.device, settings: Mapping[str, str]) -> None:
        self.engine = Engine.of(
            families.load(version / CHECKPOINT_FOLDER, family=settings[FAMILY_PARAMETER]),
            device=device,
            dtype=getattr(torch, settings[DTYPE_PARAMETER]) if settings[DTYPE_PARAMETER] else None,
            token_budget=int(settings[BUDGET_PARAMETER]),
            max_sample_tokens=int(settings[SAMPLE_TOKENS_PARAMETER]),
            feature_cache_mib=int(settings.get(FEATURE_CACHE_PARAMETER) or 0),
            cuda_graphs=settings.get(GRAPHS_PARAMETER) == "true",
        )

    def decode(self, tensors: wire.Tensors) -> list[Sample]:
        cache = self.engine.cache
        return wire.decode_samples(tensors, None if cache is None else cache.found)

    def prepare(self, question: Sample) -> tuple[Prepared, int]:
        prepared = self.engine.prepare(question)
        if isinstance(prepared.rows, RewardError):
            raise prepared.rows
        return prepared, prepared.num_tokens

    @property
    def works_ahead(self) -> bool:
        return self.engine.works_ahead

    def work_ahead(self, prepared: Prepared) -> None:
        self.engine.work_ahead(prepared)

    def answer(self, questions: Sequence[Prepared], execution: Execution) -> list[Outcome]:
        return self.engine.score(questions, execution)

    def encode(self, answers: Sequence[Result], tensors: wire.Tensors, outputs: Collection[str]) -> wire.Tensors:
        return wire.encode_results(answers, wire.num_positions(tensors), outputs)
