# SPDX-License-Identifier: MIT
"""The commands of ``rfm``: where the packages meet that do not know of each other."""
