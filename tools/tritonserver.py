# SPDX-License-Identifier: MIT
"""Write a ``tritonserver`` that uses this Python's packages, for tests that run under another Python.

The Triton wheel needs numpy 1. Tests with numpy 2 find this program in PATH.

python tools/tritonserver.py FOLDER
"""

import shlex
import sys
from pathlib import Path

from rfm.serve.installation import find_installation

folder = Path(sys.argv[1]).resolve()
folder.mkdir()
installation = find_installation()
variables = [f"{name}={value}" for name, value in installation.environment.items()]
words = ["exec", "env", *variables, str(installation.executable), *installation.lay_out_backends(folder / "backends")]
program = folder / "tritonserver"
program.write_text(f'#!/bin/sh\n{shlex.join(words)} "$@"\n')
program.chmod(0o755)
