# SPDX-License-Identifier: MIT
"""Writes a Qwen3-VL reward checkpoint of 4B size with random weights, in upstream's layout.

    python benchmarks/random_vlm_checkpoint.py FOLDER --base-model DIR_OR_ID

The base model is only asked for its tokenizer. Heads and settings are those of Robometer-4B's defaults:
bfloat16, multi-image, per-frame progress tokens, ten bins of progress, no similarity.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

SPECIAL_TOKENS = ("<|split_token|>", "<|reward_token|>", "<|pref_token|>", "<|sim_token|>", "<|prog_token|>")
BINS = 10
TEXT: dict[str, Any] = {  # Qwen3-VL-4B-Instruct
    "hidden_size": 2560, "intermediate_size": 9728, "num_hidden_layers": 36, "num_attention_heads": 32,
    "num_key_value_heads": 8, "head_dim": 128, "max_position_embeddings": 262144, "rope_theta": 5000000,
    "rope_scaling": {"rope_type": "default", "mrope_interleaved": True, "mrope_section": [24, 20, 20]},
}  # fmt: skip
VISION = {
    "hidden_size": 1024, "intermediate_size": 4096, "depth": 24, "num_heads": 16, "patch_size": 16,
    "out_hidden_size": 2560, "deepstack_visual_indexes": [5, 11, 17], "num_position_embeddings": 2304,
}  # fmt: skip
RUN = {
    "model": {
        "model_type": "default", "torch_dtype": "bfloat16", "use_multi_image": True,
        "use_per_frame_progress_token": True,
    },
    "training": {"predict_pref_progress": True},
}  # fmt: skip


def main() -> None:
    """Writes model.safetensors, config.json and config.yaml."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--base-model", required=True, help="folder or id whose tokenizer is used")
    options = parser.parse_args()
    write(options.folder, options.base_model)


def write(folder: Path, base_model: str, layers: int = TEXT["num_hidden_layers"]) -> None:
    """Writes the files into a new ``folder``.

    base_model: folder or id whose tokenizer is used
    layers: of the language model; 36: 4B parameters, 3: 0.6B
    """
    folder.mkdir(parents=True)

    from transformers import AutoTokenizer, Qwen3VLConfig, Qwen3VLModel

    tokenizer = AutoTokenizer.from_pretrained(base_model)
    tokenizer.add_tokens(list(SPECIAL_TOKENS), special_tokens=True)
    ids = {name: tokenizer.convert_tokens_to_ids(token) for name, token in _TOKEN_IDS.items()}
    text = {**TEXT, "num_hidden_layers": layers, "vocab_size": len(tokenizer)}
    config = Qwen3VLConfig(text_config=text, vision_config=VISION, **ids)
    torch.manual_seed(0)
    backbone = Qwen3VLModel._from_config(config, dtype=torch.bfloat16)
    width = TEXT["hidden_size"]
    weights = {f"model.{name}": tensor for name, tensor in backbone.state_dict().items()}
    weights |= (
        _head("progress_head", width, BINS) | _head("success_head", width, 1) | _head("preference_head", width, 1)
    )
    weights["frame_pool_attn.weight"] = torch.randn(1, width)
    tensors = {name: tensor.to(torch.bfloat16).contiguous() for name, tensor in weights.items()}
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    (folder / "config.json").write_text(json.dumps(config.to_dict(), indent=2))
    run = {**RUN, "model": {**RUN["model"], "base_model_id": base_model}}
    (folder / "config.yaml").write_text(json.dumps(run))  # JSON is YAML


_TOKEN_IDS = {
    "image_token_id": "<|image_pad|>",
    "video_token_id": "<|video_pad|>",
    "vision_start_token_id": "<|vision_start|>",
    "vision_end_token_id": "<|vision_end|>",
}


def _head(name: str, width: int, outputs: int) -> dict[str, Tensor]:
    layers = {0: nn.Linear(width, width // 2), 1: nn.LayerNorm(width // 2), 4: nn.Linear(width // 2, outputs)}
    return {f"{name}.{i}.{key}": tensor for i, layer in layers.items() for key, tensor in layer.state_dict().items()}


if __name__ == "__main__":
    main()
