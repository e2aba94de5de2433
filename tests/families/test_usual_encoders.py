# SPDX-License-Identifier: MIT
"""Encoders that are as wide as upstream's: the same, or told to be others."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

import goldens
from rfm import published
from rfm.published import rewind as usual
from spoilt import Spoil, settings

CHECKPOINT = goldens.config("c1_t1_disc10").checkpoint  # of upstream's widths, without encoders
ENCODED = goldens.config("enc_c1_t1_disc10").sources
PREPROCESSOR = "preprocessor_config.json"


def published_image_encoder(folder: Path) -> None:
    """The files of facebook/dinov2-base that decide embeddings, except the weights."""
    from transformers import Dinov2Config

    Dinov2Config().save_pretrained(folder)
    shutil.copyfile(Path(ENCODED["image_encoder"], PREPROCESSOR), folder / PREPROCESSOR)
    settings(PREPROCESSOR, size={"shortest_edge": 256}, crop_size={"height": 224, "width": 224})(folder)


def published_text_encoder(folder: Path) -> None:
    from transformers import BertConfig

    sizes = {"hidden_size": 384, "num_hidden_layers": 12, "num_attention_heads": 12, "intermediate_size": 1536}
    BertConfig(**sizes).save_pretrained(folder)


OF_IMAGE = (published_image_encoder, usual.image_differences)
OF_TEXT = (published_text_encoder, usual.text_differences)
OTHER_ENCODERS: dict[str, tuple[Any, Spoil, list[str]]] = {
    "images as published": (OF_IMAGE, lambda _folder: None, []),
    "registers": (OF_IMAGE, settings("config.json", model_type="dinov2_with_registers"), ["model_type: expected dinov2, got dinov2_with_registers"]),
    "another crop": (OF_IMAGE, settings("preprocessor_config.json", crop_size={"height": 256, "width": 256}), ["crop_px: expected (224, 224), got (256, 256)"]),
    "another brightness": (OF_IMAGE, settings("preprocessor_config.json", image_mean=[0.5, 0.456, 0.406]), ["mean: expected (0.485, 0.456, 0.406), got (0.5, 0.456, 0.406)"]),
    "another width": (OF_IMAGE, settings("config.json", hidden_size=384, num_attention_heads=6), []),  # as the weights tell
    "texts as published": (OF_TEXT, lambda _folder: None, []),
    "fewer layers": (OF_TEXT, settings("config.json", num_hidden_layers=6), ["num_hidden_layers: expected 12, got 6"]),
}  # fmt: skip


@pytest.mark.parametrize(("encoder", "spoil", "expected"), OTHER_ENCODERS.values(), ids=OTHER_ENCODERS)
def test_an_encoder_as_wide_as_upstream_s_is_compared(
    tmp_path: Path, encoder: Any, spoil: Spoil, expected: list[str]
) -> None:
    publish, differences = encoder
    publish(tmp_path)
    spoil(tmp_path)
    assert differences(str(tmp_path)) == expected


def test_encoders_that_differ_from_upstream_s_are_noted(tmp_path: Path) -> None:
    from transformers import AutoModel, BertConfig, Dinov2Config

    image, text = tmp_path / "image", tmp_path / "text"
    shutil.copytree(ENCODED["text_encoder"], text, copy_function=shutil.copyfile)
    small = Dinov2Config(num_hidden_layers=1, image_size=28, mlp_ratio=1)
    AutoModel.from_config(small).save_pretrained(image)
    shutil.copyfile(Path(ENCODED["image_encoder"], PREPROCESSOR), image / PREPROCESSOR)
    config = BertConfig(
        hidden_size=384, num_hidden_layers=6, num_attention_heads=12, intermediate_size=8, vocab_size=180
    )
    AutoModel.from_config(config).save_pretrained(text)
    loaded = published.read(CHECKPOINT, image_encoder=str(image), text_encoder=str(text))
    *_, of_image, of_text, assumed = published.notes(CHECKPOINT, loaded)
    assert of_image.startswith(
        f"{image}: differs from upstream's facebook/dinov2-base in num_hidden_layers: expected 12, got 1; "
    )
    assert of_text == (
        f"{text}: differs from upstream's sentence-transformers/all-MiniLM-L12-v2 in vocab_size: expected 30522, got 180; "
        "num_hidden_layers: expected 12, got 6: scores are right only if the run's embeddings were made with it"
    )
    assert "--text-encoder; only its width agrees" in assumed
