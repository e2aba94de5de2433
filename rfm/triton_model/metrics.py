# SPDX-License-Identifier: MIT
"""The ``rfm_*`` metrics of a model instance, on Triton's metrics endpoint.

To change one is a call to Triton's process, of some 20 us. So a thread makes these calls, with sums where sums do,
at most every FLUSH_INTERVAL_S; what answers requests only puts what it did into a queue.
"""

from __future__ import annotations

import threading
import traceback
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any

from rfm.engine.execution import Execution
from rfm.triton_model.request import OUTCOMES, SCORED, UNKNOWN_TYPE, Request

FLUSH_INTERVAL_S = 0.25
IDLE_INTERVAL_S = 1.0  # while no batch ends

COUNTER, GAUGE, HISTOGRAM = "COUNTER", "GAUGE", "HISTOGRAM"  # as Triton names them
FRAMES, RETRIES = "frames_total", "out_of_memory_retries_total"
BATCH_SAMPLES, BATCH_PADDING = "batch_samples", "batch_padding_ratio"
COLLATE_SECONDS, FORWARD_SECONDS = "collate_seconds", "forward_seconds"
ENCODED, FOUND, MISSED = "frames_encoded_total", "feature_cache_hits_total", "feature_cache_misses_total"
CACHE_BYTES, PASSES = "feature_cache_bytes", "forward_passes_total"

SAMPLES_BUCKETS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
PADDING_BUCKETS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
BUCKETS_S = tuple(digit * 10.0**power for power in range(-4, 2) for digit in (1, 2, 5))  # 0.1 ms to 50 s

_TOTALS = {
    FRAMES: "Frames scored.",
    RETRIES: "Forward passes that ran out of memory and were tried again in halves.",
    ENCODED: "Frames that went through an encoder or a vision tower.",
    FOUND: "Frames of a batch, each once, whose features were kept.",
    PASSES: "Forward passes, and batches begun.",
    MISSED: "Frames of a batch, each once, whose features were not kept, and had to be made.",
}
_HISTOGRAMS = {
    BATCH_SAMPLES: ("Samples of one execution.", SAMPLES_BUCKETS),
    BATCH_PADDING: ("Share of the token slots of an execution's forward passes that were padding.", PADDING_BUCKETS),
    COLLATE_SECONDS: ("Of one execution, in which batches were made and no forward pass ran.", BUCKETS_S),
    FORWARD_SECONDS: ("Of one execution's forward passes.", BUCKETS_S),
}


@dataclass
class Counted:
    """What came of callers' requests in one batch.

    samples: how many, by (sample type, outcome)
    num_frames: of the samples that were scored
    num_executed: samples that ``execution`` was about
    """

    samples: Counter[tuple[str, str]] = field(default_factory=Counter)
    num_frames: int = 0
    num_executed: int = 0
    execution: Execution = field(default_factory=Execution)

    @classmethod
    def of(cls, batch: Iterable[Request[Any]], execution: Execution) -> Counted:
        """Counts a batch that ``execution`` was spent on."""
        counted = cls(execution=execution)
        for request in batch:
            if not request.is_counted:
                continue
            for sample_type, count in request.sample_types.items():
                counted.samples[sample_type, request.outcome] += count
            if request.outcome == SCORED:
                counted.num_frames += request.num_frames
            counted.num_executed += len(request.answers)
        return counted

    def totals(self) -> dict[str, int]:
        """What each counter grows by, by its name."""
        done = self.execution
        missed = 0 if done.cache_bytes is None else done.num_encoded
        frames = {FRAMES: self.num_frames, ENCODED: done.num_encoded, FOUND: done.num_found, MISSED: missed}
        return {**frames, RETRIES: done.out_of_memory_count}

    def observed(self) -> dict[str, float]:
        """What each histogram observes, by its name; nothing if no forward pass was spent on a caller."""
        if not (self.num_executed and self.execution.num_slots):
            return {}
        return {
            BATCH_SAMPLES: self.num_executed,
            BATCH_PADDING: self.execution.padding_ratio,
            COLLATE_SECONDS: self.execution.collate_s,
            FORWARD_SECONDS: self.execution.forward_s,
        }


class Metrics:
    """The metrics of one instance; to be closed. Whatever goes wrong with them is logged once, and fails no request.

    labels: the labels that name the instance
    checkpoint: labels of rfm_checkpoint_info
    sample_types: the types of samples that the model scores
    num_steps: gives how many forward passes were made so far
    """

    def __init__(
        self,
        labels: Mapping[str, str],
        checkpoint: Mapping[str, str],
        sample_types: Collection[str],
        num_steps: Callable[[], int],
    ) -> None:
        self._num_steps, self._num_told_steps = num_steps, num_steps()
        self._cache_bytes = 0
        self._queue: SimpleQueue[Counted | None] = SimpleQueue()  # None only wakes the thread
        self._closing = threading.Event()
        self._has_failed = False
        self._thread: threading.Thread | None = None
        try:
            self._series = _Series(labels, checkpoint, sample_types)
        except Exception:  # noqa: BLE001  a Triton without metrics serves all the same
            self._log_once()
            return
        self._thread = threading.Thread(target=self._flush_for_ever, name="rfm-metrics", daemon=True)
        self._thread.start()

    def add(self, counted: Counted) -> None:
        """Counts what came of a batch."""
        if self._thread is not None:
            self._queue.put(counted)

    def close(self) -> None:
        """Returns when Triton knows all that was added, and that the checkpoint is served no more."""
        if self._thread is None:
            return
        self._closing.set()
        self._queue.put(None)
        self._thread.join()
        self._flush(is_served=False)

    def _flush_for_ever(self) -> None:
        while not self._closing.is_set():
            first = None
            with suppress(Empty):
                first = self._queue.get(timeout=IDLE_INTERVAL_S)
            self._closing.wait(FLUSH_INTERVAL_S)
            self._flush(first, is_served=True)

    def _flush(self, first: Counted | None = None, *, is_served: bool) -> None:
        try:
            batches = [batch for batch in (first, *_drained(self._queue)) if batch is not None]
            self._series.add(batches)
            for batch in batches:
                self._cache_bytes = batch.execution.cache_bytes or self._cache_bytes
            num_steps = self._num_steps()
            self._series.step(num_steps - self._num_told_steps)
            self._num_told_steps = num_steps
            self._series.show(cached=self._cache_bytes, is_served=is_served)
        except Exception:  # noqa: BLE001  requests are answered all the same
            self._log_once()

    def _log_once(self) -> None:
        import triton_python_backend_utils as pb_utils

        if not self._has_failed:
            self._has_failed = True
            pb_utils.Logger.log_error(f"metrics cannot be reported: {traceback.format_exc()}")


class _Series:
    """The metrics in Triton's process. They outlive this one, and go on where a model is loaded again."""

    def __init__(self, labels: Mapping[str, str], checkpoint: Mapping[str, str], sample_types: Collection[str]) -> None:
        self._families: list[Any] = []  # a metric dies with its family
        samples = self._family("samples_total", COUNTER, "Samples, by what became of the request that they were in.")
        self._samples = {  # all at once, so that already the first failure is an increase
            (sample_type, outcome): samples.Metric(labels={**labels, "sample_type": sample_type, "outcome": outcome})
            for sample_type in (*sample_types, UNKNOWN_TYPE)
            for outcome in OUTCOMES
        }
        self._totals = {
            name: self._family(name, COUNTER, description).Metric(labels=dict(labels))
            for name, description in _TOTALS.items()
        }
        self._histograms = {
            name: self._family(name, HISTOGRAM, description).Metric(labels=dict(labels), buckets=list(buckets))
            for name, (description, buckets) in _HISTOGRAMS.items()
        }
        kept = self._family(CACHE_BYTES, GAUGE, "Bytes of the features that are kept.")
        self._cache_bytes = kept.Metric(labels=dict(labels))
        info = self._family("checkpoint_info", GAUGE, "1: the checkpoint is served.")
        model = {name: labels[name] for name in ("model", "version")}
        self._checkpoint = info.Metric(labels={**model, **checkpoint})
        self.show(cached=0, is_served=True)

    def _family(self, name: str, kind: str, description: str) -> Any:
        import triton_python_backend_utils as pb_utils

        kind = getattr(pb_utils.MetricFamily, kind)
        self._families.append(pb_utils.MetricFamily(name=f"rfm_{name}", description=description, kind=kind))
        return self._families[-1]

    def add(self, batches: Iterable[Counted]) -> None:
        """Adds what came of ``batches``."""
        samples: Counter[tuple[str, str]] = Counter()
        totals: Counter[str] = Counter()
        for batch in batches:
            samples.update(batch.samples)
            totals.update(+Counter(batch.totals()))
            for name, value in batch.observed().items():
                self._histograms[name].observe(value)
        for key, count in samples.items():
            self._samples[key].increment(count)
        for name, total in totals.items():
            self._totals[name].increment(total)

    def step(self, num_steps: int) -> None:
        """Adds forward passes. They count while a batch goes on: by them ``rfm serve`` knows that it does not hang."""
        if num_steps:
            self._totals[PASSES].increment(num_steps)

    def show(self, *, cached: int, is_served: bool) -> None:
        """Sets the gauges to these values."""
        self._cache_bytes.set(cached)
        # Every time: where a model is reloaded, the instance that goes says 0 when the one that comes has said 1.
        self._checkpoint.set(float(is_served))


def _drained(queue: SimpleQueue[Counted | None]) -> list[Counted | None]:
    drained: list[Counted | None] = []
    with suppress(Empty):
        while True:
            drained.append(queue.get_nowait())
    return drained
