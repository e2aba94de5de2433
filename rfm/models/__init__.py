# SPDX-License-Identifier: MIT
"""The networks: one file per model family."""
