# SPDX-License-Identifier: MIT
"""``make internal-imports``: print the share of test lines in files that import internal names of our packages.

Such tests break when an internal name changes, though users see nothing of it.
Public are the names in ``__all__`` of the modules that tests/project/test_structure.py lists.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
STRUCTURE = ast.parse((ROOT / "tests" / "project" / "test_structure.py").read_text())
PLACES = {"rfm": "rfm", "rfm_client": "client/rfm_client", "rfm_commands": "commands/rfm_commands"}
PLACES |= {"rfm_export": "export/rfm_export", "rfm_rl": "apps/rl/rfm_rl", "rfm_page": "apps/page/rfm_page"}
PLACES |= {"rfm_gateway": "apps/gateway/rfm_gateway", "rfm_labels": "apps/labels/rfm_labels"}


def constant(tree: ast.Module, name: str) -> list[str] | dict[str, set[str]]:
    """Return the literal assigned to a name; an empty list if there is none."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == [name]:
            return ast.literal_eval(node.value)
    return []


PUBLIC = {  # modules
    f"{package}.{inner}".rstrip(".") for package, modules in constant(STRUCTURE, "PUBLIC").items() for inner in modules
}


@lru_cache
def public_names(module: str) -> frozenset[str]:
    """Return the public names of a module."""
    package, _, inner = module.partition(".")
    place = ROOT / PLACES[package] / inner.replace(".", "/")
    file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
    return frozenset(constant(ast.parse(file.read_text()), "__all__") if module in PUBLIC else ())


def internals(file: Path) -> Iterator[str]:
    """Yield the internal names that a file imports."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in PLACES:
            names = {alias.name for alias in node.names} - public_names(node.module)
            yield from {f"{node.module}.{name}" for name in names} - PUBLIC
        elif isinstance(node, ast.Import):
            yield from {alias.name for alias in node.names if alias.name.partition(".")[0] in PLACES} - PUBLIC


def main() -> int:
    """Print the share of each folder and of all tests. Returns 1 if it exceeds ``--most``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=float, default=100.0, help="percent; exit with status 1 above it")
    parser.add_argument("--files", action="store_true", help="also print each such file with its internal names")
    arguments = parser.parse_args()
    lines, internal = Counter[str](), Counter[str]()
    for file in sorted((ROOT / "tests").rglob("*.py")):
        folder = file.relative_to(ROOT / "tests").parts[0]
        lines[folder] += (count := len(file.read_text().splitlines()))
        if names := sorted(set(internals(file))):
            internal[folder] += count
            if arguments.files:
                print(f"{count:5} {file.relative_to(ROOT)}: {', '.join(names)}")
    for folder, count in lines.items():
        print(f"{folder:12} {100 * internal[folder] / count:5.1f} % of {count} lines")
    share = 100 * internal.total() / lines.total()
    print(f"{'all':12} {share:5.1f} % of {lines.total()} lines")
    return int(share > arguments.most)


if __name__ == "__main__":
    sys.exit(main())
