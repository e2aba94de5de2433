# SPDX-License-Identifier: MIT
"""Start one Triton, look after it, and leave nothing behind. Every fault is cured by a restart."""
