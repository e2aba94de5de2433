# SPDX-License-Identifier: MIT
"""Count the work of networks of a published size, without a GPU and without memory for weights.

    python benchmarks/count.py

Prints a Markdown table. The networks and samples are those of real_size.py. They run on PyTorch's meta device, whose
tensors have shapes but no values, so the counts do not depend on this machine. All code of the engine runs as on a GPU.
What it reads from the device is 0, so a written answer has its full length.

passes: of the language model, also for each written token
padding: share of the tokens
kernels: operators that compute; attention and RMSNorm count as one each, as GPUs have kernels for them
TFLOP: of matrix products and attention; half of the products of causal attention
element-wise GB: tensors read and written by all other operators
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any
from unittest import mock

import torch
import typer
from real_size import asked_in_words, noise, robometer
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from rfm.engine import Engine
from rfm.engine.execution import Execution

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


def counted(
    what: str, engine: Engine, device: torch.device, num_samples: int, num_frames: int, size_px: tuple[int, int]
) -> dict[str, Any]:
    """Return the row of a batch of noise videos."""
    execution, passes = Execution(), []
    last: Any = engine.predictor.network.model.language_model.norm  # type: ignore[attr-defined]  # of these families
    hook = last.register_forward_hook(lambda *_: passes.append(1))
    with without_autocast(), Count() as count:
        engine.evaluate(noise(num_samples, num_frames, size_px), execution)
    hook.remove()
    row = (
        what, num_samples, num_frames, "x".join(map(str, size_px)), execution.num_tokens,
        f"{execution.padding_ratio:.1%}", len(passes), count.num_kernels, f"{count.num_flop / 1e12:.2f}",
        f"{count.num_bytes / 1e9:.1f}",
    )  # fmt: skip
    typer.echo(f"| {' | '.join(map(str, row))} |")
    return dict(zip(COLUMNS, row, strict=True))


def main() -> None:
    """Count all, and print the table."""
    typer.echo(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    robometer(META, counted)
    asked_in_words(META, counted)


if __name__ == "__main__":
    typer.run(main)
