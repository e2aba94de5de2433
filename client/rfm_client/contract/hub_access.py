# SPDX-License-Identifier: MIT
"""Fetch from the Hugging Face Hub or its cache, with readable errors. Needs ``huggingface_hub``.

Since version 1 the library's HTTP exceptions come from httpx, and most wrap other exceptions.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Any

_DOWN = range(500, 600)
_MISSING = (HTTPStatus.UNAUTHORIZED, HTTPStatus.NOT_FOUND)  # the Hub hides private repositories behind 401


class HubError(OSError):
    """Fetching from the Hub and its cache failed; the message says why."""


@contextmanager
def hub_errors() -> Iterator[None]:
    """Turn ``huggingface_hub`` exceptions into HubError."""
    from huggingface_hub.errors import HfHubHTTPError

    transport: Any = next(base for base in HfHubHTTPError.__mro__ if base.__name__ == "HTTPError")
    try:
        yield
    except HubError:
        raise
    except (HfHubHTTPError, transport, OSError, ValueError) as error:
        raise HubError(_reason(error)) from error


def cached_snapshot(
    repo_id: str, kind: str = "model", revision: str | None = None, patterns: list[str] | None = None
) -> Path:
    """Return the folder of a revision in the Hub's cache, fetched if the Hub answers.

    kind: ``model`` or ``dataset``
    patterns: file names to fetch; None: all files

    Raises HubError.
    """
    from huggingface_hub import snapshot_download

    down = None
    try:
        down = unreachable(repo_id, kind, revision)
        with hub_errors():
            is_down = down is not None
            return Path(
                snapshot_download(
                    repo_id, repo_type=kind, revision=revision, allow_patterns=patterns, local_files_only=is_down
                )
            )
    except HubError as error:
        raise HubError(str(error) if down is None else f"{down}, and {error}") from error


def unreachable(repo_id: str, kind: str = "model", revision: str | None = None) -> str | None:
    """Return why the Hub does not answer; None if it has the repository and revision.

    Without this check, the library waits forever when a server does not answer the file list request.

    kind: ``model`` or ``dataset``
    Raises HubError if the Hub refuses the repository or revision.
    """
    from huggingface_hub import HfApi
    from huggingface_hub.constants import HF_HUB_ETAG_TIMEOUT

    try:
        with hub_errors():
            HfApi().repo_info(repo_id, repo_type=kind, revision=revision, timeout=HF_HUB_ETAG_TIMEOUT)
    except HubError as error:
        status, is_content = _status(error.__cause__), isinstance(error.__cause__, ValueError)
        if is_content or status not in (None, HTTPStatus.TOO_MANY_REQUESTS, *_DOWN):
            raise
        return str(error)
    return None


def _status(error: BaseException | None) -> int | None:
    """Return the HTTP status that the Hub answered with; None without an answer."""
    return getattr(getattr(error, "response", None), "status_code", None)


def _reason(error: BaseException) -> str:
    from huggingface_hub.constants import ENDPOINT, HF_HUB_ETAG_TIMEOUT
    from huggingface_hub.errors import (
        GatedRepoError,
        LocalEntryNotFoundError,
        OfflineModeIsEnabled,
        RevisionNotFoundError,
    )

    causes = [error]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
        causes.append(cause)
    status = next((status for cause in causes if (status := _status(cause)) is not None), None)
    if any(isinstance(cause, OfflineModeIsEnabled) for cause in causes):
        return "HF_HUB_OFFLINE is set"
    if isinstance(error, GatedRepoError):
        return f"{ENDPOINT} requires the owner's consent: request access on the page, then hf auth login"
    if isinstance(error, RevisionNotFoundError):
        return f"{ENDPOINT} has no such revision of it"
    if status in _MISSING:
        return f"{ENDPOINT} has no such repository, or requires a login (hf auth login)"
    if status is not None:
        return f"{ENDPOINT} answered {status}"
    if any("Timeout" in type(cause).__name__ for cause in causes):
        return f"{ENDPOINT} did not answer within {HF_HUB_ETAG_TIMEOUT} s"
    if len(causes) == 1 and isinstance(error, LocalEntryNotFoundError):
        return "the cache has no such revision of it"
    system = [cause for cause in causes if isinstance(cause, OSError) and cause.strerror]
    if system and len(causes) > 1:
        return f"{ENDPOINT} cannot be reached: {system[-1].strerror}"
    return " ".join(str(causes[-1]).split())
