# SPDX-License-Identifier: MIT
"""Checkpoints that answer in generated text (upstream: ``model_type: vqa``): progress and preference, parsed.

An answer that is not what was asked for is an error of its sample. Success is not told: NaN.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from rfm.collate.vlm import VlmCollator, VlmRow
from rfm.families.vlm import VlmFamily
from rfm.family import RowScores
from rfm.models.vlm import VlmBatch
from rfm_client import FrameScores, InferenceFailedError, RewardError
from rfm_client.samples import Float32Array

MAX_NEW_TOKENS = 1024  # as the original generates
SHOWN_CHARACTERS = 200  # of an answer that cannot be read
_ANSWER = re.compile(r"<ans>(.*?)</ans>", re.DOTALL)
_PREFERENCES = {"A": 1.0, "B": 0.0}


class UnreadableAnswerError(InferenceFailedError):
    """The model has said something else than what it was asked for."""


class VqaFamily(VlmFamily):
    """A vision-language model that generates its answers, greedily."""

    def __init__(self, network: Any, collator: VlmCollator, device: torch.device) -> None:
        super().__init__(network, collator, device)
        self._accepted = set(inspect.signature(network.forward).parameters)

    @torch.inference_mode()
    def score(self, rows: Sequence[VlmRow], batch: VlmBatch) -> list[RowScores | RewardError]:
        """One generation for all rows, then each one's answer."""
        return [_read(text, row) for text, row in zip(self.generate(batch), rows, strict=True)]

    def generate(self, batch: VlmBatch) -> list[str]:
        """What the model says to each conversation."""
        inputs = batch.to(self.device, self._dtype).inputs
        tokenizer = self.collator.tokenizer
        generated = self.network.generate(
            **{name: tensor for name, tensor in inputs.items() if name in self._accepted},
            max_new_tokens=MAX_NEW_TOKENS,
            do_sample=False,
            pad_token_id=tokenizer.pad_token_id,
            eos_token_id=tokenizer.eos_token_id,
        )
        said = generated[:, inputs["input_ids"].shape[1] :]
        texts: list[str] = tokenizer.batch_decode(said, skip_special_tokens=True)
        return texts


def parse_progress(text: str, num_frames: int) -> Float32Array:
    """float32 [T] from ``<ans>[0.1, 0.4, ...]</ans>``. Raises ValueError for anything else."""
    answer = _answer(text)
    try:
        values = ast.literal_eval(answer)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError(f"expected a list of numbers ({error})") from error
    if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
        raise ValueError("expected a list of numbers")
    if len(values) != num_frames or not all(0 <= value <= 1 for value in values):
        raise ValueError(f"expected {num_frames} numbers from 0 to 1")
    return np.asarray(values, np.float32)


def parse_preference(text: str) -> float:
    """1 for ``<ans>A</ans>``, 0 for ``<ans>B</ans>``. Raises ValueError for anything else."""
    answer = _answer(text)
    if answer not in _PREFERENCES:
        raise ValueError("expected A or B")
    return _PREFERENCES[answer]


def _answer(text: str) -> str:
    match = _ANSWER.search(text)
    if match is None:
        raise ValueError("expected an answer between <ans> and </ans>")
    return match[1].strip()


def _read(text: str, row: VlmRow) -> RowScores | RewardError:
    lengths = row.num_frames
    try:
        if len(lengths) == 1:
            return RowScores([FrameScores(progress=parse_progress(text, lengths[0]), success=_not_told(lengths[0]))])
        frames = [FrameScores(progress=_not_told(length), success=_not_told(length)) for length in lengths]
        return RowScores(frames, parse_preference(text))
    except ValueError as error:
        return UnreadableAnswerError(f"the model's answer cannot be read: {error}, got {text[:SHOWN_CHARACTERS]!r}")


def _not_told(length: int) -> Float32Array:
    return np.full(length, np.nan, np.float32)
