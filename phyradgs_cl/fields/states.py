"""The truth of a moving object: its volume at some times."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.fields.deformation import Deformation


@dataclass(frozen=True, eq=False)
class MovingTruth:
    """True volumes of a simulated object. times_s: (K,) in s on the clock of the scan's frames. volumes: (K, nz, ny, nx)
    float32 in 1/mm at these times, on the scan's grid. deformation: how the scan's reference became them; None where no
    field describes it. Raises InputError for shapes that do not fit, and values that are not finite."""

    times_s: np.ndarray
    volumes: np.ndarray
    deformation: Deformation | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "times_s", checks.numbers("times of states", self.times_s, (None,)))
        checks.shape("states", self.volumes, (len(self.times_s), None, None, None))
        checks.finite("states", self.volumes)
