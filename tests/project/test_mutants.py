# SPDX-License-Identifier: MIT
"""The mutants of ``make mutate``: what is changed, what is left alone, and what names them."""

from __future__ import annotations

import mutate
from mutants import mutants

SOURCE = '''
LIMIT: int | None = 3


@decorated(frozen=True)
def first(values: list[int] | None, *, most: float = 0.5) -> int | None:
    """Not 1."""
    assert len(values) == 2
    if values[0] < LIMIT and not values[1]:
        raise ValueError(f"{LIMIT + 1} of {1}")
    return sum(a * b for a, b in zip(values[1:], values, strict=True))
'''


def test_one_thing_is_changed_at_a_time() -> None:
    made = mutants("a.py", SOURCE)
    assert [(mutant.function, mutant.before, mutant.after) for mutant in made if mutant.line != 8] == [
        ("module", "LIMIT: int | None = 3", "LIMIT: int | None = 4"),
        ("module", "LIMIT: int | None = 3", "LIMIT: int | None = 2"),
        *[
            ("first", "def first(values: list[int] | None, *, most: float = 0.5) -> int | None:", f"def first(values: list[int] | None, *, most: float = {new}) -> int | None:")
            for new in ("1.5", "1.0")
        ],
        *[
            ("first", "if values[0] < LIMIT and not values[1]:", f"if {new}:")
            for new in (
                "(not (values[0] < LIMIT and (not values[1])))",
                "((values[0] < LIMIT) or (not values[1]))",
                "values[0] <= LIMIT and not values[1]",
                "values[1] < LIMIT and not values[1]",
                "values[0] < LIMIT and (values[1])",
                "values[0] < LIMIT and not values[2]",
                "values[0] < LIMIT and not values[0]",
            )
        ],
        *[
            ("first", "return sum(a * b for a, b in zip(values[1:], values, strict=True))", f"return sum({new}, values, strict=True))")
            for new in ("(a + b) for a, b in zip(values[1:]", "a * b for a, b in zip(values[1 + 1:]", "a * b for a, b in zip(values[2:]", "a * b for a, b in zip(values[0:]")
        ],
    ]  # fmt: skip
    for mutant in made:
        assert sum(a != b for a, b in zip(SOURCE.splitlines(), mutant.content.splitlines(), strict=True)) == 1


def test_a_mutant_keeps_its_key_when_its_line_moves() -> None:
    moved = mutants("a.py", "\n\n" + SOURCE)
    assert [mutant.key for mutant in moved] == [mutant.key for mutant in mutants("a.py", SOURCE)]
    assert len({mutant.key for mutant in moved}) == len(moved)


def test_the_choice_is_the_same_each_time_and_from_every_file() -> None:
    everything = list(mutate.every_mutant())
    chosen = mutate.choose(everything, 200, 0)
    assert chosen == mutate.choose(everything, 200, 0) != mutate.choose(everything, 200, 1)
    assert {mutant.file for mutant in chosen} == {mutant.file for mutant in everything}
    assert 195 <= len({mutant.key for mutant in chosen}) == len(chosen)


def test_each_known_survivor_is_a_mutant_of_today() -> None:
    assert mutate.known_reasons().keys() <= {mutant.key for mutant in mutate.every_mutant()}
