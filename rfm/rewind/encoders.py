# SPDX-License-Identifier: MIT
"""Raw frames and task -> the embeddings that a ReWiND transformer reads.

A DINOv2-type image encoder (its pooled output) and a BERT-type sentence encoder (the mean of its last
hidden state over the text's tokens, not normalised), both carried by ``transformers``.
N images, C = 3 channels, H x W pixels, T frames, L tokens, Dv and Dt widths of the embeddings.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from rfm.checkpoint.preprocessor import MAX_UINT8, PIL_BICUBIC, PREPROCESSOR_CONFIG
from rfm.execution import Execution
from rfm.layers.linear import speed_up
from rfm.layers.tensors import as_tensor
from rfm_client.contract import InferenceFailedError, InvalidSampleError, RewardError, Trajectory
from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.samples import Float32Array, Footage, UInt8Array, joined, stackable

IMAGES_PER_FORWARD = 64
MAX_ENCODER_ASPECT_RATIO = 50
_LOADING_PROBLEMS = ("missing_keys", "unexpected_keys", "mismatched_keys")  # as transformers tells of a load


@dataclass(frozen=True)
class ImagePreprocessor:
    """uint8 images -> normalised crops, bit for bit as the "fast" (torchvision) Bit image processor makes them.

    Shortest edge to ``resize_px`` (bicubic, antialiased, on uint8), centre crop to ``crop_px`` = (height, width),
    then per channel (value - 255 mean) / (255 std).
    """

    resize_px: int
    crop_px: tuple[int, int]
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @property
    def frame_size(self) -> FrameSize:
        """What becomes of a frame before it is cropped."""
        return FrameSize("shortest", (self.resize_px,))

    @classmethod
    def from_config(cls, config: Mapping[str, Any], where: str) -> ImagePreprocessor:
        """From the fields of preprocessor_config.json. Raises ValueError for steps other than the above."""
        crop = config.get("crop_size", {})
        required = {
            "do_resize": True,
            "do_center_crop": True,
            "do_rescale": True,
            "do_normalize": True,
            "resample": PIL_BICUBIC,
        }
        for name, value in required.items():
            if config.get(name) != value:
                raise ValueError(f"{where}: {name}: expected {value}, got {config.get(name)}")
        if abs(config.get("rescale_factor", 0.0) - 1 / MAX_UINT8) > 1e-9:
            raise ValueError(f"{where}: rescale_factor: expected 1/255, got {config.get('rescale_factor')}")
        if set(config.get("size", {})) != {"shortest_edge"} or set(crop) != {"height", "width"}:
            expected = "size {shortest_edge} and crop_size {height, width}"
            raise ValueError(f"{where}: expected {expected}, got {config.get('size')} and {crop}")
        return cls(
            resize_px=config["size"]["shortest_edge"],
            crop_px=(crop["height"], crop["width"]),
            mean=tuple(config["image_mean"]),
            std=tuple(config["image_std"]),
        )

    def __call__(self, images: Tensor) -> Tensor:
        """uint8 [N, H, W, C] -> float32 [N, C, *crop_px], on the CPU."""
        crops = self._crop(self._resize(images.permute(0, 3, 1, 2))).float()
        mean, std = (torch.tensor(values).view(-1, 1, 1) * MAX_UINT8 for values in (self.mean, self.std))
        return (crops - mean) / std

    def _resize(self, images: Tensor) -> Tensor:
        height, width = images.shape[-2:]
        short, long = min(height, width), max(height, width)
        resized = (self.resize_px, int(self.resize_px * long / short))
        size = resized if height <= width else resized[::-1]
        if size == (height, width):
            return images
        return F.interpolate(images, size, mode="bicubic", antialias=True)

    def _crop(self, images: Tensor) -> Tensor:
        height, width = images.shape[-2:]
        crop_height, crop_width = self.crop_px
        pad_height, pad_width = max(crop_height - height, 0), max(crop_width - width, 0)
        if pad_height or pad_width:
            sides = (pad_width // 2, (pad_width + 1) // 2, pad_height // 2, (pad_height + 1) // 2)
            images = F.pad(images, sides)
            height, width = images.shape[-2:]
        top, left = round((height - crop_height) / 2), round((width - crop_width) / 2)
        return images[..., top : top + crop_height, left : left + crop_width]


class Encoders:
    """An image and a text encoder with what goes before them. Built by ``from_pretrained``."""

    def __init__(self, image_model: Any, preprocessor: ImagePreprocessor, text_model: Any, tokenizer: Any) -> None:
        self.image_model = image_model.eval()
        self.preprocessor = preprocessor
        self.text_model = text_model.eval()
        for model in (image_model, text_model):
            speed_up(model)
        self.tokenizer = tokenizer

    @classmethod
    def from_pretrained(
        cls,
        image_source: str | Path,
        text_source: str | Path,
        *,
        image_weights: Mapping[str, Tensor] | None = None,
        text_weights: Mapping[str, Tensor] | None = None,
    ) -> Encoders:
        """From local folders or Hugging Face ids; given weights (a checkpoint's own) win over the source's.

        Raises ImportError without transformers, OSError for a source that cannot be had, ValueError for one
        that does not fit.
        """
        try:
            from transformers import AutoTokenizer
            from transformers.utils.hub import cached_file
        except ImportError as error:
            raise ImportError('raw frames need transformers: pip install ".[encoders]"') from error
        preprocessor_file = cached_file(str(image_source), PREPROCESSOR_CONFIG)
        preprocessor_config = json.loads(Path(str(preprocessor_file)).read_text())
        return cls(
            _load_model(image_source, image_weights),
            ImagePreprocessor.from_config(preprocessor_config, f"{image_source}/{PREPROCESSOR_CONFIG}"),
            _load_model(text_source, text_weights),
            AutoTokenizer.from_pretrained(str(text_source), use_fast=True, trust_remote_code=False),
        )

    def save_pretrained(self, image_folder: Path, text_folder: Path) -> None:
        """Writes both so that ``from_pretrained`` needs no network."""
        self.image_model.save_pretrained(image_folder)
        preprocessor = {
            "do_resize": True,
            "size": {"shortest_edge": self.preprocessor.resize_px},
            "resample": PIL_BICUBIC,
            "do_center_crop": True,
            "crop_size": dict(zip(("height", "width"), self.preprocessor.crop_px, strict=True)),
            "do_rescale": True,
            "rescale_factor": 1 / MAX_UINT8,
            "do_normalize": True,
            "image_mean": self.preprocessor.mean,
            "image_std": self.preprocessor.std,
            "image_processor_type": "BitImageProcessor",
        }
        (image_folder / PREPROCESSOR_CONFIG).write_text(json.dumps(preprocessor, indent=2) + "\n")
        self.text_model.save_pretrained(text_folder)
        self.tokenizer.save_pretrained(text_folder)

    def to(self, device: torch.device) -> Encoders:
        """Moves both encoders to ``device``."""
        self.image_model.to(device)
        self.text_model.to(device)
        return self

    @property
    def video_feature_dim(self) -> int:
        """Dv."""
        return int(self.image_model.config.hidden_size)

    @property
    def text_feature_dim(self) -> int:
        """Dt."""
        return int(self.text_model.config.hidden_size)

    def encode(self, samples: Sequence[Footage], execution: Execution | None = None) -> list[Trajectory | RewardError]:
        """The embeddings of each sample's frames, one trajectory after the other, and task, or why there are none.

        execution: what it took is added to it; its tokens are those of images, which have no padding, and of tasks
        """
        execution = execution or Execution()
        began_s, collated_s = time.perf_counter(), execution.collate_s
        outcomes: dict[int, Trajectory | RewardError] = {}
        for index, footage in enumerate(samples):
            try:
                self._check_task(footage.trajectories[0].task)
                for trajectory in footage.trajectories:
                    _check_shape(trajectory)
            except InvalidSampleError as error:
                outcomes[index] = error
        good = [index for index in range(len(samples)) if index not in outcomes]
        if good:
            parts = {index: stackable(samples[index].trajectories) for index in good}
            videos = self.encode_frames([joined(part) for of_sample in parts.values() for part in of_sample], execution)
            texts = self.encode_tasks([samples[index].trajectories[0].task for index in good], execution)
            encoded = iter(videos)
            for (index, of_sample), text in zip(parts.items(), texts, strict=True):
                outcomes[index] = _embedded(list(islice(encoded, len(of_sample))), text)
        execution.forward_s += time.perf_counter() - began_s - (execution.collate_s - collated_s)
        return [outcomes[index] for index in range(len(samples))]

    @torch.inference_mode()
    def encode_frames(
        self, videos: Sequence[UInt8Array], execution: Execution | None = None
    ) -> list[Float32Array | InferenceFailedError]:
        """uint8 [T, H, W, 3] of any T, H, W each -> float32 [T, Dv] each, or why there is none."""
        execution = execution or Execution()

        def forward(crops: Tensor) -> list[Tensor]:
            output = self.image_model(pixel_values=crops.to(self.image_model.device))
            num_tokens = output.last_hidden_state.shape[:2].numel()
            execution.add_tokens(num_tokens, num_tokens)
            return list(output.pooler_output.clone())  # as a view it would keep the states of all tokens

        batches = self._crop_batches(videos, execution)
        images = iter([image for crops in batches for image in execution.run(forward, crops)])
        return [_of_video(list(islice(images, len(video)))) for video in videos]

    @torch.inference_mode()
    def encode_tasks(
        self, tasks: Sequence[str], execution: Execution | None = None
    ) -> list[Float32Array | InferenceFailedError]:
        """float32 [Dt] of each task, or why there is none."""
        execution = execution or Execution()

        def forward(part: list[str]) -> list[Float32Array]:
            tokens = self._tokenize(part, padding=True, return_tensors="pt").to(self.text_model.device)
            hidden = self.text_model(**tokens).last_hidden_state
            execution.add_tokens(int(tokens["attention_mask"].sum()), tokens["attention_mask"].numel())
            mask = tokens["attention_mask"].unsqueeze(-1).to(hidden.dtype)
            return list(((hidden * mask).sum(dim=1) / mask.sum(dim=1)).float().cpu().numpy())

        return execution.run(forward, list(tasks))

    def _crop_batches(self, videos: Sequence[UInt8Array], execution: Execution) -> Iterator[Tensor]:
        """The crops of all videos' frames, in order, at most IMAGES_PER_FORWARD of them in memory."""
        waiting: list[Tensor] = []
        for video in videos:
            for start in range(0, len(video), IMAGES_PER_FORWARD):
                images = as_tensor(video[start : start + IMAGES_PER_FORWARD])
                if sum(map(len, waiting)) + len(images) > IMAGES_PER_FORWARD:
                    yield torch.cat(waiting)
                    waiting = []
                started_s = time.perf_counter()
                waiting.append(self.preprocessor(images))  # on the CPU: nowhere else is uint8 resized antialiased
                execution.collate_s += time.perf_counter() - started_s
        yield torch.cat(waiting)

    def _check_task(self, task: str) -> None:
        """Raises InvalidSampleError for a task longer than the text encoder reads; it is never cut silently."""
        if not task.strip():
            raise InvalidSampleError.at("task", "a task sentence", repr(task))
        limit = min(self.tokenizer.model_max_length, self.text_model.config.max_position_embeddings)
        count = len(self._tokenize(task)["input_ids"])
        if count > limit:
            raise InvalidSampleError.at("task", f"at most {limit} tokens (limit of the text encoder)", str(count))

    def _tokenize(self, text: str | list[str], **options: Any) -> Any:
        # A task is data: "[SEP]" in it is five characters, not a separator.
        return self.tokenizer(text, split_special_tokens=True, verbose=False, **options)


def _of_video(images: Sequence[Tensor | InferenceFailedError]) -> Float32Array | InferenceFailedError:
    """float32 [T, Dv] from each frame's."""
    for image in images:
        if isinstance(image, InferenceFailedError):
            return image
    return torch.stack(images).float().cpu().numpy()  # type: ignore[arg-type]  # all are tensors


def _embedded(
    videos: Sequence[Float32Array | InferenceFailedError], text: Float32Array | InferenceFailedError
) -> Trajectory | RewardError:
    embeddings = []
    for outcome in (*videos, text):
        if isinstance(outcome, InferenceFailedError):
            return outcome
        if not np.isfinite(outcome).all():
            return InferenceFailedError("an encoder gave an embedding that is not finite")
        embeddings.append(outcome)
    return Trajectory(video_embeddings=np.concatenate(embeddings[:-1]), text_embedding=embeddings[-1])


def _check_shape(trajectory: Trajectory) -> None:
    """The shorter side is brought to size; a sliver of an image would become a huge one."""
    height, width = trajectory.positions.shape[1:3]
    if max(height, width) > MAX_ENCODER_ASPECT_RATIO * min(height, width):
        expected = f"frames at most {MAX_ENCODER_ASPECT_RATIO} times as long as wide"
        raise InvalidSampleError.at("frames", expected, f"{height} x {width}")


def _load_model(source: str | Path, weights: Mapping[str, Tensor] | None) -> Any:
    """The model of ``source``, with ``weights`` in place of its own. Raises ValueError unless they fit to the letter.

    transformers does the loading, since it knows how names of weights changed from release to release.
    """
    from transformers import AutoConfig, AutoModel

    with TemporaryDirectory() as folder:
        if weights is not None:
            AutoConfig.from_pretrained(str(source), trust_remote_code=False).save_pretrained(folder)
            tensors = {name: tensor.contiguous() for name, tensor in weights.items()}
            save_file(tensors, Path(folder) / "model.safetensors", metadata={"format": "pt"})
        try:
            model, loaded = AutoModel.from_pretrained(
                str(source) if weights is None else folder,
                use_safetensors=True,
                trust_remote_code=False,  # None would ask the user
                dtype=torch.float32,
                output_loading_info=True,
            )
        except RuntimeError as error:  # shapes
            raise ValueError(f"{source}: the encoder's weights do not fit: {error}") from error
    problems = ("missing_keys", "mismatched_keys") if weights is None else _LOADING_PROBLEMS
    found = {name: sorted(map(str, loaded[name])) for name in problems if loaded[name]}
    if found:  # transformers would leave missing ones random, and others out
        raise ValueError(f"{source}: the encoder's weights do not fit: {found}")
    return model
