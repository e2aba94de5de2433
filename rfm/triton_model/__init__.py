# SPDX-License-Identifier: MIT
"""What runs inside Triton's model process.

``batch_model`` is the base of every model.py: each ``request`` is decoded and prepared, all are answered together, and
each answer is encoded. A model whose frames take long to prepare has a ``pipeline``. ``placement`` says on which device
and with how many threads. ``watchdog`` ends a process that hangs or is broken. ``metrics`` and the ``request_log`` say
what happened. ``weights`` are checked before they are loaded.
"""
