# SPDX-License-Identifier: MIT
"""A model process ends when Triton has ended."""

from __future__ import annotations

import os
import threading
import time

_WATCH_INTERVAL_S = 1.0


def end_with_triton() -> None:
    """For a model process: it ends when Triton has, however that ended, and whatever it waits for."""
    triton = os.getppid()

    def watch() -> None:
        while os.getppid() == triton:
            time.sleep(_WATCH_INTERVAL_S)
        os._exit(1)

    threading.Thread(target=watch, name="rfm-end-with-triton", daemon=True).start()
