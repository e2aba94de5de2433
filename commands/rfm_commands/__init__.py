# SPDX-License-Identifier: MIT
"""The ``rfm`` commands. They join packages that do not import each other."""
