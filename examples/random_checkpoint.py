# SPDX-License-Identifier: MIT
"""Writes the small random checkpoint that ``model_repository/`` serves until there is a trained one.

python examples/random_checkpoint.py FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

from rfm.demo.checkpoint import write_random_checkpoint

if __name__ == "__main__":
    write_random_checkpoint(Path(sys.argv[1]))
