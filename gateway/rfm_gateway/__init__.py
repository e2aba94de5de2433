# SPDX-License-Identifier: MIT
"""The HTTP surface of the FastAPI evaluation server, before a Triton server. A distribution of its own.

A request becomes samples (``body``, ``schema``), is scored through ``AsyncRewardClient`` (``scoring``), and the answer
is written in the evaluation server's shape. It holds no model and no queue. ``app`` joins the endpoints.
"""
