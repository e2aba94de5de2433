# SPDX-License-Identifier: MIT
"""Preprocessing settings of a base model: applied, without effect, or refused."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

import goldens
import reward_models
from rfm import families
from rfm.families import CheckpointError
from spoilt import Spoil, copied, in_json, settings
from vlm import PLAIN, load

IMAGES, VIDEOS, BOTH = "preprocessor_config.json", "video_preprocessor_config.json", "processor_config.json"
VIDEO = "q25_video_avg_disc10"


def loaded(name: str, spoil: Spoil, tmp_path: Path) -> Any:
    """Return a reference checkpoint's collator after a change of the base model."""
    sources = goldens.config(name).sources
    base = shutil.copytree(sources["base_model"], tmp_path / "base", copy_function=shutil.copyfile)
    spoil(base)
    return load(name, base=str(base)).collator


def nested(**changes: Any) -> Spoil:
    """Transformers 5's file beside those of transformers 4, with the same content but for ``changes``."""

    def spoil(base: Path) -> None:
        content = json.loads((base / IMAGES).read_text())
        (base / BOTH).write_text(json.dumps({"image_processor": content | changes}))

    return spoil


def without(file: str, *names: str) -> Spoil:
    return in_json(file, lambda content: [content.pop(name) for name in names])


OF_IMAGES, OF_VIDEOS = "preprocessing of images: ", "preprocessing of videos: "
UNAPPLIED = (
    ", which is not applied here and may change pixels; if the model was trained without it, remove it from a copy"
)
REFUSED: dict[str, tuple[str, Spoil, str]] = {
    "no normalisation": (PLAIN, settings(IMAGES, do_normalize=False), f"{OF_IMAGES}do_normalize: expected true, got false{UNAPPLIED}"),
    "no rescaling": (PLAIN, settings(IMAGES, do_rescale=False), f"{OF_IMAGES}do_rescale: expected true, got false{UNAPPLIED}"),
    "another scale": (PLAIN, settings(IMAGES, rescale_factor=1 / 127.5), f"{OF_IMAGES}rescale_factor: expected 1/255, got 0.00784"),
    "a crop": (PLAIN, settings(IMAGES, do_center_crop=True), f"{OF_IMAGES}do_center_crop: expected false, got true{UNAPPLIED}"),
    "wider tokens": (PLAIN, settings(IMAGES, merge_size=4), f"{OF_IMAGES}merge_size: expected 2, got 4{UNAPPLIED}"),
    "longer patches": (PLAIN, settings(IMAGES, temporal_patch_size=1), f"{OF_IMAGES}temporal_patch_size: expected 2, got 1{UNAPPLIED}"),
    "an unknown setting": (PLAIN, settings(IMAGES, sharpen=True), f"{OF_IMAGES}sharpen: expected a known setting, got true{UNAPPLIED}"),
    "other patches": (PLAIN, settings(IMAGES, patch_size=14), f"{OF_IMAGES}patch_size: expected 16, as vision_config of config.json, got 14"),
    "no patches": (PLAIN, without(IMAGES, "patch_size"), f"{OF_IMAGES}patch_size: expected 16, as vision_config of config.json, got none"),
    "one mean": (PLAIN, settings(IMAGES, image_mean=0.5), f"{OF_IMAGES}image_mean: expected 3 numbers, got 0.5"),
    "two means": (PLAIN, settings(IMAGES, image_mean=[0.5, 0.5]), f"{OF_IMAGES}image_mean: expected 3 numbers, got [0.5, 0.5]"),
    "a mean in words": (PLAIN, settings(IMAGES, image_mean=["a", 0, 0]), f"{OF_IMAGES}image_mean: expected 3 numbers, got ['a', 0, 0]"),
    "no deviation": (PLAIN, without(IMAGES, "image_std"), f"{OF_IMAGES}image_std: expected 3 numbers, got None"),
    "a deviation of 0": (PLAIN, settings(IMAGES, image_std=[0.5, 0, 0.5]), f"{OF_IMAGES}image_std: expected numbers above 0, got [0.5, 0, 0.5]"),
    "videos without normalisation": (VIDEO, settings(VIDEOS, do_normalize=False), f"{OF_VIDEOS}do_normalize: expected true, got false"),
    "two files that disagree": (
        PLAIN,
        nested(image_mean=[0.4] * 3),
        "/base: image_mean: expected one value, got preprocessor_config.json with [0.5, 0.5, 0.5] and image_processor of "
        "processor_config.json with [0.4, 0.4, 0.4]: transformers 4 reads the former, transformers 5 the latter; correct",
    ),
    "a setting in transformers 5's file alone": (PLAIN, nested(do_normalize=None, do_pad=True), f"{OF_IMAGES}do_pad: expected false, got true"),
    "no settings in transformers 5's file": (
        PLAIN,
        lambda base: (base / BOTH).write_text('{"image_processor": "none"}'),
        "processor_config.json: image_processor: expected settings, got 'none'",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "spoil", "message"), REFUSED.values(), ids=REFUSED)
def test_a_setting_that_is_not_applied_is_refused(tmp_path: Path, name: str, spoil: Spoil, message: str) -> None:
    with pytest.raises(CheckpointError, match=re.escape(message)):
        loaded(name, spoil, tmp_path)


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


OF_TOPREWARD, OF_ROBOREWARD = "topreward/checkpoints/vlm_fp32_untied", "roboreward/rr_tied_bf16/checkpoint"
ASKED: dict[str, tuple[dict[str, Any], str]] = {
    "a limit for each frame": ({"cap_pixels_per_frame": True}, f"cap_pixels_per_frame: expected false, got true{UNAPPLIED}"),
    "another limit for each frame": ({"max_video_tokens": 100}, f"max_video_tokens: expected 768, got 100{UNAPPLIED}"),
    "no normalisation": ({"do_normalize": False}, f"do_normalize: expected true, got false{UNAPPLIED}"),
    "frames in their own size": ({"do_resize": False}, f"do_resize: expected true, got false{UNAPPLIED}"),
    "another rate": ({"fps": 1}, f"fps: expected 2, got 1{UNAPPLIED}"),
    "pixels in the older form": ({"max_pixels": 50176}, f"max_pixels: expected null, got 50176{UNAPPLIED}"),
    "other patches": ({"patch_size": 14}, "patch_size: expected 16, as vision_config of config.json, got 14"),
    "one mean": ({"image_mean": 0.5}, "image_mean: expected 3 numbers, got 0.5"),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), ASKED.values(), ids=ASKED)
@pytest.mark.parametrize(("kind", "source"), [("topreward", OF_TOPREWARD), ("roboreward", OF_ROBOREWARD)])
def test_settings_of_videos_are_checked_for_models_that_are_asked(
    tmp_path: Path, kind: str, source: str, changes: dict[str, Any], message: str
) -> None:
    folder = shutil.copytree(reward_models.ROOT / source, tmp_path / "model", copy_function=shutil.copyfile)
    known = families.load(folder, reward_model=kind).collator.images
    content = json.loads((folder / VIDEOS).read_text())
    (folder / BOTH).write_text(json.dumps({"video_processor": content, "processor_class": "Qwen3VLProcessor"}))
    assert families.load(folder, reward_model=kind).collator.images == known
    settings(VIDEOS, **changes)(folder)
    (folder / BOTH).unlink()
    with pytest.raises(CheckpointError, match=re.escape(message)):
        _ = families.load(folder, reward_model=kind).collator


def test_frames_that_the_processor_does_not_pick_are_refused_where_it_must(tmp_path: Path) -> None:
    folder = shutil.copytree(reward_models.ROOT / OF_TOPREWARD, tmp_path / "model", copy_function=shutil.copyfile)
    settings(VIDEOS, do_sample_frames=False)(folder)
    families.load(folder, reward_model="topreward")
    with pytest.raises(CheckpointError, match="do_sample_frames: expected true, got false"):
        families.load(folder, reward_model="topreward-robometer")


VISION = {
    "no patches": (PLAIN, "vision_config", {"patch_size": None}, "vision_config.patch_size: expected a value, got none"),
    "patches in words": (PLAIN, "vision_config", {"patch_size": "16"}, "vision_config.patch_size: expected a whole number"),
    "no merged tokens": (PLAIN, "vision_config", {"spatial_merge_size": 0}, "vision_config.spatial_merge_size: expected a whole number of at least 1, got 0"),
    "half a patch": (PLAIN, "vision_config", {"temporal_patch_size": 0.5}, "vision_config.temporal_patch_size: expected a whole number of at least 1, got 0.5"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "part", "changes", "message"), VISION.values(), ids=VISION)
def test_a_vision_tower_without_sizes_is_refused(
    tmp_path: Path, name: str, part: str, changes: dict[str, Any], message: str
) -> None:
    folder = copied(goldens.config(name), tmp_path / "checkpoint")
    in_json("config.json", lambda content: content[part].update(changes))(folder)
    with pytest.raises(CheckpointError, match=re.escape(message)):
        load(name, folder)
