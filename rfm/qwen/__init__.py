# SPDX-License-Identifier: MIT
"""The Qwen backbones that five families share: images and videos, prompts, trees of prefixes, the pass, few bits."""
