# SPDX-License-Identifier: MIT
"""Start one Triton, look after it, and leave nothing behind. A restart is the cure of every fault.

- ``triton_server``: a tritonserver process, from an ``installation``; ``repository``: the models that it reads.
- ``access``: where it listens, perhaps with TLS, and the key of restricted APIs.
- ``processes``: end processes, find dead and stopped ones, remove the shared memory of killed servers.
- ``watch`` finds faults from Triton's answers, its processes and a ``probe`` of each model; the ``supervisor`` restarts
  Triton and the gateway; ``status`` reports their state over HTTP.
- ``repository_api`` loads and unloads models over gRPC.
"""
