# SPDX-License-Identifier: MIT
"""What runs beside Triton: starts it, watches it and its models, and restarts what fails."""
