# SPDX-License-Identifier: MIT
"""The page in the browser: reward curves of videos, datasets, running episodes. A gateway serves it."""
