# SPDX-License-Identifier: MIT
from __future__ import annotations

from collections.abc import Iterator

import pytest

from coded_env import Recorder


@pytest.fixture
def recorder() -> Iterator[Recorder]:
    with Recorder() as client:
        yield client
