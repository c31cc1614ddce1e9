"""Two scans of which a method must make the same."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan


@pytest.fixture(scope="session")
def masked() -> Callable[[Scan, np.ndarray], list[Scan]]:
    """(scan, mask of its frames or of one) → the scan with nothing, and with a lot, in masked pixels."""

    def make(scan: Scan, mask: np.ndarray) -> list[Scan]:
        frames = [np.where(mask != 0, np.float32(garbage), scan.projections) for garbage in (0.0, 50.0)]
        return [replace(scan, projections=f, pixel_mask=mask) for f in frames]

    return make
