# SPDX-License-Identifier: MIT
"""Building blocks for ``rfm-client`` commands: options, one-line errors, exit codes, tables. Applications build on it.

Needs ``rfm-client[cli]``.
"""

from rfm_client.cli.command import Command, ExitCode, report, with_options
from rfm_client.cli.options import JsonOutput, ServerOptions
from rfm_client.cli.show import number, print_facts, print_table

__all__ = [
    "Command",
    "ExitCode",
    "JsonOutput",
    "ServerOptions",
    "number",
    "print_facts",
    "print_table",
    "report",
    "with_options",
]
