"""What a calibration found: a line per parameter, the combinations that nothing tells apart, and the scan set right."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.moved import Sway, Views

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


@dataclass(frozen=True, eq=False, repr=False)
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

    def __repr__(self) -> str:
        said = ", ".join(f"{one.name} {one.verdict}" for one in self.parameters)
        return f"Calibration({said}; residual {self.residual_rms[0]:.4g}, then {self.residual_rms[1]:.4g})"

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
            "views": {name: np.round(values, 6).tolist() for name, values in self.per_view().items()},
        }

    def per_view(self) -> dict[str, np.ndarray]:
        """What was corrected of every view, (F,) by name and unit; nothing where nothing was.

        Of a wobble what was added to the stated poses: source and panel turn counterclockwise as seen from above, the panel
        moves along its own v and u. Of a motion how the object lies in the middle of each view: turned about x, y and z, and
        moved along them."""
        if self.views is None:
            return {}
        if isinstance(self.views, Views):
            shift_v_mm, shift_u_mm = self.views.shift_mm.T
            found = {"turn_deg": np.rad2deg(self.views.turn_rad), "shift_v_mm": shift_v_mm, "shift_u_mm": shift_u_mm}
        else:
            six = self.views.at(np.asarray(self.scan.frame_start_s) + self.scan.shutter.middle_s).T
            found = {f"turn_{axis}_deg": np.rad2deg(values) for axis, values in zip("xyz", six[:3], strict=True)}
            found |= {f"shift_{axis}_mm": values for axis, values in zip("xyz", six[3:], strict=True)}
        return {name: values for name, values in found.items() if values.any()}  # a kind that was left alone is 0

    def plot(self) -> "Figure":
        """A figure: residuals of four frames before and after, and what was corrected of single views."""
        from phyradgs_cl.calibrate.picture import calibration_figure

        return calibration_figure(self)
