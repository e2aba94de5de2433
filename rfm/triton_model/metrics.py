# SPDX-License-Identifier: MIT
"""The ``rfm_*`` metrics of a model instance, on Triton's metrics endpoint.

To change one is a call to Triton's process, of some 20 us. So a thread makes these calls, with sums where sums do,
at most every FLUSH_INTERVAL_S; what answers requests only puts what it did into a queue.
"""

from __future__ import annotations

import threading
import traceback
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any

from rfm.execution import Execution
from rfm.triton_model.request import OUTCOMES, SCORED, UNKNOWN_TYPE, Request

FLUSH_INTERVAL_S = 0.25
IDLE_INTERVAL_S = 5.0  # while no request comes

COUNTER, GAUGE, HISTOGRAM = "COUNTER", "GAUGE", "HISTOGRAM"  # as Triton names them
FRAMES, RETRIES = "frames_total", "out_of_memory_retries_total"
BATCH_SAMPLES, BATCH_PADDING = "batch_samples", "batch_padding_ratio"
WAIT_SECONDS, COLLATE_SECONDS, FORWARD_SECONDS = "wait_seconds", "collate_seconds", "forward_seconds"

BATCH_REQUESTS, WAITING_REQUESTS = "batch_requests", "waiting_requests"
ENCODED, FOUND, MISSED = "frames_encoded_total", "feature_cache_hits_total", "feature_cache_misses_total"
CACHE_BYTES = "feature_cache_bytes"

SAMPLES_BUCKETS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
PADDING_BUCKETS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
BUCKETS_S = tuple(digit * 10.0**power for power in range(-4, 2) for digit in (1, 2, 5))  # 0.1 ms to 50 s

_TOTALS = {
    FRAMES: "Frames scored.",
    RETRIES: "Forward passes that ran out of memory and were tried again in halves.",
    ENCODED: "Frames that went through an encoder or a vision tower.",
    FOUND: "Frames of a batch, each once, whose features were kept.",
    MISSED: "Frames of a batch, each once, whose features were not kept, and had to be made.",
}
_GAUGES = {
    BATCH_REQUESTS: "Requests of the batch that is worked on now; 0: idle.",
    WAITING_REQUESTS: "Requests that wait in the model for their turn.",
    CACHE_BYTES: "Bytes of the features that are kept.",
}
_HISTOGRAMS = {
    BATCH_SAMPLES: ("Samples of one execution.", SAMPLES_BUCKETS),
    BATCH_PADDING: ("Share of the token slots of an execution's forward passes that were padding.", PADDING_BUCKETS),
    WAIT_SECONDS: ("The longest wait in the model of one execution's requests, for their turn.", BUCKETS_S),
    COLLATE_SECONDS: ("Of one execution, in which batches were made and no forward pass ran.", BUCKETS_S),
    FORWARD_SECONDS: ("Of one execution's forward passes.", BUCKETS_S),
}


@dataclass
class Counted:
    """What came of callers' requests in one batch.

    samples: how many, by (sample type, outcome)
    num_frames: of the samples that were scored
    num_executed: samples that ``execution`` was about
    wait_s: the longest that one of the requests had waited for its turn
    """

    samples: Counter[tuple[str, str]] = field(default_factory=Counter)
    num_frames: int = 0
    num_executed: int = 0
    wait_s: float = 0.0
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
            counted.wait_s = max(counted.wait_s, request.waited_s)
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
            WAIT_SECONDS: self.wait_s,
            COLLATE_SECONDS: self.execution.collate_s,
            FORWARD_SECONDS: self.execution.forward_s,
        }


class Metrics:
    """The metrics of one instance; to be closed. Whatever goes wrong with them is logged once, and fails no request.

    labels: the labels that name the instance
    checkpoint: labels of rfm_checkpoint_info
    sample_types: the types of samples that the model scores
    num_waiting: requests that wait for their turn; to be set when it changes
    """

    def __init__(self, labels: Mapping[str, str], checkpoint: Mapping[str, str], sample_types: Collection[str]) -> None:
        self.num_waiting = 0
        self._at_work = self._cache_bytes = 0
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

    @contextmanager
    def at_work_on(self, batch: Iterable[Request[Any]]) -> Iterator[None]:
        """A context in which the gauge of requests in work counts the callers' requests of the batch."""
        self._set_at_work(sum(request.is_counted for request in batch))
        try:
            yield
        finally:
            self._set_at_work(0)

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

    def _set_at_work(self, num_requests: int) -> None:
        if self._thread is not None and num_requests != self._at_work:
            self._at_work = num_requests
            self._queue.put(None)

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
            waiting, cached = self.num_waiting, self._cache_bytes
            self._series.show(at_work=self._at_work, waiting=waiting, cached=cached, is_served=is_served)
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
        self._gauges = {
            name: self._family(name, GAUGE, description).Metric(labels=dict(labels))
            for name, description in _GAUGES.items()
        }
        self._shown = dict.fromkeys(_GAUGES, -1)
        info = self._family("checkpoint_info", GAUGE, "1: the checkpoint is served.")
        model = {name: labels[name] for name in ("model", "version")}
        self._checkpoint = info.Metric(labels={**model, **checkpoint})
        self.show(at_work=0, waiting=0, cached=0, is_served=True)

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

    def show(self, *, at_work: int, waiting: int, cached: int, is_served: bool) -> None:
        """Sets the gauges whose values have changed."""
        for name, value in {BATCH_REQUESTS: at_work, WAITING_REQUESTS: waiting, CACHE_BYTES: cached}.items():
            if value != self._shown[name]:
                self._gauges[name].set(value)
                self._shown[name] = value
        # Every time: where a model is reloaded, the instance that goes says 0 when the one that comes has said 1.
        self._checkpoint.set(float(is_served))


def _drained(queue: SimpleQueue[Counted | None]) -> list[Counted | None]:
    drained: list[Counted | None] = []
    with suppress(Empty):
        while True:
            drained.append(queue.get_nowait())
    return drained
