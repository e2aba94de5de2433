# SPDX-License-Identifier: MIT
"""Checkpoints of the Hugging Face Hub and of its cache: the revision, the files, and what a repository lacks."""

from __future__ import annotations

import json
import re
import shutil
import socket
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch

import goldens
import local_hub
from rfm import files, published
from rfm.files import CheckpointError
from rfm.published.hub import best_tag
from rfm.published.run_config import find_run_config
from spoilt import settings, with_sources

WITH_IMAGES = "q3_tok_disc10"  # vision-language: every frame an image, with a progress token
TAG = "best-p-rank-0.8500-step-123"
UNTAGGED, TAGGED, WITHOUT = "org/name", f"org/other@{TAG}", "org/without"  # separate repositories
IN_SUBFOLDER, PICKLED, PICKLED_WITHIN = "org/runs/one/ckpt=5@v1", "org/pickled", "org/runs/pickled@v1"
LATE, LATE_ABOVE = "org/late/one/ckpt@v1", "org/late/two/ckpt@v1"
NOT_THERE, ABSENT, OTHER_TAG = "org/runs/none@v1", "org/absent/folder@v1", "org/name@v9"
ONLINE = (UNTAGGED, TAGGED, WITHOUT, IN_SUBFOLDER, PICKLED, PICKLED_WITHIN, NOT_THERE, LATE, LATE_ABOVE, ABSENT)
OFFLINE = (f"{UNTAGGED}@{TAG}", TAGGED, IN_SUBFOLDER, UNTAGGED, OTHER_TAG, ABSENT, f"{WITHOUT}@{TAG}", LATE, LATE_ABOVE)


def outcome(source: str) -> Any:
    """Return a checkpoint's configuration, or the refusal."""
    try:
        return published.load(source).config
    except CheckpointError as error:
        return str(error)


@pytest.fixture(scope="module")
def from_hub(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Ask the Hub, then, offline, the cache that this filled.

    Checkpoints are multi-image ones as upstream uploads them: the tag's commit lacks config.yaml, which main has.
    """
    folder = tmp_path_factory.mktemp("hub")
    tag, main, without, pickled, runs = (folder / name for name in ("tag", "main", "without", "pickled", "runs"))
    shutil.copytree(goldens.config(WITH_IMAGES).checkpoint, tag, copy_function=shutil.copyfile)
    for empty in (main, without, pickled):
        empty.mkdir()
    shutil.copytree(tag, runs / "one" / "ckpt=5")
    (runs / "one" / "ckpt=5" / "config.yaml").rename(runs / "one" / "config.yaml")
    (tag / "config.yaml").rename(main / "config.yaml")
    late, late_main = folder / "late", folder / "late_main"
    for run, place in (("one", "one/ckpt"), ("two", "two")):
        shutil.copytree(tag, late / run / "ckpt")
        (late_main / place).mkdir(parents=True)
        shutil.copy(main / "config.yaml", late_main / place)
    shutil.copy(main / "config.yaml", without / "README.md")
    torch.save({}, pickled / "pytorch_model.bin")
    torch.save({}, pickled / "optimizer.pt")
    shutil.copytree(pickled, runs / "pickled")
    mains = {UNTAGGED: main, TAGGED: main, WITHOUT: without}
    repositories = {source.partition("@")[0]: {"main": files, TAG: tag} for source, files in mains.items()}
    repositories |= {PICKLED: {"main": pickled}, "org/runs": {"main": main, "v1": runs}}
    repositories["org/late"] = {"main": late_main, "v1": late}
    with local_hub.hub(repositories) as endpoint, local_hub.asked(endpoint, folder / "cache"):
        online = {source: outcome(source) for source in ONLINE}
    with mock.patch("huggingface_hub.constants.HF_HUB_CACHE", str(folder / "cache")):
        return online | {f"offline {source}": outcome(source) for source in OFFLINE}


IN_CACHE = [f"offline {source}" for source in (f"{UNTAGGED}@{TAG}", TAGGED, UNTAGGED, IN_SUBFOLDER, LATE, LATE_ABOVE)]


@pytest.mark.parametrize("source", [UNTAGGED, TAGGED, IN_SUBFOLDER, LATE, LATE_ABOVE, *IN_CACHE])
def test_config_yaml_is_found_on_main_of_the_hub_s_repository(from_hub: dict[str, Any], source: str) -> None:
    expected: Any = published.load(goldens.config(WITH_IMAGES).checkpoint).config
    assert expected.multi_image and expected.per_frame_progress_token
    assert from_hub[source] == expected


REFUSED = {
    "pickles alone": (PICKLED, r"org/pickled@main: expected model\.safetensors, got pytorch_model\.bin: pickles may run code"),
    "pickles alone in a subfolder": (PICKLED_WITHIN, r"org/runs@v1: expected model\.safetensors, got pytorch_model\.bin: pickles"),
    "no such subfolder": (NOT_THERE, r"org/runs@v1: expected the folder none, got none of this name"),
    "offline, and another revision in the cache": (f"offline {OTHER_TAG}", rf"org/name@v9: cannot be fetched: HF_HUB_OFFLINE is set, and the cache has no such revision of it; there is .*; name one, .*; without it, name a revision that is in the cache: org/name@{TAG}, org/name@main$"),
    "offline, and not in the cache": (f"offline {ABSENT}", r"org/absent@v1: cannot be fetched: .*; there is no folder /.*/org/absent/folder@v1 either; name one"),
    "no such repository": (ABSENT, r"^org/absent@v1: cannot be fetched: http://127\.0\.0\.1:\d+ has no such repository, or requires a login "),
    "offline, and known to have no config.yaml": (f"offline {WITHOUT}@{TAG}", r"expected config\.yaml of the training run there"),
}  # fmt: skip


@pytest.mark.parametrize(("source", "message"), REFUSED.values(), ids=REFUSED)
def test_the_refusal_of_an_unusable_hub_repository_names_the_fault(
    from_hub: dict[str, Any], source: str, message: str
) -> None:
    assert re.search(message, from_hub[source]), from_hub[source]


CACHED = {
    "main": ({"main": True}, "main"),
    "the best tag": ({"main": True, TAG: True, "best-p-rank-0.2000-step-9": True}, TAG),
    "the best tag with weights": ({"main": True, TAG: False, "best-p-rank-0.2000-step-9": True}, "best-p-rank-0.2000-step-9"),
}  # fmt: skip


@pytest.mark.parametrize(("revisions", "expected"), CACHED.values(), ids=CACHED)
def test_a_repository_in_the_cache_is_found_offline_and_its_revision_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, revisions: dict[str, bool], expected: str
) -> None:
    home = tmp_path / "models--org--name"
    for name, has_weights in revisions.items():
        snapshot = home / "snapshots" / local_hub.commit_of(name)
        snapshot.mkdir(parents=True)
        (snapshot / ("model.safetensors" if has_weights else "README.md")).touch()
        (snapshot / "config.yaml").touch()
        (home / "refs").mkdir(exist_ok=True)
        (home / "refs" / name).write_text(local_hub.commit_of(name))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    lines: list[str] = []
    commit = local_hub.commit_of(expected)
    assert published.find("org/name", lines.append) == home / "snapshots" / commit
    used = f"org/name@{expected} of the cache is used (commit {commit}), because HF_HUB_OFFLINE is set; the Hub may"
    assert [line[: len(used)] for line in lines] == [used]
    assert published.find(f"org/name@{expected}", lines.append) == home / "snapshots" / commit
    assert len(lines) == 1


def test_the_hub_gives_all_files_that_are_read_in_a_folder(tmp_path: Path) -> None:
    """The tokenizer's configuration has an older chat template, as in repositories that were saved again."""
    folder, options = with_sources("roboreward", tmp_path)
    template = json.loads((folder / "chat_template.json").read_text())["chat_template"]
    (folder / "chat_template.json").unlink()
    (folder / "chat_template.jinja").write_text(template)
    older = template.replace("<|im_start|>", "<|im_start|>older ")
    assert older != template
    settings("tokenizer_config.json", chat_template=older)(folder)
    (folder / "additional_chat_templates").mkdir()
    (folder / "additional_chat_templates" / "tool_use.jinja").write_text("tools")
    for name in ("config.yml", "tokenizer.model", "README.md"):
        (folder / name).write_text("license: mit")
    files = sorted(str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file())
    (folder / "pytorch_model.bin").touch()
    (folder / "modeling.py").touch()
    with local_hub.hub({"org/asked": {"main": folder}}) as endpoint, local_hub.asked(endpoint, tmp_path / "cache"):
        fetched = published.find("org/asked")
    assert sorted(str(file.relative_to(fetched)) for file in fetched.rglob("*") if file.is_file()) == files
    shutil.rmtree(fetched / "additional_chat_templates")  # which transformers leaves open
    assert "older" not in published.load(fetched, **options).collator.example()


@pytest.mark.slow
def test_a_hub_that_does_not_answer_is_refused_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as silent, socket.create_server(("127.0.0.1", 0)) as closed:
        addresses = [f"http://127.0.0.1:{each.getsockname()[1]}" for each in (silent, closed)]
        closed.close()
        reasons = (f"{addresses[0]} did not answer within 1 s", f"{addresses[1]} cannot be reached: Connection refused")
        for address, reason in zip(addresses, reasons, strict=True):
            with local_hub.asked(address, tmp_path / "cache", timeout_s=1):
                for source, absent in {
                    "org/name": "the cache has neither a best revision nor a main with weights",
                    "org/name@v1": "the cache has no such revision of it",
                }.items():
                    assert outcome(source) == (
                        f"{source}: cannot be fetched: {reason}, and {absent}; there is no folder {tmp_path}/{source} "
                        "either; name one, or see to the Hub's name, login and network"
                    )


def test_a_base_model_of_the_hub_is_read_from_the_cache_once_the_hub_is_gone(tmp_path: Path) -> None:
    folder, options = with_sources(WITH_IMAGES, tmp_path)
    base = Path(options["base_model"])
    template = json.loads((base / "chat_template.json").read_text())["chat_template"]
    (base / "chat_template.json").unlink()
    (base / "chat_template.jinja").write_text(template)
    run = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(re.sub(r"base_model_id: \S+", "base_model_id: org/base-qwen3-vl", run))

    def template_of(base_model: str) -> str:
        files._main_of.cache_clear()
        return str(published.load(folder, base_model=base_model).collator.tokenizer.chat_template)

    with local_hub.hub({"org/base": {"main": base}}) as endpoint, local_hub.asked(endpoint, tmp_path / "cache"):
        assert template_of("org/base") == template
        missing = rf"base model org/other: tokenizer and processor: {endpoint} has no such repository, or requires a"
        with pytest.raises(CheckpointError, match=missing):
            template_of("org/other")
    with local_hub.asked(endpoint, tmp_path / "cache"):
        assert template_of("org/base") == template
        with pytest.raises(CheckpointError, match=rf"{endpoint} cannot be reached: Connection refused, and the cache"):
            template_of("org/other")
    files._main_of.cache_clear()


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
