"""What a calibration found: a line per parameter, the combinations that nothing tells apart, and the scan set right."""

from dataclasses import asdict, dataclass

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.moved import Sway, Views

CORRECTED, AGREES, CANNOT_TELL = "corrected", "agrees", "cannot tell"


@dataclass(frozen=True)
class Found:
    """One parameter in ``unit``: stated, and found with its standard deviation (both None where the frames cannot tell).
    ``share``: what is left of its signal once the object and the other parameters have adapted, 0 to 1."""

    name: str
    unit: str
    stated: float
    found: float | None
    deviation: float | None
    share: float
    verdict: str

    def facts(self) -> dict[str, object]:
        """The fields as plain values, for JSON."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Calibration:
    """``scan``: with what was corrected, all else as it was. parameters: a line each. alike: combinations that leave no
    trace of their own, in words. residual_rms: of the frames before and after, dimensionless, at the finest level, whose
    residuals ``before`` and ``after`` (F, rows, columns) are kept for a picture. views: their own turns and shifts, or
    the object's motion, where some were found; the table has the root mean square of each kind, with the deviation of one.
    Lengths are in mm, angles in degrees, times in s. ``calibrate`` makes it, and raises InputError where it cannot."""

    scan: Scan
    parameters: list[Found]
    alike: list[str]
    residual_rms: tuple[float, float]
    before: np.ndarray
    after: np.ndarray
    views: "Views | Sway | None" = None

    @property
    def corrected(self) -> list[Found]:
        """The parameters that were put right."""
        return [one for one in self.parameters if one.verdict == CORRECTED]

    def facts(self) -> dict[str, object]:
        """All but scan and images, as plain values."""
        before, after = self.residual_rms
        return {
            "parameters": [one.facts() for one in self.parameters],
            "alike": self.alike,
            "residual_rms_before": before,
            "residual_rms_after": after,
        }
