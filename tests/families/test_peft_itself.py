# SPDX-License-Identifier: MIT
"""An adapter that PEFT itself writes, with the transformers beside it. ``make test-newest`` has both."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

import goldens
from rfm import published

peft = pytest.importorskip("peft", reason="make test-newest installs it")
transformers = pytest.importorskip("transformers")
pytestmark = pytest.mark.filterwarnings("ignore:.*is deprecated:FutureWarning")  # PEFT 0.21 with transformers 5.24


@pytest.mark.parametrize("targets", [["q_proj", "down_proj"], ["qkv", "v_proj"]], ids=["text", "text and tower"])
def test_an_adapter_of_the_newest_peft_is_merged_as_peft_does(tmp_path: Path, targets: list[str]) -> None:
    config, base, adapter = goldens.config("q3_tok_disc10"), tmp_path / "base", tmp_path / "adapter"
    shutil.copytree(config.base_model, base)
    content = json.loads((base / "config.json").read_text()) | {"tie_word_embeddings": True}
    content["text_config"] |= {"tie_word_embeddings": True}
    run = load_file(config.checkpoint / "model.safetensors")
    num_tokens = next(len(rows) for name, rows in run.items() if name.endswith("embed_tokens.weight"))
    whole = transformers.Qwen3VLForConditionalGeneration(transformers.Qwen3VLConfig.from_dict(content))
    whole.save_pretrained(base)
    whole.resize_token_embeddings(num_tokens)
    settings = peft.LoraConfig(r=4, lora_alpha=8, target_modules=targets, init_lora_weights=False)
    wrapped = peft.get_peft_model(whole.model, settings)
    wrapped.save_pretrained(adapter, save_embedding_layers=True)
    shutil.copy(config.checkpoint / "config.yaml", adapter)
    save_file(
        {name: each for name, each in run.items() if not name.startswith("model.")},
        adapter / "custom_heads.safetensors",
    )
    built = published.load(adapter, base_model=str(base)).build(torch.float32).state_dict()
    merged = wrapped.merge_and_unload().state_dict()
    for name, expected in merged.items():
        torch.testing.assert_close(built[f"model.{name}"], expected, rtol=0, atol=1e-6)
