# SPDX-License-Identifier: MIT
"""MkDocs hook: use README.md as the home page, and turn links to files outside ``docs/`` into plain file names."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

README = Path(__file__).parents[1] / "README.md"
RELATIVE = re.compile(r"\]\((?!\w+:|#)")
LINK = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+[^)#\s]+)(?:#[^)\s]*)?\)")


def on_files(files: Any, config: Any) -> Any:
    """Add README.md as the home page."""
    from mkdocs.structure.files import File

    home = RELATIVE.sub("](../", README.read_text()).replace("](../docs/", "](")
    files.append(File.generated(config, "index.md", content=home))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return the page's Markdown without links that lead out of ``docs/``."""
    depth = len(PurePosixPath(page.file.src_uri).parts) - 1

    def kept(link: re.Match[str]) -> str:
        return f"{link[1]} (`{link[2].removeprefix('../' * (depth + 1))}`)" if link[2].count("../") > depth else link[0]

    return LINK.sub(kept, markdown)
