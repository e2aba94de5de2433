# SPDX-License-Identifier: MIT
"""Tensors to a server of several and answers back: calls, deadlines, retries, shared memory."""
