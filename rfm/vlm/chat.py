# SPDX-License-Identifier: MIT
"""Parts of a conversation -> the chat template's text -> tokens. Short conversations may be kept: they come again."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from enum import Enum
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np

from rfm.vlm.film import Indices

KEPT_TEXTS = 256  # conversations: an RL loop asks about the same task again and again
MAX_KEPT_BYTES = 16_384  # of one's text; a task sentence and 128 frames have fewer. A byte is a token at most.
FRAME_BYTES = 64  # of a chat template's text about a frame, about

Asked = TypeVar("Asked", bound=Hashable)
Read = TypeVar("Read")


class Visual(Enum):
    """What a chat template shows besides text, by the name that it has there."""

    IMAGE = "image"
    VIDEO = "video"


class Chat:
    """A base model's chat template and tokenizer.

    keeps: whether the latest conversations are kept
    """

    def __init__(self, tokenizer: Any, *, keeps: bool) -> None:
        self._tokenizer = tokenizer
        self._text = _kept(self._render, _num_bytes) if keeps else self._render
        self._tokens = _kept(self._tokenise, _num_bytes) if keeps else self._tokenise

    def text(self, parts: tuple[str | Visual, ...]) -> str:
        """The chat template's text of one user message."""
        return self._text(parts)

    def tokens(self, text: str) -> Indices:
        """int64 [L]: the text's tokens; not to be changed."""
        return self._tokens(text)

    def _render(self, parts: tuple[str | Visual, ...]) -> str:
        content = [{"type": "text", "text": part} if isinstance(part, str) else {"type": part.value} for part in parts]
        conversation = [{"role": "user", "content": content}]
        return str(self._tokenizer.apply_chat_template(conversation, tokenize=False, add_vision_id=True))

    def _tokenise(self, text: str) -> Indices:
        ids = np.asarray(self._tokenizer(text, add_special_tokens=False, verbose=False)["input_ids"], np.int64)
        ids.setflags(write=False)
        return ids


def _kept(read: Callable[[Asked], Read], length: Callable[[Asked], int]) -> Callable[[Asked], Read]:
    """``read``, whose latest results are kept for what is not long; ``length``: bytes of what is read."""
    kept = lru_cache(KEPT_TEXTS)(read)
    return lambda asked: (kept if length(asked) <= MAX_KEPT_BYTES else read)(asked)


def _num_bytes(parts: str | Sequence[str | Visual]) -> int:
    """Of a text in UTF-8, or about as many as the chat template makes of the parts."""
    if isinstance(parts, str):
        return len(parts.encode(errors="surrogatepass"))
    return sum(_num_bytes(part) if isinstance(part, str) else FRAME_BYTES for part in parts)
