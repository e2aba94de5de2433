# SPDX-License-Identifier: MIT
"""The code inside Triton's model process.

``batch_model`` is the base of every model.py: it decodes and prepares each ``request``, answers them as a batch, and
encodes the responses. A ``pipeline`` serves models whose frames take long to prepare. ``placement`` checks
the weights, and sets device and threads. ``watchdog`` ends a hung or broken process. ``metrics`` reports outcomes.
"""
