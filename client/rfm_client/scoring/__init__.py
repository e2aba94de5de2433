# SPDX-License-Identifier: MIT
"""From samples to requests, and from answers to results: what both clients do in a call."""
