"""What every step has in common: a scan in, a scan out, and numbers that say what was done."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Scan

Facts = dict[str, Any]


@dataclass(frozen=True)
class Model:
    """A scan's own way from frames (F, v, u) to a volume (z, y, x) and back, on its grid, for steps that ask the object.
    regularised: one with little total variation that explains frames, which takes a while."""

    volume: Callable[[np.ndarray], np.ndarray]
    frames: Callable[[np.ndarray], np.ndarray]
    regularised: Callable[[np.ndarray], np.ndarray]


MakeModel = Callable[[Scan], Model]
Step = Callable[[Scan, Any, MakeModel], tuple[Scan, Facts]]
