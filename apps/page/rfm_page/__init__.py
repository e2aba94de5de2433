# SPDX-License-Identifier: MIT
"""The browser page: reward curves of videos, datasets, running episodes. A gateway serves it."""
