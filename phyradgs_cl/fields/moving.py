"""An object that moves or changes during a scan: its volumes at some times, a gating signal, and its deformed volume."""

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

_SLAB_VOXELS = 1 << 18  # about how many voxels a thread deforms at a time: their coordinates take six times their memory
_BORDER = 8  # width in voxels of the zeros around a volume: across it the spline's coefficients fall by a factor of 3e-5


@dataclass(frozen=True, eq=False)
class States:
    """Volumes of an object at K times ("states").

    times_s: (K,) in s, rising, on the clock of the scan's frames. volumes: (K, nz, ny, nx) float32 in 1/mm at these times,
    on the scan's grid. Raises InputError for shapes that do not fit, times that do not rise, values that are not finite, and
    K = 0."""

    times_s: np.ndarray
    volumes: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "times_s", checks.rising("times of states", self.times_s))
        volumes = checks.real_array("states", self.volumes)
        checks.shape("states", volumes, (len(self.times_s), None, None, None))
        checks.finite("states", volumes)
        object.__setattr__(self, "volumes", np.asarray(volumes, np.float32))

    @property
    def span_s(self) -> tuple[float, float]:
        """The interval in s that the volumes describe, from half a step before the first to half a step after the last."""
        steps_s = np.diff(self.times_s) if len(self.times_s) > 1 else np.zeros(1)
        return float(self.times_s[0] - steps_s[0] / 2), float(self.times_s[-1] + steps_s[-1] / 2)

    def at(self, time_s: float) -> np.ndarray:
        """Returns the volume (nz, ny, nx) float32 at a time in s: linear between two stated volumes, constant before the
        first and after the last. Raises InputError for anything but a finite number."""
        place = float(np.interp(checks.numbers("time_s", time_s, ()), self.times_s, np.arange(len(self.times_s))))
        first, share = int(place), np.float32(place - int(place))
        after = self.volumes[min(first + 1, len(self.volumes) - 1)]
        return np.asarray(self.volumes[first] + share * (after - self.volumes[first]), np.float32)


@dataclass(frozen=True, eq=False)
class MovingTruth(States):
    """True volumes of a simulated moving object. deformation: the motion relative to ``Scan.reference``; None: not known."""

    deformation: Deformation | None = None


@dataclass(frozen=True, eq=False)
class Gating:
    """A signal that tells the state of the object's motion, as a breathing belt or an ECG does.

    times_s: (n,) in s, rising, on the clock of ``Scan.frame_start_s``. values: (n,) of any unit and sign. is_phase: the
    values are phases in cycles that rise in time. Only their fraction of a cycle matters: after 0.9, 0.1 means 1.1.

    Raises InputError for shapes that differ, values that are not finite, and times that do not rise."""

    times_s: np.ndarray
    values: np.ndarray
    is_phase: bool = False

    def __post_init__(self) -> None:
        checks.flag("gating is_phase", self.is_phase)
        times_s = checks.rising("gating times_s", self.times_s)
        object.__setattr__(self, "times_s", times_s)
        object.__setattr__(self, "values", checks.numbers("gating values", self.values, times_s.shape))

    @property
    def steps(self) -> np.ndarray:
        """The difference (n − 1,) from each value to the next. For phases it is at least 0 and below 1 cycle."""
        steps = np.diff(self.values)
        return steps % 1.0 if self.is_phase else steps

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """Returns the values (m,) at times (m,) in s, linear between two stated values. Phases may be 1 or more."""
        before = np.clip(np.searchsorted(self.times_s, times_s, "right") - 1, 0, len(self.times_s) - 1)
        lengths_s, steps = np.append(np.diff(self.times_s), 1.0), np.append(self.steps, 0.0)
        share = np.clip((np.asarray(times_s) - self.times_s[before]) / lengths_s[before], 0, 1)
        return np.asarray(self.values[before] + share * steps[before])


def deformed(volume: np.ndarray, grid: Grid, deformation: Deformation, weights: Sequence[float] | np.ndarray) -> np.ndarray:
    """Returns a deformed volume (nz, ny, nx) float32 in 1/mm: v(y + w(y)) at every voxel centre y.

    v interpolates the reference ``volume`` (nz, ny, nx) in 1/mm on ``grid`` by cubic splines, and is 0 outside it. w is the
    displacement of ``deformation`` with ``weights`` (R,), as ``deformation.weights_at`` gives them for a time. Where w is 0
    everywhere, the volume is returned unchanged. Raises InputError for shapes that do not fit."""
    if not isinstance(deformation, Deformation):
        raise InputError("deformation", checks.short_repr(deformation), "a Deformation")
    checks.shape("volume", checks.real_array("volume", volume), grid.shape)
    shares = checks.numbers("weights", weights, (deformation.rank,))
    return SplineVolume(np.asarray(volume, np.float32), grid).deformed(deformation, shares)


class SplineVolume:
    """A volume (nz, ny, nx) float32 in 1/mm on ``grid``, interpolated by cubic splines, and 0 outside the grid.

    Splines undershoot near edges, so no value is returned below the least voxel, or below 0 if that is less."""

    def __init__(self, volume: np.ndarray, grid: Grid) -> None:
        self.volume, self.grid = volume, grid
        self._least = min(float(volume.min()), 0.0)
        self._coefficients: np.ndarray | None = None

    def deformed(self, deformation: Deformation, weights: np.ndarray) -> np.ndarray:
        """Returns the deformed volume v(y + w(y)), (nz, ny, nx) float32, for displacements w with ``weights`` (R,)."""
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
        """Returns the deformed slices of ``part``, which is a part of the grid and begins at the grid's slice ``first``."""
        shift = deformation.on_grid_mm(part, weights) / np.array(self.grid.voxel_size_mm[::-1], np.float32)
        nz, ny, nx = part.shape
        voxels = np.ogrid[first : first + nz, :ny, :nx]
        places = [axis.astype(np.float32) + shift[..., 2 - k] + _BORDER for k, axis in enumerate(voxels)]
        values = scipy.ndimage.map_coordinates(self._coefficients, places, np.float32, prefilter=False)
        return np.maximum(values, self._least, out=values)
