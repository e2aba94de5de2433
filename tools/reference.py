# SPDX-License-Identifier: MIT
"""``make reference``: update the lists in docs/reference that are generated from code.

``--check`` writes nothing and fails if a list is outdated. Lists stand between
``<!-- NAME: made by make reference -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rfm.families.robometer.network import VlmConfig
from rfm.published.robometer_run import SETTINGS, RunConfig
from rfm_commands.config import FASTAPI_KEYS

DOCUMENTS = sorted((Path(__file__).parents[1] / "docs" / "reference").glob("*.md"))
BLOCK = re.compile(r"(<!-- ([\w ]+): made by make reference -->\n).*?(<!-- end -->)", re.DOTALL)
MEANING = re.compile(r"^ *(\w+): (.*)", re.MULTILINE)  # a docstring line


def current(file: Path) -> str:
    """Return a document's text with up-to-date lists. Raises KeyError for an unknown list."""
    return BLOCK.sub(lambda found: f"{found[1]}\n{LISTS[found[2]]()}\n{found[3]}", file.read_text())


def _text(value: Any) -> str:
    """Format a value as in the file; empty for none."""
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


def _run_settings() -> str:
    """Settings that a vision-language checkpoint takes from its run's config.yaml."""
    meanings = {
        name: meaning for kind in reversed(VlmConfig.__mro__) for name, meaning in MEANING.findall(kind.__doc__ or "")
    }
    nothing: dict[str, dict[str, Any]] = {key.partition(".")[0]: {} for keys in SETTINGS.values() for key in keys}
    defaults = {"size_px": "refused", **RunConfig(Path(), "", nothing).network()}
    return "".join(
        f"- `{name}` ({', '.join(f'`{key}`' for key in keys)}): {meanings[name]}. "
        f"Default: {_text(defaults.get(name)) or 'unknown'}.\n"
        for name, keys in SETTINGS.items()
    )


LISTS: dict[str, Callable[[], str]] = {
    "fastapi": lambda: "".join(f"- `{key}`: `{here}`\n" for key, here in FASTAPI_KEYS.items()),
    "run settings": _run_settings,
}


def main(check: bool) -> None:
    """Write the lists, or exit with the names of outdated documents."""
    changed = {file: text for file in DOCUMENTS if (text := current(file)) != file.read_text()}
    if check and changed:
        sys.exit(
            f"{', '.join(file.name for file in changed)}: expected the lists of the code, got others: make reference"
        )
    for file, text in changed.items():
        file.write_text(text)


if __name__ == "__main__":
    main("--check" in sys.argv)
