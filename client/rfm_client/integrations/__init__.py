# SPDX-License-Identifier: MIT
"""Rewards for other libraries, each in a module of its own."""
