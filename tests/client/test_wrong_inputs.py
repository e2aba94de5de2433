# SPDX-License-Identifier: MIT
"""What ``rfm`` and ``rfm-client`` answer to wrong inputs: the whole message, as a user reads it."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from engine_server import EngineServer
from in_process import rfm, rfm_client
from labelling import LEROBOT
from paths import ROOT
from servers import Endpoints

NOBODY = "grpc://localhost:1"  # where no server listens
STARTED = "start the server there (rfm serve), or give the URL of one that runs (with TLS: grpcs:// or https://; without: grpc:// or http://)"
URL = "expected grpc://host:port or http://host:port, or grpcs:// or https:// (brackets around an IPv6 address), got"
DATASET = (
    "expected a LeRobot dataset (meta/info.json), an RLDS dataset (features.json), an HDF5 file (.hdf5, .h5), a folder "
    "of videos or of folders of pictures with tasks.csv, any folder with --videos or --reader, or a Hub id "
    "org/name[@revision], got"
)
PAIR = "expected a certificate and its key (PEM, unencrypted) at"
EARLY = "early/checkpoint --image-encoder early/image_encoder --text-encoder early/text_encoder"
SOURCE = "checkpoint: expected a folder that exists or a Hugging Face id org/name[/subfolder][@tag], got"


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working folder with the files that the commands name."""
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "empty").mkdir()
    (folder / "early").symlink_to(ROOT / "examples" / "early_checkpoint")
    (folder / "repository").symlink_to(ROOT / "model_repository")
    shutil.copytree(LEROBOT / "toy_v21", folder / "dataset")
    for name in ("file.txt", "key.pem"):
        (folder / name).write_text("some words")
    (folder / "mistake.yaml").write_text("serve: {\n")
    np.save(folder / "grey.npy", np.zeros((4, 32, 32), np.uint8))
    np.save(folder / "seen.npy", np.zeros((2, 8), np.float32))
    np.save(folder / "clip.npy", np.random.default_rng(0).integers(0, 256, (4, 32, 32, 3), np.uint8))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("HF_HUB_OFFLINE", "1")
        yield folder


def bad(option: str, problem: str) -> str:
    return f"Invalid value for '{option}': {problem}"


# Usage errors; the message follows "Error: ".
USAGE = {
    "rfm-client score": "Missing argument 'VIDEO...'.",
    "rfm-client score a.mp4 --tsk x": "No such option: --tsk (Possible options: --fps, --task)",
    "rfm-client score a.mp4": bad("--task", "expected a sentence, got none"),
    "rfm-client compare a.mp4 b.npz --task N/A": bad("--task", "expected a sentence, got 'N/A'"),
    "rfm-client score a.mp4 --fps zero": bad("--fps", "expected a number, got 'zero'"),
    "rfm-client score a.mp4 --fps 0": bad("--fps", "expected at least 0.001, got 0.0"),
    "rfm-client score a.mp4 --fps nan": bad("--fps", "expected a finite number, got nan"),
    "rfm-client score a.mp4 --channels grb": bad("--channels", "'grb' is not one of 'rgb', 'bgr'."),
    "rfm-client score a.mp4 --frames 8": "Invalid value: --frames needs --sampling",
    "rfm-client score a.mp4 --plot a.jpg": bad("--plot", "expected a file that ends in .png, .pdf, .svg, got a.jpg"),
    "rfm-client score a.mp4 --plot nowhere/a.png": bad(
        "--plot", "expected a folder at nowhere, got none: mkdir -p nowhere"
    ),
    "rfm-client score a.mp4 --task x --url localhost:8001": bad("--url", f"{URL} 'localhost:8001'"),
    "rfm-client score a.mp4 --ca-file key.pem": bad(
        "--ca-file", "expected certificates (PEM) at key.pem, got a file without certificate"
    ),
    "rfm-client score a.mp4 --client-certificate key.pem": ("Invalid value: --client-certificate needs --client-key"),
    "rfm-client score a.mp4 --client-certificate key.pem --client-key key.pem": bad(
        "--client-certificate", f"{PAIR} key.pem and key.pem, got a file in another format"
    ),
    "rfm-client score --json a.mp4 b.mp4": bad("--json", "expected a file that ends in .json or -, got a.mp4"),
    f"rfm-client score {' '.join(['a.mp4'] * 41)} --plot a.png": bad("--plot", "expected at most 40 videos, got 41"),
    "rfm-client score a.mp4 --sampling all --frames 4": bad("--frames", "expected none with the rule all, got 4"),
    "rfm-client status --url http://a:1 --url http://b:1 --metrics-url http://a:2": (
        "Invalid value: --metrics-url needs a single --url"
    ),
    "rfm-client compare a.mp4": "Invalid value for VIDEO: expected at least 2 videos, got 1",
    "rfm-client sample --num-frames 8-4": bad("--num-frames", "expected a whole number, got '8-4'"),
    "rfm-client bench --hz 0": bad("--hz", "expected at least 0.01, got 0.0"),
    "rfm-client bench --hz 0.1 --seconds 5": bad(
        "--seconds", "expected at least 10, which a step at this rate takes, got 5.0"
    ),
    "rfm-client --task x score a.mp4": "No such option: --task",
    "rfm-client serve my_models": "No such command 'serve': that is `rfm serve`",
    f"rfm-client gateway --triton {NOBODY} --metrics-url nope": bad(
        "--metrics-url", "expected http://host:port/metrics, got 'nope'"
    ),
    f"rfm-client gateway --triton {NOBODY} --dataset nope": bad(
        "--dataset", f"nope: {DATASET} none: there is no FOLDER/nope"
    ),
    "rfm-client label dataset --override-task": "Invalid value: --override-task needs --task",
    "rfm score a.mp4": "No such command 'score': that is `rfm-client score`",
    "rfm try a.mp4 --task N/A": bad("--task", "expected a sentence, got 'N/A'"),
    "rfm serve": "Invalid value: give FOLDER, CHECKPOINT or --repository",
    "rfm serve repository --as topreward": ("Invalid value: --as decides an export, but repository names a repository"),
    "rfm serve org/name --checkpoint org/other": "Invalid value: give CHECKPOINT or --checkpoint, not both",
    "rfm serve repository other": ("Invalid value: expected one FOLDER, and after it -- --OPTION=VALUE, got other"),
    "rfm serve repository --log-verbose=1": (
        "No such option: --log-verbose: put options of tritonserver after --, as in rfm serve FOLDER -- "
        "--log-verbose=VALUE, and more of an export's settings into --config"
    ),
    "rfm serve repository --http-port abc": bad("--http-port", "expected a whole number, got 'abc'"),
    "rfm serve repository --gateway-dataset nope": (
        "Invalid value: --gateway-dataset needs --gateway-port, which starts the gateway"
    ),
}

# Other errors, each with the exit code; the message follows the name of the program.
FAILURES = {
    **{
        f"{command} --url {url}": (3, f"{url}: no connection: Connection refused: {STARTED}")
        for command, url in (
            *(("rfm-client status", NOBODY), ("rfm-client status", "http://localhost:1")),
            ("rfm-client score a.mp4 --task x", NOBODY),
        )
    },
    "rfm-client status --url grpcs://localhost:1": (
        *(3, f"grpcs://localhost:1: no connection: Connection refused: {STARTED}; or name 127.0.0.1: of "),
        "localhost's addresses, IPv6 and IPv4, gRPC reports the fault of one alone",
    ),
    "rfm-client evaluate nope": (1, "nope: expected a labelled dataset, got no file or folder of this name"),
    "rfm-client label nope": (1, f"nope: {DATASET} none: there is no FOLDER/nope"),
    "rfm-client label file.txt": (1, f"file.txt: {DATASET} another file"),
    "rfm serve repository --http-port 0": (1, "--http-port: expected at least 1, got 0"),
    "rfm serve repository --grpc-key key.pem": (1, "--grpc-key needs --grpc-certificate"),
    "rfm serve repository --grpc-certificate key.pem --grpc-key key.pem": (
        1,
        f"--grpc-certificate: {PAIR} key.pem and key.pem, got a file in another format",
    ),
    "rfm serve repository --host 10.0.0.5 --grpc-certificate key.pem --grpc-key key.pem": (
        *(
            1,
            "--grpc-certificate: expected client certificates (--grpc-client-ca) or a key (--api-key-file) at 10.0.0.5, ",
        ),
        "since TLS alone asks for nothing, got none; --grpc-any-client serves everyone",
    ),
    "rfm serve repository --gateway-port FREE_PORT --gateway-dataset nope": (
        1,
        f"--gateway-dataset: nope: {DATASET} none: there is no FOLDER/nope",
    ),
    "rfm serve repository --config mistake.yaml": (
        *(1, "mistake.yaml: expected a YAML file, got a mistake in line 2 "),
        "(expected the node content, but found '<stream end>')",
    ),
    "rfm export nope --repository out": (1, f"{SOURCE} 'nope'"),
    "rfm export file.txt --repository out": (1, f"{SOURCE} the file file.txt; name its folder, ."),
    "rfm export empty --repository out --name 'a b'": (1, "--name: expected letters, digits, _ and -, got 'a b'"),
    f"rfm models list --url {NOBODY}": (1, f"{NOBODY}: no connection: Connection refused: {STARTED}"),
    "rfm serve early --as rewind": (
        *(1, "repository: expected a folder of models, got early, a folder that holds a checkpoint: rfm serve "),
        f"{EARLY} exports and serves it",
    ),
    "rfm serve --checkpoint early": (
        *(1, "checkpoint: expected a checkpoint, got early, a folder that holds one; name "),
        EARLY,
    ),
    "rfm serve --checkpoint repository": (
        *(1, "checkpoint: expected a checkpoint, got repository, a repository: name it with --repository"),
    ),
    "rfm try nope.mp4 --task x": (
        *(1, "repository: expected a folder of models, got model_repository, which is not there: rfm export "),
        "--checkpoint CHECKPOINT --repository model_repository writes one; --checkpoint robometer/Robometer-4B ",
        "serves a public checkpoint",
    ),
    "rfm try empty --task x --repository repository": (
        1,
        "video: expected a video file, got a folder: name the videos in it (empty)",
    ),
    "rfm try nope.mp4 --task x --repository repository": (1, "video: expected a video file, got none (nope.mp4)"),
}

NO_TASK = 'task: expected a sentence with frames, got none: add --task "SENTENCE"'

# With a server of the demo's checkpoint. A video's name stands before its message.
AT_SERVER = {
    "score grey.npy --task x": (
        *(1, "grey.npy: frames: expected uint8 or float in 0..1 [T, H, W, 3] or [T, 3, H, W], got uint8 [4, 32, 32] "),
        "(grey.npy)",
    ),
    "score clip.npy --task x --model rfm_frames": (
        *(5, "clip.npy: Request for unknown model: 'rfm_frames_frames' is not found; served: rfm"),
        ": give the checkpoint's name with model (--model)",
    ),
    "score clip.npy": (1, "clip.npy: ", NO_TASK),
    "score clip.npy --task N/A": (1, "clip.npy: ", NO_TASK.replace("none", "'N/A'")),
    "compare clip.npy clip.npy": (1, NO_TASK),
    "compare clip.npy seen.npy --task x": (
        *(1, "clip.npy and seen.npy: second: expected frames, as the first trajectory, got video_embeddings"),
    ),
    "compare clip.npy nope.npy --task x": (1, "file: expected a file of arrays, got no file of this name (nope.npy)"),
    "label dataset --cameras top": (
        1,
        "--cameras: expected some of observation.images.front, observation.images.wrist, got 'top'",
    ),
    "label dataset --mode whole --frames 4": (1, "frames: expected none with the rule all, got 4: leave --frames out"),
}


def answer(command: str) -> tuple[int, str]:
    """Return the exit code and the last line of standard error."""
    program, *words = shlex.split(command.replace("FREE_PORT", str(Endpoints.free().http_port)))
    done = (rfm if program == "rfm" else rfm_client)(*words)
    return done.exit_code, done.stderr.splitlines()[-1].replace(str(Path.cwd()), "FOLDER")


@pytest.mark.parametrize(("command", "message"), USAGE.items(), ids=USAGE)
def test_errors_of_wrong_usage_use_the_words_of_the_command_line(command: str, message: str) -> None:
    assert answer(command) == (2, f"Error: {message}")


@pytest.mark.parametrize(("command", "told"), FAILURES.items(), ids=FAILURES)
def test_errors_of_impossible_commands_name_the_value_found(command: str, told: tuple[int | str, ...]) -> None:
    code, *message = told
    program = command.split()[0]
    assert answer(command) == (code, f"{program}: {''.join(map(str, message))}")


@pytest.mark.parametrize(("words", "told"), AT_SERVER.items(), ids=AT_SERVER)
def test_unusable_inputs_are_refused_while_a_server_is_ready(
    engines: EngineServer, words: str, told: tuple[int | str, ...]
) -> None:
    code, *message = told
    expected = f"rfm-client: {''.join(map(str, message))}"
    exit_code, said = answer(f"rfm-client {words} --url {engines.url}")
    said = re.sub("served: [^:]*rfm:", "served: rfm:", said)  # without models that other tests have loaded
    assert (exit_code, said) == (code, expected)
