# SPDX-License-Identifier: MIT
"""Building blocks for servers in front of Triton: addresses, logs, credentials, Triton's status."""

from rfm_client.contract.addresses import ListenAddress, check_certificate
from rfm_client.contract.process import begin_request, raise_limit, write_log
from rfm_client.contract.wire import DEFAULT_MODEL
from rfm_client.transport.connection import Credentials
from rfm_client.transport.status import ServerStatus
from rfm_client.transport.threads import off_loop

__all__ = [
    "DEFAULT_MODEL",
    "Credentials",
    "ListenAddress",
    "ServerStatus",
    "begin_request",
    "check_certificate",
    "off_loop",
    "raise_limit",
    "write_log",
]
