# SPDX-License-Identifier: MIT
"""How far apart numbers may be that should be equal. goldens.py has the tolerances of reference scores."""

from __future__ import annotations

TOLERANCE = 1e-5  # float32 scores of one sample: in another batch, in another process, over another protocol
BATCHED_VLM_TOLERANCE = 1e-4  # scores of a vision-language model, whose frames share other batches
SHOWN = 5e-4  # three decimals on the page
