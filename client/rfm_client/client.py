# SPDX-License-Identifier: MIT
"""RewardClient: rewards for trajectories from a served reward model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from types import TracebackType
from typing import cast

from rfm_client import wire
from rfm_client.errors import InvalidSampleError, RewardError
from rfm_client.samples import (
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    Sample,
    SimilarityResult,
    SimilaritySample,
    Trajectory,
)
from rfm_client.transport import Transport, connect

DEFAULT_MODEL = "rfm"
DEFAULT_TIMEOUT_S = 60.0
MAX_REQUEST_BYTES = 32 * 2**20  # larger parts gain nothing and hold more memory on both sides

_SCORES = (wire.PROGRESS, wire.SUCCESS, wire.PREFERENCE, wire.SIMILARITY)


class RewardClient:
    """A connection to one server. Thread-safe; closes itself as a context manager.

    url: ``grpc://host:8001`` or ``http://host:8000``
    model: name under which the checkpoint was exported; trajectories of raw frames go to ``<model>_frames``
    timeout_s: the longest that one request may take
    transport: instead of a connection to ``url``, for tests and unusual networks
    """

    def __init__(
        self,
        url: str,
        *,
        model: str = DEFAULT_MODEL,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        transport: Transport | None = None,
    ) -> None:
        self._model = model
        self._transport = transport if transport is not None else connect(url, timeout_s)
        self._max_batch_sizes: dict[str, int] = {}

    def progress(self, trajectory: Trajectory, *, frame_steps: int = 0) -> ProgressResult:
        """Progress and success at each frame; ``frame_steps`` as in ProgressSample. Raises RewardError."""
        return cast(ProgressResult, self._one(ProgressSample(trajectory, frame_steps=frame_steps)))

    def preference(self, first: Trajectory, second: Trajectory) -> PreferenceResult:
        """Probability that ``first`` does its task better than ``second``. Raises RewardError."""
        return cast(PreferenceResult, self._one(PreferenceSample(first, second)))

    def similarity(self, reference: Trajectory, other: Trajectory) -> SimilarityResult:
        """Raw similarity score of ``other`` to ``reference``. Raises RewardError."""
        return cast(SimilarityResult, self._one(SimilaritySample(reference, other)))

    def evaluate(self, samples: Sequence[Sample], *, logits: bool = False, timing: bool = False) -> list[Result]:
        """The results of any mix of samples, in order. Raises the RewardError of the first that has one."""
        outcomes = self.evaluate_each(samples, logits=logits, timing=timing)
        for index, outcome in enumerate(outcomes):
            if isinstance(outcome, InvalidSampleError) and len(samples) > 1:
                raise outcome.inside(f"samples[{index}]") from outcome
            if isinstance(outcome, RewardError):
                raise outcome
        return cast("list[Result]", outcomes)

    def evaluate_each(
        self, samples: Sequence[Sample], *, logits: bool = False, timing: bool = False
    ) -> list[Result | RewardError]:
        """As ``evaluate``, but a sample that fails gives its error in its place and the others their results.

        logits: with the raw scores of the progress bins, which only discrete checkpoints have
        timing: with the server's time for the batch
        """
        optional = {wire.PROGRESS_LOGITS: logits, wire.TIMING_MS: timing}
        outputs = (*_SCORES, *(name for name, wanted in optional.items() if wanted))
        outcomes: dict[int, Result | RewardError] = {}
        for model, group in self._groups(samples):
            try:
                parts = list(self._parts(model, samples, group))
            except RewardError as error:
                outcomes.update(dict.fromkeys(group, error))
                continue
            for part in parts:
                answers = self._ask(model, [samples[index] for index in part], outputs)
                outcomes.update(zip(part, answers, strict=True))
        return [outcomes[index] for index in range(len(samples))]

    def is_ready(self) -> bool:
        """Whether the server answers and the model is ready, for embeddings or for raw frames."""
        return any(self._transport.is_ready(model) for model in (self._model, f"{self._model}_frames"))

    def close(self) -> None:
        """Closes the connection."""
        self._transport.close()

    def __enter__(self) -> RewardClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _one(self, sample: Sample) -> Result:
        return self.evaluate([sample])[0]

    def _groups(self, samples: Sequence[Sample]) -> Iterator[tuple[str, list[int]]]:
        """Model and indices of the samples that fit the same arrays. Short ones first."""

        def key(index: int) -> tuple[str, tuple[int, ...], tuple[int, ...]]:
            first = samples[index].trajectories[0]
            model = self._model if first.frames is None else f"{self._model}_frames"
            text = first.text_embedding
            return model, first.positions.shape[1:], () if text is None else text.shape

        by_length = sorted(range(len(samples)), key=lambda index: (key(index), _num_positions(samples[index])))
        for (model, *_), group in groupby(by_length, key=key):
            yield model, list(group)

    def _parts(self, model: str, samples: Sequence[Sample], group: Sequence[int]) -> Iterator[list[int]]:
        """The group cut into requests that are bounded in samples and bytes."""
        part: list[int] = []
        for index in group:
            frame_bytes = samples[index].trajectories[0].positions[0].nbytes
            padded_bytes = (len(part) + 1) * _num_positions(samples[index]) * frame_bytes
            if part and (padded_bytes > MAX_REQUEST_BYTES or len(part) == self._max_batch_size(model)):
                yield part
                part = []
            part.append(index)
        yield part

    def _max_batch_size(self, model: str) -> int:
        if model not in self._max_batch_sizes:
            self._max_batch_sizes[model] = self._transport.max_batch_size(model)
        return self._max_batch_sizes[model]

    def _ask(self, model: str, samples: Sequence[Sample], outputs: Sequence[str]) -> Sequence[Result | RewardError]:
        """One request. Triton refuses it whole if one sample is bad; then each sample is asked about alone."""
        try:
            tensors = self._transport.infer(model, wire.encode_samples(samples), outputs)
            return wire.decode_results(tensors, samples)
        except InvalidSampleError as error:
            if len(samples) == 1:
                return [error]
            return [self._ask(model, [sample], outputs)[0] for sample in samples]
        except RewardError as error:
            return [error] * len(samples)


def _num_positions(sample: Sample) -> int:
    return sum(trajectory.num_frames for trajectory in sample.trajectories)
