# SPDX-License-Identifier: MIT
"""Errors that stop an export."""

from rfm_client.contract.errors import LocatedError


class ExportError(LocatedError):
    """An export that cannot be made, and why."""


class ExportDiffersError(ExportError):
    """The export's scores differ from the checkpoint's, or are missing; nothing was published."""
