# SPDX-License-Identifier: MIT
"""model.py of a control (control.py): it answers 0.5. It imports nothing of ours."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import triton_python_backend_utils as pb_utils

SCORE = 0.5


class TritonPythonModel:
    """Writes outputs of the shapes that the model under test writes."""

    def initialize(self, args: Mapping[str, str]) -> None:
        """Called once by Triton when the model is loaded."""
        config = json.loads(args["model_config"])
        self._frames = next(spec["name"] for spec in config["input"] if len(spec["dims"]) > 1)
        self._dims = {spec["name"]: spec["dims"] for spec in config["output"]}

    def execute(self, requests: Sequence[Any]) -> list[Any]:
        """Called by Triton with the requests of one batch."""
        return [self._response(request) for request in requests]

    def _response(self, request: Any) -> Any:
        batch, num_frames = pb_utils.get_input_tensor_by_name(request, self._frames).as_numpy().shape[:2]
        tensors = []
        for name in request.requested_output_names():
            shape = [batch, *(num_frames if size == -1 else size for size in self._dims[name])]
            tensors.append(pb_utils.Tensor(name, np.full(shape, SCORE, np.float32)))
        return pb_utils.InferenceResponse(tensors)
