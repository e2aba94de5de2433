# SPDX-License-Identifier: MIT
"""Checkpoint -> servable Triton model repository."""

from rfm_export.errors import ExportDiffersError, ExportError
from rfm_export.export import check, export

__all__ = ["ExportDiffersError", "ExportError", "check", "export"]
