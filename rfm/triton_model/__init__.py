# SPDX-License-Identifier: MIT
"""What runs inside Triton's model process.

``batch_model`` is the base of every model.py: a batch of ``request`` is decoded, answered and encoded. Around that
stand the ``quarantine`` of requests that kill (known by their ``request_digest``), ``cancellation``, ``metrics``, the
``request_log`` and the ``self_check`` of an instance. ``weights`` are checked before they are loaded; ``exit`` ends the
process with Triton.
"""
