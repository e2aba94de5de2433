# SPDX-License-Identifier: MIT
"""What every model.py has in common: requests are read as they come, scored together, and answered one by one."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

import torch

from rfm.execution import Execution
from rfm.journal import NO_DIGEST
from rfm.parameters import BUDGET_PARAMETER, QUEUE_SIZE_PARAMETER, QUEUE_TIMEOUT_PARAMETER
from rfm.probe import blank_question
from rfm.triton_model.exit import exit_with_triton
from rfm.triton_model.metrics import Counted, Metrics
from rfm.triton_model.other_instances import OtherInstances
from rfm.triton_model.pipeline import Bounds, Pipeline, Stages
from rfm.triton_model.placement import Placement, num_instances, use_threads
from rfm.triton_model.quarantine import Quarantine
from rfm.triton_model.request import SAMPLE_TYPES, Origins, RejectedError, Request
from rfm.triton_model.request_digest import digest
from rfm.triton_model.request_log import RequestLog
from rfm.triton_model.self_check import SelfCheck
from rfm.triton_model.triton_queue import TritonQueue
from rfm.triton_model.weights import check_digest
from rfm_client.contract import InvalidSampleError, RewardError, wire
from rfm_client.contract.model_info import DIGEST_PARAMETER, NETWORK_PARAMETER, REVISION_PARAMETER, SOURCE_PARAMETER
from rfm_client.contract.named_frames import NamedFootage
from rfm_client.contract.samples import Footage
from rfm_client.contract.triton import QUEUE_FULL
from rfm_client.contract.wire import Tensors

MS_PER_S = 1e3
MAX_INT32 = 2**31 - 1
AT_ONCE_S = 50e-3  # what takes longer is done by another thread, so that meanwhile others can be rejected
UNSEEN_S = 0.25  # for so long others may wait in Triton unseen: each look at them costs the time to send answers apart
CHEAP_ANSWER_S = {"cpu": 5e-3, "cuda": 0.2e-3}  # one that takes less is not worth the time that sending it takes

Question = TypeVar("Question")
Answer = TypeVar("Answer")
Scored: TypeAlias = list[tuple[Sequence[Request[Question]], Execution]]  # requests, and what was spent on them


class BatchModel(Generic[Question, Answer]):
    """Triton <-> a function from questions to answers. A request holds one or more questions.

    A subclass says how a request's tensors are read (``decode``), what is done with a question when it comes
    (``prepare``), how questions are answered (``answer``) and how the answers of one request are written (``encode``).
    One that ``works_ahead`` says, too, what can be done before a question's turn comes (``work_ahead``).
    """

    def initialize(self, args: Mapping[str, str]) -> None:
        """Called once by Triton when the model is loaded."""
        exit_with_triton()
        config = json.loads(args["model_config"])
        settings = {name: value["string_value"] for name, value in config["parameters"].items()}
        placement = Placement.of(args, config, settings)
        version = Path(args["model_repository"], args["model_version"])
        check_digest(version, settings.get(DIGEST_PARAMETER, ""))
        placement.run(lambda: self.load(version, placement.device, settings))
        model = {"model": args["model_name"], "version": args["model_version"]}
        labels = {**model, "device": str(placement.device), "instance": args["model_instance_name"]}
        names = [spec["name"] for spec in config["input"]]
        self._log = RequestLog(model)
        self._metrics = Metrics(labels, _checkpoint(settings), _sample_types(names))
        num_preparing = placement.num_preparing if self.works_ahead else 0
        self._quarantine = Quarantine.of_this_process(args["model_name"], config["max_batch_size"], num_preparing)
        other_instances = OtherInstances.of_this_process(args["model_name"]) if num_instances(config) > 1 else None
        self.start(config, settings, other_instances, placement.apply, placement.device.type, num_preparing)

    def start(
        self,
        config: Mapping[str, Any],
        settings: Mapping[str, str],
        other_instances: OtherInstances | None = None,
        begin: Callable[[], None] = lambda: None,
        device: str = "cpu",
        num_preparing: int = 0,
    ) -> None:
        """Begins to take requests. Weights, log, metrics and quarantine are there.

        begin: called in the thread that scores; the thread of ``execute`` computes nothing with several threads
        device: type of the one that computes; answers that are cheap there are given together
        num_preparing: threads that work ahead
        """
        self._cheap_answer_s, self._is_on_cpu = CHEAP_ANSWER_S[device], device == "cpu"
        self._sample_s = math.inf  # what each sample of the last group took; inf: there was none
        bounds = _bounds(config, settings)
        self._max_batch, self._max_waiting = bounds.batch_samples, bounds.waiting_jobs
        self._max_ahead = min(self._max_batch, bounds.waiting_jobs or self._max_batch)
        self._patience_s = (int(settings.get(QUEUE_TIMEOUT_PARAMETER) or 0) / MS_PER_S) or None
        self._self_check = SelfCheck(self._score_blank, self._log.report_end)
        self._triton_queue = TritonQueue()
        self._blank_tensors = blank_question(config)
        warmups = config.get("model_warmup", [])
        self._origins = Origins(sum(max(warmup.get("count", 0), 1) for warmup in warmups), digest(self._blank_tensors))
        self._other_instances = other_instances
        stages = Stages(
            self._score,
            self._send,
            self._self_check.end,
            begin,
            begin_preparing=partial(use_threads, 1),  # there are as many threads as this instance has cores
            prepare=self._work_ahead,
            num_preparing=num_preparing,
        )
        self._pipeline = Pipeline(stages, bounds)

    def finalize(self) -> None:
        """Called once by Triton when the model is unloaded."""
        self._pipeline.close()
        self._quarantine.close()
        self._metrics.close()

    def load(self, version: Path, device: torch.device, settings: Mapping[str, str]) -> None:
        """Loads the weights in the folder ``version`` onto ``device``."""
        raise NotImplementedError

    @property
    def works_ahead(self) -> bool:
        """Whether ``work_ahead`` is worth a thread; asked when the weights are loaded."""
        return False

    def decode(self, tensors: Tensors) -> list[Question]:
        """The questions of one request. Raises InvalidSampleError."""
        raise NotImplementedError

    def prepare(self, question: Question) -> tuple[Any, int]:
        """What ``answer`` wants of a question, and its tokens, of which a batch has at most ``token_budget``. Cheap.

        Raises RewardError for a question that cannot be answered.
        """
        return question, 0

    def work_ahead(self, prepared: Any) -> None:
        """Does what takes long and can be done with a prepared question before its turn, in any thread, or never."""

    def answer(self, questions: Sequence[Any], execution: Execution) -> Sequence[Answer | RewardError]:
        """One answer, or error, for each of the prepared questions. ``execution`` records what they took."""
        raise NotImplementedError

    def encode(self, answers: Sequence[Answer], tensors: Tensors, outputs: Collection[str]) -> Tensors:
        """The requested outputs of one request whose inputs were ``tensors``."""
        raise NotImplementedError

    def execute(self, requests: Sequence[Any]) -> list[Any] | None:
        """Called by Triton with requests. Gives their responses; None: they are sent as they come."""
        called_s = time.monotonic()
        self._self_check.wait_if_ending()
        batch = [self._received(inference) for inference in requests]
        self._triton_queue.called(called_s, len(batch), sum(request.num_bytes for request in batch))
        if self._is_on_cpu and self._are_cheap(batch, self._pipeline.num_samples_waiting):
            self._pipeline.wait_for(lambda: self._pipeline.is_idle, AT_ONCE_S)
        if self._pipeline.is_idle and self._is_better_at_once(batch):
            responses = self._responses_to(batch)
            self._triton_queue.returned(len(responses))
            return responses
        self._take_in(batch, requests)
        if self._other_instances is not None:
            self._other_instances.wait_for_turn(self._pipeline, self._max_ahead)
        self._triton_queue.returned(0)
        return None

    def _take_in(self, batch: Sequence[Request[Question]], requests: Sequence[Any]) -> None:
        """Has requests wait for their turn, or answers why they cannot."""
        self._quarantine.owe(len(batch))
        for request, inference in zip(batch, requests, strict=True):
            request.outlive(inference)
            self._read(request)
        failed = [request for request in batch if request.error is not None]
        failed += self._put([request for request in batch if request.error is None])
        if failed:
            self._send(failed, [(failed, Execution())])

    def _is_better_at_once(self, batch: Sequence[Request[Question]]) -> bool:
        """Whether requests are better scored while ``execute`` waits, and answered together.

        To send a response takes a tenth of a millisecond longer than to give it back. But to wait here keeps Triton
        from handing over more, and an accelerator waits until it does. A full batch says that more wait; some of them
        may have to be rejected. Of what waits behind a batch that is not full, nothing is known; so there is a look at
        them before they may have waited for too long.

        Where the process dies, Triton 2.51 fails the requests of ``execute``, and never those that are to be answered
        later. So all are answered at once while a suspect may kill the process.
        """
        if self._quarantine.has_suspects or self._sample_s == math.inf:
            return True
        return self._take_less(batch, AT_ONCE_S) if len(batch) == 1 else self._are_cheap(batch)

    def _are_cheap(self, batch: Sequence[Request[Question]], num_waiting: int = 0) -> bool:
        """Whether the answers take little time, a request on average, and all together with ``num_waiting`` samples."""
        return self._take_less(batch, min(AT_ONCE_S, self._cheap_answer_s * len(batch)), num_waiting)

    def _take_less(self, batch: Sequence[Request[Question]], limit_s: float, num_waiting: int = 0) -> bool:
        """Whether requests that are no full batch probably take less than ``limit_s``, and with ``num_waiting`` other
        samples less than AT_ONCE_S, and than those who may wait in Triton can be left alone.
        """
        num_samples, most = sum(each.num_samples for each in batch), max(each.num_samples for each in batch)
        if num_samples + most > self._max_batch:  # one more like them would not fit
            return False
        # Unseen, none shall wait for longer than it may wait here, behind requests as large as these.
        request_s = self._sample_s * num_samples / len(batch)
        queue_s = math.inf if self._max_waiting is None else request_s * self._max_waiting
        longest_s = min(UNSEEN_S, queue_s, self._patience_s or math.inf)
        left_s = min(AT_ONCE_S, longest_s - self._triton_queue.unseen_s)
        return self._sample_s * num_samples < limit_s and self._sample_s * (num_samples + num_waiting) < left_s

    def _responses_to(self, batch: Sequence[Request[Question]]) -> list[Any]:
        """Reads the requests, waits until they are scored, and answers them."""
        for request in batch:
            self._read(request)
        scored: Scored[Question] = []
        if failed := [request for request in batch if request.error is not None]:
            scored.append((failed, Execution()))
        if ready := [request for request in batch if request.error is None]:
            scored += self._pipeline.run(ready)
        responses = [self._response(request) for request in batch]
        self._count(scored)
        return responses

    def _put(self, batch: Sequence[Request[Question]]) -> list[Request[Question]]:
        """Has requests wait for their turn. Gives those for which there is no room, with the error that says so."""
        rejected = self._pipeline.put(batch)
        self._metrics.num_waiting = self._pipeline.num_waiting
        for request in rejected:
            request.error = RejectedError(f"{QUEUE_FULL}: {self._pipeline.num_waiting} requests wait already")
        return rejected

    def _received(self, inference: Any) -> Request[Question]:
        """A request with its tensors, or with an error."""
        request: Request[Question] = Request.of(inference)
        try:
            request.receive(inference)
        except Exception as error:  # noqa: BLE001  whatever went wrong with it costs no other its answer
            request.fail(error)
        return request

    def _read(self, request: Request[Question]) -> None:
        """The first stage: the request's questions are prepared, or it has an error."""
        if request.error is not None:
            return
        try:
            self._origins.find(request)
            request.questions = self.decode(request.tensors)
            self._quarantine.check(request.digest)
            self._prepare(request)
        except RewardError as error:
            request.error = error
        except Exception as error:  # noqa: BLE001  whatever went wrong with it costs no other its answer
            request.fail(error)

    def _prepare(self, request: Request[Question]) -> None:
        """Prepares the questions of a request, or notes the first error, located in it."""
        prepared = []
        for index, question in enumerate(request.questions):
            try:
                prepared.append(self.prepare(question))
            except RewardError as error:
                request.error = _located(error, index, len(request.questions))
                return
        request.prepared, num_tokens = zip(*prepared, strict=True)
        request.num_tokens = sum(num_tokens)

    def _work_ahead(self, request: Request[Question]) -> None:
        """Beside the scoring of others: what takes long of a request. Not while a suspect may end the process, for
        which others would be blamed. What is not done here is done in the request's turn.
        """
        if self._quarantine.has_suspects:
            return
        with self._quarantine.preparing(request.digest), suppress(Exception):  # its turn will show what is wrong
            for prepared in request.prepared:
                self.work_ahead(prepared)

    def _score(self, batch: Sequence[Request[Question]]) -> Scored[Question]:
        """The second stage: the answers, or the error, of each request."""
        self._metrics.num_waiting = self._pipeline.num_waiting
        if self._self_check.is_ending:  # those that wait are told while there is somebody to tell them
            for request in batch:
                request.error = RejectedError("the instance is broken, and ends")
            return [(batch, Execution())]
        for request in batch:
            request.begin()
        with self._metrics.at_work_on(batch), self._self_check.around(batch):
            return self._scored(batch)

    def _scored(self, batch: Sequence[Request[Question]]) -> Scored[Question]:
        """Scores the requests together or, if that fails, each alone: what breaks one costs no other its answer."""
        execution = Execution(on_forward=self._quarantine.renew)
        try:
            self._answer_together(batch, execution)
        except Exception as error:  # noqa: BLE001  the request boundary: whatever happened, every request is answered
            if len(batch) > 1:
                self._log.report_batch(batch, error)
                return [scored for request in batch for scored in self._scored([request])]
            batch[0].fail(error)
            execution = Execution()
        return [(batch, execution)]

    def _answer_together(self, batch: Sequence[Request[Question]], execution: Execution) -> None:
        for request in batch:
            request.error = request.given_up(self._sample_s) or request.out_of_patience(self._patience_s)
        for group in self._quarantine.groups([request for request in batch if request.error is None]):
            questions = [question for request in group for question in request.prepared]
            started_s = time.perf_counter()
            with self._quarantine.at_work_on([request.digest for request in group]):
                answers = iter(self.answer(questions, execution))
            took_s = time.perf_counter() - started_s
            self._sample_s = took_s / len(questions)
            for request in group:
                request.answers = [next(answers) for _ in request.prepared]
                request.error = _first_error(request.answers)

    def _send(self, batch: Sequence[Request[Question]], scored: Scored[Question]) -> None:
        """The third stage: encodes, sends and counts."""
        for request in batch:
            request.send(self._response(request))
            self._quarantine.owe(-1)
        self._count(scored)

    def _response(self, request: Request[Question]) -> Any:
        """Triton's response of the answers or the error; of an error, too, if the answers cannot be written."""
        if request.error is None:
            try:
                return request.response(self.encode(request.answers, request.tensors, request.outputs))
            except Exception as error:  # noqa: BLE001  whatever went wrong with it costs no other its answer
                request.fail(error)
        return request.error_response()

    def _count(self, scored: Scored[Question]) -> None:
        """Logs what has failed, and counts all."""
        for part, execution in scored:
            for request in part:
                if request.error is not None:
                    self._log.report(request)
            self._metrics.add(Counted.of(part, execution))

    def _score_blank(self) -> None:
        """Raises the error of an instance that cannot score the blank sample."""
        try:
            questions = [self.prepare(question)[0] for question in self.decode(self._blank_tensors)]
        except InvalidSampleError:  # a checkpoint may refuse blank frames
            return
        with self._quarantine.at_work_on([NO_DIGEST]):  # a hang is noticed, and no request is a suspect
            error = _first_error(self.answer(questions, Execution(on_forward=self._quarantine.renew)))
        if error is not None and not isinstance(error, InvalidSampleError):
            raise error


def _first_error(answers: Sequence[Any]) -> RewardError | None:
    """The first error of a request, located in it if it holds several questions."""
    errors = ((answer, index) for index, answer in enumerate(answers) if isinstance(answer, RewardError))
    return next((_located(*error, len(answers)) for error in errors), None)


def _located(error: RewardError, index: int, count: int) -> RewardError:
    """The error of the question ``index`` of a request of ``count`` questions."""
    return error.inside(f"samples[{index}]") if isinstance(error, InvalidSampleError) and count > 1 else error


def _bounds(config: Mapping[str, Any], settings: Mapping[str, str]) -> Bounds:
    """How much an instance takes at a time, as it was exported; what an older export does not say is unbounded."""
    batch_samples = config["max_batch_size"]
    batch_tokens = int(settings.get(BUDGET_PARAMETER) or MAX_INT32)
    waiting = int(settings.get(QUEUE_SIZE_PARAMETER) or 0) or None
    # An idle instance, to which Triton hands a full batch, has room for it.
    share = None if waiting is None else max(math.ceil(waiting / num_instances(config)), min(waiting, batch_samples))
    return Bounds(batch_samples, batch_tokens, batch_samples, share)


def _sample_types(input_names: Sequence[str]) -> list[str]:
    """The types of samples that a model with these inputs scores."""
    of_samples = wire.SAMPLE_TYPE in input_names
    kinds = {name: not issubclass(kind, (Footage, NamedFootage)) for kind, name in SAMPLE_TYPES.items()}
    return [name for name, is_sample in kinds.items() if is_sample == of_samples]


def _checkpoint(settings: Mapping[str, str]) -> dict[str, str]:
    """Which checkpoint a model serves, as rfm_export wrote it down; of its network the class."""
    origin = {name: settings.get(name, "") for name in (SOURCE_PARAMETER, REVISION_PARAMETER, DIGEST_PARAMETER)}
    return {**origin, "network": json.loads(settings.get(NETWORK_PARAMETER) or "{}").get("class", "")}
