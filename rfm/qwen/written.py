# SPDX-License-Identifier: MIT
"""Reward models that answer in words: all answers in a batch grow together, always by the likeliest token.

A model implements its prompts (``WritingCollator``) and reads its answers (``WritingPredictor.read``). The pass over
the prompts also checks a draft of the answer's usual beginning: draft tokens are accepted up to the first that is not
the likeliest. So a draft saves passes and changes no answer.

B conversations in a batch, N draft tokens, D digits, V rows in the language head.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rfm.engine.device import memory_errors
from rfm.engine.execution import Execution
from rfm.engine.predictor import RowScores, no_success
from rfm.qwen.backbone import Indices, KeyValues, next_hidden_state
from rfm.qwen.batch import VlmBatch, VlmRow
from rfm.qwen.images import QwenImages
from rfm.qwen.language import LanguageCollator, LanguageConfig
from rfm.qwen.predictor import QwenPredictor
from rfm_client.contract import FrameScores, InferenceFailedError, InvalidSampleError, RewardError
from rfm_client.contract.samples import Float32Array

NOT_FINITE = -1  # replaces a token if some of its logits are not finite
MOST_SHOWN = 200  # answer characters in an error message


@dataclass(frozen=True)
class WritingConfig(LanguageConfig):
    """The configuration of a model that writes answers.

    stops: ids of the tokens that end an answer
    max_new_tokens: most tokens per answer
    """

    stops: tuple[int, ...]
    max_new_tokens: int = 128


class WritingCollator(LanguageCollator):
    """The collator for prompts that a written answer follows.

    draft: int64 [N], the tokens with which an answer usually begins
    digits: ids of the D tokens whose logits are kept at the first digit of an answer
    """

    config: Any
    digits: Sequence[int] = ()
    makes_trees = False  # an answer is written behind each conversation

    def __init__(self, config: WritingConfig, tokenizer: Any, images: QwenImages, draft: str) -> None:
        super().__init__(config, tokenizer, images)
        self.draft = self._chat.tokens(draft)

    def collate(self, rows: Sequence[VlmRow], length: int | None = None) -> VlmBatch:
        """Return the batch of conversations with the draft behind each.

        length: as in ``QwenCollator.collate``
        The queries are each conversation's last token and the draft tokens.
        """
        batch = super().collate([self._drafted(row) for row in rows], length)
        back = torch.arange(-len(self.draft), 1)
        return replace(
            batch,
            queries=(batch.queries[:, None] + back).flatten(),
        )

    def _drafted(self, row: VlmRow) -> VlmRow:
        at = row.position_ids[:, -1:] + 1 + np.arange(len(self.draft))
        return replace(
            row,
            input_ids=np.concatenate([row.input_ids, self.draft]),
            position_ids=np.concatenate([row.position_ids, at], axis=1),
            query=row.num_tokens + len(self.draft) - 1,
        )


@dataclass
class WrittenAnswer:
    """An answer while it is written.

    tokens: without the token that ends it
    digit_logits: float32 [D], logits for the collator's digits at the first digit; None: no digit yet
    has_ended: no further token belongs to it
    is_finite: all logits for its tokens are finite
    """

    tokens: list[int] = field(default_factory=list)
    digit_logits: Float32Array | None = None
    has_ended: bool = False
    is_finite: bool = True


class WritingPredictor(QwenPredictor):
    """A vision-language model on a device, which writes answers.

    expected: what an answer must hold, for the error message if it cannot be read
    """

    collator: WritingCollator
    expected: str

    def read(
        self, text: str, answer: WrittenAnswer, row: VlmRow, execution: Execution
    ) -> RowScores | RewardError | None:
        """Return the scores in an answer, or its error; None: the answer cannot be read."""
        raise NotImplementedError

    @torch.inference_mode()
    def score(self, rows: Sequence[VlmRow], batch: VlmBatch, execution: Execution) -> list[RowScores | RewardError]:
        """Return each row's scores or error.

        execution: its ``on_forward`` is called after each forward pass
        """
        answers, made = self.write(rows, batch, execution)
        scores = [self._read(answer, row, execution) for answer, row in zip(answers, rows, strict=True)]
        self._keep_finite(rows, batch, made)
        return scores

    def num_tokens(self, row: VlmRow) -> int:
        """Return how many tokens the row's first pass has, including the draft."""
        return row.num_tokens + len(self.collator.draft)

    @torch.inference_mode()
    def write(
        self, rows: Sequence[VlmRow], batch: VlmBatch, execution: Execution
    ) -> tuple[list[WrittenAnswer], Tensor | None]:
        """Return the answers, always with the likeliest token, and the features that the vision tower computed.

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
        """Return the answers after the first pass, and how many draft tokens each accepts.

        tokens, digit_logits: int64 [B, N + 1], float32 [B, N + 1, D], behind the prompt and behind each draft token
        """
        num_right: Indices = (tokens[:, :-1] == self.collator.draft).cumprod(axis=1).sum(axis=1)
        answers = [WrittenAnswer() for _ in tokens]
        for index, answer in enumerate(answers):
            for step in range(num_right[index] + 1):
                self._add(answer, tokens[index, step], digit_logits[index, step])
        return answers, num_right

    def _likeliest(self, logits: Tensor) -> tuple[Indices, Float32Array]:
        """Return the likeliest tokens, or NOT_FINITE, and the digits' logits: [..., V] -> int64 [...], [..., D]."""
        tokens = torch.where(logits.isfinite().all(-1), logits.argmax(-1), NOT_FINITE)
        return tokens.cpu().numpy(), logits[..., list(self.collator.digits)].float().cpu().numpy()

    def _add(self, answer: WrittenAnswer, token: int, digit_logits: Float32Array) -> None:
        """Add the next token to an answer that has not ended. digit_logits: float32 [D]."""
        config = self.collator.config
        if answer.has_ended:
            return
        answer.is_finite = token != NOT_FINITE
        if not answer.is_finite or token in config.stops:
            answer.has_ended = True
            return
        if answer.digit_logits is None and token in self.collator.digits:
            answer.digit_logits = digit_logits
        answer.tokens.append(int(token))
        answer.has_ended = len(answer.tokens) == config.max_new_tokens

    def _read(self, answer: WrittenAnswer, row: VlmRow, execution: Execution) -> RowScores | RewardError:
        if not answer.is_finite:
            return InferenceFailedError("the network gave a score that is not finite")
        text = self.collator.tokenizer.decode(answer.tokens, skip_special_tokens=True)
        scores = self.read(text, answer, row, execution)
        if scores is not None:
            return scores
        execution.num_unreadable += 1
        return unread(self.expected, text)

    def _keep_finite(self, rows: Sequence[VlmRow], batch: VlmBatch, made: Tensor | None) -> None:
        """Cache the features from a pass, if all are finite."""
        if made is None or bool(made.isfinite().all()):
            self._keep(rows, batch.layout, made)


def progress_of(score: float) -> RowScores:
    """Return the scores for a row whose answer holds one number."""
    progress = np.array([score])
    return RowScores([FrameScores(progress=progress, success=no_success(progress))])


def unread(expected: str, text: str) -> InvalidSampleError:
    """Return the error for an answer that holds no score."""
    return InvalidSampleError.at("answer", expected, repr(text[:MOST_SHOWN]))
