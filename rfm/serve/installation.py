# SPDX-License-Identifier: MIT
"""Find tritonserver: an explicit path, PATH, or the nvidia-pytriton wheel.

Only the wheel's binary is used. The wheel lacks a backend directory with the running Python's stub, and the search path
for its libraries and libpython. This module adds both.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import shutil
import sys
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rfm_client.contract.errors import LocatedError

EXECUTABLE = "tritonserver"
WHEEL = "nvidia-pytriton"
WHEEL_VERSION = "2.51.0"  # the Triton version that it contains
_BACKEND_FILES = ("libtriton_python.so", "triton_python_backend_utils.py")
_STUB = "triton_python_backend_stub"
_GPU_DEVICES = "/dev/nvidiactl", "/dev/dxg"  # on Linux; on WSL 2
_OF_GPUS = {"--allow-gpu-metrics": "false", "--pinned-memory-pool-byte-size": "0"}


class ServerStartError(LocatedError):
    """tritonserver cannot start. The message is one line. model: the model at fault; None: no model"""

    def __init__(self, problem: str, where: object = "", model: str | None = None) -> None:
        super().__init__(problem, where)
        self.model = model


@dataclass(frozen=True)
class Installation:
    """A tritonserver that can run.

    environment: variables to set for it
    wheel: the wheel's ``tritonserver`` folder; None: an installed Triton, which finds its own backends
    """

    executable: Path
    environment: dict[str, str] = field(default_factory=dict)
    wheel: Path | None = None

    def lay_out_backends(self, folder: Path) -> list[str]:
        """Link the wheel's backend into the empty ``folder``. Return arguments that name it; none without a wheel."""
        if self.wheel is None:
            return []
        backend = folder / "python"
        backend.mkdir(parents=True)
        for name in _BACKEND_FILES:
            (backend / name).symlink_to(self.wheel / "backends" / "python" / name)
        (backend / _STUB).symlink_to(_stub(self.wheel))
        return [f"--backend-directory={folder}"]


def find_installation(executable: Path | None = None) -> Installation:
    """Find the installation: ``executable``, else the one on PATH, else the wheel. Raises ServerStartError."""
    if executable is not None:
        if not (executable.is_file() and os.access(executable, os.X_OK)):
            raise ServerStartError.at("tritonserver", f"a program at {executable}", "none")
        return Installation(executable)
    in_path = shutil.which(EXECUTABLE)
    return Installation(Path(in_path)) if in_path else _wheel_installation()


def has_gpu() -> bool:
    """True if there is a device of NVIDIA's driver, also under WSL 2."""
    return any(map(os.path.exists, _GPU_DEVICES))


def without_gpus(given: Sequence[str]) -> list[str]:
    """Return the tritonserver arguments that turn off what fails without a GPU, except those in ``given``."""
    names = {argument.partition("=")[0] for argument in given}
    return [f"{name}={value}" for name, value in _OF_GPUS.items() if name not in names]


def _wheel_installation() -> Installation:
    package = importlib.util.find_spec("pytriton")
    if package is None or not package.submodule_search_locations:
        where = f'an explicit path, {EXECUTABLE} in PATH or the wheel (pip install ".[triton]")'
        raise ServerStartError.at("tritonserver", where, "none of them")
    wheel = Path(package.submodule_search_locations[0]) / EXECUTABLE
    numpy_version = importlib.metadata.version("numpy")
    if int(numpy_version.partition(".")[0]) >= 2:
        # With numpy 2, this stub silently returns empty outputs.
        raise ServerStartError.at("numpy", f"< 2 with the Triton of {WHEEL}", f"{numpy_version}: pip install 'numpy<2'")
    _stub(wheel)
    library_folders = (wheel.parent.parent / "nvidia_pytriton.libs", _libpython().parent)
    # The stub takes its Python environment from the first python3 on PATH.
    environment = {
        "LD_LIBRARY_PATH": _prepended("LD_LIBRARY_PATH", *library_folders),
        "PATH": _prepended("PATH", Path(sys.executable).parent),
    }
    return Installation(wheel / "bin" / EXECUTABLE, environment, wheel)


def _stub(wheel: Path) -> Path:
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    stub = wheel / "python_backend_stubs" / version / _STUB
    if not stub.is_file():
        there = ", ".join(sorted(path.name for path in stub.parent.parent.glob("*")))
        raise ServerStartError.at("Python", f"one of {there} for the Triton of {WHEEL}", version)
    return stub


def _libpython() -> Path:
    """Return the shared library that the stub links to. Raises ServerStartError."""
    name = f"libpython{sys.version_info.major}.{sys.version_info.minor}.so.1.0"
    folders = [sysconfig.get_config_var("LIBDIR"), str(Path(sys.base_prefix, "lib"))]
    for folder in folders:
        if folder and (Path(folder) / name).is_file():
            return Path(folder) / name
    package = name.partition(".so")[0]
    hint = f"apt-get install {package}, or a Python built with --enable-shared"
    raise ServerStartError.at(name, f"in {folders[0]}", f"nothing there ({hint})")


def _prepended(variable: str, *folders: Path) -> str:
    return os.pathsep.join([*map(str, folders), *filter(None, [os.environ.get(variable)])])
