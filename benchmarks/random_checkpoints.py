# SPDX-License-Identifier: MIT
"""Random checkpoints with a published size: they cost as much time and memory as trained ones.

Tokenizers are the tests' small ones, which make more tokens from a text than Qwen's. The ordinary Qwen3-VL gets weights
that make it write "ANSWER: 4", because RoboReward's time depends on the answer's length.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

GOLDEN = Path(__file__).parents[1] / "tests" / "golden"
ROBOMETER, QWEN, RYNNVALUE = "robometer", "qwen", "rynnvalue"  # checkpoint kinds
DESCRIBED = {"robot_description": "a Franka single-arm robot", "camera_description": "the main right camera"}
SOURCES = {  # small checkpoints that provide all other files
    ROBOMETER: GOLDEN / "vlm" / "q3_tok_disc10_bf16" / "checkpoint",
    QWEN: GOLDEN / "reward_models" / "roboreward" / "rr_tied_bf16" / "checkpoint",
    RYNNVALUE: GOLDEN / "reward_models" / "rynnvalue" / "bro_symlog_bf16_tied" / "checkpoint",
}
BASE_MODEL = GOLDEN / "vlm" / "bases" / "q3"  # Robometer's tokenizer
PREFIX, EMBEDDING, HEAD = "model.", "model.language_model.embed_tokens.weight", "lm_head.weight"
SHARDS = ("model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors")
ANSWER, PROMPT_END = "ANSWER: 4", "\n"
STD = 0.02  # for weights
ADDED_STD = 1e-6  # for a layer's last weights: a state stays its token's embedding
SCORE_HEADS = {"progress": 10, "success": 1, "preference": 1}  # outputs


@dataclass(frozen=True)
class Size:
    """Settings that override those in the small checkpoints.

    vocabulary: for the ordinary Qwen3-VL; 0: the small one
    published_heads: True: RynnValue's heads and bins have the published size
    """

    text: Mapping[str, Any] = field(default_factory=dict)
    vision: Mapping[str, Any] = field(default_factory=dict)
    vocabulary: int = 0
    published_heads: bool = False


TINY = Size(
    {"hidden_size": 64, "intermediate_size": 128, "num_attention_heads": 4, "num_key_value_heads": 2},
    {"depth": 2, "out_hidden_size": 64, "deepstack_visual_indexes": [0]},
)
QWEN3_VL_4B = Size(
    {
        "hidden_size": 2560, "intermediate_size": 9728, "num_attention_heads": 32, "num_key_value_heads": 8,
        "head_dim": 128, "num_hidden_layers": 36, "max_position_embeddings": 262144, "rope_theta": 5000000,
        "rope_scaling": {"rope_type": "default", "mrope_interleaved": True, "mrope_section": [24, 20, 20]},
    },
    {
        "hidden_size": 1024, "intermediate_size": 4096, "depth": 24, "num_heads": 16, "patch_size": 16,
        "out_hidden_size": 2560, "deepstack_visual_indexes": [5, 11, 17], "num_position_embeddings": 2304,
    },
    151_936,
    published_heads=True,
)  # fmt: skip


def write(folder: Path, kind: str, size: Size, device: str = "cpu") -> Path:
    """Write a checkpoint in bfloat16, and return its folder. Weights that all kinds share are written once.

    folder: for checkpoints with one size
    device: where the weights are drawn
    """
    from safetensors.torch import save_file

    of_kind = shutil.copytree(SOURCES[kind], folder / kind, ignore=shutil.ignore_patterns("*.safetensors", "metrics*"))
    config = json.loads((of_kind / "config.json").read_text())
    config["text_config"] |= size.text
    config["vision_config"] |= size.vision
    if kind == QWEN:
        config["text_config"]["vocab_size"] = size.vocabulary or config["text_config"]["vocab_size"]
        config["text_config"]["tie_word_embeddings"] = config["tie_word_embeddings"] = False
    if kind == RYNNVALUE and size.published_heads:
        from rfm.published.rynnvalue import PUBLISHED

        config |= {name: value for name, value in PUBLISHED.items() if name.endswith("_config")}
    (of_kind / "config.json").write_text(json.dumps(config, indent=2))
    generator = torch.Generator(device).manual_seed(0)
    shapes = _backbone_shapes(config)
    shared = folder / SHARDS[0]
    if not shared.exists():
        common = {name: _random(name, shape, generator) for name, shape in shapes.items() if name != EMBEDDING}
        save_file(common, shared, metadata={"format": "pt"})
        del common
    os.link(shared, of_kind / SHARDS[0])
    own = {EMBEDDING: _random(EMBEDDING, shapes[EMBEDDING], generator)}
    if kind == RYNNVALUE:
        own |= _value_heads(config)
    else:
        own |= _score_heads(shapes[EMBEDDING][1]) if kind == ROBOMETER else _answering_head(of_kind, own)
    save_file(own, of_kind / SHARDS[1], metadata={"format": "pt"})
    places = dict.fromkeys(shapes, SHARDS[0]) | dict.fromkeys(own, SHARDS[1])
    index = {"metadata": {}, "weight_map": places}
    (of_kind / "model.safetensors.index.json").write_text(json.dumps(index))
    return of_kind


def _backbone_shapes(config: Mapping[str, Any]) -> dict[str, Sequence[int]]:
    from transformers import Qwen3VLConfig, Qwen3VLModel

    with torch.device("meta"):
        told = {name: value for name, value in config.items() if name != "attn_implementation"}  # RynnValue's own
        network = Qwen3VLModel._from_config(Qwen3VLConfig(**told))
    return {PREFIX + name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}


def _random(name: str, shape: Sequence[int], generator: torch.Generator) -> torch.Tensor:
    if len(shape) == 1:
        made = torch.full(shape, 0.0 if name.endswith("bias") else 1.0)
    else:
        adds = "language_model" in name and name.endswith(("o_proj.weight", "down_proj.weight"))
        std = ADDED_STD if adds else STD
        made = torch.empty(shape, dtype=torch.bfloat16, device=generator.device).normal_(0, std, generator=generator)
    return made.to("cpu", torch.bfloat16)


def _score_heads(width: int) -> dict[str, torch.Tensor]:
    half = width // 2
    made = {"frame_pool_attn.weight": torch.randn(1, width)}
    for head, outputs in SCORE_HEADS.items():
        made[f"{head}_head.1.weight"], made[f"{head}_head.1.bias"] = torch.ones(half), torch.zeros(half)
        for layer, shape in ((0, (half, width)), (4, (outputs, half))):
            name = f"{head}_head.{layer}"
            made[f"{name}.weight"] = torch.randn(shape) / math.sqrt(shape[1])
            made[f"{name}.bias"] = torch.zeros(shape[0])
    return {name: tensor.bfloat16() for name, tensor in made.items()}


def _value_heads(config: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    from rfm.families.rynnvalue.network import HeadConfig, ValueHead

    made: dict[str, torch.Tensor] = {}
    names = {"value": [f"value_heads.{number}" for number in range(config["num_value_heads"])]}
    names["relative_value"] = ["relative_value_head"]
    for kind, heads in names.items():
        told, bins = config[f"{kind}_head_config"], config[f"{kind}_tokenizer_config"]
        settings = HeadConfig(told["head_type"], told["hidden_dims"], told["depth"], told["activation"])
        num_inputs = config[f"{kind}_token_repeat"] * config["text_config"]["hidden_size"]
        for name in heads:
            head = ValueHead(settings, num_inputs, bins["bins"])
            made |= {f"{name}.{key}": tensor.bfloat16() for key, tensor in head.state_dict().items()}
    return made


def _answering_head(folder: Path, own: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return an output layer that predicts PROMPT_END + ANSWER token by token: the next token always scores highest."""
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(folder)
    (begin,), answer = (tokenizer(text).input_ids for text in (PROMPT_END, ANSWER))
    stop = json.loads((folder / "generation_config.json").read_text())["eos_token_id"][0]
    embedding = own[EMBEDDING]
    head = (torch.randn(embedding.shape, generator=torch.Generator().manual_seed(1)) * STD).bfloat16()
    for before, after in zip([begin, *answer], [*answer, stop], strict=True):
        head[after] = 8 * embedding[before]
    return {HEAD: head}
