# SPDX-License-Identifier: MIT
"""Triton's model for the encoders: frames and task go in, embeddings for the scorer come out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import torch

from rfm import families
from rfm.config import DEFAULT_SAMPLE_TOKENS
from rfm.engine.execution import Execution
from rfm.engine.feature_cache import BYTES_PER_MIB, FeatureCache
from rfm.parameters import FAMILY_PARAMETER, FEATURE_CACHE_PARAMETER, SAMPLE_TOKENS_PARAMETER
from rfm.triton_model.batch_model import BatchModel
from rfm_client.contract import InvalidSampleError, RewardError, wire
from rfm_client.contract.samples import EncoderSample, Float32Array


class TritonPythonModel(BatchModel[EncoderSample, EncoderSample]):
    """An instance: a pair of encoders on a device."""

    def load(self, version: Path, device: torch.device, settings: Mapping[str, str]) -> None:
        self.encoders = families.encoders_of(settings[FAMILY_PARAMETER]).load(version).to(device)
        cache_mib = int(settings.get(FEATURE_CACHE_PARAMETER) or 0)
        self.cache = FeatureCache[Float32Array](cache_mib * BYTES_PER_MIB) if cache_mib else None
        self.max_frames = int(settings.get(SAMPLE_TOKENS_PARAMETER) or DEFAULT_SAMPLE_TOKENS)

    def decode(self, tensors: wire.Tensors) -> list[EncoderSample]:
        num_frames = len(tensors[wire.NUM_FRAMES]) * wire.num_positions(tensors)
        if num_frames > self.max_frames:  # embeddings may be larger than small frames or digests
            expected = f"at most {self.max_frames} frames in a request, with padding (max_sample_tokens of this server)"
            raise InvalidSampleError.at(wire.NUM_FRAMES, expected, str(num_frames))
        return wire.decode_trajectories(tensors, None if self.cache is None else self.cache.found)

    def answer(self, questions: Sequence[EncoderSample], execution: Execution) -> list[EncoderSample | RewardError]:
        return self.encoders.encode(questions, execution, self.cache)

    def encode(self, answers: Sequence[EncoderSample], tensors: wire.Tensors, outputs: Collection[str]) -> wire.Tensors:
        return wire.encode_trajectories(answers, wire.num_positions(tensors), outputs)
