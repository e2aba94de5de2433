# SPDX-License-Identifier: MIT
"""The kinds of checkpoint that can be scored, one module each."""
