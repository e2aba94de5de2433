# SPDX-License-Identifier: MIT
"""What a gateway takes on, as a dataclass and as options of a command: one table for all commands that run one."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, get_type_hints

import typer

MIB = 2**20


def _limit(default: float, least: float, help: str) -> Any:
    return field(default=default, metadata={"min": least, "help": help})


@dataclass(frozen=True)
class Limits:
    """What a gateway takes on; docs/gateway.md has the reasons for the defaults."""

    timeout: float = _limit(120.0, 0.001, "Seconds that a request may wait, then take to arrive, then to be scored.")
    max_body_mib: int = _limit(512, 1, "Largest request.")
    max_memory_mib: int = _limit(1024, 1, "What all requests under way may hold; others wait.")
    max_in_flight: int = _limit(256, 1, "Evaluations at a time; others wait.")
    max_waiting: int = _limit(1024, 0, "Evaluations that wait for their turn; more are refused with 503.")

    def __post_init__(self) -> None:
        if self.max_memory_mib < self.max_body_mib:
            raise ValueError(f"max_memory_mib: expected at least max_body_mib ({self.max_body_mib}), got less")

    @property
    def options(self) -> dict[str, Any]:
        """Values by the names of the gateway's options."""
        return {each.name.replace("_", "-"): getattr(self, each.name) for each in fields(self)}


def with_limits(prefix: str = "") -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command that takes ``limits: Limits`` an option for each of them, its name behind ``prefix``.

    The options raise typer.BadParameter for limits that contradict each other.
    """

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(**options: Any) -> None:
            values = {each.name: options.pop(prefix + each.name) for each in fields(Limits)}
            try:
                limits = Limits(**values)
            except ValueError as error:
                raise typer.BadParameter(str(error)) from None
            command(**options, limits=limits)

        hints = get_type_hints(command, include_extras=True)
        kept = [
            parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
            for name, parameter in inspect.signature(command).parameters.items()
            if name != "limits"
        ]
        added = [
            _option(prefix + each.name, type(each.default), each.default, each.metadata) for each in fields(Limits)
        ]
        run.__signature__ = inspect.Signature([*kept, *added])  # type: ignore[attr-defined]  # what typer reads
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in (*kept, *added)}
        return run

    return decorated


def _option(name: str, kind: type, default: Any, metadata: Any) -> inspect.Parameter:
    option = typer.Option(**metadata)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option])
