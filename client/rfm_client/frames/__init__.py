# SPDX-License-Identifier: MIT
"""Trajectories from files, fitted to the served checkpoint."""
