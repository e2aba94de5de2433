# SPDX-License-Identifier: MIT
"""Options that several commands share, each declared once: servers, videos, outputs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import typer

from rfm_client.async_client import DEFAULT_TIMEOUT_S
from rfm_client.cli.command import STANDARD_OUTPUT, usage_errors
from rfm_client.client import RewardClient
from rfm_client.contract import errors
from rfm_client.contract.names import DEFAULT_MODEL
from rfm_client.contract.samples import MAX_FRAME_STEPS, MIN_FRAME_STEPS
from rfm_client.contract.settings import ConfigError, Settings, Texts, setting
from rfm_client.data.orientation import Orientation
from rfm_client.data.sampling import Rule, Sampling
from rfm_client.transport.credentials import Credentials

DEFAULT_URL = "grpc://localhost:8001"
MIN_TIMEOUT_S, MAX_TIMEOUT_S = 0.001, 86_400
MAX_PICTURED = 50  # videos; a larger picture is unreadable, and soon cannot be drawn
_ENDINGS = {"json": (".json",), "plot": (".png", ".pdf", ".svg"), "rrd": (".rrd",)}


@dataclass(frozen=True)
class CredentialFiles(Settings):
    """Credentials for a protected server, as files: CAs, client certificate, API key."""

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
    fps: float = setting(3.0, "Frames a second that are taken from a video.", least=0.001)
    max_frames: int | None = setting(None, "Score at most so many frames, evenly.", least=1)
    subsample: bool = setting(True, "Score no more frames than the checkpoint was trained on, evenly spaced; else all.")
    resize: bool = setting(False, "Make frames as small as the checkpoint reads them, then send.")
    orient: Orientation = setting(
        "none", "Turn frames upright before they are scored (see docs/guides/label_a_dataset.md)."
    )


@dataclass(frozen=True)
class PrefixOptions(Settings):
    """Rule that samples each frame's prefix; without a rule, one pass scores all frames."""

    TITLE: ClassVar[str] = "Prefixes"

    frame_steps: int = setting(
        0,
        "Dense mode: score frame t on its prefix 0..t alone, sampled to so many frames.",
        least=0,
        most=MAX_FRAME_STEPS,
    )
    sampling: Rule | None = setting(
        None, "Rule by which each frame is scored on its prefix (see docs/guides/choose_frames.md)."
    )
    frames: int | None = setting(None, "Frames that the rule shows the model; else as many as in training.", least=1)

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
    plot: Path | None = setting(None, "Draw frames and scores: .png, .pdf or .svg.", metavar="FILE")
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
            if not Path(value).parent.is_dir():
                raise ConfigError(name, f"expected a folder at {Path(value).parent}, got none")
        can_be_made = self.npy is None or (self.npy.suffix in ("", ".npy") and self.npy.parent.is_dir())
        if self.npy is not None and not self.npy.is_dir() and not can_be_made:
            raise ConfigError("npy", f"expected a .npy file or a folder, got {self.npy}")

    @property
    def prints_tables(self) -> bool:
        """True if tables go to standard output."""
        return self.json != STANDARD_OUTPUT

    def check(self, videos: Sequence[str]) -> None:
        """Raise ConfigError for more videos than the files take."""
        if self.plot is not None and len(videos) > MAX_PICTURED:
            raise ConfigError("plot", f"expected at most {MAX_PICTURED} videos, got {len(videos)}")
        if self.npy is not None and self.npy.suffix == ".npy" and len(videos) > 1:
            raise ConfigError("npy", f"expected a folder for {len(videos)} videos, got {self.npy}")

    def array_files(self, stems: Sequence[str]) -> list[Path]:
        """Return the .npy file of each video, and make its folder; empty without --npy."""
        if self.npy is None:
            return []
        if self.npy.suffix == ".npy":
            return [self.npy]
        self.npy.mkdir(exist_ok=True)
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
