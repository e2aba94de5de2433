# SPDX-License-Identifier: MIT
"""Count the work of networks of a published size, without a GPU and without memory for weights.

    python benchmarks/count.py

Prints a Markdown table. The networks run on PyTorch's meta device, whose tensors have shapes but no values, so the
counts do not depend on this machine. All code of the engine runs as on a GPU. Values that it reads from the device are
0, so a draft of zeros is accepted, and a written answer has the full length. Tokenizers are the tests' small ones,
which make more tokens of text than Qwen's.

passes: of the language model, also for each written token
padding: share of the tokens
kernels: operators that compute; attention and RMSNorm count as one each, as GPUs have kernels for them
TFLOP: of matrix products and attention; half of the products of causal attention
element-wise GB: tensors read and written by all other operators
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
import typer
from random_checkpoints import QWEN3_VL_4B
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from rfm import families
from rfm.engine import Engine
from rfm.engine.execution import Execution
from rfm.vlm.language import LanguageNetwork
from rfm.vlm.network import VlmRewardModel, build_backbone
from rfm.vlm.predictor import VlmPredictor
from rfm_client import ProgressSample, Trajectory

GOLDEN = Path(__file__).parents[1] / "tests" / "golden"
WRITTEN_TOKENS = 6  # of "ANSWER: 4" and its end
SMALL_PX, USUAL_PX = (224, 224), (480, 640)
ROBOMETER, ROBOREWARD, TOPREWARD = "Robometer", "roboreward", "topreward"
ROWS: list[tuple[str, int, int, tuple[int, int]]] = [  # reward model, samples, frames, their size
    *((ROBOMETER, count, 8, size_px) for size_px in (SMALL_PX, USUAL_PX) for count in (1, 8, 32)),
    *((ROBOREWARD, count, 8, USUAL_PX) for count in (1, 8)),
    *((f"{ROBOREWARD}-expected", count, 8, USUAL_PX) for count in (1, 8)),
    *((TOPREWARD, 1, count, SMALL_PX) for count in (16, 64)),
    (TOPREWARD, 1, 16, USUAL_PX),
    (f"{TOPREWARD},num_prefixes=15", 1, 64, SMALL_PX),
]

META = torch.device("meta")
ATTENTION = torch.ops.aten.scaled_dot_product_attention.default
RMS_NORM = torch.ops.aten.rms_norm.default
ASKS = torch.ops.aten._local_scalar_dense.default
READS = torch.ops.aten._to_copy.default
NO_KERNEL = {
    "_unsafe_view",
    "detach",
    "empty",
    "empty_like",
    "empty_strided",
    "lift_fresh",
    "new_empty",
}  # besides views
COLUMNS = (
    "reward model", "samples", "frames", "size", "tokens", "padding", "passes", "kernels", "TFLOP", "element-wise GB",
)  # fmt: skip


class Count(TorchDispatchMode):
    """Counts the operators on the meta device within this context."""

    def __init__(self) -> None:
        super().__init__()
        self.num_kernels = self.num_flop = self.num_bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func is ATTENTION:
            return self._attention(*args, **kwargs)
        if func is RMS_NORM:
            return self._rms_norm(args[0])
        with self:
            parts = func.decompose(*args, **kwargs)
        if parts is not NotImplemented:
            return parts
        read = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        if func is READS and read[0].device == META and torch.device(kwargs.get("device") or META) != META:
            return torch.zeros(read[0].shape, dtype=kwargs.get("dtype") or read[0].dtype)
        if func is ASKS:
            return 0
        made = func(*args, **kwargs)
        written = [each for each in tree_leaves(made) if isinstance(each, Tensor)]
        name = func._schema.name.removeprefix("aten::")
        if any(each.device == META for each in written) and not func.is_view and name not in NO_KERNEL:
            self._add(func, args, kwargs, made, read + written)
        return made

    def _add(self, func: Any, args: Any, kwargs: Any, made: Any, tensors: list[Tensor]) -> None:
        self.num_kernels += 1
        if (flop := flop_registry.get(func._overloadpacket)) is not None:
            self.num_flop += flop(*args, **kwargs, out_val=made)
        elif func._overloadpacket in (torch.ops.aten.embedding, torch.ops.aten.index):  # reads no more than it writes
            self.num_bytes += 2 * _num_bytes(made)
        else:
            self.num_bytes += sum(map(_num_bytes, tensors))

    def _attention(self, query: Tensor, key: Tensor, value: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        """Return what flash attention gives: values in the layout [batch, length, heads, width]."""
        options = dict(zip(("attn_mask", "dropout_p", "is_causal"), args, strict=False)) | kwargs
        self.num_kernels += 1
        num_products = query.numel() * (key.shape[-2]) * 2
        self.num_flop += num_products if options.get("is_causal") else 2 * num_products
        shape = (*query.shape[:-1], value.shape[-1])
        return query.new_empty(shape[0], shape[2], shape[1], shape[3]).transpose(1, 2)

    def _rms_norm(self, x: Tensor) -> Tensor:
        self.num_kernels += 1
        self.num_bytes += 2 * _num_bytes(x)
        return torch.empty_like(x)


def _num_bytes(tensor: Tensor) -> int:
    """Return the bytes of a tensor; repeated values count once."""
    return min(tensor.numel() * tensor.element_size(), tensor.untyped_storage().nbytes())


@contextlib.contextmanager
def without_autocast() -> Iterator[None]:
    """A context in which transformers may ask for autocast, which the meta device does not have."""
    with mock.patch.object(torch, "autocast", lambda **_: contextlib.nullcontext()):
        yield


def engine_of(reward_model: str) -> Engine:
    """Return the engine of a network with 4 billion parameters, which need no memory."""
    if reward_model == ROBOMETER:
        return _robometer()
    folder = (
        "roboreward/rr_tied_bf16/checkpoint" if ROBOREWARD in reward_model else "topreward/checkpoints/vlm_fp32_untied"
    )
    small: Any = families.load(GOLDEN / "reward_models" / folder, reward_model=reward_model)
    config = _of_real_size(small.config, QWEN3_VL_4B.vocabulary)
    if hasattr(config, "max_new_tokens"):
        config = replace(config, max_new_tokens=WRITTEN_TOKENS)
    of_real_size = replace(small, config=config)
    images = small.collator.images
    collator = of_real_size.make_collator(
        small.collator.tokenizer, QWEN3_VL_4B.vision["patch_size"], images.normalisation
    )
    if len(getattr(collator, "draft", ())):
        collator.draft = np.zeros_like(collator.draft)
    vars(of_real_size)["collator"] = collator
    predictor = of_real_size.make_predictor(_network(LanguageNetwork, config), META, None)
    return Engine(predictor, max_sample_tokens=10**6)


def _robometer() -> Engine:
    folder = GOLDEN / "vlm" / "q3_tok_disc10_bf16" / "checkpoint"
    small: Any = families.load(folder, base_model=str(GOLDEN / "vlm" / "bases" / "q3"))
    config = _of_real_size(small.config, len(small.collator.tokenizer))
    collator = type(small.collator)(config, small.collator.tokenizer, small.collator.images)
    return Engine(VlmPredictor(_network(VlmRewardModel, config), collator, META))


def _of_real_size(config: Any, num_tokens: int) -> Any:
    text = {**config.backbone["text_config"], **QWEN3_VL_4B.text, "vocab_size": num_tokens}
    vision = {**config.backbone["vision_config"], **QWEN3_VL_4B.vision}
    return replace(config, backbone={**config.backbone, "text_config": text, "vision_config": vision}, dtype="bfloat16")


def _network(network_class: Any, config: Any) -> Any:
    with META:
        network = network_class(config, build_backbone(config, torch.bfloat16))
    for parameter in network.parameters():  # buffers stay float32
        parameter.data = parameter.data.bfloat16()
    return network.requires_grad_(False)


def counted(reward_model: str, num_samples: int, num_frames: int, size_px: tuple[int, int]) -> dict[str, Any]:
    """Return the table row of a batch of noise videos."""
    engine, random = engine_of(reward_model), np.random.default_rng(0)
    videos = random.integers(0, 256, (num_samples, num_frames, *size_px, 3), np.uint8)
    samples = [ProgressSample(Trajectory(frames=video, task="put the red block in the bowl")) for video in videos]
    execution, passes = Execution(), []
    last: Any = engine.predictor.network.model.language_model.norm  # type: ignore[attr-defined]  # of these families
    last.register_forward_hook(lambda *_: passes.append(1))
    with without_autocast(), Count() as count:
        engine.evaluate(samples, execution)
    row = (
        reward_model, num_samples, num_frames, "x".join(map(str, size_px)), execution.num_tokens,
        f"{execution.padding_ratio:.1%}", len(passes), count.num_kernels, f"{count.num_flop / 1e12:.2f}",
        f"{count.num_bytes / 1e9:.1f}",
    )  # fmt: skip
    return dict(zip(COLUMNS, row, strict=True))


def main() -> None:
    """Count all, and print the table."""
    typer.echo(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for row in ROWS:
        typer.echo(f"| {' | '.join(map(str, counted(*row).values()))} |")


if __name__ == "__main__":
    typer.run(main)
