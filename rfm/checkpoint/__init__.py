# SPDX-License-Identifier: MIT
"""Files of a checkpoint, of whatever family: found, read, checked, digested."""
