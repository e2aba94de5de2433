# SPDX-License-Identifier: MIT
"""What every model.py has in common: the requests of one ``execute`` are answered together, and fail apart."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch

from rfm.execution import Execution
from rfm.journal import NO_DIGEST
from rfm.parameters import THREADS_PARAMETER
from rfm.probe import blank_question
from rfm.triton_model.asked import SAMPLE_TYPES, SCORED, Asked, CancelledError
from rfm.triton_model.ending import end_with_triton
from rfm.triton_model.metrics import Counted, Metrics
from rfm.triton_model.quarantine import Poison, digest
from rfm.triton_model.request_log import RequestLog
from rfm.triton_model.self_check import SelfCheck
from rfm.triton_model.weights import check_digest
from rfm_client.contract import InferenceFailedError, InvalidSampleError, RewardError, wire
from rfm_client.contract.model_info import DIGEST_PARAMETER, NETWORK_PARAMETER, REVISION_PARAMETER, SOURCE_PARAMETER
from rfm_client.contract.names import PROBE_PREFIX
from rfm_client.contract.samples import Footage
from rfm_client.contract.wire import Tensors

Question = TypeVar("Question")
Answer = TypeVar("Answer")


WORTH_ASKING_S = 10e-3  # for one answer


class BatchModel(Generic[Question, Answer]):
    """Triton <-> a function from questions to answers. A request holds one or more questions.

    A subclass says how a request's tensors are read (``decode``), how questions are answered (``answer``) and
    how the answers of one request are written (``encode``).
    """

    answer_s = math.inf  # what each of the last batch's answers took

    def initialize(self, args: Mapping[str, str]) -> None:
        """Called once by Triton when the model is loaded."""
        end_with_triton()
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
        self._poison = Poison.of_this_process(args["model_name"], max(config["max_batch_size"], 1))
        self._blank_tensors = blank_question(config)
        self._blank = digest(self._blank_tensors)
        self._self_check = SelfCheck(self._score_blank, self._log.tell_of_end)
        # Each instance answers them before anybody else is let in.
        self._num_warmups = sum(max(warmup.get("count", 1), 1) for warmup in config.get("model_warmup", []))

    def finalize(self) -> None:
        """Called once by Triton when the model is unloaded."""
        self._poison.close()
        self._metrics.close()

    def load(self, version: Path, device: torch.device, settings: Mapping[str, str]) -> None:
        """Loads the weights in the folder ``version`` onto ``device``."""
        raise NotImplementedError

    def decode(self, tensors: Tensors) -> list[Question]:
        """The questions of one request. Raises InvalidSampleError."""
        raise NotImplementedError

    def answer(self, questions: Sequence[Question], execution: Execution) -> Sequence[Answer | RewardError]:
        """One answer, or error, a question. ``execution`` is told what they took."""
        raise NotImplementedError

    def encode(self, answers: Sequence[Answer], tensors: Tensors, outputs: Collection[str]) -> Tensors:
        """The requested outputs of one request whose inputs were ``tensors``."""
        raise NotImplementedError

    def execute(self, requests: Sequence[Any]) -> list[Any]:
        """Called by Triton with the requests of one batch; gives one response each."""
        self._self_check.before_batch()
        batch: list[Asked[Question]] = [Asked(request, self._is_from_a_caller(request)) for request in requests]
        self._metrics.at_work_on(sum(asked.is_counted for asked in batch))
        try:
            responses = self._responses(batch)
            self._self_check.after_batch(batch)
            return responses
        finally:
            self._metrics.at_work_on(0)

    def _score_blank(self) -> None:
        """Raises the error of an instance that cannot score the blank sample."""
        questions = self.decode(self._blank_tensors)
        with self._poison.at_work_on([NO_DIGEST]):  # a hang is noticed, and blames nobody
            error = _first_error(self.answer(questions, Execution(on_forward=self._poison.renew)))
        if error is not None and not isinstance(error, InvalidSampleError):
            raise error

    def _is_from_a_caller(self, request: Any) -> bool:
        """Whether it is neither one of the requests with which Triton warms the model up nor says it is a probe."""
        request_id: str = request.request_id()
        if not request_id and self._num_warmups:
            self._num_warmups -= 1
            return False
        return not request_id.startswith(PROBE_PREFIX)

    def _responses(self, batch: Sequence[Asked[Question]]) -> list[Any]:
        execution = Execution(on_forward=self._poison.renew)
        try:
            for asked in batch:
                self._read(asked)
            answers = self._answers([asked for asked in batch if asked.error is None], execution)
            responses = [self._response(asked, answers) for asked in batch]
        except Exception as error:  # noqa: BLE001  the request boundary: whatever happened, every request is answered
            if len(batch) > 1:  # find out whose fault it is, and serve the others
                self._log.tell_of_batch(batch, error)
                return [response for asked in batch for response in self._responses([asked])]
            batch[0].error = InferenceFailedError("scoring failed; the server's log has the reason")
            batch[0].error.__cause__ = error
            execution = Execution()
            responses = [_failure(batch[0].error)]
        for asked in batch:
            if asked.error is not None:
                self._log.tell(asked)
        self._metrics.add(_counted([asked for asked in batch if asked.is_counted], execution))
        return responses

    def _read(self, asked: Asked[Question]) -> None:
        import triton_python_backend_utils as pb_utils

        asked.error, asked.num_executed = None, 0
        given = {name: pb_utils.get_input_tensor_by_name(asked.request, name) for name in self.input_names}
        asked.tensors = {name: tensor.as_numpy() for name, tensor in given.items() if tensor is not None}
        asked.num_samples = len(asked.tensors[wire.NUM_FRAMES])
        if asked.request_id and not asked.is_counted:  # anybody can say to be a probe; a probe asks the blank question
            asked.is_counted = digest(asked.tensors) != self._blank
        try:
            asked.questions = self.decode(asked.tensors)
        except InvalidSampleError as error:
            asked.error = error
        # Asked only where an answer costs much more than to ask Triton's process, which takes 0.1 ms a request.
        if self.answer_s >= WORTH_ASKING_S and asked.request.is_cancelled():
            asked.error = CancelledError("cancelled by the client")

    def _answers(
        self, batch: Sequence[Asked[Question]], execution: Execution
    ) -> dict[Asked[Question], Sequence[Answer | RewardError]]:
        """Those of each request. All are answered together, but for those that may be poison."""
        digests = {asked: digest(asked.tensors) if asked.is_counted else NO_DIGEST for asked in batch}
        together = []
        answers: dict[Asked[Question], Sequence[Answer | RewardError]] = {}
        for asked, told in digests.items():
            try:
                self._poison.check(told)
            except InvalidSampleError as error:
                asked.error = error
                continue
            if self._poison.is_suspect(told):
                with self._poison.at_work_on([told]):
                    answers |= self._answered([asked], execution)
            else:
                together.append(asked)
        with self._poison.at_work_on([digests[asked] for asked in together]):
            return answers | self._answered(together, execution)

    def _answered(
        self, batch: Sequence[Asked[Question]], execution: Execution
    ) -> dict[Asked[Question], Sequence[Answer | RewardError]]:
        for asked in batch:
            asked.num_executed = len(asked.questions)
        questions = [question for asked in batch for question in asked.questions]
        started_s = time.perf_counter()
        answers = iter(self.answer(questions, execution) if questions else ())
        if questions:
            self.answer_s = (time.perf_counter() - started_s) / len(questions)
        return {asked: [next(answers) for _ in asked.questions] for asked in batch}

    def _response(
        self, asked: Asked[Question], answers: Mapping[Asked[Question], Sequence[Answer | RewardError]]
    ) -> Any:
        import triton_python_backend_utils as pb_utils

        asked.error = asked.error or _first_error(answers[asked])
        if asked.error is not None:
            return _failure(asked.error)
        outputs = self.encode(answers[asked], asked.tensors, asked.request.requested_output_names())  # type: ignore[arg-type]
        return pb_utils.InferenceResponse([pb_utils.Tensor(name, array) for name, array in outputs.items()])


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


def _counted(batch: Sequence[Asked[Any]], execution: Execution) -> Counted:
    counted = Counted(execution=execution)
    for asked in batch:
        for sample_type, count in asked.sample_types.items():
            counted.samples[sample_type, asked.outcome] += count
        if asked.outcome == SCORED:
            counted.num_frames += asked.num_frames
        counted.num_executed += asked.num_executed
    return counted


def _sample_types(input_names: Sequence[str]) -> list[str]:
    """What a model with these inputs can be asked about."""
    of_samples = wire.SAMPLE_TYPE in input_names
    return [name for kind, name in SAMPLE_TYPES.items() if issubclass(kind, Footage) != of_samples]


def _checkpoint(settings: Mapping[str, str]) -> dict[str, str]:
    """Which checkpoint a model serves, as rfm_export tells it; of its network the class."""
    told = {name: settings.get(name, "") for name in (SOURCE_PARAMETER, REVISION_PARAMETER, DIGEST_PARAMETER)}
    return {**told, "network": json.loads(settings.get(NETWORK_PARAMETER) or "{}").get("class", "")}
