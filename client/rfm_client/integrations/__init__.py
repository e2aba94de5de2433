# SPDX-License-Identifier: MIT
"""Rewards inside other libraries."""
