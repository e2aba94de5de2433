# SPDX-License-Identifier: MIT
"""Commands of ``rfm``: they join packages that do not import each other."""
