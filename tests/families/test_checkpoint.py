# SPDX-License-Identifier: MIT
"""Forms of one checkpoint, pickles, and the lines about doubtful settings and heads."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

import goldens
import spoilt
from rfm import published
from rfm.published import CheckpointError
from spoilt import Spoil, both, copied, in_two_shards, settings, sharded_pickle, taken, weights

CONTINUOUS = "legacy_keys_l2"  # lacks causal_mask and use_per_frame_progress_token
MISMATCHED = "h40_L3_H5_c1_t1_disc5_cfgmismatch"  # the configs say l2 and 32 bins, the weights 5 bins
IN_RUN_FOLDER = "c1_t1_disc10"  # config.yaml in the parent folder
WITH_IMAGES = "q3_tok_disc10"  # vision-language: every frame an image, with a progress token
QWEN_2_5 = "q25_mean_l2"
ADAPTER = "q25_peft_adapter_disc10"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of a reference checkpoint for a test to spoil."""
    return copied(goldens.config(CONTINUOUS), tmp_path / "checkpoint")


def test_weights_decide_where_configurations_disagree() -> None:
    config = published.load(goldens.config(MISMATCHED).checkpoint).config
    assert (config.progress_bins, config.max_len, config.num_layers, config.hidden_dim) == (5, 10, 3, 40)
    assert (config.video_feature_dim, config.text_feature_dim) == (256, 96)
    assert config.use_per_frame_progress_token


@pytest.mark.parametrize("place", ["config.yml", ".hydra/config.yaml", "../config.yml", "../.hydra/config.yaml"])
def test_config_yaml_may_have_other_names(folder: Path, place: str) -> None:
    expected = published.load(folder).config
    target = folder / place
    target.parent.mkdir(exist_ok=True)
    (folder / "config.yaml").rename(target)
    assert published.load(folder).config == expected


def assert_same(after: Any, before: Any) -> None:
    assert after.config == before.config
    assert after.parts["network"].keys() == before.parts["network"].keys()
    assert all(torch.equal(after.parts["network"][key], tensor) for key, tensor in before.parts["network"].items())


def renamed(change: Callable[[str], str]) -> Spoil:
    return weights(lambda tensors: [tensors.update({change(name): tensors.pop(name)}) for name in [*tensors]])


def in_fsdp(name: str) -> str:
    return f"_fsdp_wrapped_module.{name}".replace("layers.1.", "layers.1._fsdp_wrapped_module.")


def saved_by_us(folder: Path) -> None:
    shutil.rmtree(folder)
    published.load(goldens.config(IN_RUN_FOLDER).checkpoint).save(folder)


def right_under(found: re.Match[str]) -> str:
    return "visual" if found[1] == "visual" else "model"


ROTARY = ("language_model.rotary_emb", "visual.rotary_pos_emb")
OTHER_FORMS: dict[str, tuple[str, Spoil]] = {
    "saved by us": (IN_RUN_FOLDER, saved_by_us),
    "shards": (CONTINUOUS, in_two_shards),
    "an old shard of known names": (
        CONTINUOUS,
        both(in_two_shards, lambda f: save_file({"success_head.4.bias": torch.ones(1)}, f / "model-00001-of-00003.safetensors")),
    ),
    "no causal_mask but null": (CONTINUOUS, settings("config.json", causal_mask=None)),
    "no heads but null": (CONTINUOUS, settings("config.json", num_attention_heads=None)),
    "DataParallel": (CONTINUOUS, renamed(lambda name: f"module.{name}")),
    "PEFT": (CONTINUOUS, renamed(lambda name: f"base_model.model.{name}")),
    "FSDP": (CONTINUOUS, renamed(in_fsdp)),
    "FSDP of a vision-language one": (WITH_IMAGES, renamed(in_fsdp)),
    "DataParallel and torch.compile": (CONTINUOUS, renamed(lambda name: f"module._orig_mod.{name}")),
    "some layers": (CONTINUOUS, renamed(lambda name: name.replace("transformer.", "transformer._orig_mod."))),
    "layers right under the model": (QWEN_2_5, spoilt.renamed(r"^model\.(language_model|visual)\b", right_under)),
    "rotary frequencies": (QWEN_2_5, weights(lambda w: w.update({f"model.{name}.inv_freq": torch.ones(8) for name in ROTARY}))),
    "Lightning": (CONTINUOUS, renamed(lambda name: f"model.{name}")),
}  # fmt: skip


@pytest.mark.parametrize(("name", "change"), OTHER_FORMS.values(), ids=OTHER_FORMS)
def test_a_checkpoint_in_another_form_is_the_same(tmp_path: Path, name: str, change: Spoil) -> None:
    golden = goldens.config(name)
    folder = copied(golden, tmp_path / "checkpoint")
    change(folder)
    assert_same(published.load(folder, **golden.sources), published.load(golden.checkpoint, **golden.sources))


STATES = ("optimizer.pt", "scheduler.pt", "rng_state.pth", "rng_state_0.pth", "training_args.bin", "scaler.pt")


def pickled(name: str, wrap: Callable[[dict[str, Tensor]], object]) -> Spoil:
    return lambda folder: torch.save(wrap(taken(folder)), folder / name)


PICKLES: dict[str, tuple[Spoil, str]] = {
    "shards": (sharded_pickle, r"pytorch_model-00001-of-00002\.bin, pytorch_model-00002-of-00002\.bin"),
    "of Lightning": (pickled("epoch=3.ckpt", lambda w: {"epoch": 3, "state_dict": w, "callbacks": {}}), r"epoch=3\.ckpt"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "named"), PICKLES.values(), ids=PICKLES)
def test_pickles_are_refused_unread(folder: Path, spoil: Spoil, named: str) -> None:
    spoil(folder)
    for state in STATES:
        torch.save({"state": {}}, folder / state)
    expected = rf"expected model\.safetensors, got {named}: pickles may run code .*; save the weights where they were"
    with pytest.raises(CheckpointError, match=expected):
        published.load(folder)


def test_a_pickled_adapter_is_refused(tmp_path: Path) -> None:
    golden = goldens.config(ADAPTER)
    folder = copied(golden, tmp_path / "checkpoint")
    (folder / "adapter_model.safetensors").rename(folder / "adapter_model.bin")
    with pytest.raises(CheckpointError, match=r"expected adapter_model\.safetensors, got adapter_model\.bin: pickles"):
        published.load(folder, **golden.sources)


ZEROED = {
    "the whole head": (["success_head"], ["success"]),
    "its last weights": (["progress_head.4.weight"], ["progress"]),
    "its bias": (["progress_head.4.bias"], []),
    "two heads, one of which is not asked for": (["progress_head", "preference_head"], ["progress"]),
}


@pytest.mark.parametrize(("zeroed", "expected"), ZEROED.values(), ids=ZEROED)
def test_notes_name_a_head_of_zeros(folder: Path, zeroed: list[str], expected: list[str]) -> None:
    weights(lambda w: [t.zero_() for key, t in w.items() if key.startswith(tuple(zeroed))])(folder)
    notes = published.notes(folder, published.read(folder), ("progress", "success"))
    assert [line for line in notes if "model.safetensors" in line] == [
        f"model.safetensors: {each}_head.4.weight is 0 throughout: {each} is the same whatever is scored, as if untrained"
        for each in expected
    ]
