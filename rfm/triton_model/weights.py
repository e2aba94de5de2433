# SPDX-License-Identifier: MIT
"""Are a served version's weights those that were exported?"""

from __future__ import annotations

from pathlib import Path

from google.protobuf import text_format
from tritonclient.grpc import model_config_pb2 as pb

from rfm.checkpoint.content import CheckpointError, is_there
from rfm.checkpoint.provenance import weights_digest
from rfm_client.contract.model_info import DIGEST_PARAMETER


def check_digest(version: Path, expected: str) -> None:
    """Raises CheckpointError if the weights in the folder ``version`` are not those that were exported.

    expected: the digest in the model's configuration, which may be that of a newer version. Each version folder keeps
    the configuration of its own export. Empty: the export named none
    """
    kept = version / "config.pbtxt"
    if is_there(kept):
        expected = _digest_in(kept)
    if expected and (got := weights_digest([version])) != expected:
        raise CheckpointError(
            f"{version}: expected the weights that were exported ({expected}), got others ({got}); export them again"
        )


def _digest_in(file: Path) -> str:
    """The digest that an exported configuration names; empty if it names none."""
    try:
        config = text_format.Parse(file.read_text(), pb.ModelConfig())
    except (OSError, ValueError, text_format.ParseError) as error:
        raise CheckpointError(f"{file}: expected a configuration of the export, got {error}") from error
    return str(config.parameters[DIGEST_PARAMETER].string_value)
