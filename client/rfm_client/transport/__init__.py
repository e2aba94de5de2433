# SPDX-License-Identifier: MIT
"""Requests to one of several servers: calls, deadlines, retries, shared memory."""
