# SPDX-License-Identifier: MIT
"""One version of the checkpoint behind an answer, also where the answer takes several requests."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import TypeVar

from rfm_client.contract.errors import RewardError, ServerUnavailableError
from rfm_client.contract.results import Result

Outcome = TypeVar("Outcome", bound=Result | RewardError)


class CheckpointReplacedError(ServerUnavailableError):
    """Several versions of the checkpoint would be behind one answer, since it is being replaced."""


async def of_one_version(
    ask: Callable[[], Awaitable[Sequence[Outcome]]], *, may_repeat: bool = True
) -> Sequence[Outcome]:
    """What ``ask`` gives; if several versions answered, what it gives the second time.

    may_repeat: there is a second time
    Raises CheckpointReplacedError if several versions answered then, too.
    """
    outcomes = await ask()
    if may_repeat and len(versions_of(outcomes)) > 1:
        outcomes = await ask()
    check_one(versions_of(outcomes))
    return outcomes


def versions_of(outcomes: Iterable[Result | RewardError]) -> set[str | None]:
    """The versions that gave these results."""
    return {outcome.model_version for outcome in outcomes if not isinstance(outcome, RewardError)}


def check_one(versions: set[str | None]) -> None:
    """Raises CheckpointReplacedError if there are several."""
    if len(versions) > 1:
        got = ", ".join(sorted(map(str, versions)))
        raise CheckpointReplacedError(
            f"model_version: expected one for the whole answer, got {got}: the checkpoint is being replaced, try again"
        )
