# SPDX-License-Identifier: MIT
"""Check that a version's weights are those of its export."""

from __future__ import annotations

from pathlib import Path

from google.protobuf import text_format
from tritonclient.grpc import model_config_pb2 as pb

from rfm.checkpoint.content import CheckpointError, is_there
from rfm.checkpoint.provenance import weights_digest
from rfm_client.contract.model_info import DIGEST_PARAMETER


def check_digest(version: Path, expected: str) -> None:
    """Raise CheckpointError if the weights in the folder ``version`` changed after the export.

    expected: digest in the model's configuration; may be empty. The configuration in the version folder takes
        precedence, since the model's may belong to a newer version
    """
    kept = version / "config.pbtxt"
    if is_there(kept):
        expected = _digest_in(kept)
    if expected and (got := weights_digest([version])) != expected:
        raise CheckpointError.at(
            version, f"the weights that were exported ({expected})", f"others ({got})", "export them again"
        )


def _digest_in(file: Path) -> str:
    """Return the digest of the weights in an exported configuration; may be empty."""
    try:
        config = text_format.Parse(file.read_text(), pb.ModelConfig())
    except (OSError, ValueError, text_format.ParseError) as error:
        raise CheckpointError.at(file, "a configuration of the export", error) from error
    return str(config.parameters[DIGEST_PARAMETER].string_value)
