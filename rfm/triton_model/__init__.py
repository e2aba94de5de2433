# SPDX-License-Identifier: MIT
"""What runs inside Triton's model process.

``batch_model`` is the base of every model.py: each ``request`` is decoded, answered and encoded. A ``pipeline`` has
requests wait for their turn, and scores those that are ready together. ``placement`` says on which device and with how
many threads. ``triton_queue`` knows for how long requests may have waited in Triton unseen. ``other_instances`` are
those of the same version of the model, which share its requests.

Around that stand the ``quarantine`` of requests that kill (known by their ``request_digest``), ``metrics``, the
``request_log`` and the ``self_check`` of an instance. ``weights`` are checked before they are loaded; ``exit`` ends the
process with Triton.
"""
