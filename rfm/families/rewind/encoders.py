# SPDX-License-Identifier: MIT
"""Encode raw frames and tasks into the embeddings that a ReWiND transformer reads.

A frame embedding is the pooled output of a DINOv2-type image encoder. A task embedding is the mean over all tokens in a
BERT-type sentence encoder's last hidden state, not normalised. Both networks come from ``transformers``.
T frames, H x W pixels, embedding widths Dv and Dt.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rfm.engine.device import Copies
from rfm.engine.execution import Execution
from rfm.engine.feature_cache import FeatureCache, digests_of, get_or_make
from rfm.engine.layers import as_tensor, speed_up
from rfm.engine.threads import IN_TURN, FrameThreads
from rfm.families.rewind.pretrained import (
    IMAGE_MODELS,
    TEXT_MODELS,
    ImagePreprocessor,
    load_model,
    load_preprocessor,
    load_tokenizer,
)
from rfm.files import PREPROCESSOR_CONFIG, read_json
from rfm_client.contract import InferenceFailedError, InvalidSampleError, RewardError, Trajectory
from rfm_client.contract.description import Description
from rfm_client.contract.samples import EncoderSample, Float32Array, NamedFrame, UInt8Array

IMAGE_ENCODER_FOLDER = "image_encoder"  # in an exported version of a model with encoders
TEXT_ENCODER_FOLDER = "text_encoder"
IMAGES_PER_FORWARD = 64
MAX_ENCODER_ASPECT_RATIO = 50


class Encoders:
    """An image encoder and a text encoder, with their preprocessing. Built by ``from_pretrained``."""

    def __init__(self, image_model: Any, preprocessor: ImagePreprocessor, text_model: Any, tokenizer: Any) -> None:
        self.image_model = image_model.eval()
        self.preprocessor = preprocessor
        self.text_model = text_model.eval()
        for model in (image_model, text_model):
            speed_up(model)
        self.tokenizer = tokenizer
        self.threads, self._copies = IN_TURN, Copies(torch.device("cpu"))

    @classmethod
    def from_pretrained(
        cls,
        image_source: str | Path,
        text_source: str | Path,
        *,
        image_weights: Mapping[str, Tensor] | None = None,
        text_weights: Mapping[str, Tensor] | None = None,
    ) -> Encoders:
        """Load the encoders from local folders or Hugging Face ids.

        image_weights, text_weights: a checkpoint's own, instead of the sources'
        Raises ImportError without transformers, OSError for a source that cannot be read, ValueError and
        CheckpointError for a source that does not fit.
        """
        try:
            import transformers  # noqa: F401
        except ImportError as error:
            raise ImportError('raw frames need transformers: pip install ".[encoders]"') from error
        image_model = load_model(image_source, image_weights, IMAGE_MODELS)
        preprocessor = load_preprocessor(image_source)
        text_model = load_model(text_source, text_weights, TEXT_MODELS)
        return cls(image_model, preprocessor, text_model, load_tokenizer(text_source, text_model.config.vocab_size))

    @classmethod
    def load(cls, folder: Path) -> Encoders:
        """Load the encoders that ``save`` wrote into ``folder``."""
        return cls.from_pretrained(folder / IMAGE_ENCODER_FOLDER, folder / TEXT_ENCODER_FOLDER)

    def save(self, folder: Path) -> None:
        """Write both encoders into ``folder``; ``load`` then needs no internet."""
        image_folder, text_folder = folder / IMAGE_ENCODER_FOLDER, folder / TEXT_ENCODER_FOLDER
        self.image_model.save_pretrained(image_folder)
        content = json.dumps(self.preprocessor.to_config(), indent=2)
        (image_folder / PREPROCESSOR_CONFIG).write_text(content + "\n")
        self.text_model.save_pretrained(text_folder)
        self.tokenizer.save_pretrained(text_folder)

    @classmethod
    def describe(cls, folder: Path) -> Description:
        """Describe the encoders that ``save`` wrote into ``folder``, without loading them."""
        file = folder / IMAGE_ENCODER_FOLDER / PREPROCESSOR_CONFIG
        preprocessor = ImagePreprocessor.from_config(read_json(file), str(file))
        return Description(network={"class": cls.__name__}, frame_size=preprocessor.frame_size)

    @property
    def description(self) -> Description:
        """The encoders' record in the export."""
        return Description(network={"class": type(self).__name__}, frame_size=self.preprocessor.frame_size)

    def to(self, device: torch.device) -> Encoders:
        """Move both encoders to ``device``, and return them."""
        self.image_model.to(device)
        self.text_model.to(device)
        self.threads, self._copies = FrameThreads.of(device), Copies(device)
        return self

    @property
    def video_feature_dim(self) -> int:
        """Dv, the width of a frame embedding."""
        return int(self.image_model.config.hidden_size)

    @property
    def text_feature_dim(self) -> int:
        """Dt, the width of a task embedding."""
        return int(self.text_model.config.hidden_size)

    def encode(
        self,
        samples: Sequence[EncoderSample],
        execution: Execution | None = None,
        cache: FeatureCache[Float32Array] | None = None,
    ) -> list[EncoderSample | RewardError]:
        """Return each sample with embeddings for its frames and task, or its error.

        execution: receives the costs, with image tokens (no padding) and task tokens
        cache: embedding cache, which encodes equal frames and tasks once; None: no cache, and no named frames
        """
        execution = execution or Execution()
        outcomes: dict[int, EncoderSample | RewardError] = {}
        for index, encoder_sample in enumerate(samples):
            try:
                self._check_task(encoder_sample.trajectories[0].task)
                for trajectory in encoder_sample.trajectories:
                    _check_shapes(trajectory)
            except InvalidSampleError as error:
                outcomes[index] = error
        good = [index for index in range(len(samples)) if index not in outcomes]
        if good:
            trajectories = [trajectory for index in good for trajectory in samples[index].trajectories]
            tasks = [samples[index].trajectories[0].task for index in good]
            with execution.forwarding():
                videos, texts = self._all_of(trajectories, tasks, execution, cache)
            remaining = iter(videos)
            for index, text in zip(good, texts, strict=True):
                outcomes[index] = _embedded([next(remaining) for _ in samples[index].trajectories], text)
        return [outcomes[index] for index in range(len(samples))]

    def _all_of(
        self,
        trajectories: Sequence[Trajectory],
        tasks: Sequence[str],
        execution: Execution,
        cache: FeatureCache[Float32Array] | None,
    ) -> tuple[Sequence[Float32Array | RewardError], Sequence[Float32Array | RewardError]]:
        """Return the embeddings of each trajectory's frames [T, Dv] and of each task [Dt]."""
        if cache is None:
            whole = [each.positions for each in trajectories]
            execution.num_encoded += sum(map(len, whole))
            return self.encode_frames(whole, execution), self.encode_tasks(tasks, execution)
        with execution.collating():
            videos = self._named(trajectories)
        frames = [frame for video in videos for frame in video]
        made, num_made = get_or_make(
            cache,
            (digest for digest, _ in frames),
            {digest: pixels for digest, pixels in frames if pixels.dtype == np.uint8},
            lambda missing: self._images(missing, execution),
            is_always_made=lambda frame: not frame.any(),  # the probe's frames: a cached result would prove nothing
        )
        images = {**dict(frames), **made}  # an embedding that came with the request may be evicted by now
        execution.num_encoded += num_made
        execution.num_found += len(images) - num_made
        sources = {task_digest(task): task for task in tasks}
        texts, _ = get_or_make(cache, sources, sources, lambda missing: self.encode_tasks(missing, execution))
        execution.cache_bytes = cache.num_bytes
        of_videos = [_of_video([images[digest] for digest, _ in video]) for video in videos]
        return of_videos, [texts[task_digest(task)] for task in tasks]

    def _named(self, trajectories: Sequence[Trajectory]) -> list[Sequence[NamedFrame]]:
        """Return the trajectories' frames with their digests."""
        whole = [frame for each in trajectories if each.named is None for frame in each.positions]
        named = zip(digests_of(whole, self.threads), whole, strict=True)
        return [list(islice(named, each.num_frames)) if each.named is None else each.named for each in trajectories]

    def encode_frames(
        self, videos: Sequence[UInt8Array], execution: Execution | None = None
    ) -> list[Float32Array | RewardError]:
        """Encode videos, uint8 [T, H, W, 3] each; return float32 [T, Dv] or an error for each."""
        images = iter(self._images([frame for video in videos for frame in video], execution or Execution()))
        return [_of_video(list(islice(images, len(video)))) for video in videos]

    @torch.inference_mode()
    def _images(
        self, frames: Sequence[UInt8Array], execution: Execution
    ) -> Sequence[Float32Array | InferenceFailedError]:
        """Return float32 [Dv] or an error for each frame [H, W, 3]. The frames may differ in size."""

        def forward(crops: Tensor) -> list[Tensor]:
            sent = self._copies.send(crops)
            self._copies.wait_for([sent])
            output = self.image_model(pixel_values=self.preprocessor.normalised(sent))
            num_tokens = output.last_hidden_state.shape[:2].numel()
            execution.add_tokens(num_tokens, num_tokens)
            return list(output.pooler_output.clone())  # a view would keep the states of all tokens in memory

        # A GPU computes these while the CPU prepares the next crops, until the embeddings are read.
        images = [image for crops in self._crop_batches(frames, execution) for image in execution.run(forward, crops)]
        made = [image for image in images if isinstance(image, Tensor)]
        read = iter(torch.stack(made).float().cpu().numpy() if made else ())
        return [next(read) if isinstance(image, Tensor) else image for image in images]

    @torch.inference_mode()
    def encode_tasks(
        self, tasks: Sequence[str], execution: Execution | None = None
    ) -> list[Float32Array | InferenceFailedError]:
        """Return float32 [Dt] or an error for each task."""
        execution = execution or Execution()

        def forward(part: list[str]) -> list[Float32Array]:
            tokens = self._tokenize(part, padding=True, return_tensors="pt")
            num_tokens = int(tokens["attention_mask"].sum())
            tokens = tokens.to(self.text_model.device)
            hidden = self.text_model(**tokens).last_hidden_state
            execution.add_tokens(num_tokens, tokens["attention_mask"].numel())
            mask = tokens["attention_mask"].unsqueeze(-1).to(hidden.dtype)
            return list(((hidden * mask).sum(dim=1) / mask.sum(dim=1)).float().cpu().numpy())

        return execution.run(forward, list(tasks))

    def _crop_batches(self, frames: Sequence[UInt8Array], execution: Execution) -> Iterator[Tensor]:
        """Yield the frames' crops in order, uint8 [N, H', W', 3], IMAGES_PER_FORWARD at a time."""
        for start in range(0, len(frames), IMAGES_PER_FORWARD):
            with execution.collating():
                parts = self.threads.parts(self._crops, frames[start : start + IMAGES_PER_FORWARD])
                crops = parts[0] if len(parts) == 1 else torch.cat(parts)
            yield crops

    def _crops(self, frames: Sequence[UInt8Array]) -> Tensor:
        return torch.cat([self.preprocessor.crops(as_tensor(frame)[None]) for frame in frames])

    def _check_task(self, task: str) -> None:
        """Raise InvalidSampleError for an empty task or one beyond the text encoder's limit; none is truncated."""
        if not task.strip():
            raise InvalidSampleError.at("task", "a task sentence", repr(task))
        limit = min(self.tokenizer.model_max_length, self.text_model.config.max_position_embeddings)
        count = len(self._tokenize(task)["input_ids"])
        if count > limit:
            raise InvalidSampleError.at("task", f"at most {limit} tokens (limit of the text encoder)", str(count))

    def _tokenize(self, text: str | list[str], **options: Any) -> Any:
        # A task is data: "[SEP]" in it is text, not a separator.
        return self.tokenizer(text, split_special_tokens=True, verbose=False, **options)


def task_digest(task: str) -> bytes:
    """Return the cache key for a task embedding, longer than a frame digest, so no caller can send it."""
    return b"task" + hashlib.sha256(task.encode()).digest()


def _of_video(images: Sequence[Float32Array | RewardError]) -> Float32Array | RewardError:
    """Stack the frame embeddings to float32 [T, Dv]; the first error replaces them."""
    error = next((image for image in images if isinstance(image, RewardError)), None)
    return np.stack(images) if error is None else error  # type: ignore[arg-type]  # all are arrays


def _embedded(
    videos: Sequence[Float32Array | RewardError], text: Float32Array | RewardError
) -> EncoderSample | RewardError:
    embeddings = []
    for outcome in (*videos, text):
        if isinstance(outcome, RewardError):
            return outcome
        if not np.isfinite(outcome).all():
            return InferenceFailedError("an encoder gave an embedding that is not finite")
        embeddings.append(outcome)
    *of_videos, of_text = embeddings
    return EncoderSample(tuple(Trajectory(video_embeddings=video, text_embedding=of_text) for video in of_videos))


def _check_shapes(trajectory: Trajectory) -> None:
    """Raise InvalidSampleError for narrow frames: resizing the shorter side would make them huge."""
    frames = trajectory.positions[:1] if trajectory.named is None else [frame for _, frame in trajectory.named]
    for height, width in {frame.shape[:2] for frame in frames if frame.dtype == np.uint8}:
        if min(height, width) < 1 or max(height, width) > MAX_ENCODER_ASPECT_RATIO * min(height, width):
            expected = f"frames at most {MAX_ENCODER_ASPECT_RATIO} times as long as wide"
            raise InvalidSampleError.at("frames", expected, f"{height} x {width}")
