# SPDX-License-Identifier: MIT
"""Parts of networks that more than one family has."""
