# SPDX-License-Identifier: MIT
"""The configurations that an export writes, without weights: the wire contract, instances, caches, batches, graphs."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from google.protobuf import text_format
from tritonclient.grpc import model_config_pb2 as pb

import goldens
from engines import serve_config
from reward_models import ROOT
from rfm import published
from rfm.config import ExportConfig
from rfm_client.contract import wire
from rfm_export import ExportError
from rfm_export.layout import Version, generated_models
from rfm_export.pbtxt import render
from rfm_export.source import Source, read_for_export, saturating_samples, with_batch_size
from vlm import BFLOAT16, load

EMBEDDINGS, FRAMES, VLM = (goldens.config(name) for name in ("c1_t1_disc10", "enc_c1_t1_disc10", "q3_tok_disc10"))
CACHE = "feature_cache_mib"


def ignore(line: str) -> None:
    pass


@functools.cache
def source(name: str) -> Source:
    config = goldens.config(name)
    return read_for_export(config.checkpoint, serve_config(config), None, None, ignore, other_machine=True)


def models(config: goldens.Config, **changes: Any) -> dict[str, pb.ModelConfig]:
    """The configurations of an export, as Triton parses them."""
    read = source(config.name)
    settings = with_batch_size(replace(serve_config(config), **changes), read.checkpoint, ignore)
    version = Version(1, settings, settings.num_gpus or 0, read.family.name)
    made = generated_models(read.description, read.of_encoders, version)
    return {each.name: text_format.Parse(render(each.config), pb.ModelConfig()) for each in made}


def dims(tensors: Any) -> dict[str, tuple[str, list[int]]]:
    return {t.name: (pb.DataType.Name(t.data_type).removeprefix("TYPE_"), list(t.dims)) for t in tensors}


def test_the_scorers_configuration_is_the_wire_contract() -> None:
    (config,) = models(EMBEDDINGS).values()
    assert (config.name, config.backend, config.max_batch_size) == ("rfm", "python", 64)
    assert dims(config.input) == {
        "sample_type": ("UINT8", [1]),
        "num_frames": ("INT32", [2]),
        "frame_steps": ("INT32", [1]),
        "video_embeddings": ("FP32", [-1, 768]),
        "text_embedding": ("FP32", [384]),
    }
    assert dims(config.output) == {
        "progress": ("FP32", [-1]),
        "success": ("FP32", [-1]),
        "preference": ("FP32", [1]),
        "similarity": ("FP32", [1]),
        "progress_logits": ("FP32", [-1, 10]),
        "timing_ms": ("FP32", [2]),
    }
    assert [tensor.name for tensor in config.input if tensor.allow_ragged_batch] == ["video_embeddings"]
    batching = config.dynamic_batching
    assert not batching.max_queue_delay_microseconds  # a delay would cost every lone request
    assert not batching.HasField("default_queue_policy")
    assert not config.HasField("sequence_batching")
    assert [warmup.name for warmup in config.model_warmup] == ["progress", "preference", "similarity"]


def test_a_model_s_config_has_only_outputs_and_warmups_that_its_checkpoint_supports() -> None:
    config = models(goldens.config("legacy_keys_l2"), max_queue_size=7, queue_timeout_ms=250)["rfm"]
    assert "progress_logits" not in dims(config.output)
    # by default the queue is not bounded: with a bound, Triton 2.51 at times notices a free instance half a second late
    policy = config.dynamic_batching.default_queue_policy
    assert (policy.max_queue_size, policy.default_timeout_microseconds) == (7, 250_000)
    assert policy.allow_timeout_override
    warmups = models(goldens.config("robometer_c1_t1_disc10"))["rfm"].model_warmup
    assert [warmup.name for warmup in warmups] == ["progress", "preference"]


def test_frames_go_through_the_encoder_into_the_scorer() -> None:
    exported = models(FRAMES, name="video")
    encoder, ensemble = exported["video_encoder"], exported["video_frames"]
    assert dims(encoder.output) == {"video_embeddings": ("FP32", [-1, 48]), "text_embedding": ("FP32", [32])}
    ragged = [tensor.name for tensor in encoder.input if tensor.allow_ragged_batch]
    assert ragged == ["frames", "second_frames", "frame_digests"]
    for config in (encoder, ensemble):
        assert [tensor.name for tensor in config.input if tensor.optional] == ["second_frames", "frame_digests"]
    assert dims(ensemble.input) == {
        "sample_type": ("UINT8", [1]),
        "num_frames": ("INT32", [2]),
        "frame_steps": ("INT32", [1]),
        "frames": ("UINT8", [-1, -1, -1, 3]),
        "second_frames": ("UINT8", [-1, -1, -1, 3]),
        "frame_digests": ("UINT8", [-1, 32]),
        "task": ("STRING", [1]),
    }
    steps = [(step.model_name, step.model_version) for step in ensemble.ensemble_scheduling.step]
    assert steps == [("video_encoder", 1), ("video", 1)]
    assert dims(ensemble.output) == dims(exported["video"].output)


def test_two_instances_a_gpu_or_one_on_the_cpu() -> None:
    """Two instances of a network over embeddings: one scores while the other reads."""
    for num_gpus, expected in {
        0: (pb.ModelInstanceGroup.KIND_CPU, 1, []),
        2: (pb.ModelInstanceGroup.KIND_GPU, 2, [0, 1]),
    }.items():
        (group,) = models(EMBEDDINGS, num_gpus=num_gpus)["rfm"].instance_group
        assert (group.kind, group.count, list(group.gpus)) == expected


@pytest.mark.parametrize(("config", "holder"), [(FRAMES, "rfm_encoder"), (VLM, "rfm_frames")], ids=["ReWiND", "VLM"])
def test_frame_references_need_a_single_cache_since_triton_chooses_the_gpu(config: goldens.Config, holder: str) -> None:
    for num_gpus in (0, 1, 2, 8):
        exported = models(config, num_gpus=num_gpus)
        takes = {name for name, each in exported.items() if wire.FRAME_DIGESTS in dims(each.input)}
        assert takes == ({holder, "rfm_frames"} if num_gpus < 2 else set())
        assert exported[holder].parameters[CACHE].string_value == "256"


def test_two_instances_on_a_gpu_have_no_cache_to_name_frames_of() -> None:
    model = models(VLM, num_gpus=1, instances=2)["rfm_frames"]
    assert wire.FRAME_DIGESTS not in dims(model.input)
    assert CACHE not in model.parameters


def test_a_configuration_names_graphs_only_if_they_are_on() -> None:
    for cuda_graphs in (False, True):
        assert (
            "cuda_graphs" in models(VLM, num_gpus=1, cuda_graphs=cuda_graphs)["rfm_frames"].parameters
        ) is cuda_graphs
    refused = {
        VLM: "cuda_graphs: expected an export for GPUs, got one for the CPU",
        EMBEDDINGS: r"cuda_graphs: expected an RFM, .*leave out --cuda-graphs$",
    }
    for config, message in refused.items():
        settings = replace(serve_config(config), cuda_graphs=True)
        with pytest.raises(ExportError, match=message):
            read_for_export(config.checkpoint, settings, None, None, ignore, other_machine=True)


# The batch that saturates a GPU, from the work of a typical sample.

QWEN3_4B = {  # Qwen3-VL-4B-Instruct
    "text_config": {
        "hidden_size": 2560, "intermediate_size": 9728, "num_attention_heads": 32, "num_key_value_heads": 8,
        "head_dim": 128, "num_hidden_layers": 36,
    },
    "vision_config": {
        "hidden_size": 1024, "intermediate_size": 4096, "depth": 24, "num_heads": 16, "out_hidden_size": 2560,
        "deepstack_visual_indexes": [5, 11, 17], "num_position_embeddings": 2304,
    },
}  # fmt: skip
TEXT_2B = {"hidden_size": 2048, "intermediate_size": 6144, "num_attention_heads": 16, "num_hidden_layers": 28}


def of_real_size(checkpoint: Any, text: Mapping[str, int] | None = None) -> Any:
    """A small reference checkpoint that claims the network of Qwen3-VL-4B or ``text``. The weights are not read."""
    sizes = {part: {**checkpoint.config.backbone[part], **QWEN3_4B[part]} for part in QWEN3_4B}
    sizes["text_config"] |= text or {}
    sizes["vision_config"]["out_hidden_size"] = sizes["text_config"]["hidden_size"]
    return replace(checkpoint, config=replace(checkpoint.config, backbone={**checkpoint.config.backbone, **sizes}))


def batch_size(checkpoint: Any) -> tuple[int | None, list[str]]:
    """The derived size, and what is said about it."""
    told: list[str] = []
    return with_batch_size(ExportConfig(), checkpoint, told.append).max_batch_size, told


def test_a_robometer_is_scored_as_its_size_and_clips_allow_and_the_export_says_why() -> None:
    whole = of_real_size(load(BFLOAT16))
    size, (line,) = batch_size(whole)
    assert size == 4
    assert line.startswith("max_batch_size is 4: one sample of 8 frames of 224x224 takes 5.5 TFLOP, and a GPU is ")
    assert line.endswith("saturated at about 20 (--max-batch-size sets another number)")
    assert batch_size(of_real_size(load(BFLOAT16), TEXT_2B))[0] == 8
    assert batch_size(replace(whole, config=replace(whole.config, trained_frames=16)))[0] == 2


@pytest.mark.parametrize(
    ("folder", "reward_model", "expected"),
    [
        ("roboreward/rr_tied_bf16/checkpoint", "roboreward", 2),
        ("topreward/checkpoints/vlm_fp32_untied", "topreward", 4),
        ("topreward/checkpoints/vlm_fp32_untied", "topreward-robometer", 1),
    ],
)
def test_models_of_4b_that_are_asked_in_words(folder: str, reward_model: str, expected: int) -> None:
    assert batch_size(of_real_size(published.load(ROOT / folder, reward_model=reward_model)))[0] == expected


@pytest.mark.parametrize("name", ["c1_t1_disc10", "q3_tok_disc10", "q25_video_avg_disc10"])
def test_a_small_network_keeps_batches_of_64_without_a_line(name: str) -> None:
    config = goldens.config(name)
    assert batch_size(published.load(config.checkpoint, **config.sources)) == (64, [])


def test_the_number_is_at_least_1_and_at_most_64() -> None:
    assert [saturating_samples(flop) for flop in (0.0, 1e9, 5e12, 6e12, 1e15)] == [64, 64, 4, 4, 1]
