# SPDX-License-Identifier: MIT
"""The engine: scores samples without Triton."""

from rfm.engine.scoring import Engine, Outcome, Prepared

__all__ = ["Engine", "Outcome", "Prepared"]
