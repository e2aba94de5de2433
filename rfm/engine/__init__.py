# SPDX-License-Identifier: MIT
"""The engine: scores samples without Triton."""

from rfm.engine.execution import Execution
from rfm.engine.scoring import Engine, Outcome, Prepared

__all__ = ["Engine", "Execution", "Outcome", "Prepared"]
