# SPDX-License-Identifier: MIT
"""Options that several commands share, each declared once: servers, videos, outputs."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np
import typer

from rfm_client.async_client import DEFAULT_TIMEOUT_S
from rfm_client.cli.command import STANDARD_OUTPUT, usage_errors
from rfm_client.client import RewardClient
from rfm_client.contract.checks import is_blank, require
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import (
    AccessDeniedError,
    InvalidSampleError,
    InvalidValueError,
    ModelNotFoundError,
    RewardError,
)
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Sample, SimilaritySample, random_trajectory
from rfm_client.contract.settings import ConfigError, Settings, Texts, setting
from rfm_client.contract.wire import DEFAULT_MODEL
from rfm_client.frames.inputs import ARRAY_SUFFIXES
from rfm_client.frames.orientation import ChannelOrder, Orientation
from rfm_client.frames.sampling import RULES, Rule, Sampling
from rfm_client.plot import MAX_CURVES, Size
from rfm_client.transport.connection import Credentials
from rfm_client.transport.servers import PROBE_TIMEOUT_S

SampleType: TypeAlias = Literal["progress", "preference", "similarity"]

SYNTHETIC_TASK = "put the block in the bowl"
DEFAULT_URL = "grpc://localhost:8001"
MIN_TIMEOUT_S, MAX_TIMEOUT_S = 0.001, 86_400
FRAMES = "Frames"  # heading for all options that decide which frames are scored, and from what
_PICTURES = (".png", ".pdf", ".svg")
_ENDINGS = {"json": (".json",), "plot": _PICTURES, "strips": _PICTURES, "rrd": (".rrd",)}


def timeout_setting(default_s: float, help: str = "Time limit of a request, in seconds.") -> Any:
    """Return a field for the option ``--timeout``."""
    return setting(default_s, help, flag="--timeout", least=MIN_TIMEOUT_S, most=MAX_TIMEOUT_S)


@dataclass(frozen=True)
class CredentialFiles(Settings):
    """Credentials for a protected server, as files: CAs, client certificate, API key. Raises ConfigError."""

    TITLE: ClassVar[str] = "Credentials"

    ca_file: Path | None = setting(
        None, "Certificate authorities (PEM) to trust. Default: the system's.", variable="RFM_CA_FILE"
    )
    client_certificate: Path | None = setting(None, "Client certificate (PEM).", variable="RFM_CLIENT_CERTIFICATE")
    client_key: Path | None = setting(None, "The certificate's key (PEM).", variable="RFM_CLIENT_KEY")
    api_key_file: Path | None = setting(None, "File with the API key.", variable="RFM_API_KEY_FILE")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.credentials  # noqa: B018  # reports an unreadable file now, and Ray's other machines may lack the key

    @cached_property
    def credentials(self) -> Credentials:
        """The credentials in the files."""
        try:
            api_key = None if self.api_key_file is None else self.api_key_file.read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError.at("api_key_file", "a text file", error) from None
        try:
            return Credentials(self.ca_file, self.client_certificate, self.client_key, api_key=api_key)
        except ConfigError as error:
            raise error.named(lambda name: "api_key_file" if name == "api_key" else name) from None


@dataclass(frozen=True)
class ServerOptions(CredentialFiles):
    """A command's servers, model, timeout and credentials."""

    TITLE: ClassVar[str] = "Server"

    urls: Texts = setting(
        (DEFAULT_URL,),
        "grpc://host:8001 or http://host:8000, with TLS grpcs:// or https://. Repeat for more servers of the same "
        "checkpoint.",
        flag="--url",
        variable="RFM_URL",
    )
    model: str = setting(DEFAULT_MODEL, "Model name in the repository.")
    timeout_s: float = timeout_setting(DEFAULT_TIMEOUT_S)

    @property
    def origin(self) -> dict[str, Any]:
        """The servers and the model, for JSON documents."""
        return {"servers": list(self.urls), "model": self.model}

    def client(self, *urls: str, **options: Any) -> RewardClient:
        """Return a client for these servers, else for all. Raises typer.BadParameter for an invalid URL."""
        with usage_errors("--url"):
            given = {"model": self.model, "timeout_s": self.timeout_s, **self.credentials.options, **options}
            return RewardClient(urls or self.urls, **given)

    @contextmanager
    def connected(self, **options: Any) -> Iterator[RewardClient]:
        """Yield a client if a server answers and serves the model. Otherwise raise RewardError at once."""
        with self.client(**options) as client:
            problems = map(self._problem, self.urls)
            if (first := next(problems)) is not None and all(problems):  # asks until a server scores
                raise first
            yield client

    def _problem(self, url: str, **options: Any) -> RewardError | None:
        """Return why a server does not score; None: it does."""
        with self.client(url, retry=False, **options) as client:
            try:
                try:
                    client.model_info()
                except ModelNotFoundError:
                    client.model_info(frames=True)
            except RewardError as error:
                return error
        return None


@dataclass(frozen=True)
class StatusOptions(ServerOptions):
    """Servers whose status is shown."""

    NO_OPTION: ClassVar[Collection[str]] = {"model"}

    timeout_s: float = timeout_setting(10.0)


@dataclass(frozen=True)
class WaitOptions(ServerOptions):
    """Servers and model to wait for."""

    timeout_s: float = timeout_setting(120.0, "Time limit, in seconds.")

    def check_access(self) -> None:
        """Raise AccessDeniedError if all servers refuse this client, which no waiting changes."""
        timeout_s = min(PROBE_TIMEOUT_S, self.timeout_s)
        problems = (self._problem(url, timeout_s=timeout_s) for url in self.urls)
        refusals = [each for each in problems if isinstance(each, AccessDeniedError)]
        if len(refusals) == len(self.urls):
            raise refusals[0]


@dataclass(frozen=True)
class FrameRate(Settings):
    """Which frames to sample from a video."""

    TITLE: ClassVar[str] = FRAMES

    fps: float = setting(3.0, "Frames per second to sample.", least=0.001)


@dataclass(frozen=True)
class VideoOptions(FrameRate):
    """The videos' task, and which frames to send at what size and orientation."""

    TITLE: ClassVar[str] = "Videos"

    task: str = setting("", "The task, as a sentence. Required, except for embeddings with a task.")
    resize: bool = setting(False, "Downscale frames to the model's input size before sending.")
    orient: Orientation = setting("none", "Turn frames upright first (see docs/guides/label_a_dataset.md).")
    channels: ChannelOrder = setting("rgb", "Channel order in the file; bgr swaps red and blue.")
    subsample: bool = setting(True, "Reduce each video to the number of frames of training, evenly spaced.")

    @property
    def more(self) -> dict[str, Any]:
        """Arguments for ``load_trajectory`` that only some models read."""
        return {name: getattr(self, name) for name in self.settings() if name not in VideoOptions.settings()}

    def begin(self, videos: Sequence[str]) -> None:
        """Raise ConfigError if videos lack a task, which only files of arrays may have."""
        if is_blank(self.task) and not all(video.lower().endswith(ARRAY_SUFFIXES) for video in videos):
            raise ConfigError.at("task", "a sentence", repr(self.task) if self.task else "none")


@dataclass(frozen=True)
class ScoredVideos(VideoOptions):
    """Videos, and what only some models read besides. Raises ConfigError."""

    TITLE: ClassVar[str] = "Robo-Dopamine"

    views: Texts = setting(
        (),
        "Video of a further camera at the same times, for Robo-Dopamine; twice: left wrist, right wrist.",
        flag="--view",
        metavar="VIDEO",
    )
    goal: str | None = setting(None, "Picture of the task done, for Robo-Dopamine.", metavar="IMAGE")

    def begin(self, videos: Sequence[str]) -> None:
        """Raise ConfigError if videos lack a task, or if views come with more than one video."""
        super().begin(videos)
        if self.views and len(videos) > 1:
            raise ConfigError.at("views", "a single VIDEO, of which they are views", len(videos))

    def check_read(self, client: RewardClient) -> None:
        """Raise InvalidSampleError if an option is given that the model does not read."""
        for name, value in self.more.items():
            if value:
                expected = "none with this model, which reads one camera and no goal"
                is_read = client.model_info(frames=True).reads_views
                require(name, is_read, expected, repr(value), InvalidSampleError)


@dataclass(frozen=True)
class PrefixOptions(Settings):
    """Rule that samples every frame's prefix; without a rule, one pass scores all frames."""

    TITLE: ClassVar[str] = FRAMES

    sampling: Rule | None = setting(
        None,
        f"Score each frame on its prefix, sampled by a rule of docs/guides/choose_frames.md ({', '.join(RULES)}); else "
        "score in one pass.",
        metavar="RULE",
    )
    frames: int | None = setting(None, "Frames per prefix (with --sampling). Default: as in training.", least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sampling is None:
            if self.frames is not None:
                raise ConfigError.of_two("frames", "needs", "sampling")
            return
        try:
            Sampling.of(self.sampling, self.frames, trained_frames=1)
        except InvalidValueError as error:
            raise ConfigError.like(error) from None


@dataclass(frozen=True)
class JsonOutput(Settings):
    """A file for the results as JSON. Raises ConfigError, before the first request, for an unusable file."""

    TITLE: ClassVar[str] = "Outputs"

    json: str | None = setting(None, "Write JSON to FILE; - prints it instead of the table.", metavar="FILE|-")

    def __post_init__(self) -> None:
        for name, value in self._files.items():
            if value != STANDARD_OUTPUT and Path(value).suffix not in _ENDINGS[name]:
                instead = " or -" if name == "json" else ""
                raise ConfigError.at(name, f"a file that ends in {', '.join(_ENDINGS[name])}{instead}", value)

    @property
    def prints_tables(self) -> bool:
        """True if tables go to standard output."""
        return self.json != STANDARD_OUTPUT

    @property
    def _files(self) -> dict[str, str | Path]:
        """Return the files to write, by option."""
        return {name: value for name in _ENDINGS if (value := getattr(self, name, None)) is not None}

    def begin(self, num_videos: int = 0) -> None:
        """Raise ConfigError, before the first request, if a file cannot be created, or cannot show that many videos."""
        for name, file in self._files.items():
            if _ENDINGS[name] == _PICTURES and num_videos > MAX_CURVES:
                raise ConfigError.at(name, f"at most {MAX_CURVES} videos", num_videos)
            folder = Path(file).parent
            if not folder.is_dir():
                raise ConfigError.at(name, f"a folder at {folder}", f"none: mkdir -p {shlex.quote(str(folder))}")
            if not os.access(folder, os.W_OK):
                raise ConfigError.at(name, f"a folder at {folder} that you can write to", "no permission")

    def write_json(self, document: Mapping[str, Any]) -> None:
        """Write the document to the file or standard output, if --json is given."""
        if self.json is None:
            return
        text = json.dumps(document, indent=2, allow_nan=False)
        if self.json == STANDARD_OUTPUT:
            typer.echo(text)
        else:
            Path(self.json).write_text(f"{text}\n")


@dataclass(frozen=True)
class OutputOptions(JsonOutput):
    """Files that show the videos' scores."""

    plot: Path | None = setting(
        None, "Draw all curves in one figure, sized for a paper: .png, .pdf or .svg.", metavar="FILE"
    )
    strips: Path | None = setting(
        None, "Draw frames of each video above its scores: .png, .pdf or .svg.", metavar="FILE"
    )
    size: Size = setting("paper", "Shape of --plot and --strips: paper, as high as needed; slide, 16:9; square, 1:1.")
    caption: str | None = setting(
        None, "Text above --plot and --strips; empty: none. Default: the task and the checkpoint.", metavar="TEXT"
    )
    rrd: Path | None = setting(
        None, "Record frames and scores on one timeline for Rerun's viewer: .rrd.", metavar="FILE"
    )


def asked_model(client: RewardClient, *, use_frames: bool) -> ModelInfo:
    """Return the model for embeddings, or with ``use_frames``, or without it, that for frames. Raises RewardError."""
    if not use_frames:
        with suppress(ModelNotFoundError):
            return client.model_info()
    return client.model_info(frames=True)


@dataclass(frozen=True)
class SyntheticSamples(Settings):
    """Synthetic samples: type, number, and trajectory length."""

    TITLE: ClassVar[str] = "Samples"

    sample_type: SampleType = setting("progress", "Type of the samples.")
    num_samples: int = setting(4, "Number of samples.", least=1, most=10_000)
    num_frames: int = setting(8, "Frames of a trajectory.", least=1, most=9999)
    use_frames: bool = setting(False, "Send random frames even if the model takes embeddings.")

    def samples(self, client: RewardClient) -> list[Sample]:
        """Return samples with the served checkpoint's widths. Raises ModelNotFoundError if no model takes them."""
        widths = asked_model(client, use_frames=self.use_frames).widths
        random = np.random.default_rng(0)
        kinds = {"progress": ProgressSample, "preference": PreferenceSample, "similarity": SimilaritySample}
        count = 1 if self.sample_type == "progress" else 2
        return [
            kinds[self.sample_type](
                *(random_trajectory(random, self.num_frames, widths, task=SYNTHETIC_TASK) for _ in range(count))
            )
            for _ in range(self.num_samples)
        ]
