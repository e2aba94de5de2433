# SPDX-License-Identifier: MIT
"""model.py of a control (control.py): it takes a set time for each request and answers 0.5. It imports nothing of ours."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import triton_python_backend_utils as pb_utils

SERVICE_PARAMETER = "control_service_s"
SCORE = 0.5


class TritonPythonModel:
    """Burns the time of one core that the model under test takes, and writes outputs of the shapes that it writes."""

    def initialize(self, args: Mapping[str, str]) -> None:
        """Called once by Triton when the model is loaded."""
        config = json.loads(args["model_config"])
        self._frames = next(spec["name"] for spec in config["input"] if len(spec["dims"]) > 1)
        self._dims = {spec["name"]: spec["dims"] for spec in config["output"]}
        self._service_s = float(config["parameters"][SERVICE_PARAMETER]["string_value"])

    def execute(self, requests: Sequence[Any]) -> list[Any]:
        """Called by Triton with the requests of one batch."""
        return [self._response(request) for request in requests]

    def _response(self, request: Any) -> Any:
        until_s = time.thread_time() + self._service_s
        batch, num_frames = pb_utils.get_input_tensor_by_name(request, self._frames).as_numpy().shape[:2]
        tensors = []
        for name in request.requested_output_names():
            shape = [batch, *(num_frames if size == -1 else size for size in self._dims[name])]
            tensors.append(pb_utils.Tensor(name, np.full(shape, SCORE, np.float32)))
        while time.thread_time() < until_s:
            pass
        return pb_utils.InferenceResponse(tensors)
