# SPDX-License-Identifier: MIT
"""Supervise the Triton that ``rfm.launch`` starts. A restart is the cure of every fault.

``watch`` finds faults from Triton's answers, its processes and a ``probe`` of each model, and tracks the served
versions. The ``supervisor`` restarts Triton and the gateway. ``status`` reports their state over HTTP.
"""
