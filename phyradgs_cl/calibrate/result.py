"""The result of a calibration: an estimate per parameter, combinations that the frames do not determine, and the corrected
scan."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.perturbed import Sway, Views
from phyradgs_cl.drawing import draw_image, new_figure
from phyradgs_cl.text import to_digits_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CORRECTED, AGREES, CANNOT_TELL = "corrected", "agrees", "cannot tell"
_FRAMES = 4  # at most this many frames are shown in the figure
_ROW_INCH, _CURVES_INCH, _WIDTH_INCH = 1.8, 2.4, 7.0


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter in ``unit``: its stated value, and the value found with its standard deviation.

    ``found`` and ``deviation`` are None if the frames do not determine the parameter. share: of the frames' change with the
    parameter, the fraction, 0 to 1, that no object and no other parameter explains."""

    name: str
    unit: str
    stated: float
    found: float | None
    deviation: float | None
    share: float
    verdict: str

    @property
    def words(self) -> str:
        """The value found, with two digits of its standard deviation; "-" if no value was found."""
        if self.found is None or self.deviation is None:
            return "-"
        return " ± ".join(to_digits_of(number, self.deviation) for number in (self.found, self.deviation))

    def facts(self) -> dict[str, object]:
        return asdict(self)


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """The corrected ``scan``, with unchanged frames, and how it was found.

    - parameters: an estimate of each. alike: combinations of parameters, in words, that no frame tells from another object.
    - residual_rms: RMS residual before and after correction, in line integrals, on the finest grid. before, after: these
      residuals (F, rows, columns).
    - views: corrections per view, or the object's motion; None if not significant. ``parameters`` has the root mean square
      of each kind, with the deviation of a single view.

    Lengths are in mm, angles in degrees, times in s. ``calibrate`` returns a Calibration, or raises InputError."""

    scan: Scan
    parameters: list[ParameterEstimate]
    alike: list[str]
    residual_rms: tuple[float, float]
    before: np.ndarray
    after: np.ndarray
    views: "Views | Sway | None" = None

    def __repr__(self) -> str:
        verdicts = ", ".join(f"{one.name} {one.verdict}" for one in self.parameters)
        return f"Calibration({verdicts}; residual {self.residual_rms[0]:.4g}, then {self.residual_rms[1]:.4g})"

    @property
    def corrected(self) -> list[ParameterEstimate]:
        """The parameters that were corrected."""
        return [one for one in self.parameters if one.verdict == CORRECTED]

    def facts(self) -> dict[str, object]:
        """Returns all fields but scan and residuals as numbers, texts, lists and dicts."""
        before, after = self.residual_rms
        return {
            "parameters": [one.facts() for one in self.parameters],
            "alike": self.alike,
            "residual_rms_before": before,
            "residual_rms_after": after,
            "views": {name: np.round(values, 6).tolist() for name, values in self.per_view().items()},
        }

    def per_view(self) -> dict[str, np.ndarray]:
        """Returns the corrections of every view, (F,) by name and unit; {} without corrections of views.

        A wobble is added to the stated poses: source and panel turn counterclockwise seen from above, and the panel moves
        along its own v and u. A motion is the object's pose in the middle of each view: rotated about, then shifted along x,
        y and z."""
        if self.views is None:
            return {}
        if isinstance(self.views, Views):
            shift_v_mm, shift_u_mm = self.views.shift_mm.T
            curves = {"turn_deg": np.rad2deg(self.views.turn_rad), "shift_v_mm": shift_v_mm, "shift_u_mm": shift_u_mm}
        else:
            six = self.views.at(np.asarray(self.scan.frame_start_s) + self.scan.shutter.middle_s).T
            curves = {f"turn_{axis}_deg": np.rad2deg(values) for axis, values in zip("xyz", six[:3], strict=True)}
            curves |= {f"shift_{axis}_mm": values for axis, values in zip("xyz", six[3:], strict=True)}
        return {name: values for name, values in curves.items() if values.any()}  # only kinds that were corrected

    def plot(self) -> "Figure":
        """Returns a figure of the residuals of up to four frames, before on the left and after on the right, on one scale.

        Below are the corrections per view, if any. Red: the frame has more than the volume explains; blue: less."""
        frames = np.unique(np.linspace(0, len(self.before) - 1, _FRAMES).round().astype(int))
        curves = self.per_view()
        heights = [_ROW_INCH] * len(frames)
        if curves:
            heights.append(_CURVES_INCH)
        figure = new_figure(_WIDTH_INCH, sum(heights))
        rows = figure.add_gridspec(len(heights), 2, height_ratios=heights)
        limit = float(np.percentile(np.abs(self.before[frames]), 99.5)) or 1.0
        for row, frame in enumerate(frames):
            for column, (when, images) in enumerate((("before", self.before), ("after", self.after))):
                title = f"residual {frame + 1} of {len(self.before)} {when}: RMS {rms(images[frame]):.3g}"
                axes = figure.add_subplot(rows[row, column])
                draw_image(axes, images[frame], title, cmap="RdBu_r", vmin=-limit, vmax=limit)
        for column, unit in enumerate(("deg", "mm")):
            in_unit = {name: values for name, values in curves.items() if name.endswith(unit)}
            if in_unit:
                _draw_curves(figure.add_subplot(rows[len(frames), column]), in_unit, unit)
        return figure


def _draw_curves(axes: "Axes", curves: dict[str, np.ndarray], unit: str) -> None:
    for name, values in curves.items():
        axes.plot(values, lw=1.2, label=name.removesuffix(f"_{unit}").replace("_", " "))
    axes.set(xlabel="view", ylabel=unit)
    axes.set_title("corrected by view", fontsize=9)
    axes.legend(fontsize=7)
    axes.spines[["top", "right"]].set_visible(False)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
