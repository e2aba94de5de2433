# SPDX-License-Identifier: MIT
from __future__ import annotations

import argparse
import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

import goldens
import local_hub
import rfm_export
from paths import ROOT
from rfm import families
from rfm.checkpoint.content import CheckpointError
from rfm.checkpoint.hub import best_tag
from rfm.checkpoint.run_config import find_run_config
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.rewind.network import RewindConfig
from rfm.vlm.network import VlmConfig
from rfm_commands.engine_scorer import EngineScorer
from spoilt import copied, in_json, run_the_command, weights

CONTINUOUS = "legacy_keys_l2"  # lacks causal_mask and use_per_frame_progress_token
MISMATCHED = "h40_L3_H5_c1_t1_disc5_cfgmismatch"  # its configs say l2 and 32 bins, its weights 5 bins
IN_RUN_FOLDER = "c1_t1_disc10"  # config.yaml in the parent folder
WITH_IMAGES = "q3_tok_disc10"  # a vision-language one: each frame an image, with a progress token
TAG = "best-p-rank-0.8500-step-123"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of a reference checkpoint that a test may spoil."""
    return copied(goldens.config(CONTINUOUS), tmp_path / "checkpoint")


def test_weights_decide_where_configurations_disagree() -> None:
    config = families.load(goldens.config(MISMATCHED).checkpoint).config
    assert (config.progress_bins, config.max_len, config.num_layers, config.hidden_dim) == (5, 10, 3, 40)
    assert (config.video_feature_dim, config.text_feature_dim) == (256, 96)
    assert config.use_per_frame_progress_token


@pytest.mark.parametrize("file", ["config.yml", ".hydra/config.yaml"])
@pytest.mark.parametrize("above", [False, True], ids=["beside", "above"])
def test_config_yaml_may_be_called_otherwise(folder: Path, file: str, above: bool) -> None:
    expected = families.load(folder).config
    target = (folder.parent if above else folder) / file
    target.parent.mkdir(exist_ok=True)
    (folder / "config.yaml").rename(target)
    assert families.load(folder).config == expected
    assert find_run_config(folder) == target


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


def test_saving_and_loading_changes_nothing(tmp_path: Path) -> None:
    original = families.load(goldens.config(IN_RUN_FOLDER).checkpoint)
    original.save(tmp_path / "saved")
    copy = families.load(tmp_path / "saved")
    assert copy.config == original.config
    assert copy.network.keys() == original.network.keys()
    assert all(torch.equal(copy.network[name], original.network[name]) for name in copy.network)


@pytest.mark.parametrize("config", [VlmConfig, RewindConfig])
def test_what_decides_each_setting_is_documented(config: type[VlmConfig | RewindConfig]) -> None:
    documented = (ROOT / "docs" / "checkpoints.md").read_text()
    assert [field.name for field in fields(config) if f"`{field.name}`" not in documented] == []


@pytest.mark.parametrize("name", ["causal_mask", "num_attention_heads"])
def test_a_null_is_a_key_that_is_not_there(folder: Path, name: str) -> None:
    expected = families.load(folder).config
    in_json("config.json", lambda content: content.update({name: None}))(folder)
    assert families.load(folder).config == expected


def split_into_shards(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    names = sorted(weights)
    weight_map = {}
    for shard, part in {"a.safetensors": names[:20], "b.safetensors": names[20:]}.items():
        save_file({name: weights[name] for name in part}, folder / shard)
        weight_map |= dict.fromkeys(part, shard)
    (folder / "model.safetensors").unlink()
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": weight_map}))


def test_shards_are_put_together(folder: Path) -> None:
    whole = families.load(folder)
    split_into_shards(folder)
    sharded = families.load(folder)
    assert sharded.config == whole.config
    assert all(torch.equal(sharded.network[name], whole.network[name]) for name in whole.network)


def as_pickle(folder: Path) -> None:
    torch.save(load_file(folder / "model.safetensors"), folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()


def lost_shard(folder: Path) -> None:
    split_into_shards(folder)
    (folder / "b.safetensors").unlink()


def take_weights(folder: Path) -> dict[str, torch.Tensor]:
    weights = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    return weights


def sharded_pickle(folder: Path) -> None:
    weights = take_weights(folder)
    names = sorted(weights)
    weight_map = {}
    for number, part in enumerate((names[:20], names[20:]), 1):
        shard = f"pytorch_model-0000{number}-of-00002.bin"
        torch.save({name: weights[name] for name in part}, folder / shard)
        weight_map |= dict.fromkeys(part, shard)
    (folder / "pytorch_model.bin.index.json").write_text(json.dumps({"metadata": {}, "weight_map": weight_map}))


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
        in_json("config.json", lambda c: c.update(model_type="llama")),
        r"model_type: expected rewind_transformer, got llama",
    ),
    "configurations that contradict each other": (
        in_json("config.json", lambda c: c.update(num_attention_heads=8)),
        r"num_attention_heads: expected config.json and config.yaml to agree, got",
    ),
    "heads that do not divide the width": (
        lambda folder: (
            in_json("config.json", lambda c: c.update(num_attention_heads=5))(folder),
            (folder / "config.yaml").unlink(),
        )[0],
        r"num_attention_heads: expected a divisor of the hidden width 32, got 5",
    ),
    "a number of heads that is no number": (
        in_json("config.json", lambda c: c.update(num_attention_heads="4")),
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
    "pickle": (
        as_pickle,
        r"expected model.safetensors, got pytorch_model.bin: .*refused\. .*weights_only=True lets .*: python -c \"import",
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
        lambda folder: (folder / "config.yaml").write_text("data: [1]") and None,
        r"config.yaml: data: expected a mapping, got \[1\]",
    ),
    "a half frame": (
        in_json("config.json", lambda c: c.update(trained_frames=7.5)),
        r"config.json: trained_frames: expected a whole number of at least 1, got 7.5",
    ),
    "padding that is a number": (
        in_json("config.json", lambda c: c.update(trained_padding=1)),
        r"config.json: trained_padding: expected true or false, got 1",
    ),
}


@pytest.mark.parametrize(("spoil", "message"), SPOILED.values(), ids=SPOILED)
def test_a_spoiled_checkpoint_is_refused(folder: Path, spoil: Callable[[Path], None], message: str) -> None:
    spoil(folder)
    with pytest.raises(CheckpointError, match=message):
        families.load(folder).build()


@pytest.mark.parametrize("kind", ["relative", "relative_first_frame"])
@pytest.mark.parametrize("name", [CONTINUOUS, WITH_IMAGES])
def test_progress_since_the_frame_before_is_refused(tmp_path: Path, name: str, kind: str) -> None:
    golden = goldens.config(name)
    folder = copied(golden, tmp_path / "checkpoint")
    text = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(text.replace("absolute_wrt_total_frames", kind))
    expected = f"{folder}/config.yaml: data.progress_pred_type: expected absolute progress, got '{kind}': such a head"
    with pytest.raises(CheckpointError, match=re.escape(expected)):
        families.load(folder, base_model=str(golden.base_model))
    (folder / "config.yaml").write_text(text.replace("absolute_wrt_total_frames", "absolute_first_frame"))
    families.load(folder, base_model=str(golden.base_model))


def sharing_memory(folder: Path) -> None:
    """As tied weights are; a safetensors file holds none that share."""
    weights = take_weights(folder)
    both = torch.stack([weights["first_embedding_A"], weights["first_embedding_B"]])
    torch.save(weights | {"first_embedding_A": both[0], "first_embedding_B": both[1]}, folder / "model.pt")


PICKLES: dict[str, tuple[Callable[[Path], None], str]] = {
    "of transformers": (as_pickle, "pytorch_model.bin"),
    "shards": (sharded_pickle, "pytorch_model-00001-of-00002.bin, pytorch_model-00002-of-00002.bin"),
    "of Lightning": (
        lambda folder: torch.save(
            {"epoch": 3, "state_dict": take_weights(folder), "callbacks": {}}, folder / "epoch=3.ckpt"
        ),
        "epoch=3.ckpt",
    ),
    "with the arguments of the run": (
        lambda folder: torch.save(
            {"args": argparse.Namespace(max_length=16), "model_state_dict": take_weights(folder)}, folder / "last.pth"
        ),
        "last.pth",
    ),
    "weights that share memory": (sharing_memory, "model.pt"),
}


@pytest.mark.parametrize(("spoil", "named"), PICKLES.values(), ids=PICKLES)
@pytest.mark.slow
def test_the_conversion_that_the_refusal_of_a_pickle_names_works(
    folder: Path, spoil: Callable[[Path], None], named: str
) -> None:
    before = families.load(folder)
    spoil(folder)
    for state in ("optimizer.pt", "scheduler.pt", "rng_state.pth", "rng_state_0.pth", "training_args.bin", "scaler.pt"):
        torch.save({"state": {}}, folder / state)
    with pytest.raises(CheckpointError, match=re.escape(f"expected model.safetensors, got {named}: pickles may run")):
        families.load(folder)
    run_the_command(families.load, folder)
    after = families.load(folder)
    assert after.config == before.config
    assert all(torch.equal(after.network[name], before.network[name]) for name in before.network)


@pytest.mark.slow
def test_the_conversion_of_a_pickled_adapter_works(tmp_path: Path) -> None:
    golden = goldens.config("q25_peft_adapter_disc10")

    def load(folder: Path) -> Any:
        return families.load(folder, base_model=str(golden.base_model))

    before = load(golden.checkpoint)
    folder = copied(golden, tmp_path / "checkpoint")
    torch.save(load_file(folder / "adapter_model.safetensors"), folder / "adapter_model.bin")
    (folder / "adapter_model.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"expected adapter_model\.safetensors, got adapter_model\.bin: pickles"):
        load(folder)
    run_the_command(load, folder)
    after = load(folder)
    assert after.config == before.config
    assert all(torch.equal(after.factors[name], before.factors[name]) for name in before.factors)


def test_a_base_model_whose_weights_are_whole_and_in_shards_is_refused(tmp_path: Path) -> None:
    golden = goldens.config("q25_peft_adapter_disc10")
    base = shutil.copytree(golden.base_model or "", tmp_path / "base", copy_function=shutil.copyfile)
    (base / "model.safetensors.index.json").write_text('{"weight_map": {}}')
    with pytest.raises(
        CheckpointError, match=r"/base: expected model\.safetensors or shards, got model\.safetensors and"
    ):
        families.load(golden.checkpoint, base_model=str(base))


def renamed(change: Callable[[str], str]) -> Callable[[Path], None]:
    def rename(folder: Path) -> None:
        weights = {change(name): tensor for name, tensor in take_weights(folder).items()}
        save_file(weights, folder / "model.safetensors")

    return rename


PREFIXES: dict[str, Callable[[str], str]] = {
    "DataParallel": lambda name: f"module.{name}",
    "torch.compile": lambda name: f"_orig_mod.{name}",
    "PEFT": lambda name: f"base_model.model.{name}",
    "FSDP": lambda name: f"_fsdp_wrapped_module.{name}".replace("layers.1.", "layers.1._fsdp_wrapped_module."),
    "both": lambda name: f"module._orig_mod.{name}",
    "some layers": lambda name: name.replace("transformer.", "transformer._orig_mod."),
    "Lightning": lambda name: f"model.{name}",
}


@pytest.mark.parametrize("change", PREFIXES.values(), ids=PREFIXES)
@pytest.mark.parametrize("name", [CONTINUOUS, WITH_IMAGES])
def test_prefixes_of_wrappers_change_nothing(tmp_path: Path, name: str, change: Callable[[str], str]) -> None:
    golden = goldens.config(name)
    folder = copied(golden, tmp_path / "checkpoint")
    renamed(change)(folder)
    before, after = (families.load(each, base_model=str(golden.base_model)) for each in (golden.checkpoint, folder))
    assert after.config == before.config
    assert after.parts["network"].keys() == before.parts["network"].keys()
    assert all(torch.equal(after.parts["network"][key], tensor) for key, tensor in before.parts["network"].items())


def test_the_command_that_strips_a_prefix_works(folder: Path) -> None:
    before = families.load(folder)
    renamed(lambda name: name if name.startswith("video") else f"student.{name}")(folder)
    expected = (
        "got 'student.progress_head.4.weight', with the prefix student. that 'video_proj.bias' lacks; strip it with"
    )
    with pytest.raises(CheckpointError, match=re.escape(expected)):
        families.load(folder)
    run_the_command(families.load, folder)
    after = families.load(folder)
    assert all(torch.equal(after.network[name], before.network[name]) for name in before.network)


def test_an_old_shard_of_known_names_is_left_alone(folder: Path) -> None:
    whole = families.load(folder)
    extra_shard("model-00001-of-00003.safetensors", {"success_head.4.bias": torch.ones(1)})(folder)
    sharded = families.load(folder)
    assert all(torch.equal(sharded.network[name], whole.network[name]) for name in whole.network)


ENCODED = "enc_c1_t1_disc10"
NO_NUMBERS = {
    "a head": (CONTINUOUS, "success_head.4.bias", math.inf),
    "the last of a head's last layer": (WITH_IMAGES, "progress_head.4.weight", -math.inf),
    "a weight": (CONTINUOUS, "transformer.layers.0.norm1.weight", math.nan),
    "a weight of an encoder": (ENCODED, "image_encoder.layernorm.bias", math.nan),
}


def exported(source: Path, *, to: Path, **options: Any) -> None:
    rfm_export.export(source, to / "repository", ExportConfig(num_gpus=0, **options))


def of_engine(source: Path, *, to: Path, **options: Any) -> None:
    Engine.from_checkpoint(source, base_model=options.get("base_model"))


DOORS: dict[str, Callable[..., object]] = {
    "rfm export": exported,
    "rfm label": lambda source, to, **options: EngineScorer(str(source), **options),
    "Engine": of_engine,
    "families": lambda source, to, **options: families.load(source, **options),
}


@pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)
@pytest.mark.parametrize(("name", "weight", "value"), NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_weights_that_are_no_numbers_are_refused_at_every_door(
    tmp_path: Path, door: Callable[..., object], name: str, weight: str, value: float
) -> None:
    golden = goldens.config(name)
    folder = copied(golden, tmp_path / "checkpoint")
    weights(lambda weights: weights[weight].view(-1)[-1:].fill_(value))(folder)
    sources = {option: getattr(golden, option) for option in ("base_model", "image_encoder", "text_encoder")}
    options = {option: str(source) for option, source in sources.items() if source is not None}
    short = weight.removeprefix("image_encoder.")
    with pytest.raises(CheckpointError, match=rf"{re.escape(short)}: expected finite weights, got {value} at \["):
        door(folder, to=tmp_path, **options)


@pytest.mark.parametrize("which", ["image_encoder", "text_encoder"])
def test_an_encoder_s_weights_that_are_no_numbers_are_refused(tmp_path: Path, which: str) -> None:
    golden = goldens.config(ENCODED)
    folder = copied(golden, tmp_path / "checkpoint")
    weights(lambda weights: [weights.pop(name) for name in list(weights) if "_encoder." in name])(folder)
    sources = {"image_encoder": golden.image_encoder, "text_encoder": golden.text_encoder}
    spoilt = shutil.copytree(sources[which] or "", tmp_path / which, copy_function=shutil.copyfile)
    name = next(iter(load_file(spoilt / "model.safetensors")))
    weights(lambda tensors: tensors[name].view(-1)[:1].fill_(math.inf))(spoilt)
    options = {option: str(source) for option, source in (sources | {which: spoilt}).items()}
    with pytest.raises(CheckpointError, match=rf"{re.escape(name)}: expected finite weights, got inf at \["):
        families.load(folder, **options).encoders()


ZEROED = {
    "the whole head": (["success_head"], ["success"]),
    "its last weights": (["progress_head.4.weight"], ["progress"]),
    "its bias": (["progress_head.4.bias"], []),
    "two heads, one of which is not asked for": (["progress_head", "preference_head"], ["progress"]),
}


@pytest.mark.parametrize(("zeroed", "told"), ZEROED.values(), ids=ZEROED)
@pytest.mark.parametrize("name", [CONTINUOUS, WITH_IMAGES])
def test_a_head_of_zeros_is_told(tmp_path: Path, name: str, zeroed: list[str], told: list[str]) -> None:
    golden = goldens.config(name)
    folder = copied(golden, tmp_path / "checkpoint")
    weights(lambda w: [t.zero_() for key, t in w.items() if key.startswith(tuple(zeroed))])(folder)
    checkpoint = families.load(folder, base_model=str(golden.base_model))
    lines = [
        line for line in families.notes(folder, checkpoint, ("progress", "success")) if "model.safetensors" in line
    ]
    assert lines == [
        f"model.safetensors: {each}_head.4.weight is 0 throughout: {each} is the same whatever is scored, as if untrained"
        for each in told
    ]


def test_yaml_constructs_nothing(folder: Path, tmp_path: Path) -> None:
    mark = tmp_path / "was_here"
    (folder / "config.yaml").write_text(f'model: {{rewind: !!python/object/apply:os.system ["touch {mark}"]}}\n')
    with pytest.raises(CheckpointError, match=r"config\.yaml: model\.rewind: expected a mapping, got"):
        families.load(folder)
    assert not mark.exists()


TAGS = {
    "the highest score": (["best-x-0.5-step-10", "best-x-0.75-step-5", "main"], "best-x-0.75-step-5"),
    "negative scores": (["best-loss--0.9-step-1", "best-loss--0.2-step-2"], "best-loss--0.2-step-2"),
    "the first of equals": (["best-a-0.5-step-1", "best-b-0.5-step-2"], "best-a-0.5-step-1"),
    "none": (["v1", "best-0.5", "best-a-1-step-2"], None),
    "no tags": ([], None),
}


@pytest.mark.parametrize(("tags", "expected"), TAGS.values(), ids=TAGS)
def test_the_best_tag(tags: list[str], expected: str | None) -> None:
    assert best_tag(tags) == expected


@pytest.mark.parametrize("source", ["nowhere", "/no/such/folder", "a/b/../c", "a/b@", ""])
def test_what_is_neither_folder_nor_id_is_refused(source: str) -> None:
    with pytest.raises(CheckpointError, match="expected a folder that exists or a Hugging Face id"):
        families.load(source)


LOADS = """
import json, sys
from dataclasses import asdict
from rfm import families
from rfm.checkpoint.content import CheckpointError
for source in sys.argv[1:]:
    try:
        print(json.dumps(asdict(families.load(source).config)))
    except CheckpointError as error:
        print(error)
"""
UNTAGGED, TAGGED, WITHOUT = "org/name", f"org/other@{TAG}", "org/without"  # repositories of their own
IN_SUBFOLDER, PICKLED, PICKLED_WITHIN = "org/runs/one/ckpt=5@v1", "org/pickled", "org/runs/pickled@v1"
LATE, LATE_ABOVE = "org/late/one/ckpt@v1", "org/late/two/ckpt@v1"
NOT_THERE, ABSENT = "org/runs/none@v1", "org/absent/folder@v1"
FROM_HUB = (UNTAGGED, TAGGED, WITHOUT, IN_SUBFOLDER, PICKLED, PICKLED_WITHIN, NOT_THERE, LATE, LATE_ABOVE)
OFFLINE = (f"{UNTAGGED}@{TAG}", TAGGED, IN_SUBFOLDER, UNTAGGED, ABSENT, f"{WITHOUT}@{TAG}", LATE, LATE_ABOVE)


@pytest.fixture(scope="module")
def from_hub(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What a process of its own says of checkpoints, since huggingface_hub reads its environment once; a second one does
    so offline, with the same cache.

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
    environment = {**os.environ, "HF_HOME": str(folder / "cache")}

    def say(sources: tuple[str, ...], offline: str) -> list[str]:
        command = [sys.executable, "-c", LOADS, *sources]
        settings = {**environment, "HF_ENDPOINT": endpoint, "HF_HUB_OFFLINE": offline}
        loaded = subprocess.run(command, env=settings, check=True, capture_output=True, text=True, cwd=folder)
        return loaded.stdout.splitlines()

    with local_hub.hub(repositories) as endpoint:
        told = dict(zip(FROM_HUB, say(FROM_HUB, "0"), strict=True))
    return told | {f"offline {source}": line for source, line in zip(OFFLINE, say(OFFLINE, "1"), strict=True)}


IN_CACHE = [f"offline {source}" for source in (f"{UNTAGGED}@{TAG}", TAGGED, IN_SUBFOLDER, LATE, LATE_ABOVE)]


@pytest.mark.parametrize("source", [UNTAGGED, TAGGED, IN_SUBFOLDER, LATE, LATE_ABOVE, *IN_CACHE])
@pytest.mark.slow
def test_config_yaml_is_found_on_main_of_the_hub_s_repository(from_hub: dict[str, str], source: str) -> None:
    expected = asdict(families.load(goldens.config(WITH_IMAGES).checkpoint).config)
    assert expected["multi_image"] and expected["per_frame_progress_token"]
    assert json.loads(from_hub[source]) == json.loads(json.dumps(expected))


@pytest.mark.parametrize(("main", "is_found"), [("a" * 40, True), ("a" * 41, False), ("../other", False)])
def test_main_of_the_hub_s_cache_is_a_commit(tmp_path: Path, main: str, is_found: bool) -> None:
    snapshots = tmp_path / "snapshots"
    for folder in (snapshots / "of-the-tag", snapshots / ("a" * 40), tmp_path / "refs"):
        folder.mkdir(parents=True)
    (snapshots / ("a" * 40) / "config.yaml").write_text("{}")
    (tmp_path / "refs" / "main").write_text(main)
    found = find_run_config(snapshots / "of-the-tag")
    assert found == ((snapshots / ("a" * 40) / "config.yaml").resolve() if is_found else None)


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
    "offline, and no revision": (
        f"offline {UNTAGGED}",
        rf"org/name@latest: cannot be fetched: .*; without it, name a revision that is in the cache: org/name@{TAG}, org/name@main",
    ),
    "offline, and not in the cache": (
        f"offline {ABSENT}",
        r"org/absent@v1: cannot be fetched: .*; there is no folder /.*/org/absent/folder@v1 either; name one",
    ),
    "offline, and known to have no config.yaml": (
        f"offline {WITHOUT}@{TAG}",
        r"expected config\.yaml of the training run there",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("source", "message"), REFUSED_HUB.values(), ids=REFUSED_HUB)
@pytest.mark.slow
def test_what_a_hub_s_repository_lacks_is_told(from_hub: dict[str, str], source: str, message: str) -> None:
    assert re.search(message, from_hub[source]), from_hub[source]


def test_a_run_folder_is_refused_with_its_checkpoints(folder: Path) -> None:
    run = folder.parent / "run"
    for name in ("ckpt-1", "ckpt-2"):
        shutil.copytree(folder, run / name)
    split_into_shards(run / "ckpt-2")
    with pytest.raises(CheckpointError, match=re.escape(f"name the checkpoint in it: {run}/ckpt-1, {run}/ckpt-2")):
        families.load(run)


def test_a_model_repository_is_refused_with_its_checkpoints() -> None:
    expected = f"name the checkpoint in it: {ROOT}/model_repository/rfm/1/checkpoint"
    with pytest.raises(CheckpointError) as refusal:
        families.load(ROOT / "model_repository")
    assert str(refusal.value).endswith(expected)


def test_a_misspelt_folder_is_told_beside_the_hub_s_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "runs" / "checkpoint").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    expected = f"there is no folder {tmp_path}/runs/chekpoint@v2 either (but runs/checkpoint); name one, or see"
    with pytest.raises(CheckpointError, match=re.escape(expected)):
        families.load("runs/chekpoint@v2")
    expected = f"got '{tmp_path}/runs/chekpoint' (but {tmp_path}/runs/checkpoint)"
    with pytest.raises(CheckpointError, match=re.escape(expected)):
        families.load(tmp_path / "runs" / "chekpoint")
