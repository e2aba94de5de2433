# SPDX-License-Identifier: MIT
"""Preprocessing settings of a base model: applied, without effect, or refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import goldens
from rfm import published
from spoilt import Spoil, nested, settings, with_sources
from vlm import PLAIN, load

IMAGES, VIDEOS, BOTH = "preprocessor_config.json", "video_preprocessor_config.json", "processor_config.json"
VIDEO = "q25_video_avg_disc10"


def loaded(name: str, spoil: Spoil, tmp_path: Path) -> Any:
    """Return a reference checkpoint's collator after a change of the base model."""
    sources = goldens.config(name).sources
    base = shutil.copytree(sources["base_model"], tmp_path / "base", copy_function=shutil.copyfile)
    spoil(base)
    return load(name, base=str(base)).collator


SIZES = {"do_resize": False, "size": {"longest_edge": 1, "shortest_edge": 1}, "resample": 0, "max_pixels": 5}
OF_TIMES = {"do_sample_frames": True, "fps": 1, "num_frames": 3, "cap_pixels_per_frame": True, "max_video_tokens": 9}
# Keys of a Qwen2VLImageProcessor beside those of the base model, as transformers 4.40 to 5.24 write them.
FORMS = {
    "_valid_processor_keys": ["images", "do_resize"], "auto_map": {"AutoProcessor": "own.Processor"}, "crop_size": None,
    "data_format": "channels_first", "default_to_square": False, "device": None, "disable_grouping": None,
    "do_center_crop": False, "do_convert_rgb": False, "image_seq_length": 5, "pad_size": None, "return_tensors": None,
}  # fmt: skip
TAKEN: dict[str, tuple[str, Spoil]] = {
    "sizes, which Robometer's code decides": (PLAIN, settings(IMAGES, **SIZES)),
    "times of videos, which RFM's code decides": (VIDEO, settings(VIDEOS, **SIZES, **OF_TIMES)),
    "keys without effect": (PLAIN, settings(IMAGES, **FORMS)),
    "an unknown setting that is off": (PLAIN, settings(IMAGES, sharpen=False, blur=None)),
    "the same in two files": (PLAIN, nested()),
    "more nulls in one of two files": (PLAIN, nested(image_mean=None, crop_size=None)),
    "images' settings for videos": (VIDEO, lambda base: (base / VIDEOS).unlink()),
    "other settings of images": (VIDEO, settings(IMAGES, image_mean=[0.1] * 3)),
}


@pytest.mark.parametrize(("name", "spoil"), TAKEN.values(), ids=TAKEN)
def test_a_setting_without_effect_changes_nothing(tmp_path: Path, name: str, spoil: Spoil) -> None:
    assert loaded(name, spoil, tmp_path).images == load(name).collator.images


def test_transformers_5_s_file_of_videos_reads_the_same(tmp_path: Path) -> None:
    folder, options = with_sources("topreward", tmp_path)
    known = published.load(folder, **options).collator.images
    (folder / BOTH).write_text(json.dumps({"video_processor": json.loads((folder / VIDEOS).read_text())}))
    (folder / VIDEOS).unlink()
    assert published.load(folder, **options).collator.images == known
