# SPDX-License-Identifier: MIT
"""ReWiND: the transformer that scores embeddings, and the encoders that compute them from raw frames."""

from rfm.engine.family import Family
from rfm.families.rewind.checkpoint import restore
from rfm.families.rewind.encoders import Encoders

FAMILY = Family(name="rfm.families.rewind", restore=restore, reader="rfm.published.rewind", encoders=Encoders)
