# SPDX-License-Identifier: MIT
"""Layers: oneDNN's products and the RMSNorm for GPUs equal PyTorch's and transformers' bit for bit; float32 stays float32."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

import goldens
from pretended import CUDA, pretended
from rfm import published
from rfm.engine import Engine
from rfm.engine.layers import MKL_FUNCTIONS, WORTH_ONEDNN, Linear, RmsNorm, is_rms_norm, linear, pack, speed_up
from rfm.qwen.decoder_layer import decoder_layers, turn_of
from vlm import PLAIN, load

LARGE, SMALL = (512, 256), (32, 16)  # [N, K] on either side of WORTH_ONEDNN


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def weight_of(shape: tuple[int, int]) -> Tensor:
    return torch.randn(shape) / shape[1] ** 0.5


@pytest.mark.parametrize("shape", [LARGE, SMALL], ids=["large", "small"])
@pytest.mark.parametrize("leading", [(1,), (33,), (5, 7), (0, 7)], ids=str)
@pytest.mark.parametrize("bias", [True, False])
def test_products_are_those_of_torch(shape: tuple[int, int], leading: tuple[int, ...], bias: bool) -> None:
    weight, offset = weight_of(shape), torch.randn(shape[0]) if bias else None
    x, plus = torch.randn(*leading, shape[1]), torch.randn(*leading, shape[0])
    expected = F.linear(x, weight, offset)
    with torch.inference_mode():
        torch.testing.assert_close(linear(x, weight, offset), expected, rtol=0, atol=1e-5)
        torch.testing.assert_close(linear(x, weight, offset, relu=True), expected.relu(), rtol=0, atol=1e-5)
        torch.testing.assert_close(linear(x, weight, offset, plus=plus), expected + plus, rtol=0, atol=1e-5)


def test_parts_of_a_weight_and_of_a_bias_and_views_of_an_input() -> None:
    weight, bias, x = weight_of((1536, 512)), torch.randn(2048)[::2], torch.randn(4, 9, 2, 512)
    with torch.inference_mode():
        for offset in (None, bias):
            actual = linear(x[:, 1::2, 1], weight[512:], offset)
            torch.testing.assert_close(actual, F.linear(x[:, 1::2, 1], weight[512:], offset), rtol=0, atol=1e-5)


class Operators(TorchDispatchMode):
    """Records the calls of oneDNN's operator, and whether with a packed weight."""

    by_onednn = by_packed = False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.by_onednn |= func.namespace == "mkldnn"
        self.by_packed |= any(isinstance(each, Tensor) and each.is_mkldnn for each in args)
        return func(*args, **(kwargs or {}))


def test_large_float32_products_without_gradients_are_onednns(monkeypatch: pytest.MonkeyPatch) -> None:
    enough = WORTH_ONEDNN // (LARGE[0] * LARGE[1])

    def asked(rows: int, dtype: torch.dtype = torch.float32) -> bool:
        with Operators() as operators:
            linear(torch.zeros(rows, LARGE[1], dtype=dtype), torch.zeros(LARGE, dtype=dtype), None)
        return operators.by_onednn

    assert not asked(enough)
    with torch.inference_mode():
        assert asked(enough)
        assert not asked(enough - 1)
        assert not asked(enough, torch.bfloat16)
        monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
        assert not asked(enough)


@pytest.mark.parametrize("options", [{}, {"relu": True}, {"plus": torch.zeros(64, 256)}], ids=["", "relu", "plus"])
def test_nan_and_infinite_weights_give_nan_products(options: dict[str, Any]) -> None:
    """Or a broken weight would give finite scores, which are wrong."""
    for weight_value, bias_value in ((float("nan"), 0.0), (0.0, float("nan")), (float("inf"), float("-inf"))):
        weight, bias = torch.zeros(256, 512), torch.zeros(256)
        weight[7, 3], bias[7] = weight_value, bias_value
        with torch.inference_mode():
            product = linear(torch.ones(64, 512), weight, bias, **options)
        assert product[:, 7].isnan().all()
        assert product.isnan().sum() == 64


@pytest.mark.parametrize("options", [{}, {"relu": True}, {"plus": torch.randn(5, 7, 512)}], ids=["", "relu", "plus"])
@pytest.mark.parametrize("count", [5, 1], ids=["large", "small"])
def test_a_packed_weight_gives_the_same_bits(options: dict[str, Any], count: int) -> None:
    network, x = Linear(*reversed(LARGE)), torch.randn(count, 7, LARGE[1])
    network.weight.data[9, 3] = float("nan")
    options = {name: value[:count] if isinstance(value, Tensor) else value for name, value in options.items()}
    with torch.inference_mode():
        expected = network(x, **options)
        pack(network)
        with Operators() as operators:
            torch.testing.assert_close(network(x, **options), expected, rtol=0, atol=0, equal_nan=True)
        assert operators.by_packed == (count == 5)
        network.weight.zero_()
        assert network(x).equal(network.bias.expand(count, 7, -1))


def test_speed_up_keeps_parameters_numbers_and_gradients() -> None:
    network = nn.Sequential(nn.Linear(256, 512), nn.Sequential(nn.GELU(), nn.Linear(512, 256, bias=False))).eval()
    names, x = list(network.state_dict()), torch.randn(7, 256)
    weight, expected = network[0].weight, network(x)
    speed_up(network)
    assert list(network.state_dict()) == names
    assert network[0].weight is weight
    assert [type(layer) for layer in network.modules()].count(Linear) == 2
    with torch.inference_mode():
        torch.testing.assert_close(network(x), expected, rtol=0, atol=1e-5)
    network(x).sum().backward()
    assert weight.grad is not None and weight.grad.abs().sum() > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 300.0], ids=str)
def test_a_norm_of_gpus_gives_the_bits_of_transformers_norm(scale: float, dtype: torch.dtype) -> None:
    """Return values from epsilon's root to the largest channels of trained networks."""
    norm: Any = load(PLAIN).build(dtype).model.language_model.norm
    torch.manual_seed(0)
    norm.weight.normal_(1, 0.3)
    x = (torch.randn(2, 33, len(norm.weight)) * scale).to(dtype)
    with torch.inference_mode():
        assert torch.equal(RmsNorm(norm.weight, norm.variance_epsilon)(x), norm(x))


@pytest.mark.parametrize("name", [PLAIN, "q25_boundary_disc10"])
def test_all_norms_are_replaced_on_a_device_and_none_on_the_cpu(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On CPUs, PyTorch's own RMSNorm is slower in bfloat16."""
    network = load(name).build(torch.float32)
    num_norms, names = sum(map(is_rms_norm, network.modules())), list(network.state_dict())
    speed_up(network)
    assert sum(map(is_rms_norm, network.modules())) == num_norms > 0
    with pretended(monkeypatch):
        network.to(CUDA)
        speed_up(network)
    assert sum(map(is_rms_norm, network.modules())) == 0
    assert sum(isinstance(module, RmsNorm) for module in network.modules()) == num_norms
    assert list(network.state_dict()) == names


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("name", [PLAIN, "q25_boundary_disc10"])
@pytest.mark.parametrize("is_masked", [False, True], ids=["causal", "masked"])
def test_decoder_layers_give_the_bits_of_transformers_layers(name: str, dtype: torch.dtype, is_masked: bool) -> None:
    language: Any = load(name).build(dtype).eval().model.language_model
    for parameter in language.parameters():
        torch.nn.init.normal_(parameter.data, 0.5, 0.3)
    states = torch.randn(2, 33, language.config.hidden_size).to(dtype)
    position_ids = torch.randint(0, 40, (3, 2, 33))
    mask = (torch.rand(2, 1, 33, 33) < 0.5) | torch.eye(33, dtype=torch.bool) if is_masked else None
    assert_equals_transformers(language, states, position_ids, mask)
    assert not [key for key in language.state_dict() if "_decoder_layers" in key]


@torch.inference_mode()
def assert_equals_transformers(language: Any, states: Tensor, position_ids: Tensor, mask: Tensor | None = None) -> None:
    turn = turn_of(language, states, position_ids)
    theirs = language.rotary_emb(states, position_ids)
    for layer, ours in zip(language.layers, decoder_layers(language), strict=True):
        expected = layer(states, position_embeddings=theirs, attention_mask=mask)
        expected = expected[0] if isinstance(expected, tuple) else expected
        assert torch.equal(ours(states, turn, mask, None), expected)


def _normal(language: Any, **options: bool) -> None:
    drawn = {name: torch.randn_like(value) for name, value in language.state_dict().items()}
    language.load_state_dict(drawn, **options)


@torch.inference_mode()
def _double(language: Any) -> None:
    for layer in language.layers:
        layer.self_attn.k_norm.weight.mul_(2)


def _of_inference(language: Any) -> None:
    """Weights whose changes PyTorch does not count."""
    with torch.inference_mode():
        _normal(language, assign=True)
    decoder_layers(language)
    _double(language)


CHANGES: dict[str, Callable[[Any], object]] = {
    "in place": _double,
    "loaded": _normal,
    "loaded and assigned": partial(_normal, assign=True),
    "made in inference mode": _of_inference,
    "rounded": lambda language: language.bfloat16().float(),
    "another layer": lambda language: language.layers.insert(0, language.layers.pop(-1)),
    "one layer less": lambda language: language.layers.pop(0),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_decoder_layers_follow_changed_weights(change: Callable[[Any], object]) -> None:
    language: Any = load(PLAIN).build(torch.float32).eval().model.language_model
    _normal(language)
    states, position_ids = torch.randn(1, 5, language.config.hidden_size), torch.randint(0, 9, (3, 1, 5))
    assert_equals_transformers(language, states, position_ids)
    made = decoder_layers(language)
    assert decoder_layers(language) is made
    change(language)
    assert_equals_transformers(language, states, position_ids)
    assert decoder_layers(language) is not made


def test_no_weights_are_copied_while_a_cuda_graph_is_captured(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for the capture."""
    language: Any = load(PLAIN).build(torch.float32).model.language_model
    decoder_layers(language)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    decoder_layers(language)
    _double(language)
    with pytest.raises(RuntimeError, match="expected the weights of the last pass, got others"):
        decoder_layers(language)


def test_the_first_calls_of_all_functions_of_mkl_are_made_by_one_thread() -> None:
    """A wrong first call is rare, so this compares the list with PyTorch's header."""
    header = Path(torch.__file__).parent / "include" / "ATen" / "cpu" / "vml.h"
    named = re.findall(r"^ *IMPLEMENT_VML_MKL\((\w+),", header.read_text(), re.MULTILINE)
    assert sorted(named) == sorted(function.__name__ for function in MKL_FUNCTIONS)
    assert "cos" in named


def test_an_engine_multiplies_float32_as_float32() -> None:
    torch.backends.cudnn.allow_tf32 = True
    torch.backends.cuda.matmul.allow_tf32 = True
    Engine.of(published.load(goldens.REWIND[0].checkpoint))
    assert not torch.backends.cudnn.allow_tf32
    assert not torch.backends.cuda.matmul.allow_tf32
