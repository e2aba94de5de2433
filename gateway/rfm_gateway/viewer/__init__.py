# SPDX-License-Identifier: MIT
"""The page in the browser: videos and their reward curves, moving together.

``files`` serves the page itself, ``routes`` answers what it asks; both are put together in ``rfm_gateway.app``.
"""
