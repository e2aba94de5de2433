# SPDX-License-Identifier: MIT
"""Both families and the encoders on pretended GPUs: the CPU's numbers, and few waits of the host."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

import goldens
from engines import load_engine
from pretended import CUDA, SECOND, Seen, pretended
from reward_models import ROOT, references
from rfm import published
from rfm.engine import Engine
from rfm.triton_model.placement import Placement
from rfm_client import PreferenceSample, ProgressSample, Sample
from vlm import PLAIN, assert_close, video


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Iterator[Seen]:
    with pretended(monkeypatch) as seen:
        yield seen


def engine_there(name: str, feature_cache_mib: int = 0, device: torch.device = CUDA) -> Engine:
    """The engine of a reference checkpoint on a device."""
    config = goldens.config(name)
    loaded = published.read(config.checkpoint, **config.sources)
    options = {"device": device, "dtype": torch.float32, "feature_cache_mib": feature_cache_mib}
    with torch.inference_mode():  # tensors made in it need no version counters
        return Engine.of(loaded.checkpoint, encoders=loaded.encoders(), **options)


# Waits of the host in a batch like an earlier one: for values, and for copies to the device.
# Vision-language models read all scores at once.
WAITS = {
    "c1_t1_disc10": (5, 11),  # progress, logits, success, questions twice; the parts of a batch
    "legacy_keys_l2": (4, 11),
    "enc_c1_t1_disc10": (8, 15),
    **{config.name: (1, 0) for config in goldens.VLM},
}


DIFFERENT = (  # each has operators of its own
    "c1_t1_disc10", "legacy_keys_l2", "enc_c1_t1_disc10", PLAIN, "q25_attention_disc10", "q25_video_last_l2",
)  # fmt: skip


@pytest.mark.parametrize("config", [goldens.config(name) for name in DIFFERENT], ids=lambda config: config.name)
def test_a_device_gives_the_reference_answers_and_waits_no_more_often_than_it_must(
    seen: Seen, config: goldens.Config
) -> None:
    """The network is on the second device, not the current one; no tensor may lie elsewhere."""
    engine = engine_there(config.name, device=SECOND)
    cases = [case for case in config.cases() if not case.is_refused]
    for case in [*cases[:1], *(case for case in cases if "mixed" in case.file.stem)]:
        for result, expected in zip(engine.evaluate(case.samples()), case.expected(), strict=True):
            goldens.check(result, expected, case.tolerances)
    assert seen.num_operators > 100
    assert {*seen.made_on} == {SECOND}
    for _ in range(2):
        asked, awaited = seen.asked.total(), seen.awaited
        engine.evaluate(cases[0].samples())
    if config.name in WAITS:
        assert seen.asked.total() - asked <= WAITS[config.name][0]
        assert seen.awaited - awaited <= WAITS[config.name][1]


@pytest.mark.parametrize("name", ["topreward", "topreward-robometer", "roboreward", "roboreward-expected"])
def test_reward_models_that_are_asked_in_words_stay_on_their_device(seen: Seen, name: str) -> None:
    of_topreward = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied"
    folder = of_topreward if name.startswith("topreward") else references("roboreward")[0].config / "checkpoint"
    checkpoint = published.load(folder, reward_model=name)
    sample = ProgressSample(video(0, 4, 64, 64))
    with torch.inference_mode():
        engine = Engine.of(checkpoint, device=SECOND, dtype=torch.float32, feature_cache_mib=1)
    for _ in range(2):
        (result,) = engine.evaluate([sample])
        (expected,) = Engine.of(checkpoint).evaluate([sample])
        assert type(result) is type(expected)
    assert {*seen.made_on} == {SECOND}


MIXED: list[Sample] = [
    ProgressSample(video(0, 3, 64, 64)),
    PreferenceSample(video(1, 2, 64, 96), video(2, 3, 64, 64)),
    ProgressSample(video(3, 4, 140, 56), frame_steps=3),
]


@pytest.mark.parametrize("name", [PLAIN, "q25_video_avg_disc10"])
@pytest.mark.slow
def test_batches_that_are_collated_while_others_are_scored_have_the_cpu_s_scores(seen: Seen, name: str) -> None:
    engine = engine_there(name, feature_cache_mib=1)
    engine.token_budget = 100
    for _ in range(2):  # the second time, frame features are on the device
        for result, expected in zip(engine.evaluate(MIXED), load_engine(name).evaluate(MIXED), strict=True):
            assert_close(result, expected, 1e-5)
    assert seen.calls.count("Stream") == 1
    assert {"pin_memory", "stream", "wait_stream", "record_stream"} <= {*seen.calls}


def test_a_computing_thread_sets_its_cuda_device(seen: Seen) -> None:
    Placement(CUDA, 1).apply()
    Placement(torch.device("cpu"), 1).apply()
    assert seen.calls == ["set_device"]
