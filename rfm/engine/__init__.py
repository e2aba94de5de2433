# SPDX-License-Identifier: MIT
"""The engine: samples in, results out. No Triton in it."""

from rfm.engine.scoring import Engine, Outcome, Prepared

__all__ = ["Engine", "Outcome", "Prepared"]
