# SPDX-License-Identifier: MIT
from __future__ import annotations

import inspect
import json
import math
import os
import re
import shutil
import socket
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

import goldens
import local_hub
import reward_models
from rfm import families
from rfm.families import CheckpointError
from spoilt import Spoil, conversion, convert, copied, in_json, settings, text, weights

CONTINUOUS = "legacy_keys_l2"  # lacks causal_mask and use_per_frame_progress_token
MISMATCHED = "h40_L3_H5_c1_t1_disc5_cfgmismatch"  # the configs say l2 and 32 bins, the weights 5 bins
IN_RUN_FOLDER = "c1_t1_disc10"  # config.yaml in the parent folder
WITH_IMAGES = "q3_tok_disc10"  # vision-language: every frame an image, with a progress token
ADAPTER = "q25_peft_adapter_disc10"
ENCODED = "enc_c1_t1_disc10"
TAG = "best-p-rank-0.8500-step-123"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of a reference checkpoint for a test to spoil."""
    return copied(goldens.config(CONTINUOUS), tmp_path / "checkpoint")


def test_weights_decide_where_configurations_disagree() -> None:
    config = families.load(goldens.config(MISMATCHED).checkpoint).config
    assert (config.progress_bins, config.max_len, config.num_layers, config.hidden_dim) == (5, 10, 3, 40)
    assert (config.video_feature_dim, config.text_feature_dim) == (256, 96)
    assert config.use_per_frame_progress_token


@pytest.mark.parametrize("place", ["config.yml", ".hydra/config.yaml", "../config.yml", "../.hydra/config.yaml"])
def test_config_yaml_may_be_called_otherwise(folder: Path, place: str) -> None:
    expected = families.load(folder).config
    target = folder / place
    target.parent.mkdir(exist_ok=True)
    (folder / "config.yaml").rename(target)
    assert families.load(folder).config == expected


OTHER_RUNS = {
    "a vision-language one": (CONTINUOUS, WITH_IMAGES, "whose network is 'rewind_transformer', got model.base_model_id 'Qwen/"),
    "a ReWiND one": (WITH_IMAGES, CONTINUOUS, "whose network is 'qwen3_vl', got model.base_model_id 'rewind_transformer'"),
    "one of another backbone": ("q25_mean_l2", WITH_IMAGES, "whose network is 'qwen2_5_vl', got model.base_model_id 'Qwen/Qwen3-VL"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "other", "message"), OTHER_RUNS.values(), ids=OTHER_RUNS)
def test_config_yaml_of_another_run_above_the_checkpoint_is_refused(
    tmp_path: Path, name: str, other: str, message: str
) -> None:
    golden, above = goldens.config(name), goldens.config(other)
    run = next(file for file in above.checkpoint.parent.rglob("config.yaml"))
    folder = copied(golden, tmp_path / "checkpoint")
    own = folder / "config.yaml"
    own = own if own.exists() else golden.checkpoint.parent / "config.yaml"
    right = own.read_text()
    (folder / "config.yaml").unlink(missing_ok=True)
    shutil.copyfile(run, tmp_path / "config.yaml")
    with pytest.raises(CheckpointError) as refusal:
        families.load(folder, base_model=str(golden.base_model))
    told = f"{tmp_path}/config.yaml: expected the run of {folder}, {message}"
    assert str(refusal.value).startswith(told)
    assert str(refusal.value).endswith(f"; copy the run's config.yaml into {folder}, also if it is this one")
    (folder / "config.yaml").write_text(right)
    families.load(folder, base_model=str(golden.base_model))


def assert_same(after: Any, before: Any) -> None:
    assert after.config == before.config
    assert after.parts["network"].keys() == before.parts["network"].keys()
    assert all(torch.equal(after.parts["network"][key], tensor) for key, tensor in before.parts["network"].items())


def renamed(change: Callable[[str], str]) -> Spoil:
    return weights(lambda tensors: [tensors.update({change(name): tensors.pop(name)}) for name in [*tensors]])


def in_fsdp(name: str) -> str:
    return f"_fsdp_wrapped_module.{name}".replace("layers.1.", "layers.1._fsdp_wrapped_module.")


OTHER_FORMS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "saved by us": (
        IN_RUN_FOLDER,
        lambda folder: (shutil.rmtree(folder), families.load(goldens.config(IN_RUN_FOLDER).checkpoint).save(folder)),
    ),
    "shards": (CONTINUOUS, lambda folder: split_into_shards(folder)),
    "an old shard of known names": (
        CONTINUOUS,
        lambda folder: extra_shard("model-00001-of-00003.safetensors", {"success_head.4.bias": torch.ones(1)})(folder),
    ),
    "no causal_mask but null": (CONTINUOUS, settings("config.json", causal_mask=None)),
    "no heads but null": (CONTINUOUS, settings("config.json", num_attention_heads=None)),
    "DataParallel": (CONTINUOUS, renamed(lambda name: f"module.{name}")),
    "torch.compile": (CONTINUOUS, renamed(lambda name: f"_orig_mod.{name}")),
    "PEFT": (CONTINUOUS, renamed(lambda name: f"base_model.model.{name}")),
    "FSDP": (CONTINUOUS, renamed(in_fsdp)),
    "FSDP of a vision-language one": (WITH_IMAGES, renamed(in_fsdp)),
    "DataParallel and torch.compile": (CONTINUOUS, renamed(lambda name: f"module._orig_mod.{name}")),
    "some layers": (CONTINUOUS, renamed(lambda name: name.replace("transformer.", "transformer._orig_mod."))),
    "Lightning": (CONTINUOUS, renamed(lambda name: f"model.{name}")),
}


@pytest.mark.parametrize(("name", "change"), OTHER_FORMS.values(), ids=OTHER_FORMS)
def test_a_checkpoint_in_another_form_is_the_same(tmp_path: Path, name: str, change: Callable[[Path], object]) -> None:
    golden = goldens.config(name)
    folder = copied(golden, tmp_path / "checkpoint")
    change(folder)
    assert_same(families.load(folder, **golden.sources), families.load(golden.checkpoint, **golden.sources))


def split_into_shards(folder: Path) -> None:
    shards, index = in_two(take_weights(folder), ("a.safetensors", "b.safetensors"))
    for name, tensors in shards.items():
        save_file(tensors, folder / name)
    (folder / "model.safetensors.index.json").write_text(index)


def take_weights(folder: Path) -> dict[str, Tensor]:
    tensors = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    return tensors


def lost_shard(folder: Path) -> None:
    split_into_shards(folder)
    (folder / "b.safetensors").unlink()


def in_two(weights: dict[str, Tensor], names: tuple[str, str]) -> tuple[dict[str, dict[str, Tensor]], str]:
    """Return the weights by shard, and the index."""
    keys = sorted(weights)
    shards = {
        name: {key: weights[key] for key in part} for name, part in zip(names, (keys[:20], keys[20:]), strict=True)
    }
    return shards, json.dumps({"metadata": {}, "weight_map": {key: name for name in names for key in shards[name]}})


def sharded_pickle(folder: Path) -> None:
    names = ("pytorch_model-00001-of-00002.bin", "pytorch_model-00002-of-00002.bin")
    shards, index = in_two(take_weights(folder), names)
    for name, tensors in shards.items():
        torch.save(tensors, folder / name)
    (folder / "pytorch_model.bin.index.json").write_text(index)


def extra_shard(name: str, tensors: dict[str, Tensor]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        split_into_shards(folder)
        save_file(tensors, folder / name)

    return spoil


def whole_and_shards(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    split_into_shards(folder)
    save_file(weights, folder / "model.safetensors")


SPOILED: dict[str, tuple[Callable[[Path], None], str]] = {
    "missing and unexpected keys": (
        weights(lambda w: w.update(surplus=w.pop("success_head.4.bias"))),
        r"missing keys: \['success_head.4.bias'\]; unexpected keys: \['surplus'\]",
    ),
    "no head of progress": (
        weights(lambda w: [w.pop(name) for name in list(w) if name.startswith("progress_head")]),
        r"expected a ReWiND checkpoint, which has 'progress_head.4.weight'",
    ),
    "another model type": (
        settings("config.json", model_type="llama"),
        r"model_type: expected rewind_transformer, by the names of the weights, got 'llama'",
    ),
    "configurations that contradict each other": (
        settings("config.json", num_attention_heads=8),
        r"num_attention_heads: expected config.json and config.yaml to agree, got",
    ),
    "heads that do not divide the width": (
        lambda folder: (
            settings("config.json", num_attention_heads=5)(folder),
            (folder / "config.yaml").unlink(),
        )[0],
        r"num_attention_heads: expected a divisor of the hidden width 32, got 5",
    ),
    "a number of heads that is no number": (
        settings("config.json", num_attention_heads="4"),
        r"num_attention_heads in config.json: expected int, got '4'",
    ),
    "no word of a causal mask, from a file that upstream did not write": (
        lambda folder: (
            in_json("config.json", lambda c: c.pop("hidden_dim"))(folder),
            (folder / "config.yaml").unlink(),
        )[0],
        r"causal_mask: expected it in config.json or model.rewind of config.yaml, got it in neither",
    ),
    "no configuration at all": (
        lambda folder: ((folder / "config.json").unlink(), (folder / "config.yaml").unlink())[0],
        r"max_len: expected it in config.json or model.rewind of config.yaml, got it in neither",
    ),
    "no weights": (
        lambda folder: (folder / "model.safetensors").unlink(),
        r"expected model.safetensors or .*, got config.*: a checkpoint's folder has it, beside config.json",
    ),
    "weights whole and in shards": (
        whole_and_shards,
        r"expected model\.safetensors or shards, got model\.safetensors and \['model\.safetensors\.index\.json'\], of which "
        r"one is older; move away what is not meant",
    ),
    "weights whole and in shards without an index": (
        lambda folder: shutil.copy(folder / "model.safetensors", folder / "model-00001-of-00002.safetensors") and None,
        r"expected model\.safetensors or shards, got model\.safetensors and \['model-00001-of-00002\.safetensors'\]",
    ),
    "a tensor in two shards": (
        lambda folder: (
            split_into_shards(folder),
            save_file(
                load_file(folder / "a.safetensors") | load_file(folder / "b.safetensors"), folder / "b.safetensors"
            ),
        )[0],
        r"expected each tensor in one shard, got 'first_embedding_A' in a\.safetensors and in b\.safetensors; save",
    ),
    "a shard that the index does not name": (
        extra_shard("model-00003-of-00003.safetensors", {"more": torch.ones(1)}),
        r"expected the names of all shards, got model-00003-of-00003\.safetensors, which it does not name, with "
        r"\['more'\]; move that file away",
    ),
    "a weight with and without a wrapper's prefix": (
        weights(lambda w: w.update({"module.success_head.4.bias": w["success_head.4.bias"] + 1})),
        r"expected each weight once, got 'success_head\.4\.bias' and",
    ),
    "pickles whole and in shards": (
        lambda folder: (shutil.copy(folder / "config.json", folder / "pytorch_model.bin"), sharded_pickle(folder))[1],
        r"expected one form of the weights, got pytorch_model\.bin and pytorch_model-00001-of-00002\.bin; move away",
    ),
    "a lost shard": (lost_shard, r"names the shard b.safetensors, which is not there"),
    "data that is no mapping": (
        text("config.yaml", "data: [1]"),
        r"config.yaml: data: expected a mapping, got \[1\]",
    ),
    "a half frame": (
        settings("config.json", trained_frames=7.5),
        r"config.json: trained_frames: expected a whole number of at least 1, got 7.5",
    ),
    "padding that is a number": (
        settings("config.json", trained_padding=1),
        r"config.json: trained_padding: expected true or false, got 1",
    ),
}


@pytest.mark.parametrize(("spoil", "message"), SPOILED.values(), ids=SPOILED)
def test_a_spoiled_checkpoint_is_refused(folder: Path, spoil: Callable[[Path], None], message: str) -> None:
    spoil(folder)
    with pytest.raises(CheckpointError, match=message):
        families.load(folder).build()


@pytest.mark.parametrize(("name", "kind"), [(CONTINUOUS, "relative"), (WITH_IMAGES, "relative_first_frame")])
def test_progress_since_the_frame_before_is_refused(tmp_path: Path, name: str, kind: str) -> None:
    golden = goldens.config(name)
    folder = copied(golden, tmp_path / "checkpoint")
    text = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(text.replace("absolute_wrt_total_frames", kind))
    expected = f"{folder}/config.yaml: data.progress_pred_type: expected absolute progress, got '{kind}': such a head"
    with pytest.raises(CheckpointError, match=re.escape(expected)):
        families.load(folder, **golden.sources)
    (folder / "config.yaml").write_text(text.replace("absolute_wrt_total_frames", "absolute_first_frame"))
    families.load(folder, **golden.sources)


OF_PROGRESS = {
    "of all frames": ("progress_pred_type: absolute_wrt_total_frames", "", []),
    "from the first frame": (
        "progress_pred_type: absolute_first_frame",
        "",
        ["config.yaml: data.progress_pred_type is absolute_first_frame: progress is 0 at the first frame that the model "],
    ),
    "shuffled": (
        "progress_pred_type: absolute_wrt_total_frames",
        "shuffle_progress_frames: true",
        ["config.yaml: data.shuffle_progress_frames is true: the run shuffled all frames but the first, so "],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "order", "told"), OF_PROGRESS.values(), ids=OF_PROGRESS)
@pytest.mark.parametrize("name", [CONTINUOUS, WITH_IMAGES])
def test_what_the_run_took_for_progress_is_told(
    tmp_path: Path, name: str, kind: str, order: str, told: list[str]
) -> None:
    golden = goldens.config(name)
    folder = copied(golden, tmp_path / "checkpoint")
    text = (folder / "config.yaml").read_text()
    text = text.replace("progress_pred_type: absolute_wrt_total_frames", kind)
    (folder / "config.yaml").write_text(text.replace("shuffle_progress_frames: false", order) if order else text)
    checkpoint = families.load(folder, **golden.sources)
    notes = families.notes(folder, checkpoint)
    assert [line[: len(begins)] for line in notes for begins in told if "config.yaml: data." in line] == told
    assert len([line for line in notes if "config.yaml: data." in line]) == len(told)
    assert not [line for line in families.notes(folder, checkpoint, ["success"]) if "config.yaml: data." in line]


STATES = ("optimizer.pt", "scheduler.pt", "rng_state.pth", "rng_state_0.pth", "training_args.bin", "scaler.pt")


def sharing_memory(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Share memory between tensors, like tied weights; safetensors files cannot."""
    both = torch.stack([weights["first_embedding_A"], weights["first_embedding_B"]])
    return weights | {"first_embedding_A": both[0], "first_embedding_B": both[1]}


def pickled(name: str, wrap: Callable[[dict[str, Tensor]], object]) -> Spoil:
    return lambda folder: torch.save(wrap(take_weights(folder)), folder / name)


PICKLES: dict[str, tuple[Spoil, str]] = {
    "of transformers": (pickled("pytorch_model.bin", dict), "pytorch_model.bin"),
    "shards": (
        lambda folder: sharded_pickle(folder),
        "pytorch_model-00001-of-00002.bin, pytorch_model-00002-of-00002.bin",
    ),
    "of Lightning": (
        pickled("epoch=3.ckpt", lambda weights: {"epoch": 3, "state_dict": weights, "callbacks": {}}),
        "epoch=3.ckpt",
    ),
    "with the arguments of the run": (
        pickled("last.pth", lambda weights: {"args": Namespace(max_length=16), "model_state_dict": weights}),
        "last.pth",
    ),
    "weights that share memory": (pickled("model.pt", sharing_memory), "model.pt"),
}


@pytest.mark.parametrize(("spoil", "named"), PICKLES.values(), ids=PICKLES)
def test_the_conversion_that_the_refusal_of_a_pickle_names_works(folder: Path, spoil: Spoil, named: str) -> None:
    before = families.load(folder)
    spoil(folder)
    for state in STATES:
        torch.save({"state": {}}, folder / state)
    expected = rf"expected model\.safetensors, got {re.escape(named)}: pickles may run .* weights_only=True lets "
    with pytest.raises(CheckpointError, match=expected):
        families.load(folder)
    convert(families.load, folder)
    assert_same(families.load(folder), before)


def test_the_conversion_of_a_pickled_adapter_works(tmp_path: Path) -> None:
    golden = goldens.config(ADAPTER)
    load = partial(families.load, **golden.sources)
    folder = copied(golden, tmp_path / "checkpoint")
    torch.save(load_file(folder / "adapter_model.safetensors"), folder / "adapter_model.bin")
    (folder / "adapter_model.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"expected adapter_model\.safetensors, got adapter_model\.bin: pickles"):
        load(folder)
    convert(load, folder)
    assert_same(load(folder), load(golden.checkpoint))


def test_a_base_model_whose_weights_are_whole_and_in_shards_is_refused(tmp_path: Path) -> None:
    golden = goldens.config(ADAPTER)
    base = shutil.copytree(golden.sources["base_model"], tmp_path / "base", copy_function=shutil.copyfile)
    (base / "model.safetensors.index.json").write_text('{"weight_map": {}}')
    expected = r"/base: expected model\.safetensors or shards, got model\.safetensors and"
    with pytest.raises(CheckpointError, match=expected):
        families.load(golden.checkpoint, base_model=str(base))


def test_the_command_that_strips_a_prefix_works_in_a_shell(folder: Path) -> None:
    before = families.load(folder)
    renamed(lambda name: name if name.startswith("video") else f"student.{name}")(folder)
    expected = (
        "got 'student.progress_head.4.weight', with the prefix student. that 'video_proj.bias' lacks; strip it with"
    )
    with pytest.raises(CheckpointError, match=re.escape(expected)):
        families.load(folder)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    command = ["bash", "-c", conversion(families.load, folder)]
    subprocess.run(command, check=True, env={**os.environ, "PATH": path})
    assert_same(families.load(folder), before)


NO_NUMBERS = {
    "a head": (CONTINUOUS, "", "success_head.4.bias", math.inf),
    "the last of a head's last layer": (WITH_IMAGES, "", "progress_head.4.weight", -math.inf),
    "a weight": (CONTINUOUS, "", "transformer.layers.0.norm1.weight", math.nan),
    "a weight of an encoder": (ENCODED, "", "image_encoder.layernorm.bias", math.nan),
    "an image encoder beside": (ENCODED, "image_encoder", "layernorm.bias", math.inf),
    "a text encoder beside": (ENCODED, "text_encoder", "embeddings.LayerNorm.bias", math.inf),
}


@pytest.mark.parametrize(("name", "which", "weight", "value"), NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_weights_that_are_no_numbers_are_refused(
    tmp_path: Path, name: str, which: str, weight: str, value: float
) -> None:
    golden = goldens.config(name)
    folder, sources = copied(golden, tmp_path / "checkpoint"), golden.sources
    if which:
        weights(lambda tensors: [tensors.pop(key) for key in [*tensors] if "_encoder." in key])(folder)
        sources[which] = str(shutil.copytree(sources[which], tmp_path / which, copy_function=shutil.copyfile))
    spoilt = Path(sources[which]) if which else folder
    weights(lambda tensors: tensors[weight].view(-1)[-1:].fill_(value))(spoilt)
    short = weight.removeprefix("image_encoder.")
    with pytest.raises(CheckpointError, match=rf"{re.escape(short)}: expected finite weights, got {value} at \["):
        families.load(folder, **sources).encoders()


def with_config_of(name: str) -> Spoil:
    return lambda folder: shutil.copyfile(goldens.config(name).checkpoint / "config.json", folder / "config.json")


OTHER_NETWORKS: dict[str, tuple[str, Spoil, str, str]] = {
    "Qwen3-VL, of Qwen2.5-VL": (WITH_IMAGES, with_config_of("q25_mean_l2"), "qwen3_vl", "'qwen2_5_vl'"),
    "Qwen2.5-VL, of Qwen3-VL": ("q25_mean_l2", with_config_of(WITH_IMAGES), "qwen2_5_vl", "'qwen3_vl'"),
    "Qwen3-VL, of ReWiND": (WITH_IMAGES, with_config_of(CONTINUOUS), "qwen3_vl", "'rewind_transformer'"),
    "Qwen3-VL, of a part of it": (WITH_IMAGES, settings("config.json", model_type="qwen3_vl_text"), "qwen3_vl", "'qwen3_vl_text'"),
    "Qwen3-VL, without one": (WITH_IMAGES, lambda folder: (folder / "config.json").unlink(), "qwen3_vl", "none"),
    "ReWiND, of another": (CONTINUOUS, settings("config.json", model_type="llama"), "rewind_transformer", "'llama'"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "spoil", "expected", "got"), OTHER_NETWORKS.values(), ids=OTHER_NETWORKS)
def test_a_config_json_of_another_network_than_the_weights_is_named(
    tmp_path: Path, name: str, spoil: Spoil, expected: str, got: str
) -> None:
    golden = goldens.config(name)
    folder = copied(golden, tmp_path / "checkpoint")
    renamed(in_fsdp)(folder)
    spoil(folder)
    message = (
        f"config.json: model_type: expected {expected}, by the names of the weights, got {got}: the file describes"
    )
    with pytest.raises(CheckpointError, match=re.escape(message)):
        families.load(folder, **golden.sources)


ASKED = {
    "topreward": reward_models.ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied",
    "roboreward": reward_models.ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint",
}


def first_half(folder: Path) -> None:
    """Zero the second half of a file, as an unfinished download leaves it."""
    content = (folder / "model.safetensors").read_bytes()
    begin = 8 + int.from_bytes(content[:8], "little")
    kept = begin + (len(content) - begin) // 2
    (folder / "model.safetensors").write_bytes(content[:kept] + bytes(len(content) - kept))


def nothing(folder: Path) -> None:
    (folder / "model.safetensors").write_bytes(bytes((folder / "model.safetensors").stat().st_size))


UNFINISHED: dict[str, tuple[Spoil, str]] = {
    "zeros in place of all weights": (weights(lambda w: [t.zero_() for t in w.values()]), r": expected weights, got 0 throughout: the file is incomplete"),
    "half of the file": (first_half, r": expected weights, got 0 throughout: the file is incomplete; fetch or copy it again"),
    "nothing but zeros": (nothing, r"model\.safetensors: expected a safetensors file, got zeros, as after an unfinished download"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "message"), UNFINISHED.values(), ids=UNFINISHED)
@pytest.mark.parametrize("source", [CONTINUOUS, WITH_IMAGES, *ASKED])
def test_a_file_of_zeros_is_refused(tmp_path: Path, source: str, spoil: Spoil, message: str) -> None:
    if source in ASKED:
        folder = shutil.copytree(ASKED[source], tmp_path / "checkpoint", copy_function=shutil.copyfile)
        load = partial(families.load, folder, reward_model=source)
    else:
        folder = copied(goldens.config(source), tmp_path / "checkpoint")
        load = partial(families.load, folder, **goldens.config(source).sources)
    load()
    spoil(folder)
    with pytest.raises(CheckpointError, match=message):
        load()


ZEROED = {
    "the whole head": (["success_head"], ["success"]),
    "its last weights": (["progress_head.4.weight"], ["progress"]),
    "its bias": (["progress_head.4.bias"], []),
    "two heads, one of which is not asked for": (["progress_head", "preference_head"], ["progress"]),
}


@pytest.mark.parametrize(("zeroed", "told"), ZEROED.values(), ids=ZEROED)
def test_a_head_of_zeros_is_told(folder: Path, zeroed: list[str], told: list[str]) -> None:
    weights(lambda w: [t.zero_() for key, t in w.items() if key.startswith(tuple(zeroed))])(folder)
    notes = families.notes(folder, families.load(folder), ("progress", "success"))
    assert [line for line in notes if "model.safetensors" in line] == [
        f"model.safetensors: {each}_head.4.weight is 0 throughout: {each} is the same whatever is scored, as if untrained"
        for each in told
    ]


def test_yaml_constructs_nothing(folder: Path, tmp_path: Path) -> None:
    mark = tmp_path / "was_here"
    (folder / "config.yaml").write_text(f'model: {{rewind: !!python/object/apply:os.system ["touch {mark}"]}}\n')
    with pytest.raises(CheckpointError, match=r"config\.yaml: model\.rewind: expected a mapping, got"):
        families.load(folder)
    assert not mark.exists()


@pytest.mark.parametrize("source", ["nowhere", "/no/such/folder", "a/b/../c", "a/b@", ""])
def test_what_is_neither_folder_nor_id_is_refused(source: str) -> None:
    with pytest.raises(CheckpointError, match="expected a folder that exists or a Hugging Face id"):
        families.load(source)


def said(sources: Iterable[str]) -> dict[str, str]:
    """Return each checkpoint's configuration as JSON, or the refusal."""
    outcomes = {}
    for source in sources:
        try:
            outcomes[source] = json.dumps(asdict(families.load(source).config))
        except CheckpointError as error:
            outcomes[source] = str(error)
    return outcomes


LOADS = f"""
from __future__ import annotations
import json, sys
from dataclasses import asdict
from rfm import families
from rfm.families import CheckpointError

{inspect.getsource(said)}
print(json.dumps(said(sys.argv[1:])))
"""
UNTAGGED, TAGGED, WITHOUT = "org/name", f"org/other@{TAG}", "org/without"  # separate repositories
IN_SUBFOLDER, PICKLED, PICKLED_WITHIN = "org/runs/one/ckpt=5@v1", "org/pickled", "org/runs/pickled@v1"
LATE, LATE_ABOVE = "org/late/one/ckpt@v1", "org/late/two/ckpt@v1"
NOT_THERE, ABSENT, OTHER_TAG = "org/runs/none@v1", "org/absent/folder@v1", "org/name@v9"
FROM_HUB = (UNTAGGED, TAGGED, WITHOUT, IN_SUBFOLDER, PICKLED, PICKLED_WITHIN, NOT_THERE, LATE, LATE_ABOVE, ABSENT)
OFFLINE = (
    f"{UNTAGGED}@{TAG}", TAGGED, IN_SUBFOLDER, UNTAGGED, OTHER_TAG, ABSENT, f"{WITHOUT}@{TAG}", LATE, LATE_ABOVE,
)  # fmt: skip


@pytest.fixture(scope="module")
def from_hub(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Ask a separate process about checkpoints, since huggingface_hub reads the environment once; then this process,
    which is offline, with the same cache.

    They are multi-image ones as upstream uploads them: the tag's commit lacks config.yaml, which main has.
    """
    folder = tmp_path_factory.mktemp("hub")
    tag, main, without, pickled, runs = (folder / name for name in ("tag", "main", "without", "pickled", "runs"))
    shutil.copytree(goldens.config(WITH_IMAGES).checkpoint, tag, copy_function=shutil.copyfile)
    for empty in (main, without, pickled):
        empty.mkdir()
    shutil.copytree(tag, runs / "one" / "ckpt=5")
    (runs / "one" / "ckpt=5" / "config.yaml").rename(runs / "one" / "config.yaml")
    (tag / "config.yaml").rename(main / "config.yaml")
    late, late_main = folder / "late", folder / "late_main"
    for run, place in (("one", "one/ckpt"), ("two", "two")):
        shutil.copytree(tag, late / run / "ckpt")
        (late_main / place).mkdir(parents=True)
        shutil.copy(main / "config.yaml", late_main / place)
    shutil.copy(main / "config.yaml", without / "README.md")
    torch.save({}, pickled / "pytorch_model.bin")
    torch.save({}, pickled / "optimizer.pt")
    shutil.copytree(pickled, runs / "pickled")
    mains = {UNTAGGED: main, TAGGED: main, WITHOUT: without}
    repositories = {source.partition("@")[0]: {"main": files, TAG: tag} for source, files in mains.items()}
    repositories |= {PICKLED: {"main": pickled}, "org/runs": {"main": main, "v1": runs}}
    repositories["org/late"] = {"main": late_main, "v1": late}
    with local_hub.hub(repositories) as endpoint:
        settings = {"HF_HUB_CACHE": str(folder / "cache"), "HF_ENDPOINT": endpoint, "HF_HUB_OFFLINE": "0"}
        command = [sys.executable, "-c", LOADS, *FROM_HUB]
        loaded = subprocess.run(command, env={**os.environ, **settings}, check=True, capture_output=True, cwd=folder)
    with mock.patch("huggingface_hub.constants.HF_HUB_CACHE", settings["HF_HUB_CACHE"]):
        offline = said(OFFLINE)
    return json.loads(loaded.stdout) | {f"offline {source}": line for source, line in offline.items()}


IN_CACHE = [f"offline {source}" for source in (f"{UNTAGGED}@{TAG}", TAGGED, UNTAGGED, IN_SUBFOLDER, LATE, LATE_ABOVE)]


@pytest.mark.parametrize("source", [UNTAGGED, TAGGED, IN_SUBFOLDER, LATE, LATE_ABOVE, *IN_CACHE])
def test_config_yaml_is_found_on_main_of_the_hub_s_repository(from_hub: dict[str, str], source: str) -> None:
    expected = asdict(families.load(goldens.config(WITH_IMAGES).checkpoint).config)
    assert expected["multi_image"] and expected["per_frame_progress_token"]
    assert json.loads(from_hub[source]) == json.loads(json.dumps(expected))


REFUSED_HUB = {
    "pickles alone": (
        PICKLED,
        r"org/pickled@main: expected model\.safetensors, got pytorch_model\.bin: pickles may run code .* hf download "
        r"org/pickled --local-dir FOLDER, then name FOLDER as the checkpoint",
    ),
    "pickles alone in a subfolder": (
        PICKLED_WITHIN,
        r"org/runs@v1: expected .* hf download org/runs --revision v1 --local-dir FOLDER, then name FOLDER/pickled as",
    ),
    "no such subfolder": (NOT_THERE, r"org/runs@v1: expected the folder none, got none of this name"),
    "offline, and another revision in the cache": (
        f"offline {OTHER_TAG}",
        r"org/name@v9: cannot be fetched: HF_HUB_OFFLINE is set, and the cache has no such revision of it; there is .*; "
        rf"without it, name a revision that is in the cache: org/name@{TAG}, org/name@main$",
    ),
    "offline, and not in the cache": (
        f"offline {ABSENT}",
        r"org/absent@v1: cannot be fetched: .*; there is no folder /.*/org/absent/folder@v1 either; name one",
    ),
    "no such repository": (
        ABSENT,
        r"^org/absent@v1: cannot be fetched: http://127\.0\.0\.1:\d+ has no such repository, or requires a login ",
    ),
    "offline, and known to have no config.yaml": (
        f"offline {WITHOUT}@{TAG}",
        r"expected config\.yaml of the training run there",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("source", "message"), REFUSED_HUB.values(), ids=REFUSED_HUB)
def test_what_a_hub_s_repository_lacks_is_told(from_hub: dict[str, str], source: str, message: str) -> None:
    assert re.search(message, from_hub[source]), from_hub[source]


CACHED = {
    "main": ({"main": True}, "main"),
    "the best tag": ({"main": True, TAG: True, "best-p-rank-0.2000-step-9": True}, TAG),
    "the best tag with weights": ({"main": True, TAG: False, "best-p-rank-0.2000-step-9": True}, "best-p-rank-0.2000-step-9"),
}  # fmt: skip


@pytest.mark.parametrize(("revisions", "expected"), CACHED.values(), ids=CACHED)
def test_a_repository_in_the_cache_is_found_offline_and_its_revision_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, revisions: dict[str, bool], expected: str
) -> None:
    home = tmp_path / "models--org--name"
    for name, has_weights in revisions.items():
        snapshot = home / "snapshots" / local_hub.commit_of(name)
        snapshot.mkdir(parents=True)
        (snapshot / ("model.safetensors" if has_weights else "README.md")).touch()
        (snapshot / "config.yaml").touch()
        (home / "refs").mkdir(exist_ok=True)
        (home / "refs" / name).write_text(local_hub.commit_of(name))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    lines: list[str] = []
    commit = local_hub.commit_of(expected)
    assert families.find("org/name", lines.append) == home / "snapshots" / commit
    used = (
        f"org/name@{expected} of the cache is used (commit {commit}), because HF_HUB_OFFLINE is set; the Hub may have a"
    )
    assert [line[: len(used)] for line in lines] == [used]
    assert families.find(f"org/name@{expected}", lines.append) == home / "snapshots" / commit
    assert len(lines) == 1


READ_FROM_HUB = """
import json, sys
from rfm import families
folder = families.find("org/asked")
files = sorted(str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file())
print(json.dumps([files, families.load("org/asked", reward_model="roboreward").collator.example()]))
"""


def test_all_files_that_a_folder_is_read_for_come_from_the_hub_too(tmp_path: Path) -> None:
    """The tokenizer's configuration has an older chat template, as in repositories that were saved again."""
    folder = shutil.copytree(
        reward_models.ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint",
        tmp_path / "asked",
        copy_function=shutil.copyfile,
    )
    template = json.loads((folder / "chat_template.json").read_text())["chat_template"]
    (folder / "chat_template.json").unlink()
    (folder / "chat_template.jinja").write_text(template)
    older = template.replace("<|im_start|>", "<|im_start|>older ")
    assert older != template
    settings("tokenizer_config.json", chat_template=older)(folder)
    (folder / "additional_chat_templates").mkdir()
    (folder / "additional_chat_templates" / "tool_use.jinja").write_text("tools")
    for name in ("config.yml", "tokenizer.model", "README.md"):
        (folder / name).write_text("license: mit")
    files = sorted(str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file())
    (folder / "pytorch_model.bin").touch()
    (folder / "modeling.py").touch()
    with local_hub.hub({"org/asked": {"main": folder}}) as endpoint:
        words = {"HF_HUB_CACHE": str(tmp_path / "cache"), "HF_ENDPOINT": endpoint, "HF_HUB_OFFLINE": "0"}
        command = [sys.executable, "-c", READ_FROM_HUB]
        done = subprocess.run(command, env={**os.environ, **words}, check=True, capture_output=True, cwd=tmp_path)
    shutil.rmtree(folder / "additional_chat_templates")  # which transformers leaves open
    prompt = families.load(folder, reward_model="roboreward").collator.example()
    assert "older" not in prompt
    assert json.loads(done.stdout) == [files, prompt]


def test_a_hub_that_does_not_answer_is_told_in_words(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent, socket.create_server(("127.0.0.1", 0)) as closed:
        addresses = [f"http://127.0.0.1:{each.getsockname()[1]}" for each in (silent, closed)]
        closed.close()
        told = []
        for address in addresses:
            words = {"HF_HUB_CACHE": str(tmp_path), "HF_ENDPOINT": address, "HF_HUB_OFFLINE": "0"}
            command = [sys.executable, "-c", LOADS, "org/name", "org/name@v1"]
            environment = {**os.environ, **words, "HF_HUB_ETAG_TIMEOUT": "1"}
            done = subprocess.run(command, env=environment, check=True, capture_output=True, cwd=tmp_path, timeout=120)
            told.append(json.loads(done.stdout))
    reasons = (f"{addresses[0]} did not answer within 1 s", f"{addresses[1]} cannot be reached: Connection refused")
    missing = {
        "org/name": "the cache has neither a best revision nor a main with weights",
        "org/name@v1": "the cache has no such revision of it",
    }
    assert told == [
        {
            source: f"{source}: cannot be fetched: {reason}, and {absent}; there is no folder {tmp_path}/{source} "
            "either; name one, or see to the Hub's name, login and network"
            for source, absent in missing.items()
        }
        for reason in reasons
    ]


READ_BASE = """
import json, sys
from rfm import families
from rfm.families import CheckpointError
told = []
for base in ("org/base", "org/other"):
    try:
        told.append(families.load(sys.argv[1], base_model=base).collator.tokenizer.chat_template)
    except CheckpointError as error:
        told.append(str(error))
print(json.dumps(told))
"""


@pytest.mark.nightly  # a minute
def test_a_base_model_of_the_hub_is_read_from_the_cache_once_the_hub_is_gone(tmp_path: Path) -> None:
    golden = goldens.config(WITH_IMAGES)
    base = shutil.copytree(golden.sources["base_model"], tmp_path / "base", copy_function=shutil.copyfile)
    template = json.loads((base / "chat_template.json").read_text())["chat_template"]
    (base / "chat_template.json").unlink()
    (base / "chat_template.jinja").write_text(template)
    folder = copied(golden, tmp_path / "checkpoint")
    text = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(re.sub(r"base_model_id: \S+", "base_model_id: org/base-qwen3-vl", text))

    def told(endpoint: str) -> list[str]:
        words = {"HF_HUB_CACHE": str(tmp_path / "cache"), "HF_ENDPOINT": endpoint, "HF_HUB_OFFLINE": "0"}
        command = [sys.executable, "-c", READ_BASE, str(folder)]
        environment = {**os.environ, **words}
        done = subprocess.run(command, env=environment, check=True, capture_output=True, cwd=tmp_path, text=True)
        assert "Retry" not in done.stderr
        return list(json.loads(done.stdout))

    with local_hub.hub({"org/base": {"main": base}}) as endpoint:
        found, missing = told(endpoint)
    where = f"base model org/other: tokenizer and processor: {endpoint} "
    assert found == template
    assert missing.startswith(f"{where}has no such repository, or requires a login (hf auth login)")
    found, missing = told(endpoint)
    assert found == template
    assert missing.startswith(f"{where}cannot be reached: Connection refused, and the cache has no such revision of it")


def test_a_run_folder_is_refused_with_its_checkpoints(folder: Path) -> None:
    run = folder.parent / "run"
    for name in ("ckpt-1", "ckpt-2"):
        shutil.copytree(folder, run / name)
    split_into_shards(run / "ckpt-2")
    with pytest.raises(CheckpointError, match=re.escape(f"name the checkpoint in it: {run}/ckpt-1, {run}/ckpt-2")):
        families.load(run)


def test_a_misspelt_folder_is_told_beside_the_hub_s_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "runs" / "checkpoint").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    expected = f"there is no folder {tmp_path}/runs/chekpoint@v2 either (but runs/checkpoint); name one, or see"
    with pytest.raises(CheckpointError, match=re.escape(expected)):
        families.load("runs/chekpoint@v2")
    expected = f"got '{tmp_path}/runs/chekpoint' (but {tmp_path}/runs/checkpoint)"
    with pytest.raises(CheckpointError, match=re.escape(expected)):
        families.load(tmp_path / "runs" / "chekpoint")
