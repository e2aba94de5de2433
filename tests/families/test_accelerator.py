# SPDX-License-Identifier: MIT
"""Both families and the encoders on a GPU that PyTorch pretends to have: the CPU's numbers, and few waits of the host."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

import goldens
from engines import TRANSFORMERS, load_engine
from pretended import CUDA, Seen, pretended
from rfm import families
from rfm.engine import Engine
from rfm.engine.execution import Execution
from rfm.triton_model.placement import Placement
from rfm_client import PreferenceSample, ProgressSample, Sample
from vlm import PLAIN, assert_close, film


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Iterator[Seen]:
    with pretended(monkeypatch) as seen:
        yield seen


def engine_there(config: goldens.Config, feature_cache_mb: int = 0) -> Engine:
    """The engine of a reference checkpoint on the device."""
    sources = {name: getattr(config, name) for name in ("base_model", "image_encoder", "text_encoder")}
    given = {name: str(source) for name, source in sources.items() if source is not None}
    checkpoint = families.load(config.checkpoint, **given)
    options = {"device": CUDA, "dtype": torch.float32, "feature_cache_mb": feature_cache_mb}
    with torch.inference_mode():  # what is made in it needs no views that count versions
        return Engine.of(checkpoint, encoders=checkpoint.encoders(), **options)


@pytest.mark.parametrize(
    "config", [*goldens.REWIND, *goldens.WITH_ENCODERS, *goldens.VLM], ids=lambda config: config.name
)
def test_a_device_gives_every_reference_answer(seen: Seen, config: goldens.Config) -> None:
    if config.name.startswith("smol") and TRANSFORMERS >= 5:
        pytest.skip("SmolVLM is refused with transformers 5")
    engine = engine_there(config)
    for case in config.cases():
        if not case.is_refused:
            results = [each for each in engine.evaluate(case.samples()) if not isinstance(each, Exception)]
            for result, expected in zip(results, case.expected(), strict=True):
                goldens.check(result, expected, case.tolerances)
    assert seen.num_operators > 100


# How often the host waits in a batch like one that was scored before: for values, and for copies to the device.
WAITS = {
    "c1_t1_disc10": (5, 11),  # progress, its logits, success, questions twice; the parts of a batch
    "legacy_keys_l2": (4, 11),
    "enc_c1_t1_disc10": (12, 16),
    # All scores are read at once; for SmolVLM transformers looks for images of zeros.
    **{config.name: (40 if config.name.startswith("smol") else 1, 0) for config in goldens.VLM},
}


@pytest.mark.parametrize(("name", "waits"), WAITS.items(), ids=WAITS)
def test_the_host_waits_for_a_batch_no_more_often_than_it_must(seen: Seen, name: str, waits: tuple[int, int]) -> None:
    config = goldens.config(name)
    engine = engine_there(config)
    samples = next(case for case in config.cases() if not case.is_refused).samples()
    engine.evaluate(samples)
    asked, awaited = seen.asked.total(), seen.awaited
    engine.evaluate(samples)
    assert seen.asked.total() - asked <= waits[0]
    assert seen.awaited - awaited <= waits[1]


MIXED: list[Sample] = [
    ProgressSample(film(0, 3, 64, 64)),
    PreferenceSample(film(1, 2, 64, 96), film(2, 3, 64, 64)),
    ProgressSample(film(3, 4, 140, 56), frame_steps=3),
]


@pytest.mark.parametrize("name", [PLAIN, "q25_video_avg_disc10", "smol_mean_disc10"])
@pytest.mark.slow
def test_batches_that_are_collated_while_others_are_scored_have_the_cpu_s_scores(seen: Seen, name: str) -> None:
    engine = engine_there(goldens.config(name), feature_cache_mb=1)
    engine.token_budget = 100
    for _ in range(2):  # the second time, what was made of frames is kept on the device
        for result, expected in zip(engine.evaluate(MIXED), load_engine(name).evaluate(MIXED), strict=True):
            assert_close(result, expected, 1e-5)
    if not name.startswith("smol"):
        assert seen.calls.count("Stream") == 1
        assert {"pin_memory", "stream", "wait_stream", "record_stream"} <= {*seen.calls}


def test_a_lack_of_memory_frees_what_pytorch_keeps(seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    engine, network_refuses = engine_there(goldens.config(PLAIN)), iter([True, False, False])
    network: Any = engine.predictor.network
    forward = network.forward

    def refusing(batch: Any) -> Any:
        if next(network_refuses):
            raise torch.OutOfMemoryError("made up")
        return forward(batch)

    monkeypatch.setattr(network, "forward", refusing)
    execution = Execution()
    for result, expected in zip(
        engine.evaluate(MIXED[:2], execution), load_engine(PLAIN).evaluate(MIXED[:2]), strict=True
    ):
        assert_close(result, expected, 1e-5)
    assert (execution.out_of_memory_count, seen.calls.count("empty_cache")) == (1, 1)


def test_a_thread_that_computes_is_told_its_device(seen: Seen) -> None:
    Placement(CUDA, 1).apply()
    Placement(torch.device("cpu"), 1).apply()
    assert seen.calls == ["set_device"]


@pytest.mark.parametrize(
    "mix",
    [lambda here, there: here + there, lambda here, there: there[here.long()], torch.matmul],
    ids=["+", "[]", "@"],
)
def test_the_pretended_device_refuses_tensors_of_two_places(seen: Seen, mix: Callable[..., object]) -> None:
    with torch.inference_mode(), pytest.raises(RuntimeError, match="expected all tensors to be on the same device"):
        mix(torch.ones(2, 2), torch.ones(2, 2).to(CUDA))
