# SPDX-License-Identifier: MIT
"""The command lines that the page shows where something is missing, with the options of the command that started it."""

from __future__ import annotations

import shlex

from rfm_gateway.mounting import GatewayConfig

REPOSITORY, CHECKPOINT, DATASET = "my_models", "my_checkpoint", "my_dataset"  # stand for paths of the user


def remedies(config: GatewayConfig, started_by: str) -> dict[str, str | bool]:
    """Return a command line for each fault.

    start: the server has ended
    dataset: no dataset is there
    triton: Triton does not answer
    model: Triton serves no model
    starts_triton: True: ``start`` also starts Triton
    """
    url = shlex.quote(config.triton_url)
    port = str(config.address.port)
    is_beside = started_by == "rfm serve"
    start = (
        f"{started_by} {REPOSITORY} --gateway-port {port}"
        if is_beside
        else f"{started_by} --triton {url} --port {port}"
    )
    return {
        "start": start,
        "dataset": f"{start} {'--gateway-dataset' if is_beside else '--dataset'} {DATASET}",
        "triton": f"rfm-client status --url {url}" if is_beside else f"rfm serve {REPOSITORY}",
        "model": f"rfm export {CHECKPOINT} --repository {REPOSITORY}",
        "starts_triton": is_beside,
    }
