# SPDX-License-Identifier: MIT
"""A model process exits when Triton has."""

from __future__ import annotations

import os
import threading
import time

_WATCH_INTERVAL_S = 1.0


def exit_with_triton() -> None:
    """Has this model process exit when Triton has, however that ended, and whatever the process waits for."""
    triton = os.getppid()

    def watch() -> None:
        while os.getppid() == triton:
            time.sleep(_WATCH_INTERVAL_S)
        os._exit(1)

    threading.Thread(target=watch, name="rfm-exit-with-triton", daemon=True).start()
