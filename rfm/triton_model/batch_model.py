# SPDX-License-Identifier: MIT
"""BatchModel, the base of every model.py: reads Triton's requests, scores them together, and answers each."""

from __future__ import annotations

import gc
import json
import logging
import os
import re
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

import torch

from rfm.engine.device import TORCH
from rfm.engine.execution import Execution
from rfm.parameters import BUDGET_PARAMETER, DEFAULT_HANG_S, HANG_VARIABLE
from rfm.probe_request import probe_request
from rfm.triton_model.metrics import InstanceMetrics
from rfm.triton_model.pipeline import Pipeline
from rfm.triton_model.placement import Placement, check_digest, close_to_other_users
from rfm.triton_model.request import SAMPLE_TYPES, CancelledError, Request
from rfm.triton_model.watchdog import Watchdog
from rfm_client.contract import InvalidSampleError, RewardError, wire
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description
from rfm_client.contract.process import about, write_log
from rfm_client.contract.samples import EncoderSample
from rfm_client.contract.wire import Tensors

ASKING_S = 0.01  # of the last batch's time, per fruitless cancellation check; a check takes 0.1 ms

logger = logging.getLogger(__name__)

Question = TypeVar("Question")
Answer = TypeVar("Answer")
Scored: TypeAlias = list[tuple[Sequence[Request[Question]], Execution]]  # requests, and the cost of scoring them


def _decisive(computation: str, placement: Placement) -> str:
    """Return what decides scores of a computation: on a CPU not PyTorch's build, for example +cpu or +cu130."""
    return re.sub(r"\+\w+", "", computation) if placement.device.type == "cpu" else computation


class BatchModel(Generic[Question, Answer]):
    """Adapter between Triton and a function from questions to answers.

    A question is a sample or an encoder's sample; a request holds one or more.

    A subclass reads a request's tensors (``decode``), checks and prepares each question (``prepare``), answers
    questions (``answer``), and writes a request's answers (``encode``).

    A subclass that ``works_ahead`` scores in a ``Pipeline``, which calls ``work_ahead`` before a question's turn.
    Others score in ``execute``.
    """

    def initialize(self, args: Mapping[str, str]) -> None:
        """Load the model. Triton calls this once."""
        close_to_other_users()  # before any frames
        write_log(f"{args['model_name']}/{args['model_version']}", os.environ)
        config = json.loads(args["model_config"])
        settings = {name: value["string_value"] for name, value in config["parameters"].items()}
        description = Description.parse(settings.get(DESCRIPTION_PARAMETER, ""))
        placement = Placement.of(args, config, settings)
        version = Path(args["model_repository"], args["model_version"]).resolve()  # `rfm serve` hands it a link
        self._pipeline: Pipeline | None = None
        self._is_executing = False
        self._batch_s = 0.0  # duration of the last batch
        self._watchdog = Watchdog(float(os.environ.get(HANG_VARIABLE) or DEFAULT_HANG_S), self._is_working)
        check_digest(version, description.weights_digest)
        placement.run(lambda: self.load(version, placement.device, settings))
        model = {"model": args["model_name"], "version": args["model_version"]}
        labels = {**model, "device": str(placement.device), "instance": args["model_instance_name"]}
        origin = {name: getattr(description, name) or "" for name in ("source", "revision", "weights_digest")}
        checkpoint = {**origin, "network": description.network.get("class", "")}
        of_samples = wire.SAMPLE_TYPE in [spec["name"] for spec in config["input"]]
        sample_types = [name for kind, name in SAMPLE_TYPES.items() if issubclass(kind, EncoderSample) != of_samples]
        self._metrics = InstanceMetrics(labels, checkpoint, sample_types, lambda: self._watchdog.num_steps)
        self._blank_tensors = probe_request(config)
        self._num_warmups = sum(warmup.get("count") or 1 for warmup in config.get("model_warmup", []))
        exported = description.computation
        if exported and _decisive(TORCH, placement) not in _decisive(exported, placement).split(", "):
            differs = "labels will name the export's computation, %s, but this is %s: export with %s"
            logger.warning(differs, exported, TORCH, TORCH)
        if self.works_ahead:
            max_tokens = int(settings.get(BUDGET_PARAMETER) or sys.maxsize)
            self._pipeline = Pipeline(
                self._work_ahead, self._score, self._send, placement, config["max_batch_size"], max_tokens
            )
        else:
            placement.apply()

    def finalize(self) -> None:
        """Clean up. Triton calls this once when it unloads the model."""
        if self._pipeline is not None:
            self._pipeline.close()
        self._metrics.close()
        self._watchdog.close()
        gc.collect()  # of requests and their errors: a request that outlives Triton's memory crashes the process

    def load(self, version: Path, device: torch.device, settings: Mapping[str, str]) -> None:
        """Load the weights in the folder ``version`` onto ``device``."""
        raise NotImplementedError

    @property
    def works_ahead(self) -> bool:
        """True if ``work_ahead`` is worth a thread. Read once, after ``load``."""
        return False

    def decode(self, tensors: Tensors) -> list[Question]:
        """Return the questions in a request. Raises InvalidSampleError."""
        raise NotImplementedError

    def prepare(self, question: Question) -> tuple[Any, int]:
        """Return a question's input for ``answer``, and its token count (see ``token_budget``). Must be fast.

        Raises RewardError if the question cannot be answered.
        """
        return question, 0

    def work_ahead(self, prepared: Any) -> None:
        """Do the slow part of a prepared question before its turn. Called in any thread, or never."""

    def answer(self, questions: Sequence[Any], execution: Execution) -> Sequence[Answer | RewardError]:
        """Return an answer or an error for each prepared question. ``execution`` records the cost."""
        raise NotImplementedError

    def encode(self, answers: Sequence[Answer], tensors: Tensors, outputs: Collection[str]) -> Tensors:
        """Return a request's output tensors. tensors: the inputs; outputs: names of the requested outputs"""
        raise NotImplementedError

    def execute(self, requests: Sequence[Any]) -> list[Any] | None:
        """Take requests from Triton. Return their responses; None: the pipeline sends them later."""
        batch: list[Request[Question]] = [Request.of(inference) for inference in requests]
        pipeline = self._pipeline
        if pipeline is None:
            return self._responses(batch, self._score)
        if len(batch) == 1 and pipeline.is_idle:  # skips the queue and the copies
            return self._responses(batch, pipeline.run)
        for request, inference in zip(batch, requests, strict=True):
            request.outlive(inference)
            self._read(request)
        pipeline.put(batch)
        return None

    def _is_working(self) -> bool:
        return self._is_executing or (self._pipeline is not None and not self._pipeline.is_idle)

    def _responses(
        self, batch: list[Request[Question]], score: Callable[[list[Request[Question]]], Scored[Question]]
    ) -> list[Any]:
        self._is_executing = True
        try:
            for request in batch:
                self._read(request)
            scored = score(batch)
            responses = [self._response(request) for request in batch]
        finally:
            self._is_executing = False
        self._count(scored)
        return responses

    def _read(self, request: Request[Question]) -> None:
        """Decode and prepare the questions of a request, or note its error."""
        if self._num_warmups and not request.request_id:  # warm-ups come first, and have no id
            self._num_warmups -= 1
            request.is_counted = False
        if request.error is not None:
            return
        try:
            request.questions = self.decode(request.tensors)
            prepared = []
            for index, question in enumerate(request.questions):
                try:
                    prepared.append(self.prepare(question))
                except RewardError as error:
                    raise _located(error, index, len(request.questions)) from error.__cause__
            request.prepared, num_tokens = zip(*prepared, strict=True)
            request.num_tokens = sum(num_tokens)
        except RewardError as error:
            request.error = error
        except Exception as error:  # noqa: BLE001  fails this request alone
            request.fail(error)

    def _work_ahead(self, request: Request[Question]) -> None:
        """Do a request's slow part while others are scored. Drops errors: scoring raises them again."""
        with suppress(Exception):
            for prepared in request.prepared:
                self.work_ahead(prepared)

    def _score(self, batch: list[Request[Question]]) -> Scored[Question]:
        """Set each request's answers or error. Return the cost of scoring."""
        self._drop_cancelled(batch)
        failed = [request for request in batch if request.error is not None]
        good = [request for request in batch if request.error is None]
        scored: Scored[Question] = [(failed, Execution())] if failed else []
        if good:
            started_s = time.monotonic()
            scored += self._scored(good)
            self._batch_s = time.monotonic() - started_s
            self._watchdog.look_at(good, self._score_blank)
        return scored

    def _drop_cancelled(self, batch: list[Request[Question]]) -> None:
        """Set an error on requests whose callers have left: Triton 2.51 hands those over too.

        Checks the oldest requests first. Fruitless checks take at most 1 % of the last batch's time.
        """
        num_in_vain = int(self._batch_s / ASKING_S)
        for request in batch:
            if num_in_vain <= 0:
                break
            if request.error is None and request.is_cancelled():
                request.error = CancelledError("cancelled by the client")
            else:
                num_in_vain -= 1

    def _scored(self, batch: list[Request[Question]]) -> Scored[Question]:
        """Score the requests together or, if that fails, each alone, so that only the culprit fails."""
        self._watchdog.step()
        execution = Execution(on_forward=self._watchdog.step)
        try:
            answers = iter(self.answer([each for request in batch for each in request.prepared], execution))
            for request in batch:
                request.answers = [next(answers) for _ in request.prepared]
                request.error = _first_error(request.answers)
        except Exception as error:  # noqa: BLE001  every request gets an answer or an error
            if len(batch) > 1:
                _tell(_log_split, batch, error)
                return [scored for request in batch for scored in self._scored([request])]
            batch[0].fail(error)
            execution = Execution()
        return [(batch, execution)]

    def _send(self, scored: Scored[Question]) -> None:
        batch = [request for part, _ in scored for request in part]
        for request in batch:
            request.send(self._response(request))
        self._count(scored)

    def _response(self, request: Request[Question]) -> Any:
        if request.error is None:
            try:
                return request.response(self.encode(request.answers, request.tensors, request.outputs))
            except Exception as error:  # noqa: BLE001  fails this request alone
                request.fail(error)
        return request.error_response()

    def _count(self, scored: Scored[Question]) -> None:
        for part, execution in scored:
            for request in part:
                if request.error is not None:
                    _tell(request.log_error)
            _tell(self._metrics.add, part, execution)

    def _score_blank(self) -> None:
        """Score the sample from ``probe_request``. Raises errors from a broken device, but ignores a refused sample."""
        try:
            questions = [self.prepare(question)[0] for question in self.decode(self._blank_tensors)]
        except InvalidSampleError:  # a checkpoint may refuse blank frames
            return
        self.answer(questions, Execution(on_forward=self._watchdog.step))


def _tell(tell: Callable[..., None], *what: Any) -> None:
    """Call a function that logs or counts. Log errors instead of raising: responses must still go out."""
    try:
        tell(*what)
    except Exception:
        logger.exception("requests could not be logged or counted")


def _log_split(batch: Sequence[Request[Any]], error: Exception) -> None:
    """Log a failed batch, before its requests are scored one by one."""
    with about([request.request_id for request in batch]):
        logger.error("the batch failed, now each request is scored alone", exc_info=error)


def _first_error(answers: Sequence[Any]) -> RewardError | None:
    """Return a request's first error, with the index of the question if there are several."""
    errors = ((answer, index) for index, answer in enumerate(answers) if isinstance(answer, RewardError))
    return next((_located(*error, len(answers)) for error in errors), None)


def _located(error: RewardError, index: int, count: int) -> RewardError:
    """Return an error with its question's index, if the request has several."""
    return error.inside(f"samples[{index}]") if isinstance(error, InvalidSampleError) and count > 1 else error
