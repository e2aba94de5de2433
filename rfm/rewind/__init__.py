# SPDX-License-Identifier: MIT
"""ReWiND: embeddings, or raw frames through encoders, into the ReWiND transformer."""

from rfm.family import Family
from rfm.rewind.checkpoint import load, reads
from rfm.rewind.encoders import Encoders

FAMILY = Family(name="rfm.rewind", reads=reads, load=load, encoders=Encoders)
