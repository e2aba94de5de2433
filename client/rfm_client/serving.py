# SPDX-License-Identifier: MIT
"""Parts of servers in front of a served checkpoint: addresses, logs, credentials, the state of Triton."""

from rfm_client.contract.addresses import check_certificate
from rfm_client.contract.descriptors import raise_limit
from rfm_client.contract.listening import ListenAddress
from rfm_client.contract.names import DEFAULT_MODEL
from rfm_client.contract.process_log import begin_request, write_log
from rfm_client.transport.credentials import Credentials
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
