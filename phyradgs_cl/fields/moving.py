"""An object that moves or changes: its volumes at some times, a gating signal, and its volume in any state."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields.deformation import Deformation
from phyradgs_cl.fields.volume import Grid, triple

_SLAB_VOXELS = 1 << 18  # most voxels that one thread displaces at a time: coordinates need six times their memory
_BORDER = 8  # width in voxels of the zeros around a volume: a spline's coefficients fall to 3e-5 within it


@dataclass(frozen=True, eq=False)
class States:
    """Volumes of an object at some times.

    times_s: (K,) in s, rising, on the clock of the scan's frames. volumes: (K, nz, ny, nx) float32 in 1/mm at these times,
    on the scan's grid. Raises InputError for shapes that do not fit, times that do not rise, values that are not finite, and
    for no state at all."""

    times_s: np.ndarray
    volumes: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "times_s", checks.rising("times of states", self.times_s))
        checks.shape("states", self.volumes, (len(self.times_s), None, None, None))
        checks.finite("states", self.volumes)

    @property
    def span_s(self) -> tuple[float, float]:
        """The time in s that the states describe, from half a step before the first to half a step after the last."""
        steps_s = np.diff(self.times_s) if len(self.times_s) > 1 else np.zeros(1)
        return float(self.times_s[0] - steps_s[0] / 2), float(self.times_s[-1] + steps_s[-1] / 2)

    def at(self, time_s: float) -> np.ndarray:
        """Returns the volume (nz, ny, nx) float32 at a time. It is interpolated linearly between two states; before the
        first and after the last one it is constant. Raises InputError for anything but a finite number."""
        place = float(np.interp(checks.numbers("time_s", time_s, ()), self.times_s, np.arange(len(self.times_s))))
        first, share = int(place), np.float32(place - int(place))
        after = self.volumes[min(first + 1, len(self.volumes) - 1)]
        return np.asarray(self.volumes[first] + share * (after - self.volumes[first]), np.float32)


@dataclass(frozen=True, eq=False)
class MovingTruth(States):
    """True volumes of a simulated object. deformation: that of the scan's reference; None if no field describes it."""

    deformation: Deformation | None = None


@dataclass(frozen=True, eq=False)
class Gating:
    """A signal that tells how far the object's motion is at some times.

    times_s: (n,) rising, on the clock of ``Scan.frame_start_s``. values: (n,) of any unit and sign; with ``is_phase``
    rising phases in cycles, of which only the part of a cycle counts.

    Raises InputError for shapes that differ, values that are not finite, and times that do not rise."""

    times_s: np.ndarray
    values: np.ndarray
    is_phase: bool = False

    def __post_init__(self) -> None:
        times_s = checks.rising("gating times_s", self.times_s)
        object.__setattr__(self, "times_s", times_s)
        object.__setattr__(self, "values", checks.numbers("gating values", self.values, times_s.shape))

    @property
    def steps(self) -> np.ndarray:
        """The difference (n − 1,) from each value to the next. Of phases it is from 0 to below 1."""
        steps = np.diff(self.values)
        return steps % 1.0 if self.is_phase else steps

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """Returns the values (m,) at times (m,), linear between two stated values. Phases may be 1 or more."""
        before = np.clip(np.searchsorted(self.times_s, times_s, "right") - 1, 0, len(self.times_s) - 1)
        lengths_s, steps = np.append(np.diff(self.times_s), 1.0), np.append(self.steps, 0.0)
        share = np.clip((np.asarray(times_s) - self.times_s[before]) / lengths_s[before], 0, 1)
        return np.asarray(self.values[before] + share * steps[before])


def deformed(volume: np.ndarray, grid: Grid, deformation: Deformation, weights: Sequence[float] | np.ndarray) -> np.ndarray:
    """Returns the object (nz, ny, nx) float32 in 1/mm at one state's weights (R,), as ``deformation.weights_at`` gives them.

    It is v(y + w(y)) at every voxel centre y, by cubic splines through the voxels of the reference ``volume`` (nz, ny, nx)
    in 1/mm on ``grid``. Outside of it v is 0. A state at rest is the volume itself. Raises InputError for shapes that do not
    fit."""
    if not isinstance(deformation, Deformation):
        raise InputError("deformation", checks.short_repr(deformation), "a Deformation")
    checks.shape("volume", checks.real_array("volume", volume), grid.shape)
    shares = checks.numbers("weights", weights, (deformation.rank,))
    return SplineVolume(np.asarray(volume, np.float32), grid).deformed(deformation, shares)


class SplineVolume:
    """A volume (nz, ny, nx) float32 in 1/mm with values between its voxels too, by cubic splines. Outside it is 0.

    Splines undershoot near edges, so values are limited to the least voxel, or 0, from below."""

    def __init__(self, volume: np.ndarray, grid: Grid) -> None:
        self.volume, self.grid = volume, grid
        self._least = min(float(volume.min()), 0.0)
        self._coefficients: np.ndarray | None = None

    def deformed(self, deformation: Deformation, weights: np.ndarray) -> np.ndarray:
        """Returns v(y + w(y)) (nz, ny, nx) float32 at every voxel centre y, for a state's weights (R,). At rest it is the
        volume."""
        if not np.any(deformation.reach_mm * np.abs(weights)):
            return self.volume
        if self._coefficients is None:
            self._coefficients = scipy.ndimage.spline_filter(np.pad(self.volume, _BORDER), output=np.float32)
        nz, ny, nx = self.grid.shape
        slices = max(1, _SLAB_VOXELS // (ny * nx))
        starts = range(0, nz, slices)
        parts = [self.grid.part(triple((z, 0, 0)), triple((min(slices, nz - z), ny, nx))) for z in starts]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            slabs = list(pool.map(partial(self._slab, deformation, weights), starts, parts))
        return np.concatenate(slabs)

    def _slab(self, deformation: Deformation, weights: np.ndarray, first: int, part: Grid) -> np.ndarray:
        """Returns the deformed slices of ``part`` of the grid. ``first``: its first slice."""
        shift = deformation.on_grid_mm(part, weights) / np.array(self.grid.voxel_size_mm[::-1], np.float32)
        nz, ny, nx = part.shape
        voxels = np.ogrid[first : first + nz, :ny, :nx]
        places = [axis.astype(np.float32) + shift[..., 2 - k] + _BORDER for k, axis in enumerate(voxels)]
        values = scipy.ndimage.map_coordinates(self._coefficients, places, np.float32, prefilter=False)
        return np.maximum(values, self._least, out=values)
