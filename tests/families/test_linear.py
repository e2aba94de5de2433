# SPDX-License-Identifier: MIT
"""Linear layers: oneDNN's products equal those of ``nn.Linear``, and training keeps gradients."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from rfm.engine.layers import WORTH_ONEDNN, Linear, linear, speed_up

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
    """Records the calls of oneDNN's operator."""

    by_onednn = False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.by_onednn |= func.namespace == "mkldnn"
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
def test_what_is_no_number_stays_none(options: dict[str, Any]) -> None:
    """Or a broken weight would give finite scores, which are wrong."""
    for weight_value, bias_value in ((float("nan"), 0.0), (0.0, float("nan")), (float("inf"), float("-inf"))):
        weight, bias = torch.zeros(256, 512), torch.zeros(256)
        weight[7, 3], bias[7] = weight_value, bias_value
        with torch.inference_mode():
            product = linear(torch.ones(64, 512), weight, bias, **options)
        assert product[:, 7].isnan().all()
        assert product.isnan().sum() == 64


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
