# SPDX-License-Identifier: MIT
"""Run ``rfm-client`` as ``python -m rfm_client``."""

from rfm_client.cli import main

if __name__ == "__main__":
    main()
