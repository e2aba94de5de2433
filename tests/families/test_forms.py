# SPDX-License-Identifier: MIT
"""The forms of checkpoints that docs/checkpoints.md lists: files as PEFT writes them, and the test of each row."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

import goldens
from paths import GOLDEN, ROOT
from rfm.checkpoint.content import CheckpointError
from vlm import load

ADAPTER = "q25_peft_adapter_disc10"
WRITTEN: dict[str, dict[str, Any]] = json.loads((GOLDEN / "peft-configs.json").read_text())
MERGE = r"; merge it where it was trained \(merge_and_unload\(\) of PEFT\)"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the reference adapter."""
    return shutil.copytree(goldens.config(ADAPTER).checkpoint, tmp_path / "adapter", copy_function=shutil.copyfile)


def factors_twice(tensors: dict[str, Any]) -> None:
    """What PEFT makes of PiSSA: the factors, and beside them those that the run began with; here the latter are 0."""
    for name in [name for name in tensors if ".lora_A." in name]:
        other = name.replace("lora_A", "lora_B")
        tensors[name] = torch.cat([tensors[name], tensors[name]])
        tensors[other] = torch.cat([tensors[other], 0 * tensors[other]], 1)


def changed(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes the tensors of the adapter."""
    file = folder / "adapter_model.safetensors"
    tensors = load_file(file)
    change(tensors)
    save_file(tensors, file)


PLAIN = [name for name in WRITTEN if name.startswith("LoRA")]
CONVERTED = "PiSSA converted to LoRA"


@pytest.mark.parametrize("name", [*PLAIN, CONVERTED])
def test_plain_lora_of_peft_is_taken(folder: Path, name: str) -> None:
    known = load(ADAPTER).build(torch.float32).state_dict()
    if name == CONVERTED:
        changed(folder, factors_twice)
    (folder / "adapter_config.json").write_text(json.dumps(WRITTEN[name]))
    taken = load(ADAPTER, folder).build(torch.float32).state_dict()
    for key, weight in taken.items():
        torch.testing.assert_close(weight, known[key], rtol=0, atol=1e-7)


REFUSED = {
    "rsLoRA": r"expected plain LoRA, got use_rslora",
    "DoRA": r"expected plain LoRA, got use_dora",
    "PiSSA": r"init_lora_weights: expected true, got 'pissa', which may change the base model's weights before training",
    "PiSSA by iteration": r"init_lora_weights: expected true, got 'pissa_niter_4'",
    "OLoRA": r"init_lora_weights: expected true, got 'olora'",
    "EVA": r"expected plain LoRA, got eva_config",
    "MiCA": r"init_lora_weights: expected true, got 'mica'",
    "ranks of modules": r"expected plain LoRA, got rank_pattern",
    "alphas of modules": r"expected plain LoRA, got alpha_pattern",
    "biases of all": r"bias: expected none, got 'all', which PEFT does not always save",
    "biases of factors": r"expected plain LoRA, got lora_bias",
    "aLoRA": r"expected plain LoRA, got alora_invocation_tokens",
    "rows of an embedding": r"expected plain LoRA, got trainable_token_indices",
    "parameters": r"expected plain LoRA, got target_parameters",
}


def test_each_configuration_of_peft_is_taken_or_refused() -> None:
    assert WRITTEN.keys() == {*PLAIN, CONVERTED, *REFUSED}


@pytest.mark.parametrize(("name", "message"), REFUSED.items(), ids=REFUSED)
def test_other_adapters_of_peft_are_refused(folder: Path, name: str, message: str) -> None:
    (folder / "adapter_config.json").write_text(json.dumps(WRITTEN[name]))
    with pytest.raises(CheckpointError, match=rf"adapter_config\.json: {message}.*{MERGE}"):
        load(ADAPTER, folder)


EMBEDDING = "base_model.model.language_model.embed_tokens"


def of_smolvlm(tensors: dict[str, Any]) -> None:
    for name in [*tensors]:
        tensors[name.replace("model.language_model", "model.model.text_model")] = tensors.pop(name)


def on_a_convolution(tensors: dict[str, Any]) -> None:
    shapes = {"A": (4, 3, 2, 14, 14), "B": (32, 4, 1, 1, 1)}
    tensors.update(
        {f"base_model.model.visual.patch_embed.proj.lora_{side}.weight": torch.ones(s) for side, s in shapes.items()}
    )


def on_the_embedding(tensors: dict[str, Any]) -> None:
    tensors[f"{EMBEDDING}.base_layer.weight"] = tensors.pop(f"{EMBEDDING}.weight")
    tensors |= {f"{EMBEDDING}.lora_embedding_A": torch.ones(4, 9), f"{EMBEDDING}.lora_embedding_B": torch.ones(9, 4)}


def with_the_embedding_twice(tensors: dict[str, Any]) -> None:
    """What PEFT writes by save_embedding_layers=True if modules_to_save names the embedding."""
    copies = {f"{EMBEDDING}.{name}.weight": torch.ones(9, 9) for name in ("original_module", "modules_to_save")}
    tensors.update(copies)


LINEAR = r"adapter_model\.safetensors: expected LoRA factors of linear layers of a Qwen backbone, got "
OTHER_LAYERS: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "SmolVLM": (of_smolvlm, rf"{LINEAR}'model\.model\.text_model\."),
    "an embedding": (on_the_embedding, rf"{LINEAR}'model\.language_model\.embed_tokens\.lora_embedding_A'"),
    "an embedding saved in two ways": (with_the_embedding_twice, rf"{LINEAR}'model\.language_model\.embed_tokens\."),
    "a convolution": (
        on_a_convolution,
        r"patch_embed\.proj: expected LoRA factors of \[.*\], got \[32, 4, 1, 1, 1\] and",
    ),
}


@pytest.mark.parametrize(("change", "message"), OTHER_LAYERS.values(), ids=OTHER_LAYERS)
def test_lora_of_other_layers_is_refused(folder: Path, change: Callable[[dict[str, Any]], None], message: str) -> None:
    changed(folder, change)
    with pytest.raises(CheckpointError, match=rf"{message}.*{MERGE}"):
        load(ADAPTER, folder)


SPOILED = "test_a_spoiled_checkpoint_is_refused"
SAME = "test_a_checkpoint_in_another_form_scores_the_same"
WHOLE_AND_SHARDS = (
    f"{SPOILED}[weights whole and in shards]",
    f"{SPOILED}[a tensor in two shards]",
    f"{SPOILED}[a shard that the index does not name]",
)
ANOTHER_NETWORK = "test_config_yaml_of_another_run_above_the_checkpoint_is_refused"
PLACES = (
    "test_config_yaml_may_be_called_otherwise",
    "test_config_yaml_is_found_above_the_checkpoint",
    "test_config_yaml_is_found_on_main_of_the_hub_s_repository[org/name]",
)
SUBFOLDER = "test_config_yaml_is_found_on_main_of_the_hub_s_repository[offline org/runs/one/ckpt=5@v1]"
LIKELY = (
    "test_a_misspelt_folder_is_told_beside_the_hub_s_answer",
    "test_a_run_folder_is_refused_with_its_checkpoints",
    "test_a_model_repository_is_refused_with_its_checkpoints",
)
OF_TRANSFORMERS_5 = tuple(f"{SAME}[{name} of transformers 5]" for name in ("Qwen2.5-VL", "Qwen3-VL", "SmolVLM"))
ROTARY = tuple(
    f"{SPOILED}[{what}]"
    for what in (
        "rotary positions without a base",
        "rotary positions without sections",
        "two bases of rotary positions",
        "no num_attention_heads of the text_config",
    )
)
BY_NAME = (
    *(f"{SPOILED}[weights of {method}]" for method in ("gptq", "awq", "fp8")),
    "test_other_types_of_bitsandbytes_are_refused_by_name",
)
RANKS = tuple(f"{SPOILED}[{what} of another rank]" for what in ("an adapter", "a run", "a module"))
OTHER_ENCODERS = (
    "test_encoders_that_do_not_fit_are_refused",
    "test_a_preprocessor_that_works_otherwise_is_refused",
    "test_encoder_weights_that_do_not_fit_are_named",
)
# The beginning of each row of the table, and its tests.
ROWS: dict[str, tuple[str, ...]] = {
    "weights in shards": ("test_shards_are_put_together",),
    "weights whole and in shards": WHOLE_AND_SHARDS,
    "prefixes of DataParallel": ("test_prefixes_of_wrappers_change_nothing",),
    "another prefix": ("test_the_command_that_strips_a_prefix_works",),
    "pickles": (
        "test_the_conversion_that_the_refusal_of_a_pickle_names_works",
        "test_the_conversion_of_a_pickled_adapter_works",
    ),
    "a Hugging Face repository": ("test_what_a_hub_s_repository_lacks_is_told[pickles alone]",),
    "weights that are inf": ("test_weights_that_are_no_numbers_are_refused_at_every_door",),
    "a head that is 0": ("test_a_head_of_zeros_is_told",),
    "no head of": ("test_what_is_there_is_scored_as_with_all_heads_and_the_rest_refused_alone",),
    "a run of before": (f"{SPOILED}[a run of before 2026-01-21]", "test_eight_special_tokens_tell_an_old_run"),
    "`config.yml`": PLACES,
    "no `config.yaml`": ("test_without_config_yaml_nothing_is_guessed",),
    "`config.yaml` of another": (ANOTHER_NETWORK,),
    "a checkpoint in a subfolder": (SUBFOLDER,),
    "a misspelt folder": LIKELY,
    "`config.json` of transformers 5": OF_TRANSFORMERS_5,
    "`config.json` of a Qwen2.5-VL": (f"{SAME}[Qwen2.5-VL without text_config]",),
    "names of weights": (f"{SAME}[layers right under the model]",),
    "rotary frequencies": (f"{SAME}[with rotary frequencies]",),
    "`config.json` without": ROTARY,
    "tokenizer and processor": ("test_a_processor_of_transformers_5_reads_the_same",),
    "a Qwen2.5-VL that reads videos": ("test_a_video_run_of_transformers_5_is_told_about_its_positions",),
    "SmolVLM with": ("test_smolvlm_is_refused_where_its_scores_would_differ",),
    "weights in NF4": ("test_an_export_scores_as_the_values_of_its_weights",),
    "weights of GPTQ": BY_NAME,
    "an adapter as PEFT": ("test_plain_lora_of_peft_is_taken", f"{SAME}[an adapter around the language model]"),
    "PiSSA or OLoRA": (f"test_plain_lora_of_peft_is_taken[{CONVERTED}]",),
    "LoRA factors": (f"{SAME}[LoRA around the whole model]",),
    "the whole model beside": (f"{SAME}[a whole model beside its adapter]",),
    "PiSSA, OLoRA": ("test_other_adapters_of_peft_are_refused[PiSSA]", f"{SPOILED}[LoRA that begins by corda]"),
    "rsLoRA": ("test_other_adapters_of_peft_are_refused", f"{SPOILED}[LoRA with a field of the future]"),
    "LoRA of an embedding": ("test_lora_of_other_layers_is_refused",),
    "an adapter without": (f"{SPOILED}[an adapter without its embedding]",),
    "`r` that": RANKS,
    "an adapter that names": ("test_an_adapter_on_another_base_model_is_asked_about",),
    "an adapter of a run": ("test_an_adapter_of_a_run_that_began_with_a_checkpoint_needs_its_base_named",),
    "an adapter on a base": (
        "test_an_adapter_on_weights_of_few_bits_is_refused",
        "test_a_base_model_of_few_bits_is_refused",
    ),
    "`--base-model` with": (
        "test_a_processor_that_is_not_the_published_one_of_the_run_is_refused",
        "test_special_tokens_in_another_order_are_refused",
    ),
    "a checkpoint of the first": ("test_a_checkpoint_of_the_first_rewind_code_has_its_scores",),
    "ReWiND's": ("test_a_null_is_a_key_that_is_not_there",),
    "an image encoder": ("test_sizes_may_be_numbers_as_transformers_once_wrote_them",),
    "other encoders": (
        "test_encoders_that_are_not_upstream_s_are_told",
        "test_a_text_encoder_as_wide_as_upstream_s_is_compared",
    ),
    "encoders of other": OTHER_ENCODERS,
}


def test_each_row_of_the_table_has_a_test() -> None:
    section = (
        (ROOT / "docs" / "checkpoints.md").read_text().partition("## Forms of checkpoints")[2].partition("\n## ")[0]
    )
    forms = [line.split(" | ")[0].removeprefix("| ") for line in section.splitlines() if line.startswith("| ")][1:]
    assert len(forms) == len(ROWS)
    assert [form for form, row in zip(forms, ROWS, strict=True) if not form.startswith(row)] == []
    folders = [str(ROOT / "tests" / name) for name in ("families", "export")]
    command = [sys.executable, "-m", "pytest", "--collect-only", "-o", "addopts=-q --import-mode=importlib", *folders]
    collected = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    known = {line.partition("::")[2] for line in collected.splitlines()}
    known |= {name.partition("[")[0] for name in known}
    assert [test for tests in ROWS.values() for test in tests if test not in known] == []
