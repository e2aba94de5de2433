# SPDX-License-Identifier: MIT
"""The best tag on the Hub, the run of a snapshot, and the documents of settings."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from paths import ROOT
from rfm.checkpoint.hub import best_tag
from rfm.checkpoint.run_config import find_run_config
from rfm.rewind.network import RewindConfig
from rfm.vlm.network import VlmConfig


@pytest.mark.parametrize("config", [VlmConfig, RewindConfig])
def test_what_decides_each_setting_is_documented(config: type[VlmConfig | RewindConfig]) -> None:
    documented = next((ROOT / "docs").rglob("checkpoints.md")).read_text()
    assert [field.name for field in fields(config) if f"`{field.name}`" not in documented] == []


TAGS = {
    "the highest score": (["best-x-0.5-step-10", "best-x-0.75-step-5", "main"], "best-x-0.75-step-5"),
    "the first of equals, below 0": (["best-a--0.2-step-9", "best-b--0.2-step-2", "best-c--0.9-step-2"], "best-a--0.2-step-9"),
    "none": (["v1", "best-0.5", "best-a-1-step-2"], None),
}  # fmt: skip


@pytest.mark.parametrize(("tags", "expected"), TAGS.values(), ids=TAGS)
def test_the_best_tag(tags: list[str], expected: str | None) -> None:
    assert best_tag(tags) == expected


@pytest.mark.parametrize(("main", "is_found"), [("a" * 40, True), ("a" * 41, False), ("../other", False)])
def test_main_of_the_hub_s_cache_is_a_commit(tmp_path: Path, main: str, is_found: bool) -> None:
    snapshots = tmp_path / "snapshots"
    for folder in (snapshots / "of-the-tag", snapshots / ("a" * 40), tmp_path / "refs"):
        folder.mkdir(parents=True)
    (snapshots / ("a" * 40) / "config.yaml").write_text("{}")
    (tmp_path / "refs" / "main").write_text(main)
    found = find_run_config(snapshots / "of-the-tag")
    assert found == ((snapshots / ("a" * 40) / "config.yaml").resolve() if is_found else None)
