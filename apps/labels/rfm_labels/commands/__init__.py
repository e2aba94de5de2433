# SPDX-License-Identifier: MIT
"""Parts of a command that labels a dataset, as ``rfm-client label`` and ``rfm label``. Needs typer and rich.

A command takes ``DatasetArgument``, ``EpisodeTexts``, ``LabelOptions``, ``RunOptions`` and ``RayOptions`` (both of
``rfm_labels``) as parameters, and hands them to ``LabelCommand`` with a function that connects to a scorer.
"""

from rfm_labels.commands.label import DatasetArgument, EpisodeTexts, LabelCommand, RunOptions

__all__ = ["DatasetArgument", "EpisodeTexts", "LabelCommand", "RunOptions"]
