# SPDX-License-Identifier: MIT
"""What every model.py has in common: the requests of one ``execute`` are answered together, and fail apart."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch

from rfm.execution import Execution
from rfm.journal import NO_DIGEST
from rfm.parameters import THREADS_PARAMETER
from rfm.probe import blank_question
from rfm.triton_model.cancellation import Cancellation
from rfm.triton_model.exit import exit_with_triton
from rfm.triton_model.metrics import Counted, Metrics
from rfm.triton_model.quarantine import Quarantine
from rfm.triton_model.request import SAMPLE_TYPES, CancelledError, Origins, Request
from rfm.triton_model.request_digest import digest
from rfm.triton_model.request_log import RequestLog
from rfm.triton_model.self_check import SelfCheck
from rfm.triton_model.weights import check_digest
from rfm_client.contract import InferenceFailedError, InvalidSampleError, RewardError, wire
from rfm_client.contract.model_info import DIGEST_PARAMETER, NETWORK_PARAMETER, REVISION_PARAMETER, SOURCE_PARAMETER
from rfm_client.contract.samples import Footage
from rfm_client.contract.wire import Tensors

Question = TypeVar("Question")
Answer = TypeVar("Answer")


class BatchModel(Generic[Question, Answer]):
    """Triton <-> a function from questions to answers. A request holds one or more questions.

    A subclass says how a request's tensors are read (``decode``), how questions are answered (``answer``) and
    how the answers of one request are written (``encode``).
    """

    def initialize(self, args: Mapping[str, str]) -> None:
        """Called once by Triton when the model is loaded."""
        exit_with_triton()
        config = json.loads(args["model_config"])
        settings = {name: value["string_value"] for name, value in config["parameters"].items()}
        self.input_names = [spec["name"] for spec in config["input"]]
        on_gpu = args["model_instance_kind"] == "GPU"
        sharing = 1 if on_gpu else sum(group["count"] for group in config["instance_group"])
        torch.set_num_threads(int(settings[THREADS_PARAMETER]) or max(torch.get_num_threads() // sharing, 1))
        device = torch.device("cuda", int(args["model_instance_device_id"])) if on_gpu else torch.device("cpu")
        if on_gpu:
            torch.cuda.set_device(device)  # some kernels launch on the current device, whatever their tensors'
        version = Path(args["model_repository"], args["model_version"])
        check_digest(version, settings.get(DIGEST_PARAMETER, ""))
        self.load(version, device, settings)
        model = {"model": args["model_name"], "version": args["model_version"]}
        labels = {**model, "device": str(device), "instance": args["model_instance_name"]}
        self._log = RequestLog(model)
        self._metrics = Metrics(labels, _checkpoint(settings), _sample_types(self.input_names))
        self._quarantine = Quarantine.of_this_process(args["model_name"], max(config["max_batch_size"], 1))
        self._cancellation = Cancellation()
        self._self_check = SelfCheck(self._score_blank, self._log.report_end)
        self._blank_tensors = blank_question(config)
        warmups = config.get("model_warmup", [])
        num_warmups = sum(max(warmup.get("count", 0), 1) for warmup in warmups)
        self._origins = Origins(num_warmups, digest(self._blank_tensors))

    def finalize(self) -> None:
        """Called once by Triton when the model is unloaded."""
        self._quarantine.close()
        self._metrics.close()

    def load(self, version: Path, device: torch.device, settings: Mapping[str, str]) -> None:
        """Loads the weights in the folder ``version`` onto ``device``."""
        raise NotImplementedError

    def decode(self, tensors: Tensors) -> list[Question]:
        """The questions of one request. Raises InvalidSampleError."""
        raise NotImplementedError

    def answer(self, questions: Sequence[Question], execution: Execution) -> Sequence[Answer | RewardError]:
        """One answer, or error, a question. ``execution`` records what they took."""
        raise NotImplementedError

    def encode(self, answers: Sequence[Answer], tensors: Tensors, outputs: Collection[str]) -> Tensors:
        """The requested outputs of one request whose inputs were ``tensors``."""
        raise NotImplementedError

    def execute(self, requests: Sequence[Any]) -> list[Any]:
        """Called by Triton with the requests of one batch; gives one response each."""
        batch: list[Request[Question]] = [Request(request) for request in requests]
        self._origins.mark(batch)
        with self._metrics.at_work_on(batch), self._self_check.around(batch):
            return self._respond(batch)

    def _respond(self, batch: Sequence[Request[Question]]) -> list[Any]:
        """Serves the requests together or, if that fails, each alone: what breaks one costs no other its answer."""
        execution = Execution(on_forward=self._quarantine.renew)
        try:
            responses = self._serve(batch, execution)
        except Exception as error:  # noqa: BLE001  the request boundary: whatever happened, every request is answered
            if len(batch) > 1:
                self._log.report_batch(batch, error)
                return [response for request in batch for response in self._respond([request])]
            batch[0].error = InferenceFailedError("scoring failed; the server's log has the reason")
            batch[0].error.__cause__ = error
            execution = Execution()
            responses = [_failure(batch[0].error)]
        for request in batch:
            if request.error is not None:
                self._log.report(request)
        self._metrics.add(Counted.of(batch, execution))
        return responses

    def _serve(self, batch: Sequence[Request[Question]], execution: Execution) -> list[Any]:
        """Decodes, answers and encodes. A request that cannot be served has an error, and costs no other anything."""
        for request in batch:
            request.read(self.input_names)
            self._origins.verify(request)
            try:
                request.questions = self.decode(request.tensors)
                self._cancellation.check(request)
                self._quarantine.check(request.digest)
            except (InvalidSampleError, CancelledError) as error:
                request.error = error
        for group in self._quarantine.groups([request for request in batch if request.error is None]):
            questions = [question for request in group for question in request.questions]
            with self._quarantine.at_work_on([request.digest for request in group]):
                answers = iter(self._cancellation.timed(self.answer, questions, execution))
            for request in group:
                request.answers = [next(answers) for _ in request.questions]
        return [self._response(request) for request in batch]

    def _response(self, request: Request[Question]) -> Any:
        import triton_python_backend_utils as pb_utils

        request.error = request.error or _first_error(request.answers)
        if request.error is not None:
            return _failure(request.error)
        outputs = self.encode(request.answers, request.tensors, request.inference.requested_output_names())
        return pb_utils.InferenceResponse([pb_utils.Tensor(name, array) for name, array in outputs.items()])

    def _score_blank(self) -> None:
        """Raises the error of an instance that cannot score the blank sample."""
        questions = self.decode(self._blank_tensors)
        with self._quarantine.at_work_on([NO_DIGEST]):  # a hang is noticed, and no request is a suspect
            error = _first_error(self.answer(questions, Execution(on_forward=self._quarantine.renew)))
        if error is not None and not isinstance(error, InvalidSampleError):
            raise error


def _first_error(answers: Sequence[Any]) -> RewardError | None:
    """The first error of a request, located in it if it holds several questions."""
    for index, answer in enumerate(answers):
        if isinstance(answer, InvalidSampleError) and len(answers) > 1:
            return answer.inside(f"samples[{index}]")
        if isinstance(answer, RewardError):
            return answer
    return None


def _failure(error: Exception) -> Any:
    import triton_python_backend_utils as pb_utils

    code = pb_utils.TritonError.INTERNAL
    if isinstance(error, InvalidSampleError):
        code = pb_utils.TritonError.INVALID_ARG
    elif isinstance(error, CancelledError):
        code = pb_utils.TritonError.CANCELLED
    return pb_utils.InferenceResponse(error=pb_utils.TritonError(str(error), code))


def _sample_types(input_names: Sequence[str]) -> list[str]:
    """The types of samples that a model with these inputs scores."""
    of_samples = wire.SAMPLE_TYPE in input_names
    return [name for kind, name in SAMPLE_TYPES.items() if issubclass(kind, Footage) != of_samples]


def _checkpoint(settings: Mapping[str, str]) -> dict[str, str]:
    """Which checkpoint a model serves, as rfm_export wrote it down; of its network the class."""
    origin = {name: settings.get(name, "") for name in (SOURCE_PARAMETER, REVISION_PARAMETER, DIGEST_PARAMETER)}
    return {**origin, "network": json.loads(settings.get(NETWORK_PARAMETER) or "{}").get("class", "")}
