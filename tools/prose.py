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
BESIDE = ("tests", "tools", "examples", "benchmarks")
WORDS = {
    "what": r"what",
    "one": r"ones?",
    "that": r"that",
    "of": r"of",
    "its, their": r"its|their",
    "each": r"each",
    "nobody, somebody": r"(no|some|who(ever)?)(body|ever)",
}


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


def help_texts(file: Path) -> Iterator[str]:
    """Yield the help texts of options in a Python file: ``setting(default, help)`` and ``help=...``."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Call):
            told = [word.value for word in node.keywords if word.arg == "help"]
            told += node.args[1:2] if ast.unparse(node.func) == "setting" else []
            yield from (text.value for text in told if isinstance(text, ast.Constant) and isinstance(text.value, str))


def frequencies(texts: Iterator[str]) -> str:
    """Return the number of words, and the frequency of each counted word in a thousand."""
    words = re.findall(r"[A-Za-z']+", "\n".join(texts).lower())
    shares = (
        f"{name} {1000 * sum(re.fullmatch(pattern, word) is not None for word in words) / max(1, len(words)):.1f}"
        for name, pattern in WORDS.items()
    )
    return f"{len(words)} words; in a thousand: {', '.join(shares)}"


def main() -> None:
    """Print the counts of code, help texts and documents."""
    by_folder: dict[str, list[Path]] = {}
    for file in tracked("*.py"):
        by_folder.setdefault(file.relative_to(ROOT).parts[0], []).append(file)
    for folder in (*PRODUCT, *BESIDE):
        print(f"{folder}: {frequencies(text for file in by_folder[folder] for text in prose(file))}")
    code = [file for folder in PRODUCT for file in by_folder[folder]]
    print(f"the product's code: {frequencies(text for file in code for text in prose(file))}")
    print(f"help texts: {frequencies(text for file in code for text in help_texts(file))}")
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
