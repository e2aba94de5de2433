# SPDX-License-Identifier: MIT
"""What both clients do in a call: turn samples into requests and answers into results."""
