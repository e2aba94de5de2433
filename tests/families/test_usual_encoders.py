# SPDX-License-Identifier: MIT
"""Encoders that are as wide as upstream's: the same, or told to be others."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import goldens
import rfm_export
from rfm.config import ExportConfig
from rfm.rewind import pretrained as usual

CHECKPOINT = goldens.config("c1_t1_disc10").checkpoint  # of upstream's widths, without encoders


def rewritten(file: Path, change: Callable[[Any], object]) -> None:
    """A JSON file, changed."""
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def published_image_encoder(folder: Path) -> None:
    """The files of facebook/dinov2-base that decide embeddings, but for its weights."""
    from transformers import Dinov2Config

    Dinov2Config().save_pretrained(folder)
    golden = goldens.config("enc_c1_t1_disc10").image_encoder
    assert golden is not None
    shutil.copyfile(golden / "preprocessor_config.json", folder / "preprocessor_config.json")
    change = {"size": {"shortest_edge": 256}, "crop_size": {"height": 224, "width": 224}}
    rewritten(folder / "preprocessor_config.json", lambda images: images.update(change))


def published_text_encoder(folder: Path) -> None:
    from transformers import BertConfig

    BertConfig(hidden_size=384, num_hidden_layers=12, num_attention_heads=12, intermediate_size=1536).save_pretrained(
        folder
    )


def change_config(**changes: object) -> Callable[[Path], None]:
    return lambda folder: rewritten(folder / "config.json", lambda config: config.update(changes))


def another_crop(folder: Path) -> None:
    crop = {"crop_size": {"height": 256, "width": 256}}
    rewritten(folder / "preprocessor_config.json", lambda images: images.update(crop))


OTHER_ENCODERS: dict[str, tuple[Callable[[Path], None], list[str]]] = {
    "as published": (lambda _folder: None, []),
    "registers": (change_config(model_type="dinov2_with_registers"), ["model_type: expected dinov2, got dinov2_with_registers"]),
    "another crop": (another_crop, ["crop_px: expected [224, 224], got [256, 256]"]),
    "another width": (change_config(hidden_size=384, num_attention_heads=6), []),  # of which the weights tell
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "expected"), OTHER_ENCODERS.values(), ids=OTHER_ENCODERS)
def test_an_image_encoder_as_wide_as_upstream_s_is_compared(
    tmp_path: Path, spoil: Callable[[Path], None], expected: list[str]
) -> None:
    published_image_encoder(tmp_path)
    spoil(tmp_path)
    assert usual.differences(usual.image_facts(str(tmp_path))) == expected


def test_a_text_encoder_as_wide_as_upstream_s_is_compared(tmp_path: Path) -> None:
    published_text_encoder(tmp_path)
    assert usual.differences(usual.text_facts(str(tmp_path))) == []
    change_config(num_hidden_layers=6)(tmp_path)
    expected = ["num_hidden_layers: expected 12, got 6"]
    assert usual.differences(usual.text_facts(str(tmp_path))) == expected


def test_encoders_that_are_not_upstream_s_are_told(tmp_path: Path) -> None:
    from transformers import AutoModel, BertConfig, Dinov2Config

    image, text = tmp_path / "image", tmp_path / "text"
    golden = goldens.config("enc_c1_t1_disc10")
    assert golden.image_encoder is not None
    assert golden.text_encoder is not None
    shutil.copytree(golden.text_encoder, text, copy_function=shutil.copyfile)
    small = Dinov2Config(num_hidden_layers=1, image_size=28, mlp_ratio=1)
    AutoModel.from_config(small).save_pretrained(image)
    shutil.copyfile(golden.image_encoder / "preprocessor_config.json", image / "preprocessor_config.json")
    config = BertConfig(
        hidden_size=384, num_hidden_layers=6, num_attention_heads=12, intermediate_size=8, vocab_size=180
    )
    AutoModel.from_config(config).save_pretrained(text)
    said: list[str] = []
    settings = ExportConfig(num_gpus=0, image_encoder=str(image), text_encoder=str(text))
    decisions = {each.name: each for each in rfm_export.explain(CHECKPOINT, settings, say=said.append)}
    *_, of_image, of_text, assumed = said
    assert of_image.startswith(
        f"{image}: differs from upstream's facebook/dinov2-base in num_hidden_layers: expected 12, got 1; "
    )
    assert of_text == (
        f"{text}: differs from upstream's sentence-transformers/all-MiniLM-L12-v2 in num_hidden_layers: expected 12, got 6; "
        "vocab_size: expected 30522, got 180: scores are right only if the run's embeddings were made with it"
    )
    assert "--text-encoder; only its width agrees" in assumed
    assert decisions["image_encoder_settings"].value["crop_px"] == [56, 56]
