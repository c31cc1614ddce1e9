"""Two scans of which a method must make the same; makes ``balls`` importable wherever pytest starts."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan

sys.path.insert(0, str(Path(__file__).resolve().parent))


@pytest.fixture(scope="session")
def masked() -> Callable[[Scan, np.ndarray], list[Scan]]:
    """(scan, mask of its frames or of one) → the scan with nothing, and with a lot, in masked pixels."""

    def make(scan: Scan, mask: np.ndarray) -> list[Scan]:
        frames = [np.where(mask != 0, np.float32(garbage), scan.projections) for garbage in (0.0, 50.0)]
        return [replace(scan, projections=f, pixel_mask=mask) for f in frames]

    return make
