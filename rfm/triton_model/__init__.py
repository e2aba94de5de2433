# SPDX-License-Identifier: MIT
"""What runs inside Triton's model process."""
