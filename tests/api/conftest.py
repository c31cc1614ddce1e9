"""A small scan through the public door; PyTorch's tests are collected where PyTorch is."""

import importlib.util

import pytest

from phyradgs_cl.api import Gaussians, Scan, simulate

collect_ignore = [] if importlib.util.find_spec("torch") else ["test_torch.py"]


@pytest.fixture(scope="session")
def scan(rt) -> Scan:
    return simulate("jaw", size=12, detector=20, views=6, exposure_deg=30.0, device=rt)


@pytest.fixture(scope="session")
def columns_scan(rt) -> Scan:
    return simulate("jaw", size=12, detector=20, views=6, exposure_deg=30.0, readout_axis="columns", device=rt)


@pytest.fixture(scope="session")
def cloud(make_cloud) -> Gaussians:
    """Five Gaussians in the scanner's cube of 2 mm."""
    return Gaussians.from_rows(make_cloud(5, 3, spread=0.5, scale=(0.08, 0.2)))
