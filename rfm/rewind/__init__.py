# SPDX-License-Identifier: MIT
"""ReWiND: the transformer that scores embeddings, and the encoders that make them from raw frames."""

from rfm.family import Family
from rfm.rewind.checkpoint import load, reads
from rfm.rewind.encoders import Encoders

FAMILY = Family(name="rfm.rewind", reads=reads, load=load, encoders=Encoders)
