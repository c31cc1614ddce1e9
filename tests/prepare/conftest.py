"""Scans of voxels with an effect planted, and without: the same noise in both."""

from collections.abc import Callable
from functools import cache

import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import simulate

Planted = Callable[..., Scan]


@pytest.fixture(scope="session")
def planted(rt) -> Planted:
    """(option of ``simulate``=value...) → the scan, made once."""

    @cache
    def make(**effects: float) -> Scan:
        usual = {"size": 28, "detector": 42, "views": 50, "exposure_deg": 5.0, "peak": 3.0, "noise": "beer", "dose": 1e5}
        return simulate("jaw", device=rt, **{**usual, **effects})

    return make
