# SPDX-License-Identifier: MIT
from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from google.protobuf import text_format
from safetensors.torch import load_file, save_file
from tritonclient.grpc import model_config_pb2 as pb

import goldens
import rfm_export
from engines import serve_config, training_run
from in_process import rfm
from repositories import description_of, forget_input
from rfm import published
from rfm.families.rewind.checkpoint import RewindCheckpoint
from rfm.files import CheckpointError
from rfm_client.contract.description import Origin
from rfm_export import ExportDiffersError, ExportError
from rfm_export.source import read_for_export
from spoilt import WEIGHTS

EMBEDDINGS = goldens.config("c1_t1_disc10")
FRAMES = goldens.config("enc_c1_t1_disc10")
SMALL = goldens.config("legacy_keys_l2")


def export(config: goldens.Config, repository: Path, **changes: Any) -> int:
    return rfm_export.export(config.checkpoint, repository, replace(serve_config(config), **changes))


def read(repository: Path, name: str) -> pb.ModelConfig:
    """Parse the file like Triton."""
    return text_format.Parse((repository / name / "config.pbtxt").read_text(), pb.ModelConfig())


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    repository = tmp_path_factory.mktemp("exported") / "model_repository"
    export(EMBEDDINGS, repository)
    export(FRAMES, repository, name="video")
    return repository


def test_an_export_holds_the_files_for_serving_and_none_of_the_training_run(exported: Path) -> None:
    files = {str(file.relative_to(exported)) for file in exported.rglob("*") if file.is_file()}
    assert {"rfm/1/model.py", "rfm/1/checkpoint/model.safetensors", "rfm/1/checkpoint/config.json"} <= files
    assert {"video_encoder/1/image_encoder/model.safetensors", "video_encoder/1/text_encoder/tokenizer.json"} <= files
    assert not [file for file in files if file.endswith((".yaml", ".bin"))]


def test_the_next_export_is_the_next_version(tmp_path: Path) -> None:
    assert [export(FRAMES, tmp_path) for _ in range(2)] == [1, 2]
    for name in ("rfm", "rfm_encoder", "rfm_frames"):
        assert list(read(tmp_path, name).version_policy.specific.versions) == [2]
        assert {path.name for path in (tmp_path / name).iterdir() if path.name.isdecimal()} == {"1", "2"}
    assert {step.model_version for step in read(tmp_path, "rfm_frames").ensemble_scheduling.step} == {2}


def test_an_export_that_differs_from_its_checkpoint_is_not_published(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def save_wrongly(checkpoint: RewindCheckpoint, folder: Path) -> None:
        weights = {name: tensor * 1.001 for name, tensor in checkpoint.network.items()}
        original_save(replace(checkpoint, network=weights), folder)

    original_save = RewindCheckpoint.save
    monkeypatch.setattr(RewindCheckpoint, "save", save_wrongly)
    with pytest.raises(ExportDiffersError, match="expected the checkpoint's scores, got a difference of"):
        export(EMBEDDINGS, tmp_path / "repository")
    assert list(tmp_path.rglob("*")) == [tmp_path / "repository"]


def test_a_checkpoint_that_gives_no_numbers_is_not_published(tmp_path: Path) -> None:
    """All weights are numbers, but the network's output is not."""
    checkpoint = tmp_path / "checkpoint"
    shutil.copytree(EMBEDDINGS.checkpoint, checkpoint)
    file = checkpoint / "model.safetensors"
    weights = load_file(file)
    weights["progress_head.4.weight"] = torch.full_like(weights["progress_head.4.weight"], torch.finfo().max)
    file.chmod(0o644)
    save_file(weights, file, {"format": "pt"})
    expected = "probe 0: expected scores of the checkpoint, got the network gave a score that is not finite"
    with pytest.raises(ExportDiffersError, match=expected):
        rfm_export.export(checkpoint, tmp_path / "repository", serve_config(EMBEDDINGS))
    assert list((tmp_path / "repository").iterdir()) == []


def test_a_model_keeps_its_inputs_and_outputs(tmp_path: Path) -> None:
    export(EMBEDDINGS, tmp_path)
    with pytest.raises(ExportError, match=r"expected a checkpoint with the same inputs .*; choose another --name"):
        export(goldens.config("h40_L3_H5_c1_t1_disc5_cfgmismatch"), tmp_path)
    with pytest.raises(ExportError, match=r"expected a checkpoint with the same outputs .*; choose another --name"):
        export(goldens.config("legacy_keys_l2"), tmp_path)
    assert list(read(tmp_path, "rfm").version_policy.specific.versions) == [1]


@pytest.mark.slow
def test_a_model_may_gain_an_optional_input_and_lose_none(tmp_path: Path) -> None:
    export(FRAMES, tmp_path)
    for name in ("rfm_encoder", "rfm_frames"):
        forget_input(tmp_path, name, "second_frames")
    assert export(FRAMES, tmp_path) == 2
    assert "second_frames" in [each.name for each in read(tmp_path, "rfm_frames").input]
    assert export(FRAMES, tmp_path, feature_cache_mib=0) == 3
    assert "frame_digests" not in [each.name for each in read(tmp_path, "rfm_frames").input]
    config = read(tmp_path, "rfm_encoder")
    config.input.add(name="third_frames", data_type=pb.TYPE_UINT8, dims=[1], optional=True)
    (tmp_path / "rfm_encoder" / "config.pbtxt").write_text(text_format.MessageToString(config))
    with pytest.raises(ExportError, match="rfm_encoder: expected a checkpoint with the same inputs"):
        export(FRAMES, tmp_path)
    with pytest.raises(ExportError, match="expected a checkpoint that this model can serve too"):
        export(EMBEDDINGS, tmp_path)


def test_encoders_that_do_not_fit_or_cannot_be_had_are_named(tmp_path: Path) -> None:
    encoders = {"image_encoder": str(FRAMES.image_encoder), "text_encoder": str(FRAMES.text_encoder)}
    with pytest.raises(CheckpointError, match=r"expected widths \(768, 384\), got \(48, 32\)"):
        export(EMBEDDINGS, tmp_path, **encoders)
    with pytest.raises(CheckpointError, match=r"encoders /no/such/folder and .*--image-encoder and --text-encoder"):
        export(FRAMES, tmp_path, image_encoder="/no/such/folder")


HEADS = ("progress", "preference", "success", "similarity")


def of_run(folder: Path) -> str:
    return f"{folder}/config.yaml: read as the settings of the training run"


RUNS: dict[str, tuple[str, object, str]] = {  # setting, value, and what is said about it
    "a head": ("model.train_success_head", False, "the run did not train the head of success, so success means "),
    "last frames": ("loss.predict_last_frame_progress", True, "the run trained progress of the last frame alone, so "),
    "rounded": ("model.quantization", True, "the run scored with its base model rounded to a few bits; the scores "),
    "first frame": ("data.progress_pred_type", "absolute_first_frame", "progress is 0 at the first frame that the "),
    "shuffled frames": ("data.shuffle_progress_frames", True, "the run shuffled all frames but the first, so "),
    "all": ("model.train_success_head", True, ""),
}


@pytest.mark.parametrize(("setting", "value", "expected"), RUNS.values(), ids=RUNS)
def test_an_export_notes_settings_of_the_run_that_change_the_meaning_of_scores(
    tmp_path: Path, setting: str, value: object, expected: str
) -> None:
    checkpoint = shutil.copytree(EMBEDDINGS.checkpoint, tmp_path / "checkpoint", copy_function=shutil.copyfile)
    run = training_run(EMBEDDINGS.checkpoint.parent / "config.yaml")
    run["model"] |= {f"train_{head}_head": True for head in HEADS}
    section, _, key = setting.partition(".")
    run[section][key] = value
    (checkpoint / "config.yaml").write_text(yaml.safe_dump(run))
    said: list[str] = []
    read_for_export(checkpoint, serve_config(EMBEDDINGS), None, None, said.append, other_machine=True)
    shown = json.dumps(value).strip('"')
    told = [of_run(checkpoint), *([f"config.yaml: {setting} is {shown}: {expected}"] if expected else [])]
    assert len(said) == len(told)
    assert all(map(str.startswith, said, told))
    for line in published.notes(checkpoint, published.read(checkpoint), answered=[]):
        assert "model.quantization" in line  # which concerns every head


def test_an_export_says_which_config_yaml_it_took(exported: Path) -> None:
    said: list[str] = []
    for config in (FRAMES, EMBEDDINGS):
        read_for_export(config.checkpoint, serve_config(config), None, None, said.append, other_machine=True)
    assert said[0] == of_run(FRAMES.checkpoint)
    assert of_run(EMBEDDINGS.checkpoint.parent) in said
    again: list[str] = []
    read_for_export(
        exported / "rfm" / "1" / "checkpoint", serve_config(EMBEDDINGS), None, None, again.append, other_machine=True
    )
    assert again == []  # an export of an export knows of no run


def test_upstream_s_file_exports_whatever_its_batch_size_unless_it_names_gpus_that_are_not_there(
    tmp_path: Path,
) -> None:
    there, repository = torch.cuda.device_count(), tmp_path / "repository"
    file = tmp_path / "eval_config_server.yaml"
    file.write_text(f"model_path: robometer/Robometer-4B\nnum_gpus: {there + 1}\nbatch_size: 4\nserver_port: 8000\n")
    command = ["export", "--config", str(file), "--checkpoint", str(EMBEDDINGS.checkpoint)]
    command += ["--repository", str(repository)]
    refused = rfm(*command)
    assert refused.exit_code == 1
    assert f"rfm: num_gpus: expected at most {there}, got {there + 1}; --other-machine exports" in refused.stderr
    assert not repository.exists()
    exported = rfm(*command, "--other-machine")
    assert exported.exit_code == 0, exported.output
    config = read(repository, "rfm")
    assert list(config.instance_group[0].gpus) == list(range(there + 1))
    assert config.max_batch_size == 64


def test_a_link_out_of_a_checkpoint_is_refused_and_those_of_the_hub_s_cache_are_followed(tmp_path: Path) -> None:
    blobs, snapshot = (tmp_path / "models--org--name" / part for part in ("blobs", f"snapshots/{'0' * 40}"))
    snapshot.mkdir(parents=True)
    shutil.copytree(SMALL.checkpoint, blobs)
    for file in blobs.iterdir():
        (snapshot / file.name).symlink_to(Path("..", "..", "blobs", file.name))
    read_for_export(snapshot, serve_config(SMALL), None, None, print, other_machine=True)
    (snapshot / WEIGHTS).unlink()
    (snapshot / WEIGHTS).symlink_to(SMALL.checkpoint / WEIGHTS)
    with pytest.raises(CheckpointError, match=rf"{WEIGHTS}: expected a file of the checkpoint, got a link to /"):
        read_for_export(snapshot, serve_config(SMALL), None, None, print, other_machine=True)


def test_models_tell_their_weights_by_the_files_digest(exported: Path) -> None:
    """An ensemble's digest covers the files of all parts in order."""

    def digest(*folders: str) -> str:
        files = (file for folder in folders for file in sorted((exported / folder).rglob("*.safetensors")))
        return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]

    expected = {"rfm": digest("rfm"), "video": digest("video"), "video_encoder": digest("video_encoder")}
    expected["video_frames"] = digest("video_encoder", "video")
    assert len(set(expected.values())) == len(expected)
    assert {name: description_of(exported / name).weights_digest for name in expected} == expected


@pytest.mark.parametrize("file", ["text_encoder/model.safetensors", "image_encoder/preprocessor_config.json"])
def test_check_names_missing_and_differing_files_also_by_other_weights_and_settings(
    exported: Path, tmp_path: Path, file: str
) -> None:
    repository = shutil.copytree(exported, tmp_path / "repository")
    changed = repository / "video_encoder" / "1" / file
    changed.write_bytes(changed.read_bytes() + b"\n")
    (repository / "video" / "1" / "model.py").write_text("# changed\n")
    (repository / "video_frames" / "config.pbtxt").unlink()
    assert sorted(rfm_export.check(repository, serve_config(FRAMES, "video"))) == [
        f"{repository}/video/1/model.py: differs from what `rfm export` generates",
        f"{repository}/video_encoder/config.pbtxt: differs from what `rfm export` generates",
        f"{repository}/video_frames/config.pbtxt: is missing",
    ]


def test_the_digest_of_settings_covers_the_dtype_and_clients_learn_the_computation(
    exported: Path, tmp_path: Path
) -> None:
    export(FRAMES, tmp_path, name="video", dtype="bfloat16")
    for repository, dtype in ((exported, "float32"), (tmp_path, "bfloat16")):
        expected = f"{dtype}, torch {torch.__version__}, scaled_dot_product_attention"
        assert description_of(repository / "video").computation == expected
        assert description_of(repository / "video_frames").computation == expected
    told = [description_of(repository / "video") for repository in (exported, tmp_path)]
    assert len({each.weights_digest for each in told}) == 1
    assert len({each.settings_digest for each in told}) == 2


def test_a_set_size_of_batches_wins_also_in_the_check(tmp_path: Path) -> None:
    settings = replace(serve_config(SMALL), max_batch_size=7)
    rfm_export.export(SMALL.checkpoint, tmp_path, settings)
    assert read(tmp_path, "rfm").max_batch_size == 7
    assert rfm_export.check(tmp_path, settings) == []
    assert rfm_export.check(tmp_path, replace(settings, max_batch_size=None))  # 64


def test_the_origin_of_a_checkpoint_of_the_hub_has_its_commit(tmp_path: Path) -> None:
    snapshot = tmp_path / "models--org--name" / "snapshots" / "0123abcd"
    assert published.origin_of("org/name@best", snapshot, "") == Origin(
        source="org/name@best", revision="0123abcd", computation=""
    )
    snapshot.mkdir(parents=True)
    assert published.origin_of(snapshot, snapshot, "") == Origin(source="org/name@0123abcd", computation="")


def test_the_configuration_of_the_training_run_is_kept_without_its_secrets(tmp_path: Path) -> None:
    config, checkpoint = goldens.config("legacy_keys_l2"), tmp_path / "checkpoint"
    shutil.copytree(config.checkpoint, checkpoint)
    file = checkpoint / "config.yaml"
    run = json.loads(json.dumps(training_run(file)))
    secrets = "{hub_token: hf_secret, WANDB_API_KEY: secret, max_token: 5, day: 2026-01-02}"
    file.write_text(f"{file.read_text()}\nreports: {secrets}\n")
    rfm_export.export(checkpoint, tmp_path / "model_repository", serve_config(config))
    kept = description_of(tmp_path / "model_repository" / "rfm").run_config
    assert kept == {**run, "reports": {"max_token": 5, "day": "2026-01-02"}}
    assert rfm_export.check(tmp_path / "model_repository", serve_config(config)) == []
