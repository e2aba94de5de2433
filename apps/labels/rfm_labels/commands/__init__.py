# SPDX-License-Identifier: MIT
"""Shared parts for commands that label a dataset: ``rfm-client label`` and ``rfm label``. Needs typer and rich.

A command takes ``DatasetArgument``, ``EpisodeTexts``, ``RunOptions``, and ``rfm_labels``' ``LabelOptions`` and
``RayOptions`` as parameters. It passes them to ``LabelCommand``, with a function that connects to a scorer.
"""

from rfm_labels.commands.label import DatasetArgument, EpisodeTexts, LabelCommand, RunOptions

__all__ = ["DatasetArgument", "EpisodeTexts", "LabelCommand", "RunOptions"]
