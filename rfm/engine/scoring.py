# SPDX-License-Identifier: MIT
"""The engine: scores samples in as few forward passes as the token budget allows, without Triton."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt
import torch

from rfm.config import DEFAULT_SAMPLE_TOKENS, DEFAULT_TOKEN_BUDGET
from rfm.engine.device import memory_errors
from rfm.engine.execution import Execution
from rfm.engine.family import Checkpoint, FrameEncoders
from rfm.engine.feature_cache import BYTES_PER_MIB, FeatureCache
from rfm.engine.graphs import CudaCapture, Graphs
from rfm.engine.layers import keep_float32
from rfm.engine.predictor import Predictor, RowScores, of_prefixes
from rfm_client.contract import (
    FRAME_SCORES,
    InferenceFailedError,
    InvalidSampleError,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    RewardError,
    Sample,
    SimilarityResult,
)
from rfm_client.contract.results import BatchTiming, answer, trajectory_scores
from rfm_client.contract.samples import EncoderSample, with_trajectories

Outcome: TypeAlias = Result | RewardError


@dataclass(frozen=True, eq=False)
class Prepared:
    """A sample, ready for a forward pass.

    rows: the rows, or the error why the network cannot score the sample
    num_tokens: tokens in all rows
    """

    sample: Sample
    rows: Sequence[Any] | RewardError
    num_tokens: int = 0


@dataclass(eq=False, repr=False)
class Engine:
    """Scores samples with one network on one device.

    predictor: the network, with batch collation
    encoders: on the same device, for raw frames if the network scores embeddings
    token_budget: maximum tokens, with padding, in a forward pass over several rows; a larger row runs alone
    max_sample_tokens: maximum tokens in one sequence; longer samples are refused
    cache: the predictor's cache for frame features; None: no cache
    graphs: CUDA graphs for small batches, if the predictor has ``use_graphs``; None: all passes are plain
    """

    predictor: Predictor[Any, Any]
    _: KW_ONLY
    encoders: FrameEncoders | None = None
    token_budget: int = DEFAULT_TOKEN_BUDGET
    max_sample_tokens: int = DEFAULT_SAMPLE_TOKENS
    cache: FeatureCache[Any] | None = None
    graphs: Graphs | None = None

    def __post_init__(self) -> None:
        if self.graphs is not None:
            cast(Any, self.predictor).use_graphs(self.graphs)

    @classmethod
    def of(
        cls,
        checkpoint: Checkpoint,
        *,
        encoders: FrameEncoders | None = None,
        device: str | torch.device = "cpu",
        dtype: torch.dtype | None = None,
        token_budget: int = DEFAULT_TOKEN_BUDGET,
        max_sample_tokens: int = DEFAULT_SAMPLE_TOKENS,
        feature_cache_mib: int = 0,
        cuda_graphs: bool = False,
    ) -> Engine:
        """Return the engine for a checkpoint in memory.

        dtype: network dtype; None: a vision-language checkpoint's own on a GPU, otherwise float32
        feature_cache_mib: MiB for features from raw frames; 0: no cache
        cuda_graphs: run small batches as CUDA graphs; no effect on the CPU or without ``Description.uses_graphs``
        others: as in the class
        Raises CheckpointError.
        """
        keep_float32()
        on = torch.device(device)
        cache = FeatureCache[Any](feature_cache_mib * BYTES_PER_MIB) if feature_cache_mib else None
        predictor = checkpoint.predictor(on, dtype, cache)
        encoders = None if encoders is None else encoders.to(on)
        is_graphed = cuda_graphs and on.type == "cuda" and checkpoint.description.uses_graphs
        return cls(
            predictor,
            encoders=encoders,
            token_budget=token_budget,
            max_sample_tokens=max_sample_tokens,
            cache=cache,
            graphs=Graphs(CudaCapture(on)) if is_graphed else None,
        )

    def evaluate(self, samples: Sequence[Sample], execution: Execution | None = None) -> list[Outcome]:
        """Return each sample's result or error, independent of the other samples.

        execution: the batch's costs are added to it

        Errors, returned and not raised: InvalidSampleError if this checkpoint cannot score the sample,
        InferenceFailedError if a score is not finite or the sample does not fit in memory.
        """
        execution = execution or Execution()
        before = replace(execution)
        embedded_samples = self._embedded(samples, execution)
        with execution.collating():
            prepared = [self._prepared(sample, of) for sample, of in zip(samples, embedded_samples, strict=True)]
        return self._results(prepared, execution, before)

    def prepare(self, sample: Sample) -> Prepared:
        """Make a sample's rows, without encoders or a forward pass; may run while another thread scores.

        sample: frames or embeddings as the network reads them; the encoders are not used
        """
        return self._prepared(sample, sample)

    @property
    def works_ahead(self) -> bool:
        """True if ``work_ahead`` takes enough time to be worth a thread."""
        return self.predictor.works_ahead

    def work_ahead(self, prepared: Prepared) -> None:
        """Do the slow part of ``score`` early; thread-safe and optional."""
        if not isinstance(prepared.rows, RewardError):
            self.predictor.work_ahead(prepared.rows)

    def score(self, prepared: Sequence[Prepared], execution: Execution) -> list[Outcome]:
        """Return the results for prepared samples, from forward passes."""
        return self._results(prepared, execution, replace(execution))

    def _embedded(self, samples: Sequence[Sample], execution: Execution) -> Sequence[Sample | RewardError]:
        """Encode raw frames for all samples together; an error replaces a sample if encoding fails."""
        outcomes: list[Sample | RewardError] = list(samples)
        raw = {
            i: EncoderSample(s.trajectories)
            for i, s in enumerate(samples)
            if s.trajectories[0].video_embeddings is None
        }
        if self.encoders is None or not raw:
            return outcomes
        for index, outcome in zip(raw, self.encoders.encode(list(raw.values()), execution, None), strict=True):
            if isinstance(outcome, EncoderSample):
                outcomes[index] = with_trajectories(samples[index], outcome.trajectories)
            else:
                outcomes[index] = outcome
        return outcomes

    def _prepared(self, sample: Sample, embedded_sample: Sample | RewardError) -> Prepared:
        if isinstance(embedded_sample, RewardError):
            return Prepared(sample, embedded_sample)
        if not self.predictor.reads_views and any(each.has_views for each in sample.trajectories):
            expected = "none (this checkpoint reads the frames of one camera)"
            return Prepared(sample, InvalidSampleError.at("views, goal", expected, "views or a goal"))
        try:
            rows = self.predictor.rows(embedded_sample)
        except RewardError as error:
            return Prepared(sample, error)
        sequences = (each for row in rows for each in self.predictor.sequences(row))
        longest = max(map(self.predictor.num_tokens, sequences))
        if longest > self.max_sample_tokens:
            expected = f"at most {self.max_sample_tokens} tokens (max_sample_tokens of this server)"
            return Prepared(sample, InvalidSampleError.at("num_frames", expected, f"{longest} tokens"))
        return Prepared(sample, rows, sum(map(self.predictor.num_tokens, rows)))

    def _results(self, prepared: Sequence[Prepared], execution: Execution, before: Execution) -> list[Outcome]:
        """Return each sample's result or error. ``before``: ``execution`` at the start of this batch."""
        collated_s, started_s, forwarded_s = execution.collate_s, time.perf_counter(), execution.forward_s
        rows: list[Any] = []
        rows_of: list[slice] = []
        for sample in prepared:
            of_sample = () if isinstance(sample.rows, RewardError) else sample.rows
            rows_of.append(slice(len(rows), len(rows) + len(of_sample)))
            rows += of_sample
        scores = self._scores(rows, execution)
        execution.collate_s = collated_s + time.perf_counter() - started_s - (execution.forward_s - forwarded_s)
        collate_s, forward_s = execution.collate_s - before.collate_s, execution.forward_s - before.forward_s
        timing = BatchTiming(collate_s * 1e3, forward_s * 1e3)
        outcomes = [
            sample.rows
            if isinstance(sample.rows, RewardError)
            else self._outcome(sample.sample, scores[of_sample], timing)
            for sample, of_sample in zip(prepared, rows_of, strict=True)
        ]
        lacks = [name for name in ("progress", "success") if not getattr(self.predictor, f"has_{name}")]
        return _finite(outcomes, lacks=lacks)

    def _scores(self, rows: Sequence[Any], execution: Execution) -> list[RowScores | RewardError]:
        scores: dict[int, RowScores | RewardError] = {}
        for part, batch in self._collated(rows, list(self._micro_batches(rows))):
            with execution.forwarding():
                scores.update(zip(part, self._score([rows[i] for i in part], batch, execution), strict=True))
        return [scores[index] for index in range(len(rows))]

    def _collated(self, rows: Sequence[Any], parts: Sequence[list[int]]) -> Iterator[tuple[list[int], Any]]:
        """Yield each part with its batch. While the caller scores a part, a thread collates the next."""
        batch = self._collate([rows[i] for i in parts[0]]) if parts else None
        if len(parts) < 2:
            yield from ((part, batch) for part in parts)
            return
        with ThreadPoolExecutor(1) as collating:
            for part, following in zip(parts, [*parts[1:], None], strict=True):
                steps = copy_context()  # the collating thread has this thread's context variables
                coming = collating.submit(steps.run, self._collate, [rows[i] for i in following]) if following else None
                yield part, batch
                batch = coming.result() if coming is not None else None

    def _collate(self, rows: Sequence[Any]) -> Any:
        """Return the rows' batch; None if it does not fit in memory now."""
        try:
            with memory_errors():
                return self.predictor.collate(rows)
        except torch.OutOfMemoryError:
            return None

    def _score(self, rows: Sequence[Any], batch: Any, execution: Execution) -> Sequence[RowScores | RewardError]:
        """Score rows in one forward pass, or several if memory is short.

        batch: all rows collated; None: they did not fit in memory, and are collated again here
        """

        def forward(part: Sequence[Any]) -> Sequence[RowScores | RewardError]:
            of_part = batch if part is rows and batch is not None else self.predictor.collate(part)
            scores = self.predictor.score(part, of_part, execution)
            self.predictor.count(of_part, execution)
            return scores

        def divided(row: Any) -> RowScores | RewardError | None:
            sequences = self.predictor.sequences(row)
            if len(sequences) == 1:
                return None
            outcomes = execution.run(forward, sequences)  # of prefixes
            if errors := [each for each in outcomes if isinstance(each, RewardError)]:
                return errors[0]
            scores = of_prefixes([each for each in outcomes if isinstance(each, RowScores)])
            return RowScores([scores], is_of_prefixes=True)

        return execution.run(forward, rows, divided)

    def _micro_batches(self, rows: Sequence[Any]) -> Iterator[list[int]]:
        """Yield row indices for each forward pass: similar in length, within the token budget."""
        num_tokens = [self.predictor.num_tokens(row) for row in rows]
        part: list[int] = []
        for index in sorted(range(len(rows)), key=num_tokens.__getitem__):
            if part and (len(part) + 1) * num_tokens[index] > self.token_budget:
                yield part
                part = []
            part.append(index)
        if part:
            yield part

    def _outcome(
        self,
        sample: Sample,
        scores: Sequence[RowScores | RewardError],
        timing: BatchTiming,
    ) -> Outcome:
        rows = [row for row in scores if isinstance(row, RowScores)]
        if len(rows) < len(scores):
            return next(row for row in scores if isinstance(row, RewardError))
        if isinstance(sample, ProgressSample):
            frames = self.predictor.joined(sample, rows)
            return ProgressResult(**vars(frames), timing=timing)
        first, second = rows[0].frames
        query = rows[0].query
        assert query is not None  # every row with two trajectories has a query
        if isinstance(sample, PreferenceSample):
            return PreferenceResult(preference=query, first=first, second=second, timing=timing)
        return SimilarityResult(similarity=query, reference=first, other=second, timing=timing)


def _finite(outcomes: Sequence[Result | RewardError], *, lacks: Collection[str]) -> list[Result | RewardError]:
    """Return the outcomes, where an error replaces any result with a NaN or infinite score.

    lacks: scores the network does not predict, which are NaN

    Frames that the model does not answer about are not checked. Neither are progress logits: RoboReward has none for an
    answer without a digit, and in the other models a fault also shows in progress.
    """
    scores = [[] if isinstance(each, RewardError) else list(_scores(each, lacks)) for each in outcomes]
    of_all = [array for of_one in scores for array in of_one]
    if not of_all or np.isfinite(np.concatenate(of_all)).all():  # all at once, which is faster
        return list(outcomes)
    failed = InferenceFailedError("the network gave a score that is not finite")
    return [
        outcome if all(np.isfinite(array).all() for array in of_one) else failed
        for outcome, of_one in zip(outcomes, scores, strict=True)
    ]


def _scores(result: Result, lacks: Collection[str]) -> Iterator[npt.NDArray[Any]]:
    """Yield the result's scores, [N] each."""
    if of_pair := answer(result):
        yield np.array([*of_pair.values()], np.float32)
    for scores in trajectory_scores(result).values():
        known = scores.is_answered
        if not known[-1]:  # a model that skips frames answers about the last
            yield np.array([np.nan])
        for name, array in scores.arrays.items():
            if not FRAME_SCORES[name].is_per_bin and name not in lacks:
                yield array[known]
