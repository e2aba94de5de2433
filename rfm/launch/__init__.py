# SPDX-License-Identifier: MIT
"""Start a Triton, secure it, and leave nothing behind.

- ``repository_folder``: the models that Triton reads; ``repository_check``: their files, before a load.
- ``triton_server``: a tritonserver process, from an ``installation``, with ``triton_options``; ``temporary``: the
  same for the time of a context.
- Access: ``endpoints``, optionally with TLS, and the ``admin_key`` of restricted APIs.
- ``model_processes`` finds dead and stopped model processes; ``ending`` ends processes; ``cleanup`` removes the shared
  memory of killed servers.
- Calls to a running Triton: ``http``, and over gRPC ``repository_api``, which loads and unloads models.

``rfm.supervise`` builds on this package: it watches Triton and restarts it.
"""
