# SPDX-License-Identifier: MIT
"""Start one Triton, look after it, and leave nothing behind. Every fault is cured by a restart.

- ``triton_server`` runs the tritonserver of an ``installation`` on the models in a ``repository``.
- ``access``: listening addresses, TLS, and the key for restricted APIs.
- ``processes``: end processes, find dead and stopped ones, remove the shared memory of killed servers.
- ``watch`` finds faults in Triton's answers, in its processes, and with a ``probe`` per model; the ``supervisor``
  restarts Triton and the gateway; ``status`` reports their state over HTTP.
- ``repository_api`` loads and unloads models over gRPC.
"""
