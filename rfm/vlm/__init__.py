# SPDX-License-Identifier: MIT
"""RFM and Robometer: raw frames and a task, as a conversation, into a vision-language model with reward heads."""
