# SPDX-License-Identifier: MIT
"""Train the demo's checkpoint: data, networks, losses."""
