# SPDX-License-Identifier: MIT
"""Add the page to the gateway that serves it: entry point ``rfm_gateway.page``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rfm_client.options import ConfigError
from rfm_gateway.mounting import GatewayConfig, PageHost
from rfm_page.dataset_routes import dataset_routes
from rfm_page.routes import viewer_routes

if TYPE_CHECKING:
    from rfm_page.shown import ShownDataset

_PACKAGE = Path(__file__).parent


def add_page(host: PageHost) -> None:
    """Add the page's endpoints and files to a gateway. Raises ConfigError for a dataset that cannot be shown."""
    host.add_endpoints(viewer_routes(host))
    host.add_endpoints(dataset_routes(shown_datasets(host.config), host.limits))
    folders = {"uplot": _PACKAGE / "vendored" / "uplot", "examples": _PACKAGE / "examples"}
    host.add_files(_PACKAGE / "static", **folders)


def shown_datasets(config: GatewayConfig) -> list[ShownDataset]:
    """Return the datasets that the page shows. Raises ConfigError for a folder without such a dataset."""
    if not config.dataset:
        return []
    try:
        import pyarrow  # noqa: F401

        from rfm_labels import DatasetError
        from rfm_labels.datasets import Hdf5Dataset, LeRobotDataset, open_to_show
        from rfm_page.datasets import ShownLeRobot
        from rfm_page.hdf5_datasets import ShownHdf5
        from rfm_page.rlds_datasets import ShownRlds
    except ModuleNotFoundError as error:
        expected = f"the package {error.name}, which reads it"
        raise ConfigError.at("dataset", expected, "none: pip install ./apps/labels") from None
    datasets: list[ShownDataset] = []
    try:
        for path in config.dataset:
            dataset = open_to_show(path)
            if isinstance(dataset, LeRobotDataset):
                datasets.append(ShownLeRobot(dataset))
            elif isinstance(dataset, Hdf5Dataset):
                datasets.append(ShownHdf5(dataset))
            else:
                datasets.append(ShownRlds(dataset))
            datasets[-1].check()
    except (DatasetError, ImportError) as error:
        raise ConfigError(str(error), "dataset") from None
    return datasets
