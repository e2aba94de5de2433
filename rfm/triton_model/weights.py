# SPDX-License-Identifier: MIT
"""Check that a version's weights are those of its export."""

from __future__ import annotations

from pathlib import Path

from google.protobuf import text_format
from tritonclient.grpc import model_config_pb2 as pb

from rfm.files import CheckpointError, is_there, weights_digest
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description


def check_digest(version: Path, expected: str | None) -> None:
    """Raise CheckpointError if the weights in the folder ``version`` changed after the export.

    expected: digest in the model's configuration; None: unknown. The configuration in the version folder takes
        precedence, since the model's may belong to a newer version
    """
    kept = version / "config.pbtxt"
    if is_there(kept):
        expected = _digest_in(kept)
    if expected and (got := weights_digest([version])) != expected:
        raise CheckpointError.at(
            version, f"the weights that were exported ({expected})", f"others ({got})", "export them again"
        )


def _digest_in(file: Path) -> str | None:
    """Return the digest of the weights in an exported configuration; None: unknown."""
    try:
        config = text_format.Parse(file.read_text(), pb.ModelConfig())
        return Description.parse(config.parameters[DESCRIPTION_PARAMETER].string_value).weights_digest
    except (OSError, ValueError, text_format.ParseError) as error:
        raise CheckpointError.at(file, "a configuration of the export", error, "export again") from error
