# SPDX-License-Identifier: MIT
"""Parts of servers in front of a served checkpoint: addresses, logs, credentials, the state of Triton."""

from rfm_client.contract.addresses import MAX_PORT, check_certificate, is_loopback, split_url
from rfm_client.contract.descriptors import raise_limit
from rfm_client.contract.listening import check_free, from_here, in_url
from rfm_client.contract.names import DEFAULT_MODEL, GATEWAY_KEY_VARIABLE, PROBE_PREFIX, encoder_name, frames_name
from rfm_client.contract.process_log import log_requests, write_log
from rfm_client.contract.synthetic import blank_trajectory
from rfm_client.contract.wire import REQUEST_ID
from rfm_client.transport.credentials import Credentials
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.lifetime import Closing
from rfm_client.transport.off_loop import MIN_BYTES, off_loop
from rfm_client.transport.status import Device, ServerStatus, read_status

__all__ = [
    "DEFAULT_MODEL",
    "GATEWAY_KEY_VARIABLE",
    "MAX_PORT",
    "MIN_BYTES",
    "PROBE_PREFIX",
    "REQUEST_ID",
    "Closing",
    "Credentials",
    "Deadline",
    "Device",
    "ServerStatus",
    "blank_trajectory",
    "check_certificate",
    "check_free",
    "encoder_name",
    "frames_name",
    "from_here",
    "in_url",
    "is_loopback",
    "log_requests",
    "off_loop",
    "raise_limit",
    "read_status",
    "split_url",
    "write_log",
]
