# SPDX-License-Identifier: MIT
"""ReWiND: embeddings, or raw frames through encoders, into the ReWiND transformer."""
