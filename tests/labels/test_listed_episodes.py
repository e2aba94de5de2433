# SPDX-License-Identifier: MIT
"""Lists of episodes as messages show them."""

from __future__ import annotations

import pytest

from rfm_labels import parse_episodes
from rfm_labels.datasets.faults import listed


@pytest.mark.parametrize("numbers", [[0], [0, 1, 2], [3, 4, 9, 11, 12], [1, 3, 5]])
def test_listed_episodes_can_be_given_to_the_option(numbers: list[int]) -> None:
    assert parse_episodes(listed(numbers)) == numbers
