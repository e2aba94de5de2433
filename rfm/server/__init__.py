# SPDX-License-Identifier: MIT
"""Where Triton begins: the adapter that a repository's model.py derives from, and the tritonserver process."""
