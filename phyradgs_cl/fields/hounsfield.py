"""Converts attenuation to Hounsfield units. The attenuation of air and water comes from two boxes in the volume, or from the
peaks of its histogram."""

import logging
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields.volume import Grid

log = logging.getLogger(__name__)
HOUNSFIELD = "hounsfield"
"""The key of a volume's scale in its provenance."""
Box = tuple[float, ...]
"""A box in world coordinates: Z0, Z1, Y0, Y1, X0, X1 in mm."""
Window = tuple[float, float, int]
"""A peak of the histogram: its two attenuations in 1/mm at half its prominence, and the number of voxels between them."""
_FEWEST = 100  # least number of voxels of air and of water: their mean then has a tenth of one voxel's noise
# A warning is logged for water outside these limits, in 1/mm: water has 0.0097 at 500 keV and 0.53 at 10 keV.
_WATER_PER_MM = (0.009, 0.6)
_AIR_BELOW = 0.25  # the lowest peak is not air, but perhaps fat, if it lies above this fraction of water's attenuation
_ONE_MATERIAL = 0.4  # a warning is logged for a box whose standard deviation exceeds this times (water − air): two materials
_BINS = 512  # number of bins of the histogram
_SMOOTH_BINS = 2.0  # standard deviation of the Gaussian that smooths the histogram, in bins
_PROMINENT = 0.1  # a peak must rise above its surroundings by this fraction of its smoothed count
# A peak must also rise by this times the square root of its smoothed count. That is eight times the smoothed count's noise.
_CERTAIN = 3.0
_ZOOM = 2.5  # the last histogram ends at this times the upper end of water's peak, so that peaks span many bins
_SHORTENED = 5  # most times that the histogram's range is cut to a quarter: metal may be 1000 times denser than water
_NUMBER = r"-?\d+\.?\d*(?:e[-+]\d+)?"
_NOTE = re.compile(rf"values in HU(?:, water ({_NUMBER}), air ({_NUMBER}) 1/mm)?")


@dataclass(frozen=True)
class Hounsfield:
    """The scale of Hounsfield units: the attenuation in 1/mm of water (0 HU) and of air (−1000 HU). fitted: what the scale
    was fitted to, in words. Raises InputError for water outside 1e-6 to 1e3 1/mm, and for air that is not below water."""

    water_per_mm: float
    air_per_mm: float = 0.0
    fitted: str = ""

    def __post_init__(self) -> None:
        checks.within("--mu-water-per-mm", self.water_per_mm, 1e-6, 1e3)
        checks.within("air of the Hounsfield units (1/mm)", self.air_per_mm, -1e3, 1e3)
        if not self.air_per_mm < self.water_per_mm:
            found = f"air of {self.air_per_mm:.4g}, not below water of {self.water_per_mm:.4g} 1/mm"
            raise InputError("Hounsfield units", found, "air below water", "exchange or move the boxes")

    def of(self, per_mm: np.ndarray) -> np.ndarray:
        """Converts attenuation (z, y, x) in 1/mm to float32 in HU. Raises InputError where float32 overflows."""
        hu = np.subtract(per_mm, self.water_per_mm, dtype=np.float32)
        with np.errstate(over="ignore"):
            hu *= 1000.0 / (self.water_per_mm - self.air_per_mm)
        checks.finite("volume in Hounsfield units", hu)
        return hu

    def per_mm(self, hu: np.ndarray) -> np.ndarray:
        """Converts values (z, y, x) in HU to float32 in 1/mm."""
        values = np.multiply(hu, (self.water_per_mm - self.air_per_mm) / 1000, dtype=np.float32)
        values += np.float32(self.water_per_mm)
        return values

    @property
    def note(self) -> str:
        """A note about the values, for exported files; ``of_note`` reads it again."""
        return f"values in HU, water {self.water_per_mm:.9g}, air {self.air_per_mm:.9g} 1/mm"

    @property
    def line(self) -> str:
        """What the scale was fitted to, or its two values, as one line of text."""
        return self.fitted or f"water {self.water_per_mm:.4g}, air {self.air_per_mm:.4g} 1/mm"

    def facts(self) -> dict[str, object]:
        """Returns the scale as entries of a volume's provenance (the record of how it was made)."""
        return {HOUNSFIELD: asdict(self)}


def of_facts(facts: Mapping[str, object]) -> Hounsfield | None:
    """Returns the scale in a volume's provenance, or None. Raises InputError for a damaged one."""
    if (stored := facts.get(HOUNSFIELD)) is None:
        return None
    try:
        return Hounsfield(**stored)  # type: ignore[arg-type]
    except TypeError as error:
        expected = "a table of water_per_mm, air_per_mm and fitted"
        raise InputError(f"provenance {HOUNSFIELD}", checks.short_repr(stored), expected) from error


def of_note(text: str) -> tuple[bool, Hounsfield | None]:
    """Returns whether a file's note says that its values are HU, and the scale if the note states it."""
    found = _NOTE.search(text)
    if found is None or found[1] is None:
        return found is not None, None
    return True, Hounsfield(float(found[1]), float(found[2]))


def fitted(
    values: np.ndarray, grid: Grid, air: Box | None = None, water: Box | None = None, insert_hu: float = 0.0
) -> Hounsfield:
    """Fits the scale of a volume (z, y, x) in 1/mm to the means of two boxes, of air and of water.

    Without a box of air, the lowest peak of the histogram is air. Without a box of water, the largest other peak is water.
    insert_hu: the HU of the material in the box ``water``, if it is not water. Raises InputError for fewer than 100 voxels,
    air that is not below water, and a histogram without two peaks that can be air and water."""
    checks.within("--insert-hu", insert_hu, -900, 30_000)
    of_air = None if air is None else _inside("--air-mm", values, grid, air)
    of_water = None if water is None else _inside("--water-mm", values, grid, water)
    if of_air is None or of_water is None:
        lowest, largest = (values[(values >= start) & (values <= end)] for start, end, _ in _peaks(values))
        of_air, of_water = lowest if of_air is None else of_air, largest if of_water is None else of_water
    low, of_low = _mean("air", of_air, air is None)
    high, of_high = _mean("water" if insert_hu == 0 else f"insert of {insert_hu:g} HU", of_water, water is None)
    if not low < high:
        raise InputError("Hounsfield units", f"{of_low}, {of_high}", "air below water", "exchange or move the boxes")
    per_mm = (high + insert_hu / 1000 * low) / (1 + insert_hu / 1000)
    if air is None and low > _AIR_BELOW * per_mm:
        found = f"a lowest peak at {low:.3g}, water at {per_mm:.3g} 1/mm"
        raise InputError("--hu", found, "air near 0", "state a box of air by --air-mm")
    if not _WATER_PER_MM[0] <= per_mm <= _WATER_PER_MM[1]:
        text = "Hounsfield units: water has %.3g 1/mm, and at 10 to 500 keV 0.6 to 0.009: check that lengths are in mm"
        log.warning(text, per_mm)
    for name, line, voxels in (("--air-mm", of_low, of_air), ("--water-mm", of_high, of_water)):
        if voxels.std(dtype=np.float64) > _ONE_MATERIAL * (high - low):
            log.warning("%s: found %s; expected voxels of one material; move the box", name, line)
    so = "" if insert_hu == 0 else f", so water {per_mm:.4g} 1/mm"
    return Hounsfield(per_mm, low, f"{of_low}, {of_high}{so}")


def _mean(name: str, voxels: np.ndarray, is_peak: bool) -> tuple[float, str]:
    if voxels.size < _FEWEST:
        remedy = f"state a box by {'--air-mm' if name == 'air' else '--water-mm'}" if is_peak else "take a larger box"
        raise InputError(f"Hounsfield units, {name}", f"{voxels.size} voxels", f"at least {_FEWEST}", remedy)
    mean, deviation = float(voxels.mean(dtype=np.float64)), float(voxels.std(dtype=np.float64))
    where = "its box" if not is_peak else "the lowest peak" if name == "air" else "the largest peak above air"
    return mean, f"{name} {mean:.4g} ± {deviation:.2g} 1/mm ({voxels.size} voxels of {where})"


def _inside(option: str, values: np.ndarray, grid: Grid, box: Box) -> np.ndarray:
    """Returns the voxels whose centres lie in a box. Raises InputError unless the box is six numbers that rise in pairs."""
    ends_mm = checks.numbers(option, box, (6,)).reshape(3, 2)
    if (ends_mm[:, 0] >= ends_mm[:, 1]).any():
        raise InputError(option, checks.short_repr(box), "Z0 below Z1, Y0 below Y1, X0 below X1")
    z, y, x = (slice(*np.searchsorted(axis, ends)) for axis, ends in zip(grid.axes_mm(), ends_mm, strict=True))
    return values[z, y, x]


def _peaks(values: np.ndarray) -> tuple[Window, Window]:
    """Returns the histogram's peaks of air and of water. With metal in the volume, both may lie in the first few bins. So
    the histogram's range is shortened until it shows two peaks, and then once more to end not far above water."""
    lowest, highest = (float(v) for v in np.percentile(values, (0.1, 99.9)))
    for _ in range(_SHORTENED + 1):
        if len(windows := _windows(values, lowest, highest)) > 1:
            break
        highest = lowest + (highest - lowest) / 4
    if len(windows) > 1:
        windows = _windows(values, lowest, min(highest, _ZOOM * _largest(windows)[1])) or windows
    if len(windows) < 2:
        found = f"{len(windows)} peak{'s' if len(windows) != 1 else ''} in the volume"
        raise InputError("--hu", found, "two, air and water", "state boxes by --air-mm and --water-mm")
    return windows[0], _largest(windows)


def _largest(windows: list[Window]) -> Window:
    """Returns the peak with the most voxels among all but the first, which is the lowest."""
    return max(windows[1:], key=lambda window: window[2])


def _windows(values: np.ndarray, lowest: float, highest: float) -> list[Window]:
    """Returns the peaks of the histogram from ``lowest`` to ``highest`` that hold 100 voxels or more, from low to high."""
    if not lowest < highest:
        return []
    counts, edges = np.histogram(values, _BINS, (lowest, highest))
    smooth = scipy.ndimage.gaussian_filter1d(np.pad(counts.astype(np.float64), 8), _SMOOTH_BINS)
    places, facts = scipy.signal.find_peaks(smooth, prominence=0)
    least = np.maximum(_PROMINENT * smooth[places], _CERTAIN * np.sqrt(smooth[places]))
    places = places[facts["prominences"] >= least]
    _, _, left, right = scipy.signal.peak_widths(smooth, places, 0.5)
    found = []
    for first, last in zip(left - 8, right - 7, strict=True):
        low, high = np.interp((first, last), np.arange(_BINS + 1), edges)
        count = int(np.sum(counts[max(int(first), 0) : int(last) + 1]))
        if count >= _FEWEST:
            found.append((float(low), float(high), count))
    return found
