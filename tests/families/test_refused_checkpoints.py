# SPDX-License-Identifier: MIT
"""Checkpoints of every family that are incomplete, contradictory, hostile or of another kind: refused, and soon.

One table: the checkpoint, what is spoilt, and the message. Adapters are in test_adapters.py, NF4 in test_rounded.py.
"""

from __future__ import annotations

import json
import math
import os
import resource
import shutil
import signal
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

import goldens
from reward_models import ROOT
from rfm import published
from rfm.files import CheckpointError
from spoilt import (
    REWARD_MODELS,
    WEIGHTS,
    Spoil,
    beside,
    both,
    gone,
    in_json,
    in_two_shards,
    in_yaml,
    nested,
    renamed,
    run_settings,
    settings,
    text,
    text_settings,
    weights,
    with_sources,
)

REWIND, ENCODED = "legacy_keys_l2", "enc_c1_t1_disc10"
Q3, Q25, VIDEO = "q3_tok_disc10", "q25_mean_l2", "q25_video_last_l2"
TOP, TOP_ROBOMETER, TOP_LEROBOT, ROBO, LEROBOT = REWARD_MODELS
CONFIG, RUN = "config.json", "config.yaml"
IMAGES, VIDEOS, BOTH = "preprocessor_config.json", "video_preprocessor_config.json", "processor_config.json"
FIRST = "first_embedding_A"  # tensor in a ReWiND's file
HEAD, EMBEDDING, TIED = "lm_head.weight", "model.language_model.embed_tokens.weight", "tie_word_embeddings"

MAX_HEADER_BYTES = MAX_JSON_BYTES = 2**24  # of what is read
MAX_YAML_BYTES = 2**18
LONGEST_S = 30
MOST_MEMORY_BYTES = 512 * 2**20  # above the process's peak
Change = Callable[[dict[str, Any]], object]


@pytest.fixture(autouse=True)
def _soon() -> Iterator[None]:
    """Interrupt whatever waits for a pipe, or works for ever."""

    def late(*_: object) -> None:
        raise TimeoutError(f"no end within {LONGEST_S} s")

    previous = signal.signal(signal.SIGALRM, late)
    signal.alarm(LONGEST_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


def progress(kind: str) -> Spoil:
    return lambda f: text(RUN, (f / RUN).read_text().replace("absolute_wrt_total_frames", kind))(f)


def without_config(spoil: Spoil) -> Spoil:
    return both(spoil, gone(RUN))


def config_of(name: str) -> Spoil:
    return lambda folder: shutil.copyfile(goldens.config(name).checkpoint / CONFIG, folder / CONFIG)


def run_above(name: str) -> Spoil:
    """Puts the config.yaml of another run above the checkpoint, in place of its own."""
    other = next(goldens.config(name).checkpoint.parent.rglob(RUN))
    return both(gone(RUN), lambda folder: shutil.copyfile(other, folder.parent / RUN))


def extra_shard(name: str, tensors: dict[str, torch.Tensor]) -> Spoil:
    return both(in_two_shards, lambda folder: save_file(tensors, folder / name))


def shard_twice(folder: Path) -> None:
    first, second = (folder / f"{name}.safetensors" for name in "ab")
    save_file(load_file(first) | load_file(second), second)


def raw_header(change: Callable[[bytes], bytes]) -> Spoil:
    """Another header before the same numbers."""

    def spoil(folder: Path) -> None:
        content = (folder / WEIGHTS).read_bytes()
        (length,) = struct.unpack_from("<Q", content)
        raw = change(content[8 : 8 + length])
        (folder / WEIGHTS).write_bytes(struct.pack("<Q", len(raw)) + raw + content[8 + length :])

    return spoil


def header(**changes: object) -> Spoil:
    """Other facts about the first tensor."""

    def change(raw: bytes) -> bytes:
        content = json.loads(raw)
        content[FIRST].update(changes)
        return json.dumps(content).encode()

    return raw_header(change)


def twice(raw: bytes) -> bytes:
    """Name a tensor twice, with another place the second time, which the library would take."""
    first = json.dumps({FIRST: json.loads(raw)[FIRST]})[1:-1]
    return raw.replace(b"{", f"{{{first}, ".encode(), 1)


def cut_to(length: int) -> Spoil:
    return lambda folder: (folder / WEIGHTS).write_bytes((folder / WEIGHTS).read_bytes()[:length])


def instead(name: str, make: Callable[[Path], object]) -> Spoil:
    """Something else under the name of a file."""
    return lambda folder: [(folder / name).unlink(), make(folder / name)]


def first_half(folder: Path) -> None:
    """Zero the second half of a file, as an unfinished download leaves it."""
    content = (folder / WEIGHTS).read_bytes()
    begin = 8 + int.from_bytes(content[:8], "little")
    kept = begin + (len(content) - begin) // 2
    (folder / WEIGHTS).write_bytes(content[:kept] + bytes(len(content) - kept))


def fill(name: str, value: float) -> Spoil:
    """Sets the last number of a tensor."""
    return weights(lambda tensors: tensors[name].view(-1)[-1:].fill_(value))


def without_encoders(spoil: Spoil) -> Spoil:
    return both(weights(lambda w: [w.pop(key) for key in [*w] if "_encoder." in key]), spoil)


def tied(model: bool | None, text_model: bool | None) -> Spoil:
    """``tie_word_embeddings`` in config.json and in its text_config."""

    def change(content: dict[str, Any]) -> None:
        for part, value in ((content, model), (content["text_config"], text_model)):
            part.pop(TIED, None)
            part.update({} if value is None else {TIED: value})

    return in_json(CONFIG, change)


def of_vlm(change: Change) -> Spoil:
    """Changes the backbone's configuration in LeRobot's config.json."""
    return in_json(CONFIG, lambda content: change(content["vlm_config"]))


def eight_special_tokens(folder: Path) -> None:
    weights(lambda w: w.update({n: torch.cat([t, t[-3:]]) for n, t in w.items() if "embed_tokens" in n}))(folder)
    text_settings(vocab_size=454)(folder)


def template_of_text(folder: Path) -> None:
    template = json.loads((folder / "chat_template.json").read_text())["chat_template"]
    settings("chat_template.json", chat_template="<|im_start|>system\nHelp.<|im_end|>\n" + template)(folder)


UNAPPLIED = (
    r", which is not applied here and may change pixels; if the model was trained without it, remove it from a copy"
)
SAFETENSORS = rf"{WEIGHTS}: expected a safetensors file, got "
LAUGHS = "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}' if n else 'x'] * 10)}]\n" for n in range(12))
MERGES = "a0: &a0 {x: 1}\n" + "".join(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}\n" for n in range(1, 12))
ZEROS = r": expected weights, got 0 throughout: the file is incomplete; fetch or copy it again"
DIFFERENT_HEAD = r"text_config\.tie_word_embeddings: expected false, since lm_head.weight differs from the embedding, got true.*transformers 4 scores with the embedding, transformers 5 with the head"

WEIGHT_FILES: dict[str, tuple[str, Spoil, str]] = {
    "no weights": (REWIND, gone(WEIGHTS), r"expected model.safetensors or .*, got config.*; name the folder that has it, beside config.json"),
    "missing and unexpected keys": (REWIND, weights(lambda w: w.update(surplus=w.pop("success_head.4.bias"))), r"missing keys: \['success_head.4.bias'\]; unexpected keys: \['surplus'\]"),
    "whole and in shards": (REWIND, lambda f: [shutil.copy(f / WEIGHTS, f.parent), in_two_shards(f), shutil.copy(f.parent / WEIGHTS, f)], r"expected model\.safetensors or shards, got model\.safetensors and \['model\.safetensors\.index\.json'\], of which one is older; name a copy without what is not meant"),
    "whole and in shards without an index": (REWIND, lambda f: shutil.copy(f / WEIGHTS, f / "model-00001-of-00002.safetensors"), r"got model\.safetensors and \['model-00001-of-00002\.safetensors'\]"),
    "an encoder whole and in shards": (ENCODED, without_encoders(beside("image_encoder", text("model.safetensors.index.json", '{"weight_map": {}}'))), r"image_encoder: expected model\.safetensors or shards, got"),
    "a tensor in two shards": (REWIND, both(in_two_shards, shard_twice), r"expected the tensors in b\.safetensors, got no \['first_embedding_A', .*; save the weights again"),
    "a shard that the index does not name": (REWIND, extra_shard("model-00003-of-00003.safetensors", {"more": torch.ones(1)}), r"expected the names of all shards, got model-00003-of-00003\.safetensors, which it does not name, with \['more'\]; name a copy of the folder without it"),
    "a lost shard": (REWIND, both(in_two_shards, gone("b.safetensors")), r"names the shard b.safetensors, which is not there"),
    "a shard elsewhere": (REWIND, instead(WEIGHTS, lambda f: Path(f"{f}.index.json").write_text('{"weight_map": {"a": "../secret.safetensors"}}')), r"expected names of files beside it, got '\.\./secret"),
    "a shard with a NUL": (REWIND, instead(WEIGHTS, lambda f: Path(f"{f}.index.json").write_text('{"weight_map": {"a": "a\\u0000.safetensors"}}')), r"expected a file|not there"),
    "a weight with and without a wrapper's prefix": (REWIND, weights(lambda w: w.update({"module.success_head.4.bias": w["success_head.4.bias"] + 1})), r"expected each weight once, got 'success_head\.4\.bias' and"),
    "a prefix before some names": (REWIND, renamed(r"^(?!video)", "student."), r"got 'student\.progress_head\.4\.weight', with the prefix student\. that 'video_proj\.bias' lacks; save the weights again"),
    "infinity": (REWIND, fill("success_head.4.bias", math.inf), r"success_head\.4\.bias: expected finite weights, got inf at \["),
    "NaN in an encoder": (ENCODED, fill("image_encoder.layernorm.bias", math.nan), r"layernorm\.bias: expected finite weights, got nan at \["),
    "NaN in an encoder beside": (ENCODED, without_encoders(beside("text_encoder", fill("embeddings.LayerNorm.bias", math.nan))), r"LayerNorm\.bias: expected finite weights, got nan at \["),
    "zeros": (TOP, weights(lambda w: [t.zero_() for t in w.values()]), ZEROS),
    "zeros from half of the file on": (Q3, first_half, ZEROS),
    "a file of zeros": (REWIND, lambda f: (f / WEIGHTS).write_bytes(bytes(1000)), SAFETENSORS + "zeros, as after an unfinished download"),
    "an empty file": (REWIND, lambda f: (f / WEIGHTS).write_bytes(b""), SAFETENSORS + "only 0 bytes; fetch or copy it again"),
    "a file cut in its header": (REWIND, cut_to(100), SAFETENSORS + "only 100 bytes; fetch or copy it again"),
    "a file cut in its tensors": (REWIND, cut_to(-100), SAFETENSORS + ".*; fetch or copy it again"),
    "a header of 2^63 bytes": (REWIND, lambda f: (f / WEIGHTS).write_bytes(struct.pack("<Q", 2**63) + b"{}"), SAFETENSORS + f"a header of {2**63} bytes, more than"),
    "a header that fits but is huge": (REWIND, raw_header(lambda _: b"{" + b" " * MAX_HEADER_BYTES + b"}"), SAFETENSORS + f"a header of {MAX_HEADER_BYTES + 2} bytes, more than"),
    "a deep header": (REWIND, raw_header(lambda _: b"[" * 2**20), SAFETENSORS),
    "a tensor twice": (REWIND, raw_header(twice), SAFETENSORS + f"the key '{FIRST}' twice"),
    "offsets beyond the end": (REWIND, header(data_offsets=[0, 2**60]), SAFETENSORS),
    "a shape that lies": (REWIND, header(shape=[1, 1, 10**6]), SAFETENSORS),
    "a type that is none": (REWIND, header(dtype="PY"), SAFETENSORS + f"'{FIRST}' of type 'PY', which is none of F64, "),
    "weights of 8 bits": (REWIND, weights(lambda w: w.update({FIRST: w[FIRST].to(torch.float8_e4m3fn)})), SAFETENSORS + f"'{FIRST}' of type 'F8_E4M3', which is none of"),
    "whole numbers as weights": (REWIND, header(dtype="I32"), rf"{FIRST}: expected numbers like"),
    "a tail": (REWIND, lambda f: (f / WEIGHTS).write_bytes((f / WEIGHTS).read_bytes() + b"tail"), SAFETENSORS),
    "Git LFS": (REWIND, text(WEIGHTS, "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n"), SAFETENSORS + "Git LFS's note of where it is; `git lfs pull` fetches it"),
    "a folder as weights": (REWIND, instead(WEIGHTS, Path.mkdir), rf"{WEIGHTS}: expected a file, got a folder"),
    "a pipe as weights": (REWIND, instead(WEIGHTS, os.mkfifo), rf"{WEIGHTS}: expected a file, got a pipe"),
    "a pipe as config.yaml": (REWIND, instead(RUN, os.mkfifo), r"config\.yaml: expected a file, got a pipe"),
    "a link to nowhere": (REWIND, instead(CONFIG, lambda f: f.symlink_to("gone")), r"got a link that leads nowhere"),
}  # fmt: skip

SETTINGS: dict[str, tuple[str, Spoil, str]] = {
    "a deep config.json": (REWIND, text(CONFIG, "[" * 10**6), r"config\.json: expected JSON, got"),
    "a huge config.json": (REWIND, text(CONFIG, " " * (MAX_JSON_BYTES + 1)), r"config\.json: expected at most \d+ bytes"),
    "a number of many digits": (REWIND, text(CONFIG, "9" * 10**5), r"config\.json: expected JSON, got"),
    "a key twice": (REWIND, text(CONFIG, '{"max_len": 3, "max_len": 4}'), r"config\.json: expected JSON, got the key 'max_len' twice"),
    "a billion laughs": (REWIND, text(RUN, LAUGHS), r"config\.yaml: expected YAML, got aliases that stand for more"),
    "a billion merges": (REWIND, text(RUN, MERGES), r"config\.yaml: expected YAML, got aliases that stand for more"),
    "a value inside itself": (REWIND, text(RUN, "model: &m {rewind: *m}"), r"got a value that is inside itself"),
    "a deep config.yaml": (REWIND, text(RUN, "[" * 10**5), r"config\.yaml: expected YAML, got"),
    "a huge config.yaml": (REWIND, text(RUN, "#" * (MAX_YAML_BYTES + 1)), r"config\.yaml: expected YAML, got more than"),
    "a number of a thousand digits": (REWIND, text(RUN, f"a: 0x{'f' * 1000}"), r"got a number of 1002 digits"),
    "a key twice in YAML": (REWIND, text(RUN, "data: {}\ndata: {}"), r"config\.yaml: expected YAML, got the key 'data' twice"),
    "a zero byte": (REWIND, text(RUN, "a: \0"), r"config\.yaml: expected YAML, got"),
    "data that is no mapping": (REWIND, text(RUN, "data: [1]"), r"config.yaml: data: expected a mapping, got \[1\]"),
    "no configuration": (REWIND, without_config(gone(CONFIG)), r"max_len: expected it in config.json or model.rewind of config.yaml, got it in neither"),
    "no causal mask, from a file that upstream did not write": (REWIND, without_config(in_json(CONFIG, lambda c: c.pop("hidden_dim"))), r"causal_mask: expected it in config.json or model.rewind of config.yaml, got it in neither"),
    "configurations that contradict each other": (REWIND, settings(CONFIG, num_attention_heads=8), r"num_attention_heads: expected config.json and config.yaml to agree, got"),
    "heads that do not divide the width": (REWIND, without_config(settings(CONFIG, num_attention_heads=5)), r"num_attention_heads: expected a divisor of the hidden width 32, got 5"),
    "heads in words": (REWIND, settings(CONFIG, num_attention_heads="4"), r"num_attention_heads in config.json: expected int, got '4'"),
    "max_len that nothing can hold": (REWIND, settings(CONFIG, max_len=10**15), r"max_len: expected 1 to \d+, got 10{15}"),
    "half a frame": (REWIND, settings(CONFIG, trained_frames=7.5), r"config.json: trained_frames: expected a whole number of at least 1, got 7.5"),
    "frames without end": (REWIND, settings(CONFIG, trained_frames=10**30), r"trained_frames: expected at most \d+"),
    "padding that is a number": (REWIND, settings(CONFIG, trained_padding=1), r"config.json: trained_padding: expected true or false, got 1"),
    "no head of progress": (REWIND, weights(lambda w: [w.pop(name) for name in list(w) if name.startswith("progress_head")]), r"expected a ReWiND checkpoint, which has 'progress_head.4.weight'"),
    "a model type that is a list": (REWIND, settings(CONFIG, model_type=[]), r"model_type: expected rewind_transformer, by the names of the weights, got \[\]"),
    "a model type that is a list, of a model asked in words": (TOP, settings(CONFIG, model_type=[]), r"model_type: expected qwen3_vl, of an ordinary Qwen3-VL, got \[\]"),
    "Qwen3-VL, with Qwen2.5-VL's config.json": (Q3, config_of(Q25), r"config.json: model_type: expected qwen3_vl, by the names of the weights, got 'qwen2_5_vl': the file describes"),
    "Qwen3-VL, with ReWiND's": (Q3, config_of(REWIND), r"model_type: expected qwen3_vl, by the names of the weights, got 'rewind_transformer'"),
    "Qwen3-VL, with a part's": (Q3, settings(CONFIG, model_type="qwen3_vl_text"), r"model_type: expected qwen3_vl, by the names of the weights, got 'qwen3_vl_text'"),
    **{
        f"a network with names of Qwen3-VL: {kind}": (Q3, settings(CONFIG, model_type=kind), rf"model_type: expected one of rewind_transformer, qwen2_5_vl, qwen3_vl, got '{kind}', which is not supported$")
        for kind in ("qwen3_5", "qwen3_vl_moe")
    },
    "Qwen3-VL, without one": (Q3, gone(CONFIG), r"model_type: expected qwen3_vl, by the names of the weights, got none"),
    "a vision-language run above": (REWIND, run_above(Q3), r"/config.yaml: expected the run of .*, whose network is 'rewind_transformer', got model.base_model_id 'Qwen/.*; copy the run's config.yaml into .*, also if it is this one$"),
    "progress since the frame before": (REWIND, progress("relative"), r"config.yaml: data.progress_pred_type: expected absolute progress, got 'relative': such a head"),
    "progress since the frame before, of a vision-language run": (Q3, progress("relative_first_frame"), r"data.progress_pred_type: expected absolute progress, got 'relative_first_frame'"),
    "no config.yaml": (Q3, gone(RUN), r"expected config\.yaml of the training run there, in the folder above"),
    "no config.yaml beside an adapter": ("q25_peft_adapter_disc10", gone(RUN), r"expected config\.yaml of the training run there, in the folder above"),
    "a run of nothing": (Q3, text(RUN, "{}"), r"config\.yaml: model: expected the settings"),
    "no size of a video": (VIDEO, in_yaml(lambda content: content["data"].pop("resized_height")), r"data\.resized_height: expected a number or null, got no such key"),
    "a size in words": (VIDEO, run_settings("data", resized_width="wide"), r"data\.resized_width: expected a whole number"),
    "text for a truth": (Q3, run_settings("model", average_temporal_patches="false"), r"average_temporal_patches: expected bool, got 'false'"),
    "a temperature of zero": (Q3, run_settings("model", frame_pooling_attn_temperature=0.0), r"temperature: expected a number above 0, got 0.0"),
    "pairwise progress": (Q3, run_settings("model", pairwise_progress=True), r"model\.pairwise_progress: expected false .*, got true"),
    "a pooling that is none": (Q3, run_settings("model", frame_pooling="max"), r"frame_pooling: expected"),
    "tokens without images": (Q3, in_yaml(lambda content: [content[part].update(use_multi_image=False) for part in ("model", "data")]), r"use_multi_image with per-frame progress tokens: expected true"),
    "two words on one setting": (Q3, run_settings("data", use_multi_image=False), r"expected model\.use_multi_image and data\.use_multi_image to agree, got model\.use_multi_image true and data\.use_multi_image false"),
    "answers in generated text": (Q3, run_settings("model", model_type="vqa"), r"model\.model_type: expected default, got 'vqa'; models that answer in generated text are not served"),
    "no reward heads": (Q3, weights(lambda w: w.pop("progress_head.4.weight")), r"expected reward heads, got no progress_head.4.weight"),
    "a run of before 2026-01-21": (Q3, weights(lambda w: w.pop("frame_pool_attn.weight")), r"expected frame_pool_attn\.weight, got none; a run from before 2026-01-21 had 8 special tokens"),
    "eight special tokens": (Q3, eight_special_tokens, r"tokens .*, got 451; .*a run from before 2026-01-21 had 8 special tokens"),
    "the processor of another model": (Q3, lambda f: [shutil.rmtree(f.parent / "base_model"), shutil.copytree(goldens.config(Q25).sources["base_model"], f.parent / "base_model")], r"expected a tokenizer of 451 tokens .*, got 447"),
}  # fmt: skip

BACKBONES: dict[str, tuple[str, Spoil, str]] = {
    "another text layer": (Q25, text_settings(layer_types=["sliding_attention", "full_attention"]), r"text_config\.layer_types: expected full_attention alone, got \['full_attention', 'sliding_attention'\]"),
    "no rotary base": (Q3, in_json(CONFIG, lambda c: c["text_config"].pop("rope_theta")), r"config\.json: text_config\.rope_theta: expected a number above 0, got None; copy it from config\.json of the base"),
    "no rotary sections": (Q3, text_settings(rope_scaling=None), r"rope_scaling\.mrope_section: expected a list of numbers, got None"),
    "two rotary bases": (Q3, text_settings(rope_parameters={"rope_theta": 1e4}), r"expected one value of rope_theta in text_config, got 10000\.0 and 5000000\.0"),
    "two rotary types": (Q3, text_settings(rope_parameters={"rope_type": "linear"}), r"expected one value of rope_type in rope_scaling, got 'linear' and 'default'"),
    "pairs of a head rotated": (Q3, text_settings(rope_interleaved=True), r"text_config\.rope_interleaved: expected false, got True"),
    "no epsilon": (Q3, in_json(CONFIG, lambda c: c["text_config"].pop("rms_norm_eps")), r"config\.json: text_config\.rms_norm_eps: expected a value, got none; copy it"),
    "no heads": (Q25, in_json(CONFIG, lambda c: c["text_config"].pop("num_attention_heads")), r"text_config\.num_attention_heads: expected a value, got none; copy it"),
    "no levels": (Q3, in_json(CONFIG, lambda c: c["vision_config"].pop("deepstack_visual_indexes")), r"vision_config\.deepstack_visual_indexes: expected a value, got none; copy it"),
    "no whole attention": (Q25, in_json(CONFIG, lambda c: c["vision_config"].pop("fullatt_block_indexes")), r"vision_config\.fullatt_block_indexes: expected a value, got none; copy it"),
    "no patches": (Q3, in_json(CONFIG, lambda c: c["vision_config"].update(patch_size=None)), r"vision_config.patch_size: expected a value, got none"),
    "patches in words": (Q3, in_json(CONFIG, lambda c: c["vision_config"].update(patch_size="16")), r"vision_config.patch_size: expected a whole number"),
    "half a patch": (Q3, in_json(CONFIG, lambda c: c["vision_config"].update(temporal_patch_size=0.5)), r"vision_config.temporal_patch_size: expected a whole number of at least 1, got 0.5"),
    "a vision tower with other rotary positions": (Q3, in_json(CONFIG, lambda c: c["vision_config"].update(rope_parameters={"rope_theta": 100.0})), r"vision_config\.rope_parameters: expected axial with a rope_theta of 10000, got {'rope_theta': 100\.0}"),
    "a configuration that is a list": (Q25, settings(CONFIG, text_config=[1]), r"text_config: expected settings of the backbone, got \[1\]"),
    "heads in words": (Q25, text_settings(num_attention_heads="x"), r"expected a backbone that"),
    "layers without end": (Q25, text_settings(num_hidden_layers=10**9), r"text_config\.num_hidden_layers: expected at most 1024, got 1000000000"),
    "a vision tower without end": (Q25, in_json(CONFIG, lambda c: c["vision_config"].update(depth=10**9)), r"vision_config\.depth: expected at most 1024, got 1000000000"),
    "a vocabulary that nothing can hold": (Q25, text_settings(vocab_size=10**12), r"embed_tokens\.weight: expected \[1000000000000, \d+\], got"),
    "code of its own": (Q25, settings(CONFIG, auto_map={"AutoConfig": "evil.Config"}, model_type="evil"), r"model_type: expected one of .*, got 'evil', which is not supported"),
    "a quantization in config.json": (Q3, settings(CONFIG, quantization_config={"quant_method": "gptq"}), r"config\.json: quantization_config: expected none, got 'gptq'; export the checkpoint that was quantized"),
    "bitsandbytes without its kind": (Q3, settings(CONFIG, quantization_config={"quant_method": "bitsandbytes"}), r"quantization_config: expected none, got 'bitsandbytes'; export"),
    **{
        f"weights with {part}": (Q3, weights(lambda w, part=part: w.update({f"model.language_model.layers.0.mlp.up_proj{part}": torch.ones(1)})), rf"expected weights in full precision, got '.*{part}'; export the checkpoint that was quantized")
        for part in (".weight.quant_state.bitsandbytes__fp4", ".SCB", ".qweight", ".weight_scale_inv")
    },
    "a weight under two names": (Q25, weights(lambda w: w.update({"model.norm.weight": torch.ones(32)})), r"model\.language_model\.norm\.weight: expected one weight, got .*'model\.norm\.weight'.*; remove the one"),
}  # fmt: skip

PREPROCESSING: dict[str, tuple[str, Spoil, str]] = {
    **{
        name: (Q3, beside("base_model", settings(IMAGES, **changes)), f"preprocessing of images: {message}")
        for name, changes, message in [
            ("no normalisation", {"do_normalize": False}, f"do_normalize: expected true, got false{UNAPPLIED}"),
            ("no rescaling", {"do_rescale": False}, f"do_rescale: expected true, got false{UNAPPLIED}"),
            ("another scale", {"rescale_factor": 1 / 127.5}, "rescale_factor: expected 1/255, got 0.00784"),
            ("a crop", {"do_center_crop": True}, f"do_center_crop: expected false, got true{UNAPPLIED}"),
            ("wider tokens", {"merge_size": 4}, f"merge_size: expected 2, got 4{UNAPPLIED}"),
            ("longer patches", {"temporal_patch_size": 1}, f"temporal_patch_size: expected 2, got 1{UNAPPLIED}"),
            ("an unknown setting", {"sharpen": True}, f"sharpen: expected a known setting, got true{UNAPPLIED}"),
            ("other patches", {"patch_size": 14}, "patch_size: expected 16, as vision_config of config.json, got 14"),
            ("no patches", {"patch_size": None}, "patch_size: expected 16, as vision_config of config.json, got none"),
            ("one mean", {"image_mean": 0.5}, "image_mean: expected 3 numbers, got 0.5"),
            ("a mean in words", {"image_mean": ["a", 0, 0]}, r"image_mean: expected 3 numbers, got \['a', 0, 0\]"),
            ("a deviation of 0", {"image_std": [0.5, 0, 0.5]}, r"image_std: expected numbers above 0, got \[0.5, 0, 0.5\]"),
        ]
    },
    "videos without normalisation": ("q25_video_avg_disc10", beside("base_model", settings(VIDEOS, do_normalize=False)), "preprocessing of videos: do_normalize: expected true, got false"),
    "two files that disagree": (Q3, beside("base_model", nested(image_mean=[0.4] * 3)), r"/base_model: image_mean: expected one value, got preprocessor_config.json with \[0.5, 0.5, 0.5\] and image_processor of processor_config.json with \[0.4, 0.4, 0.4\]: transformers 4 reads the former, transformers 5 the latter; correct"),
    "a setting in transformers 5's file alone": (Q3, beside("base_model", nested(do_normalize=None, do_pad=True)), "preprocessing of images: do_pad: expected false, got true"),
    "no settings in transformers 5's file": (Q3, beside("base_model", text(BOTH, '{"image_processor": "none"}')), "processor_config.json: image_processor: expected settings, got 'none'"),
    "neither file": (Q3, beside("base_model", both(gone(IMAGES), text(BOTH, "{}"))), r"expected preprocessor_config\.json, or image_processor in processor_config\.json, got none .*--base-model"),
    **{
        f"videos of TOPReward: {message.partition(':')[0]}": (TOP, settings(VIDEOS, **changes), message)
        for changes, message in [
            ({"cap_pixels_per_frame": True}, f"cap_pixels_per_frame: expected false, got true{UNAPPLIED}"),
            ({"max_video_tokens": 100}, f"max_video_tokens: expected 768, got 100{UNAPPLIED}"),
            ({"do_resize": False}, f"do_resize: expected true, got false{UNAPPLIED}"),
            ({"fps": 1}, f"fps: expected 2, got 1{UNAPPLIED}"),
            ({"max_pixels": 50176}, f"max_pixels: expected null, got 50176{UNAPPLIED}"),
        ]
    },
    "frames that the processor must pick and does not": (TOP_ROBOMETER, settings(VIDEOS, do_sample_frames=False), "do_sample_frames: expected true, got false"),
}  # fmt: skip

IN_WORDS: dict[str, tuple[str, Spoil, str]] = {
    **{
        f"tied to an embedding that differs, by {name}": (TOP, tied(*stated), DIFFERENT_HEAD)
        for name, stated in {"both": (True, True), "the text model": (False, True), "it alone": (None, True)}.items()
    },
    "no language head": (TOP, weights(lambda w: w.pop(HEAD)), r"expected lm_head.weight, since tie_word_embeddings is false, got none"),
    "a template without the video": (TOP, template_of_text, r"chat template: expected one video in a prompt, got 0"),
    "an unknown key of LeRobot": (TOP_LEROBOT, settings(CONFIG, frame_stride=2), r"expected the keys of LeRobot's topreward, got 'frame_stride'"),
    "a suffix without the task": (TOP_LEROBOT, settings(CONFIG, prompt_suffix_template="Done?"), r"prompt_suffix: expected text with \{instruction\}, got 'Done\?'"),
    "a suffix with another name": (TOP_LEROBOT, settings(CONFIG, prompt_suffix_template="{task}: Yes"), r"prompt_suffix: expected text with \{instruction\}, got '\{task\}: Yes'"),
    "a penalty": (ROBO, settings("generation_config.json", repetition_penalty=1.1), r"repetition_penalty: expected 1.0, got 1.1; remove it"),
    "an unknown key of generation": (ROBO, settings("generation_config.json", suppress_tokens=[1]), r"suppress_tokens: expected no such key, got \[1\]"),
    "no end of an answer": (ROBO, settings("generation_config.json", eos_token_id=None), r"eos_token_id: expected ids of tokens, got None"),
    "no settings of generation": (ROBO, gone("generation_config.json"), r"generation_config.json: expected the file, got none"),
}  # fmt: skip

OF_LEROBOT: dict[str, tuple[str, Spoil, str]] = {
    name: (LEROBOT, spoil, message)
    for name, spoil, message in [
        ("an unknown key of Robometer", settings(CONFIG, frame_stride=2), r"expected the keys of LeRobot's robometer, got 'frame_stride'; if it changes no score, remove it"),
        ("a missing key", in_json(CONFIG, lambda c: c.pop("use_multi_image")), r"use_multi_image: expected a value, got none; save the model with LeRobot again"),
        ("no theta", of_vlm(lambda c: c["text_config"]["rope_parameters"].pop("rope_theta")), r"vlm_config: text_config.rope_theta: expected a number above 0, got None"),
        ("other bins", settings(CONFIG, progress_discrete_bins=5), r"progress_discrete_bins: expected 10 outputs, as progress_head has, got 5 with progress_loss_type discrete"),
        ("one number, by the file", settings(CONFIG, progress_loss_type="l2"), r"progress_discrete_bins: expected 10 outputs, as progress_head has, got 10 with progress_loss_type l2"),
        ("an unknown loss", settings(CONFIG, progress_loss_type="mse"), r"progress_loss_type: expected one of discrete, l1, l2, got 'mse'"),
        ("no frames", settings(CONFIG, max_frames=0), r"max_frames: expected a whole number of at least 1"),
        ("half a head", weights(lambda w: w.pop("success_head.0.weight")), r"missing keys"),
        ("no embedding", weights(lambda w: w.pop("model.lm_head.weight")), r"embed_tokens"),
        ("untied, without the embedding", of_vlm(lambda c: c.update({TIED: False})), r"embed_tokens"),
    ]
}  # fmt: skip

ENCODERS: dict[str, tuple[str, Spoil, str]] = {
    name: (ENCODED, beside(encoder, settings(file, **changes)), message)
    for name, encoder, file, changes, message in [
        ("no resize", "image_encoder", IMAGES, {"do_resize": False}, "do_resize: expected True, got False"),
        ("bilinear", "image_encoder", IMAGES, {"resample": 2}, "resample: expected 3, got 2"),
        ("another scale of an encoder", "image_encoder", IMAGES, {"rescale_factor": 1.0}, "rescale_factor: expected 1/255, got 1.0"),
        ("a fixed size", "image_encoder", IMAGES, {"size": {"height": 3, "width": 3}}, "expected size {shortest_edge}"),
        ("a processor of squares", "image_encoder", IMAGES, {"size": 64, "image_processor_type": "ViTImageProcessor"}, "expected size {shortest_edge} and crop_size {height, width}, got 64 and"),
        ("ViT", "image_encoder", CONFIG, {"model_type": "vit"}, "image_encoder: model_type: expected one of dinov2, dinov2_with_registers, got vit"),
        ("T5", "text_encoder", CONFIG, {"model_type": "t5"}, r"text_encoder: model_type: expected one of bert, .*, got t5"),
        ("a width in words", "image_encoder", CONFIG, {"hidden_size": "x"}, r"^encoders .* \(name local folders with --image-encoder and --text-encoder\)$"),
        ("a tokenizer of more words", "text_encoder", "tokenizer.json", {"model": {"type": "WordLevel", "unk_token": "w", "vocab": {"w": 0} | {f"w{i}": i for i in range(1, 200)}}}, r"text_encoder: expected a tokenizer of at most 180 tokens, got "),
    ]
}  # fmt: skip

REFUSED = [
    pytest.param(*case, id=name)
    for table in (WEIGHT_FILES, SETTINGS, BACKBONES, PREPROCESSING, IN_WORDS, OF_LEROBOT, ENCODERS)
    for name, case in table.items()
]


@pytest.mark.parametrize(("name", "spoil", "message"), REFUSED)
def test_a_spoilt_checkpoint_is_refused(tmp_path: Path, name: str, spoil: Spoil, message: str) -> None:
    folder, options = with_sources(name, tmp_path)
    spoil(folder)
    largest_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError, match=message) as refusal:
        loaded = published.read(folder, **options)
        loaded.encoders()
        loaded.checkpoint.predictor(torch.device("cpu"))
    assert len(str(refusal.value)) < 10_000
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - largest_kib) * 1024 < MOST_MEMORY_BYTES


OPTIONS = {
    "an unknown name": ("gvl", "expected one of topreward, topreward-robometer, roboreward, roboreward-expected"),
    "an unknown setting": (
        "topreward,frames=3",
        "expected settings among num_prefixes, fps, chat_template, max_frames",
    ),
    "no value": ("topreward,fps", "expected setting=value, got 'fps'"),
    "no number": ("topreward,fps=fast", "fps: expected a value of type float, got 'fast'"),
    "no frames a second": ("topreward,fps=0", "fps: expected a finite number above 0, got 0.0"),
    "an ignored setting": ("topreward-robometer,fps=2", "fps: expected none for topreward-robometer"),
    "a setting of a model without any": ("roboreward,fps=2", "expected no settings of this reward model, got 'fps'"),
    "one prefix": ("topreward,num_prefixes=1", "num_prefixes: expected at least 2, the first and the last, got 1"),
    "another mode": (
        "robodopamine,mode=fused",
        "mode: expected one of incremental, benchmark, forward, backward, mean",
    ),
    "no interval": ("robodopamine,interval=0", "interval: expected at least 1 frame, got 0"),
    "no reward model": (None, "with an ordinary vision-language model, say --as which reward model"),
}


@pytest.mark.parametrize(("reward_model", "message"), OPTIONS.values(), ids=OPTIONS)
def test_a_reward_model_in_words_that_makes_no_sense_is_refused(reward_model: str | None, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        published.load(ROOT / REWARD_MODELS[TOP][0], reward_model=reward_model)


OF_VIDEOS = r"--video-prompt: expected a checkpoint that shows videos to a Qwen3-VL, got another checkpoint"
OF_ANSWERS = r"--strict-answers: expected a RoboReward that writes its answers, got another checkpoint"
NOT_FOLLOWED: dict[str, tuple[str, dict[str, Any], str]] = {
    "video prompts of embeddings": (REWIND, {"video_prompt": "wrapped"}, OF_VIDEOS),
    "video prompts of images": (Q3, {"video_prompt": "wrapped"}, OF_VIDEOS),
    "video prompts of LeRobot's images": (LEROBOT, {"video_prompt": "wrapped"}, OF_VIDEOS),
    "video prompts of a Qwen2.5-VL": (VIDEO, {"video_prompt": "wrapped"}, OF_VIDEOS),
    "answers of TOPReward": (TOP, {"strict_answers": True}, OF_ANSWERS),
    "expected answers": (ROBO, {"strict_answers": True, "reward_model": "roboreward-expected"}, OF_ANSWERS),
    "few bits of a small network": (REWIND, {"weights": "int8"}, r"--weights: expected a vision-language checkpoint"),
}


@pytest.mark.parametrize(("name", "given", "message"), NOT_FOLLOWED.values(), ids=NOT_FOLLOWED)
def test_an_option_that_the_network_does_not_follow_is_refused(
    tmp_path: Path, name: str, given: dict[str, Any], message: str
) -> None:
    folder, options = with_sources(name, tmp_path)
    with pytest.raises(CheckpointError, match=f"{message}.*; leave it out, or export the checkpoint again"):
        published.load(folder, **{**options, **given})


def test_a_model_with_reward_heads_is_not_asked_in_words() -> None:
    with pytest.raises(CheckpointError, match="expected an ordinary Qwen3-VL, got reward heads: leave out --as"):
        published.load(goldens.config(Q3).checkpoint, reward_model="topreward")


@pytest.mark.parametrize(
    "source", ["/no/such/folder", "a/b/../c", "a/b@", "", "org/..", "..@tag", "a" * 5000, "~nobody-here/x/y", "a\0b"]
)
def test_a_source_that_is_neither_folder_nor_id_is_refused(source: str) -> None:
    with pytest.raises(CheckpointError, match="expected a folder that exists or a Hugging Face id"):
        published.load(source)


def test_yaml_and_a_base_model_run_no_code(tmp_path: Path) -> None:
    mark, (folder, _) = tmp_path / "was_here", with_sources(REWIND, tmp_path)
    (folder / RUN).write_text(f'model: {{rewind: !!python/object/apply:os.system ["touch {mark}"]}}\n')
    with pytest.raises(CheckpointError, match=r"config\.yaml: model\.rewind: expected a mapping, got"):
        published.load(folder)
    (tmp_path / "evil.py").write_text(f"open({str(mark)!r}, 'w')\n")
    (tmp_path / CONFIG).write_text(json.dumps({"model_type": "evil", "auto_map": {"AutoConfig": "evil.Config"}}))
    with pytest.raises(CheckpointError, match=r"base model .*: model_type: expected one of .*, got 'evil'"):
        published.load(goldens.config("q25_peft_adapter_disc10").checkpoint, base_model=str(tmp_path))
    assert not mark.exists()
