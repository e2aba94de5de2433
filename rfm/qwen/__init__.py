# SPDX-License-Identifier: MIT
"""The Qwen backbones that five families share: images, videos, prompts, prefix trees, the forward pass, rounding."""
