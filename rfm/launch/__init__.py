# SPDX-License-Identifier: MIT
"""What starts one Triton, secures it, and leaves nothing of it behind.

- ``repository_folder`` is what Triton reads.
- ``process`` is one tritonserver, from an ``installation``, with ``triton_options``; ``temporary`` has one for a while.
- Who reaches it: its ``endpoints``, with TLS if need be, and the ``admin_key`` of its restricted APIs.
- ``ending`` ends processes, with their parent if need be; ``cleanup`` removes what a killed server left.
- Calls to a running Triton: ``http``, and over gRPC the ``repository_api``, which loads and unloads models.

What watches and heals a Triton is ``rfm.supervise``, which builds on this.
"""
