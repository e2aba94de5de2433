# SPDX-License-Identifier: MIT
"""Trajectories from files, and made as a served model reads them."""
