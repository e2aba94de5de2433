# SPDX-License-Identifier: MIT
"""Declare settings of a command or a configuration file, and check values. Applications build on it."""

from rfm_client.contract.checks import first_names, git_lfs_pointer, require
from rfm_client.contract.errors import InvalidValueError
from rfm_client.contract.numbers import checked_count, checked_finite
from rfm_client.contract.settings import ConfigError, Settings, setting
from rfm_client.contract.tasks import is_blank

__all__ = [
    "ConfigError",
    "InvalidValueError",
    "Settings",
    "checked_count",
    "checked_finite",
    "first_names",
    "git_lfs_pointer",
    "is_blank",
    "require",
    "setting",
]
