# SPDX-License-Identifier: MIT
"""Options that several commands share, each declared once: servers, videos, outputs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeAlias

import typer

from rfm_client.cli.command import STANDARD_OUTPUT, Given, OptionsOf, usage_errors
from rfm_client.client import RewardClient
from rfm_client.client_options import DEFAULT_TIMEOUT_S
from rfm_client.contract import errors
from rfm_client.contract.names import DEFAULT_MODEL
from rfm_client.contract.samples import MAX_FRAME_STEPS, MIN_FRAME_STEPS
from rfm_client.contract.settings import ConfigError, Settings, Texts, setting
from rfm_client.frames.orientation import ChannelOrder, Orientation
from rfm_client.frames.sampling import RULES, Rule, Sampling
from rfm_client.plot import MAX_CURVES
from rfm_client.transport.credentials import Credentials

DEFAULT_URL = "grpc://localhost:8001"
MIN_TIMEOUT_S, MAX_TIMEOUT_S = 0.001, 86_400
FRAMES = "Frames"  # heading of all options that decide which frames are scored, and on what
MAX_PICTURED = MAX_CURVES  # videos; a larger picture is unreadable, and soon cannot be drawn
_PICTURES = (".png", ".pdf", ".svg")
_ENDINGS = {"json": (".json",), "plot": _PICTURES, "strips": _PICTURES, "rrd": (".rrd",)}


@dataclass(frozen=True)
class CredentialFiles(Settings):
    """Credentials for a protected server, as files: CAs, client certificate, API key."""

    TITLE: ClassVar[str] = "TLS and key"

    ca_file: Path | None = setting(None, "Authorities (PEM) to trust; else the system's.", variable="RFM_CA_FILE")
    client_certificate: Path | None = setting(
        None, "Certificate that this client shows to the server (PEM).", variable="RFM_CLIENT_CERTIFICATE"
    )
    client_key: Path | None = setting(None, "The certificate's key (PEM).", variable="RFM_CLIENT_KEY")
    api_key_file: Path | None = setting(
        None, "File with the key that requests show as Bearer.", variable="RFM_API_KEY_FILE"
    )

    def read(self) -> Credentials:
        """Return the credentials in the files. Raises ValueError for an unusable file."""
        try:
            api_key = None if self.api_key_file is None else self.api_key_file.read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"api_key_file: expected a text file, got {error}") from None
        return Credentials(self.ca_file, self.client_certificate, self.client_key, api_key=api_key)


# Options after a subcommand, which win over those before it and over variables.
CredentialsGiven: TypeAlias = Annotated[Given, OptionsOf(CredentialFiles, reads_variables=False)]


def credentials_of(context: typer.Context, given: Given) -> Credentials:
    """Return the credentials of a subcommand: the given files, else those before it. Raises typer.BadParameter."""
    before: CredentialFiles = context.obj
    with usage_errors("--ca-file, --client-certificate, --client-key, --api-key-file"):
        return replace(before, **given).read()


@dataclass(frozen=True)
class ServerOptions(Settings):
    """Servers, model and timeout of a command."""

    TITLE: ClassVar[str] = "Server"

    urls: Texts = setting(
        (DEFAULT_URL,),
        "grpc://host:8001 or http://host:8000, with TLS grpcs:// or https://. Again for more servers of the same "
        "checkpoint.",
        flag="--url",
        variable="RFM_URL",
    )
    model: str = setting(DEFAULT_MODEL, "Name under which the checkpoint was exported.")
    timeout_s: float = setting(
        DEFAULT_TIMEOUT_S,
        "Seconds that a request may take.",
        flag="--timeout",
        least=MIN_TIMEOUT_S,
        most=MAX_TIMEOUT_S,
    )

    @property
    def origin(self) -> dict[str, Any]:
        """The servers and the model, for JSON documents."""
        return {"servers": list(self.urls), "model": self.model}

    def client(self, credentials: Credentials, **options: Any) -> RewardClient:
        """Return a client. Raises typer.BadParameter for an invalid URL."""
        with usage_errors("'--url'"):
            return RewardClient(
                self.urls, model=self.model, **{"timeout_s": self.timeout_s, **credentials.options, **options}
            )

    @contextmanager
    def connected(self, credentials: Credentials) -> Iterator[RewardClient]:
        """Yield a client if a server answers and serves the model. Otherwise raise RewardError at once."""
        with self.client(credentials) as client:
            self._check(credentials)
            yield client

    def _check(self, credentials: Credentials) -> None:
        problems = []
        for url in self.urls:
            with RewardClient(
                url, model=self.model, timeout_s=self.timeout_s, retry=False, **credentials.options
            ) as one:
                try:
                    try:
                        one.model_info()
                    except errors.ModelNotFoundError:
                        one.model_info(frames=True)
                    return
                except errors.RewardError as error:
                    problems.append(error)
        raise problems[0]


@dataclass(frozen=True)
class VideoOptions(Settings):
    """Task of the videos, and choice and size of the frames to send."""

    TITLE: ClassVar[str] = "Videos"

    task: str = setting("", "The task, as a sentence.")
    fps: float = setting(3.0, "Take so many frames a second of a video.", least=0.001, group=FRAMES)
    max_frames: int | None = setting(
        None, "Score at most so many of these frames, evenly spaced.", least=1, group=FRAMES
    )
    subsample: bool = setting(
        True, "Score at most as many frames in one pass as the checkpoint was trained on, evenly spaced.", group=FRAMES
    )
    resize: bool = setting(False, "Make frames as small as the checkpoint reads them, then send.")
    orient: Orientation = setting(
        "none", "Turn frames upright before they are scored (see docs/guides/label_a_dataset.md)."
    )
    channels: ChannelOrder = setting("rgb", "Channel order in the file; bgr swaps red and blue.")


@dataclass(frozen=True)
class PrefixOptions(Settings):
    """Rule that samples each frame's prefix; without a rule, one pass scores all frames."""

    TITLE: ClassVar[str] = FRAMES

    sampling: Rule | None = setting(
        None,
        f"Score each frame on its prefix, sampled by a rule of docs/guides/choose_frames.md ({', '.join(RULES)}); else "
        "all frames in one pass.",
        metavar="RULE",
    )
    frames: int | None = setting(
        None, "Show the model so many frames of a prefix (with --sampling); else as many as in training.", least=1
    )
    frame_steps: int = setting(
        0,
        "Score each frame on its prefix, sampled by the server to so many frames (dense mode); 0: no.",
        least=0,
        most=MAX_FRAME_STEPS,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.frame_steps < MIN_FRAME_STEPS:
            raise ConfigError("frame_steps", f"expected 0 or at least {MIN_FRAME_STEPS}, got {self.frame_steps}")
        if self.sampling is None:
            if self.frames is not None:
                raise ConfigError("frames", "expected --sampling with it, got none")
            return
        if self.frame_steps:
            raise ConfigError("sampling", f"expected no --frame-steps with it, got {self.frame_steps}")
        try:
            Sampling.of(self.sampling, self.frames, trained_frames=1)
        except ValueError as error:
            raise ConfigError("frames", str(error).removeprefix("frames: ")) from None

    @property
    def rule(self) -> str:
        """A line for the user: which frames decide a frame's score."""
        if self.frame_steps:
            return f"Each frame is scored on its prefix: linspace_trunc, {self.frame_steps} frames."
        if self.sampling is not None:
            frames = f", {self.frames} frames" if self.frames else ""
            return f"Each frame is scored on its prefix: {self.sampling}{frames}."
        return "All frames in one pass; labels and the page score each prefix (--sampling)."


@dataclass(frozen=True)
class OutputOptions(Settings):
    """Files of the results. Raises ConfigError, before the first request, for an unusable file."""

    TITLE: ClassVar[str] = "Outputs"

    json: str | None = setting(
        None, "Write JSON to a .json file; alone or -: print it, and no table.", metavar="[FILE|-]"
    )
    plot: Path | None = setting(
        None, "Draw the curves of all videos in one figure, sized for a paper: .png, .pdf or .svg.", metavar="FILE"
    )
    strips: Path | None = setting(
        None, "Draw frames of each video above its scores: .png, .pdf or .svg.", metavar="FILE"
    )
    rrd: Path | None = setting(
        None, "Record frames and scores on one timeline for Rerun's viewer: .rrd.", metavar="FILE"
    )
    npy: Path | None = setting(
        None,
        "Write float32 [T, 2], progress and success: to a .npy file (one video), or one a video to a folder.",
        metavar="FILE|FOLDER",
    )

    def __post_init__(self) -> None:
        for name, endings in _ENDINGS.items():
            value = getattr(self, name)
            if value is None or value == STANDARD_OUTPUT:
                continue
            if Path(value).suffix not in endings:
                instead = " or -" if name == "json" else ""
                raise ConfigError(name, f"expected a file that ends in {', '.join(endings)}{instead}, got {value}")
        if self.npy is not None and not self.npy.is_dir() and self.npy.suffix not in ("", ".npy"):
            raise ConfigError("npy", f"expected a .npy file or a folder, got {self.npy}")

    @property
    def prints_tables(self) -> bool:
        """True if tables go to standard output."""
        return self.json != STANDARD_OUTPUT

    def make_folders(self) -> None:
        """Make the files' folders where they are missing. Raises ConfigError if that fails."""
        folders = {name: Path(value).parent for name in _ENDINGS if (value := getattr(self, name)) is not None}
        if self.npy is not None:
            folders["npy"] = self.npy.parent if self.npy.suffix == ".npy" and not self.npy.is_dir() else self.npy
        for name, folder in folders.items():
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigError(name, f"expected a folder at {folder}, got: {error.strerror}") from None

    def begin(self, videos: Sequence[str]) -> None:
        """Make the files' folders. Raises ConfigError, before that, for more videos than the files take."""
        for name in ("plot", "strips"):
            if getattr(self, name) is not None and len(videos) > MAX_PICTURED:
                raise ConfigError(name, f"expected at most {MAX_PICTURED} videos, got {len(videos)}")
        if self.npy is not None and self.npy.suffix == ".npy" and len(videos) > 1:
            raise ConfigError("npy", f"expected a folder for {len(videos)} videos, got {self.npy}")
        self.make_folders()

    def array_files(self, stems: Sequence[str]) -> list[Path]:
        """Return the .npy file of each video; empty without --npy."""
        if self.npy is None:
            return []
        if self.npy.suffix == ".npy":
            return [self.npy]
        return [self.npy / f"{stem}.npy" for stem in stems]

    def write_json(self, document: Mapping[str, Any]) -> None:
        """Write the document to the file or standard output, if --json is given."""
        if self.json is None:
            return
        text = json.dumps(document, indent=2, allow_nan=False)
        if self.json == STANDARD_OUTPUT:
            typer.echo(text)
        else:
            Path(self.json).write_text(f"{text}\n")
