# SPDX-License-Identifier: MIT
"""What runs beside Triton, which ``rfm.launch`` has started. Every fault has one cure: Triton is started again.

``watch`` finds faults and knows what is served: by Triton's answers, by its processes, and by a ``probe`` of each
model. The ``supervisor`` starts Triton again, and the gateway. ``status`` is what others see of it.
"""
