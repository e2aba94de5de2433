# SPDX-License-Identifier: MIT
"""Small faults of a source file: one operator, comparison, constant, index or branch changed at a time.

Left alone is what no test can or should see: annotations, decorators, assertions, messages (f-strings, what is
raised) and ``strict=`` of zip. Strings are left alone, too.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

_COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
_OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "+", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "//", ast.Pow: "*",
    ast.BitOr: "&", ast.BitAnd: "|",
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """A changed source file. ``before`` and ``after`` are its changed lines, so that line numbers may move."""

    file: str
    function: str
    before: str
    after: str
    line: int
    content: str
    nth: int = 1

    @property
    def key(self) -> tuple[str, str, str, str, int]:
        """What names it for good; nth of those that are alike."""
        return self.file, self.function, self.before, self.after, self.nth

    def __str__(self) -> str:
        return f"{self.file}:{self.line} in {self.function}: {self.before}  ->  {self.after}"


def mutants(file: str, source: str) -> list[Mutant]:
    """All of one file, in its order."""
    found, seen = [], Counter[tuple[str, str, str, str]]()
    starts = [0]
    for line in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for function, node, new in sorted(_changes(ast.parse(source)), key=lambda c: (c[1].lineno, c[1].col_offset)):
        assert node.end_lineno is not None and node.end_col_offset is not None
        start, stop = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        content = (source.encode()[:start] + new.encode() + source.encode()[stop:]).decode()
        last = node.lineno + new.count("\n")
        before = " ".join(line.strip() for line in source.splitlines()[node.lineno - 1 : node.end_lineno])
        after = " ".join(line.strip() for line in content.splitlines()[node.lineno - 1 : last])
        seen[file, function, before, after] += 1
        nth = seen[file, function, before, after]
        found.append(Mutant(file, function, before, after, node.lineno, content, nth))
    return found


def _changes(tree: ast.Module) -> Iterator[tuple[str, ast.expr, str]]:
    """Where, which expression, and what stands in its place."""
    todo: list[tuple[str, ast.AST]] = [("module", tree)]
    while todo:
        function, node = todo.pop()
        if isinstance(node, ast.expr):
            yield from ((function, node, new) for new in _instead(node))
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            function = node.name if function == "module" else f"{function}.{node.name}"
        todo += [(function, child) for child in _inner(node)]
        if isinstance(node, (ast.If, ast.IfExp, ast.While)):
            yield function, node.test, f"(not ({ast.unparse(node.test)}))"
        if isinstance(node, ast.Slice):
            yield from ((function, end, f"{ast.unparse(end)} + 1") for end in (node.lower, node.upper) if end)


def _inner(node: ast.AST) -> Iterator[ast.AST]:
    if isinstance(node, (ast.Assert, ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)):
        return
    if isinstance(node, ast.AnnAssign) and "TypeAlias" in ast.unparse(node.annotation):
        return
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases"):
            continue
        yield from (part for part in (value if isinstance(value, list) else [value]) if isinstance(part, ast.AST))


def _instead(node: ast.expr) -> Iterator[str]:
    if isinstance(node, ast.Compare):
        (first, *more), right = node.ops, ast.unparse(node.comparators[0])
        if not more and type(first) in _COMPARISONS:
            yield f"{ast.unparse(node.left)} {_COMPARISONS[type(first)]} {right}"
    elif isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        yield f"({ast.unparse(node.left)} {_OPERATORS[type(node.op)]} {ast.unparse(node.right)})"
    elif isinstance(node, ast.BoolOp):
        other = " and " if isinstance(node.op, ast.Or) else " or "
        yield "(" + other.join(f"({ast.unparse(value)})" for value in node.values) + ")"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub, ast.Invert)):
        if not isinstance(node.operand, ast.Constant):  # the last and the second of two are often the same
            yield f"({ast.unparse(node.operand)})"
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield str(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield repr(node.value + 1)
        if node.value != 0:
            yield repr(node.value - 1) if isinstance(node.value, int) else repr(node.value * 2)
