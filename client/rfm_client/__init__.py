# SPDX-License-Identifier: MIT
"""Rewards for robot trajectories from a served reward model.

from rfm_client import RewardClient, Trajectory

with RewardClient("grpc://localhost:8001") as client:
    result = client.progress(Trajectory(frames=frames, task="put the red block in the bowl"))
    result.progress, result.success  # float32 [T] each
"""

import importlib
import typing

from rfm_client import contract as _contract
from rfm_client.contract import *  # noqa: F403
from rfm_client.contract.samples import Float32Array, UInt8Array, as_array

if typing.TYPE_CHECKING:
    from rfm_client.async_client import AsyncRewardClient
    from rfm_client.client import RewardClient
    from rfm_client.frames.inputs import as_trajectory, load_trajectory

__all__ = [
    "AsyncRewardClient",
    "Float32Array",
    "RewardClient",
    "UInt8Array",
    "as_array",
    "as_trajectory",
    "load_trajectory",
]
__all__ += _contract.__all__

_LATER = {  # imported at first use, because servers need only the contract
    "AsyncRewardClient": "async_client",
    "RewardClient": "client",
    "as_trajectory": "frames.inputs",
    "load_trajectory": "frames.inputs",
}


if not typing.TYPE_CHECKING:  # otherwise a type checker would accept any name

    def __getattr__(name: str) -> object:
        if name in ("episodes", "frames", "options"):
            return importlib.import_module(f"rfm_client.{name}")
        if name not in _LATER:
            raise AttributeError(f"module 'rfm_client' has no attribute {name!r}")
        return getattr(importlib.import_module(f"rfm_client.{_LATER[name]}"), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_LATER})
