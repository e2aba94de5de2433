# SPDX-License-Identifier: MIT
"""Rewards and recordings for other libraries."""
