# SPDX-License-Identifier: MIT
"""Training of the demo's checkpoint: data, networks, losses."""
