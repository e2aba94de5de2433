# SPDX-License-Identifier: MIT
"""What every model.py has in common: the requests of one ``execute`` are answered together, and fail apart."""

from __future__ import annotations

import json
import math
import time
import traceback
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch

from rfm_client import InvalidSampleError, RewardError
from rfm_client.wire import Tensors

Question = TypeVar("Question")
Answer = TypeVar("Answer")

THREADS_PARAMETER = "torch_threads"  # parameters of config.pbtxt; rfm_export writes them
BUDGET_PARAMETER = "token_budget"
DTYPE_PARAMETER = "dtype"  # empty: as the checkpoint and the device decide

WORTH_ASKING_S = 10e-3  # for one answer

_CANCELLED = RewardError("cancelled by the client")  # nobody waits for the answer, so no forward is spent on it


class BatchModel(Generic[Question, Answer]):
    """Triton <-> a function from questions to answers. A request holds one or more questions.

    A subclass says how a request's tensors are read (``decode``), how questions are answered (``answer``) and
    how the answers of one request are written (``encode``).
    """

    answer_s = math.inf  # what each of the last batch's answers took

    def initialize(self, args: Mapping[str, str]) -> None:
        """Called once by Triton when the model is loaded."""
        config = json.loads(args["model_config"])
        settings = {name: value["string_value"] for name, value in config["parameters"].items()}
        self.input_names = [spec["name"] for spec in config["input"]]
        threads = int(settings[THREADS_PARAMETER])
        if threads:
            torch.set_num_threads(threads)
        on_gpu = args["model_instance_kind"] == "GPU"
        device = torch.device("cuda", int(args["model_instance_device_id"])) if on_gpu else torch.device("cpu")
        if on_gpu:
            torch.cuda.set_device(device)  # some kernels launch on the current device, whatever their tensors'
        self.load(Path(args["model_repository"], args["model_version"]), device, settings)

    def load(self, version: Path, device: torch.device, settings: Mapping[str, str]) -> None:
        """Loads the weights in the folder ``version`` onto ``device``."""
        raise NotImplementedError

    def decode(self, tensors: Tensors) -> list[Question]:
        """The questions of one request. Raises InvalidSampleError."""
        raise NotImplementedError

    def answer(self, questions: Sequence[Question]) -> Sequence[Answer | RewardError]:
        """One answer, or error, a question."""
        raise NotImplementedError

    def encode(self, answers: Sequence[Answer], tensors: Tensors, outputs: Collection[str]) -> Tensors:
        """The requested outputs of one request whose inputs were ``tensors``."""
        raise NotImplementedError

    def execute(self, requests: Sequence[Any]) -> list[Any]:
        """Called by Triton with the requests of one batch; gives one response each."""
        import triton_python_backend_utils as pb_utils

        try:
            inputs = [{} if self._is_cancelled(request) else self._inputs(request) for request in requests]
            asked = [self._decoded(tensors) if tensors else _CANCELLED for tensors in inputs]
            questions = [question for part in asked if isinstance(part, list) for question in part]
            started_s = time.perf_counter()
            answers = iter(self.answer(questions))
            if questions:
                self.answer_s = (time.perf_counter() - started_s) / len(questions)
            answered = [part if isinstance(part, RewardError) else [next(answers) for _ in part] for part in asked]
            return [self._response(*parts) for parts in zip(requests, inputs, answered, strict=True)]
        except Exception:  # noqa: BLE001  the request boundary: whatever happened, every request is answered
            pb_utils.Logger.log_error(traceback.format_exc())
        if len(requests) > 1:  # find out whose fault it is, and serve the others
            return [response for request in requests for response in self.execute([request])]
        return [_failure("scoring failed; the server's log has the reason", pb_utils.TritonError.INTERNAL)]

    def _is_cancelled(self, request: Any) -> bool:
        """Asked only where an answer costs much more than to ask Triton's process, which takes 0.1 ms a request."""
        return self.answer_s >= WORTH_ASKING_S and bool(request.is_cancelled())

    def _inputs(self, request: Any) -> Tensors:
        import triton_python_backend_utils as pb_utils

        return {name: pb_utils.get_input_tensor_by_name(request, name).as_numpy() for name in self.input_names}

    def _decoded(self, tensors: Tensors) -> list[Question] | RewardError:
        try:
            return self.decode(tensors)
        except InvalidSampleError as error:
            return error

    def _response(self, request: Any, tensors: Tensors, answers: RewardError | Sequence[Answer | RewardError]) -> Any:
        import triton_python_backend_utils as pb_utils

        error = answers if isinstance(answers, RewardError) else _first_error(answers)
        if error is _CANCELLED:
            return _failure(str(error), pb_utils.TritonError.CANCELLED)
        if error is not None:
            invalid = isinstance(error, InvalidSampleError)
            code = pb_utils.TritonError.INVALID_ARG if invalid else pb_utils.TritonError.INTERNAL
            return _failure(str(error), code)
        outputs = self.encode(answers, tensors, request.requested_output_names())  # type: ignore[arg-type]
        return pb_utils.InferenceResponse([pb_utils.Tensor(name, array) for name, array in outputs.items()])


def _first_error(answers: Sequence[Any]) -> RewardError | None:
    """The first error of a request, located in it if it holds several questions."""
    for index, answer in enumerate(answers):
        if isinstance(answer, InvalidSampleError) and len(answers) > 1:
            return answer.inside(f"samples[{index}]")
        if isinstance(answer, RewardError):
            return answer
    return None


def _failure(message: str, code: Any) -> Any:
    import triton_python_backend_utils as pb_utils

    return pb_utils.InferenceResponse(error=pb_utils.TritonError(message, code))
