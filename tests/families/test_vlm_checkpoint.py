# SPDX-License-Identifier: MIT
"""Vision-language checkpoints: the source of each setting, also of their processors."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import goldens
import spoilt
from engines import load_engine
from rfm import published
from rfm.engine import Engine
from rfm_client import ProgressSample, Result, RewardError
from spoilt import Spoil, in_json, in_yaml, nested, run_settings, settings, with_sources
from vlm import PLAIN, assert_close, load, video

SAMPLE = ProgressSample(video(0, 3, 60, 84))
TWICE = ("use_multi_image", "use_per_frame_progress_token")


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[str], Path]:
    return lambda name: spoilt.copied(goldens.config(name), tmp_path / name)


@pytest.fixture
def base(tmp_path: Path) -> Path:
    """A copy of a reference's base model."""
    return shutil.copytree(
        goldens.config(PLAIN).sources["base_model"], tmp_path / "base", copy_function=shutil.copyfile
    )


def scores(folder: Path, name: str, **sources: str) -> Result:
    (result,) = Engine.of(published.load(folder, **goldens.config(name).sources | sources)).evaluate([SAMPLE])
    assert not isinstance(result, RewardError), result
    return result


def as_transformers_5_writes(backbone: dict[str, Any]) -> None:
    text = backbone["text_config"]
    text["rope_parameters"] = {"rope_type": "default"} | (text.pop("rope_scaling") or {})
    text["rope_parameters"]["rope_theta"] = text.pop("rope_theta")
    text["pad_token_id"] = None
    backbone["vision_config"]["rope_parameters"] = {"rope_theta": 10000.0, "rope_type": "axial"}
    backbone["vision_config"]["model_type"] += "_vision"


def as_before_text_config(backbone: dict[str, Any]) -> None:
    text = backbone.pop("text_config")
    sections = text["rope_scaling"]["mrope_section"]
    for name, value in (text | {"rope_scaling": {"type": "mrope", "mrope_section": sections}}).items():
        backbone.setdefault(name, value)


FORMS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "Qwen2.5-VL of transformers 5": ("q25_mean_l2", in_json("config.json", as_transformers_5_writes)),
    "Qwen3-VL of transformers 5": (PLAIN, in_json("config.json", as_transformers_5_writes)),
    "Qwen2.5-VL without text_config": ("q25_mean_l2", in_json("config.json", as_before_text_config)),
}


@pytest.mark.parametrize(("name", "change"), FORMS.values(), ids=FORMS)
def test_a_checkpoint_in_another_form_scores_the_same(
    copied: Callable[[str], Path], name: str, change: Callable[[Path], None]
) -> None:
    folder = copied(name)
    change(folder)
    (expected,) = load_engine(name).evaluate([SAMPLE])
    assert_close(scores(folder, name), expected, 1e-6)  # sums differ with where weights lie in memory


@pytest.mark.parametrize(
    ("name", "version", "is_told"),
    [
        ("q25_video_last_l2", "5.5.4", True),
        ("q25_video_last_l2", "4.57.6", False),
        ("q25_mean_l2", "5.5.4", False),
        (PLAIN, "5.5.4", False),
    ],
)
def test_a_video_run_of_transformers_5_gets_a_note_about_its_positions(
    copied: Callable[[str], Path], name: str, version: str, is_told: bool
) -> None:
    folder = copied(name)
    in_json("config.json", lambda backbone: backbone.update(transformers_version=version))(folder)
    notes = published.notes(folder, published.read(folder, **goldens.config(name).sources))
    assert any(f"transformers_version is {version}: text behind a video" in note for note in notes) == is_told


def as_transformers_5_saves(base: Path) -> None:
    """Rewrites a processor's files."""
    config = json.loads((base / "tokenizer_config.json").read_text())
    special = config.pop("additional_special_tokens")
    config.pop("added_tokens_decoder")
    config |= {"extra_special_tokens": special, "backend": "tokenizers", "tokenizer_class": "TokenizersBackend"}
    (base / "tokenizer_config.json").write_text(json.dumps(config))
    images = json.loads((base / "preprocessor_config.json").read_text())
    (base / "processor_config.json").write_text(json.dumps({"image_processor": images}))
    template = json.loads((base / "chat_template.json").read_text())["chat_template"]
    (base / "chat_template.jinja").write_text(template)
    for file in base.iterdir():
        if file.name not in ("tokenizer.json", "tokenizer_config.json", "processor_config.json", "chat_template.jinja"):
            file.unlink()


@pytest.mark.parametrize("name", ["q25_mean_l2", PLAIN])
def test_a_processor_of_transformers_5_reads_the_same(tmp_path: Path, name: str) -> None:
    config, base = goldens.config(name), tmp_path / "base"
    shutil.copytree(config.sources["base_model"], base, copy_function=shutil.copyfile)
    as_transformers_5_saves(base)
    load(name, base=str(base)).save(tmp_path / "saved")
    (expected,) = load_engine(name).evaluate([SAMPLE])
    for folder in (config.checkpoint, tmp_path / "saved"):
        assert_close(scores(folder, name, base_model=str(base)), expected, 1e-6)


def test_fields_that_an_old_upstream_lacked_default_to_its_behaviour(copied: Callable[[str], Path]) -> None:
    folder = copied("q25_video_last_l2")
    (folder / "config.yaml").write_text(
        "model: {base_model_id: some/base}\ndata: {resized_height: 56, resized_width: 84}\n"
    )
    config = load("q25_video_last_l2", folder).config
    truths = (config.multi_image, config.per_frame_progress_token, config.progress_in_preference)
    assert (*truths, config.average_temporal_patches) == (False, False, False, False)
    assert (config.frame_pooling, config.pooling_temperature, config.size_px) == ("mean", 1.0, (56, 84))
    assert (config.dtype, config.trained_frames) == ("bfloat16", None)


@pytest.mark.parametrize("section", ["model", "data"])
def test_frame_settings_are_read_from_either_section(copied: Callable[[str], Path], section: str) -> None:
    folder = copied(PLAIN)
    in_yaml(lambda run: [run[section].pop(key) for key in TWICE])(folder)
    assert load(PLAIN, folder).config == load(PLAIN).config


IGNORED = {
    "a size for images": (PLAIN, run_settings("data", resized_height=112, resized_width=84)),
    "how images are pooled, for videos": (
        "q25_video_avg_disc10",
        run_settings("model", frame_pooling="attention", frame_pooling_attn_temperature=0.01),
    ),
}


@pytest.mark.parametrize(("name", "change"), IGNORED.values(), ids=IGNORED)
def test_settings_that_upstream_ignores_change_no_score(
    copied: Callable[[str], Path], name: str, change: Spoil
) -> None:
    folder = copied(name)
    change(folder)
    (expected,) = load_engine(name).evaluate([SAMPLE])
    assert_close(scores(folder, name), expected, 1e-6)
    assert load(name, folder).description == load(name).description


def test_the_processor_s_chat_template_wins_over_the_tokenizer_s(
    copied: Callable[[str], Path], base: Path, tmp_path: Path
) -> None:
    """Upstream prompts by the processor."""
    folder = copied(PLAIN)
    run_settings("model", base_model_id="org/own-qwen3-vl")(folder)
    of_tokenizer = "{% for message in messages %}of the tokenizer{% endfor %}"
    settings("tokenizer_config.json", chat_template=of_tokenizer)(base)

    def prompt(to: str) -> str:
        template = str(load(PLAIN, folder, str(base)).collator.tokenizer.chat_template)
        load(PLAIN, folder, str(base)).save(tmp_path / to)
        assert published.load(tmp_path / to).collator.tokenizer.chat_template == template
        return template

    assert prompt("1") == json.loads((base / "chat_template.json").read_text())["chat_template"]
    (base / "chat_template.json").unlink()
    assert prompt("2") == of_tokenizer
    (base / "chat_template.jinja").write_text("of the processor, in its newer file")
    assert prompt("3") == "of the processor, in its newer file"


IMAGES, VIDEOS, BOTH = "preprocessor_config.json", "video_preprocessor_config.json", "processor_config.json"
VIDEO = "q25_video_avg_disc10"


SIZES = {"do_resize": False, "size": {"longest_edge": 1, "shortest_edge": 1}, "resample": 0, "max_pixels": 5}
OF_TIMES = {"do_sample_frames": True, "fps": 1, "num_frames": 3, "cap_pixels_per_frame": True, "max_video_tokens": 9}
# Keys of a Qwen2VLImageProcessor beside those of the base model, as transformers 4.40 to 5.24 write them.
IDLE_KEYS = {
    "_valid_processor_keys": ["images", "do_resize"], "auto_map": {"AutoProcessor": "own.Processor"}, "crop_size": None,
    "data_format": "channels_first", "default_to_square": False, "device": None, "disable_grouping": None,
    "do_center_crop": False, "do_convert_rgb": False, "image_seq_length": 5, "pad_size": None, "return_tensors": None,
}  # fmt: skip
FEW = ("size", "patch_size", "temporal_patch_size", "merge_size", "image_mean", "image_std")
TAKEN: dict[str, tuple[str, Spoil]] = {
    "sizes, which Robometer's code decides": (PLAIN, settings(IMAGES, **SIZES)),
    "times of videos, which RFM's code decides": (VIDEO, settings(VIDEOS, **SIZES, **OF_TIMES)),
    "keys without effect": (PLAIN, settings(IMAGES, **IDLE_KEYS)),
    "an unknown setting that is off": (PLAIN, settings(IMAGES, sharpen=False, blur=None)),
    "few fields, as Qwen publishes": (PLAIN, in_json(IMAGES, lambda all: [all.pop(n) for n in [*all] if n not in FEW])),
    "the same in two files": (PLAIN, nested()),
    "more nulls in one of two files": (PLAIN, nested(image_mean=None, crop_size=None)),
    "images' settings for videos": (VIDEO, lambda base: (base / VIDEOS).unlink()),
    "other settings of images": (VIDEO, settings(IMAGES, image_mean=[0.1] * 3)),
}


@pytest.mark.parametrize(("name", "spoil"), TAKEN.values(), ids=TAKEN)
def test_a_setting_without_effect_changes_nothing(tmp_path: Path, name: str, spoil: Spoil) -> None:
    base = shutil.copytree(goldens.config(name).sources["base_model"], tmp_path / "base", copy_function=shutil.copyfile)
    spoil(base)
    assert load(name, base=str(base)).collator.images == load(name).collator.images


def test_transformers_5_s_file_of_videos_reads_the_same(tmp_path: Path) -> None:
    folder, options = with_sources("topreward", tmp_path)
    known = published.load(folder, **options).collator.images
    (folder / BOTH).write_text(json.dumps({"video_processor": json.loads((folder / VIDEOS).read_text())}))
    (folder / VIDEOS).unlink()
    assert published.load(folder, **options).collator.images == known
