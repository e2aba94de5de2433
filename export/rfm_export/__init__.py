# SPDX-License-Identifier: MIT
"""Export a checkpoint into a Triton model repository."""

from typing import TYPE_CHECKING, Any

from rfm_export.errors import ExportDiffersError, ExportError

__all__ = ["ExportDiffersError", "ExportError", "check", "export"]

if TYPE_CHECKING:
    from rfm_export.exporter import check, export
else:

    def __getattr__(name: str) -> Any:
        """Import exporter functions at first use: the exporter needs PyTorch, which takes seconds to import."""
        if name not in ("check", "export"):
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from rfm_export import exporter

        return getattr(exporter, name)
