# SPDX-License-Identifier: MIT
"""Declare settings for a command or configuration file, and check values. Applications build on it."""

from rfm_client.contract.checks import (
    checked_count,
    checked_finite,
    counted,
    first_names,
    git_lfs_pointer,
    is_blank,
    require,
)
from rfm_client.contract.errors import InvalidValueError
from rfm_client.contract.settings import ConfigError, Settings, setting

__all__ = [
    "ConfigError",
    "InvalidValueError",
    "Settings",
    "checked_count",
    "checked_finite",
    "counted",
    "first_names",
    "git_lfs_pointer",
    "is_blank",
    "require",
    "setting",
]
