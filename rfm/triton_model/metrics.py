# SPDX-License-Identifier: MIT
"""The ``rfm_*`` metrics of a model instance, on Triton's metrics endpoint.

An update calls Triton's process and takes about 20 us. Requests therefore only add to sums; a thread reports the sums
every FLUSH_INTERVAL_S.
"""

from __future__ import annotations

import ctypes
import logging
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

from rfm.engine.execution import Execution
from rfm.triton_model.request import OUTCOMES, SCORED, UNKNOWN_TYPE, Request

logger = logging.getLogger(__name__)

FLUSH_INTERVAL_S = 0.25

SAMPLES_BUCKETS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
PADDING_BUCKETS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
BUCKETS_S = tuple(digit * 10.0**power for power in range(-4, 2) for digit in (1, 2, 5))  # 0.1 ms to 50 s

FRAMES, RETRIES = "frames_total", "out_of_memory_retries_total"
BATCH_SAMPLES, BATCH_PADDING = "batch_samples", "batch_padding_ratio"
COLLATE_SECONDS, FORWARD_SECONDS = "collate_seconds", "forward_seconds"
ENCODED, FOUND, MISSED = "frames_encoded_total", "feature_cache_hits_total", "feature_cache_misses_total"
UNCLEAR, UNREADABLE = "unclear_answers_total", "unreadable_answers_total"
PASSES = "forward_passes_total"  # shows progress, so that ``rfm serve`` can distinguish a long batch from a hang

_TOTALS = {
    FRAMES: "Frames scored.",
    RETRIES: "Forward passes that ran out of memory and were repeated in halves.",
    UNCLEAR: "Written answers whose score is unclear.",
    UNREADABLE: "Written answers without a score, each an error.",
    ENCODED: "Frames that went through an encoder or a vision tower.",
    FOUND: "Distinct frames of a batch whose features were in the cache.",
    PASSES: "Forward passes, and batches begun.",
    MISSED: "Distinct frames of a batch whose features were not in the cache.",
}
_HISTOGRAMS = {
    BATCH_SAMPLES: ("Samples of one execution.", SAMPLES_BUCKETS),
    BATCH_PADDING: ("Share of the token slots of an execution's forward passes that were padding.", PADDING_BUCKETS),
    COLLATE_SECONDS: ("Time of one execution outside of its forward passes.", BUCKETS_S),
    FORWARD_SECONDS: ("Time of one execution's forward passes.", BUCKETS_S),
}


class InstanceMetrics:
    """Metrics of an instance. Must be closed. Only the first error is logged; no error fails a request.

    labels: labels of the instance
    checkpoint: labels for rfm_checkpoint_info
    sample_types: sample types that the model scores
    num_steps: returns how many forward passes have run so far
    """

    def __init__(
        self,
        labels: Mapping[str, str],
        checkpoint: Mapping[str, str],
        sample_types: Collection[str],
        num_steps: Callable[[], int],
    ) -> None:
        self._num_steps, self._num_reported_steps = num_steps, num_steps()
        self._lock = threading.Lock()  # guards the sums below
        self._samples: Counter[tuple[str, str]] = Counter()
        self._totals: Counter[str] = Counter()
        self._observed: list[tuple[str, float]] = []
        self._kept_bytes = 0
        self._has_failed = False
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        try:
            self._make_all(dict(labels), checkpoint, sample_types)
        except Exception:  # noqa: BLE001  a Triton without metrics serves all the same
            self._log_once()
            return
        self._thread = threading.Thread(target=self._flush_for_ever, name="rfm-metrics", daemon=True)
        self._thread.start()

    def add(self, batch: Iterable[Request[Any]], execution: Execution) -> None:
        """Count a batch and its cost, without warm-ups and probes."""
        if self._thread is None:
            return
        counted = [request for request in batch if request.is_counted]
        with self._lock:
            for request in counted:
                for sample_type, count in request.sample_types.items():
                    self._samples[sample_type, request.outcome] += count
            self._totals[FRAMES] += sum(request.num_frames for request in counted if request.outcome == SCORED)
            self._totals[RETRIES] += execution.out_of_memory_count
            self._totals[UNCLEAR] += execution.num_unclear if counted else 0
            self._totals[UNREADABLE] += execution.num_unreadable if counted else 0
            self._totals[ENCODED] += execution.num_encoded
            self._totals[FOUND] += execution.num_found
            if execution.cache_bytes is not None:
                self._totals[MISSED] += execution.num_encoded
                self._kept_bytes = execution.cache_bytes or self._kept_bytes
            num_executed = sum(len(request.answers) for request in counted)
            if num_executed and execution.num_slots:  # a forward pass for a caller
                self._observed += [
                    (BATCH_SAMPLES, num_executed),
                    (BATCH_PADDING, execution.padding_ratio),
                    (COLLATE_SECONDS, execution.collate_s),
                    (FORWARD_SECONDS, execution.forward_s),
                ]

    def close(self) -> None:
        """Report the last sums, and that the checkpoint is no longer served."""
        if self._thread is not None:
            self._closing.set()
            self._thread.join()
            self._flush(is_served=False)

    def _make_all(self, labels: dict[str, str], checkpoint: Mapping[str, str], sample_types: Collection[str]) -> None:
        """Create the metrics in Triton's process, where they outlive this process and continue after a reload.

        Never destroy a metric or its family: after ``finalize`` that would crash this process, and earlier it would
        remove the series under an instance that was loaded to replace this one.
        """
        samples = self._family("samples_total", "COUNTER", "Samples, by the outcome of their request.")
        self._sample_metrics = {  # all at once, so that the first failure is an increase
            (sample_type, outcome): samples.Metric(labels={**labels, "sample_type": sample_type, "outcome": outcome})
            for sample_type in (*sample_types, UNKNOWN_TYPE)
            for outcome in OUTCOMES
        }
        self._total_metrics = {
            name: self._family(name, "COUNTER", description).Metric(labels=labels)
            for name, description in _TOTALS.items()
        }
        self._histograms = {
            name: self._family(name, "HISTOGRAM", description).Metric(labels=labels, buckets=list(buckets))
            for name, (description, buckets) in _HISTOGRAMS.items()
        }
        kept = self._family("feature_cache_bytes", "GAUGE", "Bytes of cached features.")
        self._kept_metric = kept.Metric(labels=labels)
        info = self._family("checkpoint_info", "GAUGE", "1: the checkpoint is served.")
        model = {name: labels[name] for name in ("model", "version")}
        self._checkpoint_metric = info.Metric(labels={**model, **checkpoint})
        self._show(is_served=True)

    def _family(self, name: str, kind: str, description: str) -> Any:
        import triton_python_backend_utils as pb_utils

        kind = getattr(pb_utils.MetricFamily, kind)
        family = pb_utils.MetricFamily(name=f"rfm_{name}", description=description, kind=kind)
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(family))
        return family

    def _flush_for_ever(self) -> None:
        while not self._closing.wait(FLUSH_INTERVAL_S):
            self._flush(is_served=True)

    def _flush(self, *, is_served: bool) -> None:
        """Report what has accumulated since the last call."""
        with self._lock:
            samples, self._samples = self._samples, Counter()
            totals, self._totals = self._totals, Counter()
            observed, self._observed = self._observed, []
        num_steps = self._num_steps()
        totals[PASSES], self._num_reported_steps = num_steps - self._num_reported_steps, num_steps
        try:
            for key, count in samples.items():
                self._sample_metrics[key].increment(count)
            for name, total in totals.items():
                if total:
                    self._total_metrics[name].increment(total)
            for name, value in observed:
                self._histograms[name].observe(value)
            self._show(is_served=is_served)
        except Exception:  # noqa: BLE001  requests are answered all the same
            self._log_once()

    def _show(self, *, is_served: bool) -> None:
        self._kept_metric.set(self._kept_bytes)
        # Set at every flush: after a reload, the old instance sets 0 after the new instance has set 1.
        self._checkpoint_metric.set(float(is_served))

    def _log_once(self) -> None:
        if not self._has_failed:
            self._has_failed = True
            logger.exception("metrics cannot be reported")
