"""A small moving scan; these tests are collected where PyTorch is installed (make test-neural)."""

import importlib.util

import pytest

from phyradgs_cl.api import Scan, simulate

collect_ignore_glob = [] if importlib.util.find_spec("torch") else ["test_*.py"]


@pytest.fixture(scope="session")
def scan(rt) -> Scan:
    """Eleven noisy frames of a foot, 30° of exposure each, read out along rows."""
    return simulate("foot", size=16, detector=24, views=11, exposure_deg=30.0, noise="tigre", device=rt)
