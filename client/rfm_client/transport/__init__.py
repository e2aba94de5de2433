# SPDX-License-Identifier: MIT
"""Send requests to one of several servers: calls, deadlines, retries, shared memory."""
