# SPDX-License-Identifier: MIT
"""Write the RLDS datasets of the tests, and the frames that TensorFlow decodes from them. See README.md."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow as tf
import tensorflow_datasets as tfds

COLOURS = ("image", "wrist_image")
LENGTHS = {"train": (5, 3, 6), "val": (4, 2)}
INSTRUCTIONS = ("open the drawer", "close the drawer", "pick up the cube", "push the button", "stack the cups")
IMAGES = {  # name: height, width, format
    "image": (24, 32, "jpeg"),
    "wrist_image": (16, 16, "png"),
    "image_padding": (16, 16, "jpeg"),
}


def picture(seed: int, step: int, height: int, width: int) -> np.ndarray[Any, Any]:
    """A coloured slope that brightens with the steps."""
    y, x = np.mgrid[:height, :width]
    channels = [y * 3 + 10 * seed, x * 3 + 20 * step, (x + y) * 2 + 15 * step]
    return np.stack(channels, -1).clip(0, 255).astype(np.uint8)


def observation(seed: int, step: int) -> dict[str, Any]:
    frames = {name: picture(seed, step, *IMAGES[name][:2]) for name in COLOURS}
    black = np.zeros((*IMAGES["image_padding"][:2], 3), np.uint8)
    depth = np.full((16, 16, 1), step, np.float32)
    return {**frames, "image_padding": black, "depth": depth, "state": np.zeros(7, np.float32)}


class _Robot(tfds.core.GeneratorBasedBuilder):
    VERSION = tfds.core.Version("1.0.0")
    IN_STEPS: bool

    def _info(self) -> tfds.core.DatasetInfo:
        images = {
            name: tfds.features.Image(shape=(height, width, 3), encoding_format=kind)
            for name, (height, width, kind) in IMAGES.items()
        }
        observations = {
            **images,
            "depth": tfds.features.Image(shape=(16, 16, 1), dtype=np.float32, encoding_format="png"),
            "state": tfds.features.Tensor(shape=(7,), dtype=np.float32),
        }
        step = {"observation": observations, "action": tfds.features.Tensor(shape=(7,), dtype=np.float32)}
        flags = dict.fromkeys(("is_first", "is_last", "is_terminal"), np.bool_)
        text = {"language_instruction": tfds.features.Text()} if self.IN_STEPS else {}
        about = {} if self.IN_STEPS else {"natural_language_instruction": tfds.features.Text()}
        features = {
            "steps": tfds.features.Dataset({**step, **flags, **text}),
            "episode_metadata": {"file_path": tfds.features.Text(), **about},
        }
        return tfds.core.DatasetInfo(builder=self, features=tfds.features.FeaturesDict(features))

    def _split_generators(self, _: Any) -> dict[str, Any]:
        return {split: self._generate_examples(split) for split in LENGTHS}

    def _generate_examples(self, split: str) -> Any:
        for number, length in enumerate(LENGTHS[split]):
            seed = number + 3 * (split == "val")
            yield number, self._episode(seed, length)

    def _episode(self, seed: int, length: int) -> dict[str, Any]:
        texts = [INSTRUCTIONS[seed]] * length
        if seed == 2:
            texts[3:] = ["put the cube into the box"] * (length - 3)
        steps = [
            {
                "observation": observation(seed, step),
                "action": np.zeros(7, np.float32),
                "is_first": step == 0,
                "is_last": step == length - 1,
                "is_terminal": step == length - 1,
                **({"language_instruction": texts[step]} if self.IN_STEPS else {}),
            }
            for step in range(length)
        ]
        about = {} if self.IN_STEPS else {"natural_language_instruction": INSTRUCTIONS[seed]}
        return {"steps": steps, "episode_metadata": {"file_path": f"{seed}.hdf5", **about}}


class ToyStepsTexts(_Robot):
    """Sentences in the steps."""

    IN_STEPS = True


class ToyEpisodeTexts(_Robot):
    """Sentences in the episodes."""

    IN_STEPS = False


def decoded(builder: Any, cameras: Sequence[str]) -> dict[str, Any]:
    """Frames of these cameras, and tasks, by split and number in the order of the files.

    JPEG files are decoded with the accurate inverse transform, as by Pillow; TensorFlow's default is the fast one.
    """
    keep = {"steps": {"observation": {name: tfds.decode.SkipDecoding() for name in IMAGES}}}
    arrays = {}
    for split in LENGTHS:
        order = tfds.ReadConfig(interleave_cycle_length=1)
        for number, episode in enumerate(builder.as_dataset(split, decoders=keep, read_config=order)):
            steps = list(episode["steps"])
            for name in cameras:
                kind = IMAGES[name][2]
                stored = [step["observation"][name] for step in steps]
                accurate = {"dct_method": "INTEGER_ACCURATE"} if kind == "jpeg" else {}
                decode = tf.io.decode_jpeg if kind == "jpeg" else tf.io.decode_png
                arrays[f"{split}/{number}/{name}"] = np.stack([decode(each, **accurate).numpy() for each in stored])
            texts = [step["language_instruction"].numpy().decode() for step in steps if "language_instruction" in step]
            told = episode["episode_metadata"].get("natural_language_instruction")
            arrays[f"{split}/{number}/task"] = np.array(texts or [told.numpy().decode()])
    return arrays


def main(folder: Path) -> None:
    for kind in (ToyStepsTexts, ToyEpisodeTexts):
        shutil.rmtree(folder / kind.name, ignore_errors=True)
        builder = kind(data_dir=folder)
        builder.download_and_prepare(download_config=tfds.download.DownloadConfig(num_shards=2))
        shutil.rmtree(folder / "downloads", ignore_errors=True)
        np.savez_compressed(folder / f"{kind.name}.npz", **decoded(builder, COLOURS if kind is ToyStepsTexts else ()))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
