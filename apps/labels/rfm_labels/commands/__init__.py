# SPDX-License-Identifier: MIT
"""The commands ``rfm-client label`` and ``rfm-client evaluate``."""
