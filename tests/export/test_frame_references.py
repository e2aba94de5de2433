# SPDX-License-Identifier: MIT
"""Frame references need a single cache for all frames, since Triton chooses the GPU of a request."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import goldens
from engines import serve_config
from rfm_client.contract import wire
from rfm_export import export
from rfm_export.pbtxt import parse

ENCODERS, VLM = "enc_c1_t1_disc10", "q3_tok_disc10"
CACHE = "feature_cache_mib"


def test_references_need_a_single_gpu_and_each_gpu_keeps_features(tmp_path: Path) -> None:
    offered, cached = {}, {}
    for name, holder in ((ENCODERS, "rfm_encoder"), (VLM, "rfm_frames")):
        config = goldens.config(name)
        for num_gpus in (0, 1, 2, 8):
            repository = tmp_path / f"{name}-{num_gpus}"
            settings = replace(serve_config(config), num_gpus=num_gpus)
            export(config.checkpoint, repository, settings, other_machine=True, device="cpu")
            models = [parse(file.read_text()) for file in repository.glob("*/config.pbtxt")]
            takes = [model.name for model in models if wire.FRAME_DIGESTS in {each.name for each in model.input}]
            offered[name, num_gpus] = sorted(takes)
            (model,) = (model for model in models if model.name == holder)
            cached[name, num_gpus] = model.parameters[CACHE].string_value
    assert offered == {
        **{(ENCODERS, n): ["rfm_encoder", "rfm_frames"] if n < 2 else [] for n in (0, 1, 2, 8)},
        **{(VLM, n): ["rfm_frames"] if n < 2 else [] for n in (0, 1, 2, 8)},
    }
    assert set(cached.values()) == {"256"}


def test_two_instances_on_a_gpu_have_no_cache_to_name_frames_of(tmp_path: Path) -> None:
    config = goldens.config(VLM)
    settings = replace(serve_config(config), num_gpus=1, instances=2)
    export(config.checkpoint, tmp_path, settings, other_machine=True, device="cpu")
    model = parse((tmp_path / "rfm_frames" / "config.pbtxt").read_text())
    assert wire.FRAME_DIGESTS not in {each.name for each in model.input}
    assert CACHE not in model.parameters
