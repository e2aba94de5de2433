# SPDX-License-Identifier: MIT
"""Tolerances of equal numbers. goldens.py has those of reference scores."""

from __future__ import annotations

TOLERANCE = 1e-5  # float32 scores of one sample: in another batch, in another process, over another protocol
BATCHED_VLM_TOLERANCE = 1e-4  # scores of a vision-language model, whose frames share other batches
SHOWN = 5e-4  # three decimals on the page
