# SPDX-License-Identifier: MIT
"""``make prose``: count words that make code and documents hard to read. Informs only; never fails."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PRODUCT = ("apps", "client", "commands", "export", "model_repository", "rfm")
WORDS = {"what": r"what", "one": r"ones?", "that": r"that", "nobody, somebody": r"(no|some|who(ever)?)(body|ever)"}


def tracked(*patterns: str) -> list[Path]:
    """Return tracked files that match."""
    names = subprocess.run(["git", "ls-files", "--", *patterns], cwd=ROOT, check=True, capture_output=True, text=True)
    return [ROOT / name for name in names.stdout.splitlines()]


def prose(file: Path) -> Iterator[str]:
    """Yield the docstrings and comments of a Python file."""
    source = file.read_text()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and "SPDX" not in token.string:
            yield token.string


def frequencies(texts: Iterator[str]) -> str:
    """Return the number of words, and the frequency of each counted word in a thousand."""
    words = re.findall(r"[A-Za-z']+", "\n".join(texts).lower())
    shares = (
        f"{name} {1000 * sum(re.fullmatch(pattern, word) is not None for word in words) / max(1, len(words)):.1f}"
        for name, pattern in WORDS.items()
    )
    return f"{len(words)} words; in a thousand: {', '.join(shares)}"


def main() -> None:
    """Print the counts of code and documents."""
    code = [file for file in tracked("*.py") if file.relative_to(ROOT).parts[0] in PRODUCT]
    for package in PRODUCT:
        files = [file for file in code if file.relative_to(ROOT).parts[0] == package]
        print(f"{package}: {frequencies(text for file in files for text in prose(file))}")
    print(f"all code: {frequencies(text for file in code for text in prose(file))}")
    documents = [file for file in tracked("*.md") if file.name != "CHANGELOG.md"]
    print(f"documents, without CHANGELOG.md: {frequencies(file.read_text() for file in documents)}")
    classes = Counter(
        node.name for file in code for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.ClassDef)
    )
    print(
        "classes of one name:", ", ".join(f"{name} x{count}" for name, count in classes.items() if count > 1) or "none"
    )


if __name__ == "__main__":
    main()
