# SPDX-License-Identifier: MIT
"""What can stop an export."""


class ExportError(Exception):
    """An export that cannot be made, and why."""


class ExportDiffersError(ExportError):
    """The exported model does not give the numbers of its checkpoint, or there are none; nothing was published."""
