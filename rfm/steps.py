# SPDX-License-Identifier: MIT
"""Steps of work that takes long: who does it says that it gets on, and who watches it is told.

What is between the two, a checkpoint's family or the model.py of an older export, need not know of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar


def _nobody() -> None:
    pass


_watching: ContextVar[Callable[[], None]] = ContextVar("rfm_steps", default=_nobody)


@contextmanager
def telling(watching: Callable[[], None]) -> Iterator[None]:
    """A context, of this thread alone, in which ``watching`` is called with each step. It is to be cheap."""
    token = _watching.set(watching)
    try:
        yield
    finally:
        _watching.reset(token)


def one_step_further() -> None:
    """Says that the work has got on. To be called often, say with each frame: it costs less than a microsecond."""
    _watching.get()()
