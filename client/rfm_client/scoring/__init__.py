# SPDX-License-Identifier: MIT
"""Steps of a call in both clients: samples to requests, answers to results."""
