# SPDX-License-Identifier: MIT
"""A MkDocs hook that replaces links to files outside ``docs/`` by their names, since the site lacks those files."""

from __future__ import annotations

import re
from pathlib import PurePosixPath
from typing import Any

LINK = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+[^)#\s]+)(?:#[^)\s]*)?\)")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return the page's Markdown without links that lead out of ``docs/``."""
    depth = len(PurePosixPath(page.file.src_uri).parts) - 1

    def kept(link: re.Match[str]) -> str:
        return f"{link[1]} (`{link[2].removeprefix('../' * (depth + 1))}`)" if link[2].count("../") > depth else link[0]

    return LINK.sub(kept, markdown)
