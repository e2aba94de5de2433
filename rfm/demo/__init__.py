# SPDX-License-Identifier: MIT
"""What ``rfm demo`` shows: a small checkpoint, a clip, and the scores that a served model gives them."""
