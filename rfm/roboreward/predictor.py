# SPDX-License-Identifier: MIT
"""The predictor of RoboReward: writes a batch's answers together, or computes their expected scores.

The pass over the prompts also checks a draft of the answer's usual beginning: its tokens are accepted up to the first
that is not the likeliest. So a draft saves passes and changes no answer.

B conversations in a batch, N tokens of the draft, V rows of the language head.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from rfm.engine.device import memory_errors
from rfm.engine.execution import Execution
from rfm.engine.layers import progress_from_logits
from rfm.engine.predictor import RowScores, no_success
from rfm.roboreward.prompts import SCORES, RoboRewardCollator, RoboRewardConfig, is_unclear, parsed
from rfm.vlm.batch import VlmBatch
from rfm.vlm.predictor import VlmPredictor
from rfm.vlm.qwen import Indices, KeyValues, next_hidden_state
from rfm.vlm.row import VlmRow
from rfm_client.contract import FrameScores, InferenceFailedError, InvalidSampleError, RewardError
from rfm_client.contract.samples import Float32Array

NOT_FINITE = -1  # instead of a token: some of its logits are not finite


@dataclass
class WrittenAnswer:
    """An answer while it is written.

    tokens: without the token that ends it
    digit_logits: float32 [5], logits of SCORES where the first of these digits is written; None: there is none
    has_ended: no further token belongs to it
    is_finite: all logits of its tokens are finite
    """

    tokens: list[int] = field(default_factory=list)
    digit_logits: Float32Array | None = None
    has_ended: bool = False
    is_finite: bool = True


class RoboRewardPredictor(VlmPredictor):
    """A Qwen3-VL on a device, which writes a score."""

    collator: RoboRewardCollator
    makes_trees = False  # an answer is written behind each conversation

    @torch.inference_mode()
    def score(self, rows: Sequence[VlmRow], batch: VlmBatch, execution: Execution) -> list[RowScores | RewardError]:
        """Return each row's scores, or its error.

        execution: its ``on_forward`` is called after each forward pass
        """
        self._copies.wait_for([] if batch.pixels is None else batch.pixels.videos)
        if self._config.is_expected:
            output = self._output(batch)
            logits = output.logits[:, self.collator.digits].float()
            read = zip(progress_from_logits(logits).tolist(), logits.cpu().numpy(), rows, strict=True)
            scores = [_scores(progress, of_digits, row) for progress, of_digits, row in read]
            made = output.made
        else:
            answers, made = self.write(rows, batch, execution)
            scores = [self._read(answer, row, execution) for answer, row in zip(answers, rows, strict=True)]
        if made is None or bool(made.isfinite().all()):
            self._keep(rows, batch.layout, made)
        return scores

    def num_tokens(self, row: VlmRow) -> int:
        """Return the number of tokens in the row's first pass, which include the draft."""
        return row.num_tokens + len(self.collator.draft)

    @torch.inference_mode()
    def write(
        self, rows: Sequence[VlmRow], batch: VlmBatch, execution: Execution
    ) -> tuple[list[WrittenAnswer], Tensor | None]:
        """Return the answers, each token the likeliest, and the features that the vision tower computed.

        execution: its ``on_forward`` is called after each forward pass
        """
        key_values = KeyValues()
        output = self._output(batch, key_values)
        tokens, digit_logits = self._likeliest(output.logits.unflatten(0, (len(rows), -1)))
        answers, num_right = self._begun(tokens, digit_logits)
        execution.on_forward()
        tokens = tokens[np.arange(len(rows)), num_right]
        lengths = np.array([row.num_tokens for row in rows]) + num_right
        positions = np.array([row.position_ids[0, -1] for row in rows]) + 1 + num_right
        while not all(answer.has_ended for answer in answers):
            with memory_errors():
                fed = tokens.clip(min=0)  # instead of NOT_FINITE
                hidden = next_hidden_state(self.network.model.language_model, fed, positions, lengths, key_values)
                tokens, digit_logits = self._likeliest(self.network.lm_head(hidden))
            for answer, token, logits in zip(answers, tokens, digit_logits, strict=True):
                self._add(answer, token, logits)
            execution.on_forward()
            lengths, positions = lengths + 1, positions + 1
        return answers, output.made

    def _begun(self, tokens: Indices, digit_logits: Float32Array) -> tuple[list[WrittenAnswer], Indices]:
        """Return the answers after the first pass, and how many of the draft's tokens each answer accepts.

        tokens, digit_logits: int64 [B, N + 1], float32 [B, N + 1, 5], behind the prompt and each token of the draft
        """
        num_right: Indices = (tokens[:, :-1] == self.collator.draft).cumprod(axis=1).sum(axis=1)
        answers = [WrittenAnswer() for _ in tokens]
        for index, answer in enumerate(answers):
            for step in range(num_right[index] + 1):
                self._add(answer, tokens[index, step], digit_logits[index, step])
        return answers, num_right

    def _likeliest(self, logits: Tensor) -> tuple[Indices, Float32Array]:
        """Return the likeliest tokens, or NOT_FINITE, and the logits of SCORES: [..., V] -> int64 [...], [..., 5]."""
        tokens = torch.where(logits.isfinite().all(-1), logits.argmax(-1), NOT_FINITE)
        return tokens.cpu().numpy(), logits[..., self.collator.digits].float().cpu().numpy()

    def _add(self, answer: WrittenAnswer, token: int, digit_logits: Float32Array) -> None:
        """Add the next token to an answer that has not ended. digit_logits: float32 [5], logits of SCORES"""
        if answer.has_ended:
            return
        answer.is_finite = token != NOT_FINITE
        if not answer.is_finite or token in self._config.stops:
            answer.has_ended = True
            return
        if answer.digit_logits is None and token in self.collator.digits:
            answer.digit_logits = digit_logits
        answer.tokens.append(int(token))
        answer.has_ended = len(answer.tokens) == self._config.max_new_tokens

    def _read(self, answer: WrittenAnswer, row: VlmRow, execution: Execution) -> RowScores | RewardError:
        if not answer.is_finite:
            return InferenceFailedError("the network gave a score that is not finite")
        text = self.collator.tokenizer.decode(answer.tokens, skip_special_tokens=True)
        score = parsed(text)
        if score is None:
            expected = f"a score from {SCORES[0]} to {SCORES[-1]} in the model's answer"
            return InvalidSampleError.at("answer", expected, repr(text[:200]))
        unclear = is_unclear(text, score)
        execution.num_unclear += unclear
        if unclear and self._config.strict_answers:
            expected = f"one whole score from {SCORES[0]} to {SCORES[-1]} (strict_answers of this model)"
            return InvalidSampleError.at("answer", expected, repr(text[:200]))
        logits = np.full(len(SCORES), np.nan, np.float32) if answer.digit_logits is None else answer.digit_logits
        return _scores((score - SCORES[0]) / (len(SCORES) - 1), logits, row, unclear=unclear)

    @property
    def _config(self) -> RoboRewardConfig:
        config: RoboRewardConfig = self.network.config
        return config


def _scores(
    progress: float, logits: Float32Array, row: VlmRow, *, unclear: bool | None = None
) -> RowScores | RewardError:
    """Return the same scores for each frame of a row. unclear: None: no answer is written"""
    num_frames = row.videos[0].num_shown
    of_frames = np.full(num_frames, progress, np.float32)
    frames = FrameScores(
        progress=of_frames,
        success=no_success(of_frames),
        progress_logits=np.tile(logits, (num_frames, 1)),
        unclear=None if unclear is None else np.full(num_frames, unclear),
    )
    return RowScores([frames])
