"""A deforming object: a sum of a few displacement fields with weights in time. The fields are cubic B-splines in space.

    w(y, t) = Σ_r φ_r(t) U_r(y),   U_r(y) = Σ_c control_c,r β³((y − origin) / spacing − c)

At time t, the object has at point y the attenuation that the reference volume has at y + w(y, t).
D. Rueckert et al., Nonrigid registration using free-form deformations, IEEE Trans. Med. Imaging 18, 712-721 (1999)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields.volume import Grid, triple

_LEVELS = 16  # ``smallest_determinant`` rounds weights to this many steps, so that few different states are left to test
_MOST_STEPS = 200  # most iterations that invert a displacement field: enough if each multiplies the error by at most 0.93
_FLAT = 1e-4  # a point where every slope of the displacement, in mm per mm, is below this counts as having determinant 1
_CLOSE = 1e-6  # the inversion stops when no displacement changes by more than this fraction of the control spacing


@dataclass(frozen=True, eq=False)
class Deformation:
    """How an object moves and deforms during a scan.

    control_mm: (R, nz, ny, nx, 3) coefficients of the R fields U_r at control points, components x, y, z. Beyond the
    outermost control points the fields fall smoothly to 0 within two spacings. origin_mm: the position x, y, z of control
    point (0, 0, 0). spacing_mm: the distance of control points, one length or three (x, y, z). times_s: (T,) rising, on the
    clock of ``Scan.frame_start_s``. weights: (T, R) φ_r at these times, linear in between and constant outside.

    Raises InputError for other shapes, values that are not finite, lengths that are not above 0, and times that do not
    rise."""

    control_mm: np.ndarray
    origin_mm: tuple[float, float, float]
    spacing_mm: float | tuple[float, float, float]
    times_s: np.ndarray
    weights: np.ndarray

    def __post_init__(self) -> None:
        control_mm = checks.numbers("deformation control_mm", self.control_mm, (None, None, None, None, 3))
        if 0 in control_mm.shape:
            raise InputError("deformation control_mm", f"shape {control_mm.shape}", "at least one field and control point")
        origin_mm = checks.numbers("deformation origin_mm", self.origin_mm, (3,))
        given = checks.numbers("deformation spacing_mm", self.spacing_mm)
        checks.shape("deformation spacing_mm", given, (3,) if given.ndim else ())
        spacing_mm = np.broadcast_to(given, 3)
        if (spacing_mm <= 0).any():
            raise InputError("deformation spacing_mm", str(self.spacing_mm), "lengths above 0")
        times_s = checks.rising("deformation times_s", self.times_s)
        weights = checks.numbers("deformation weights", self.weights, (len(times_s), len(control_mm)))
        object.__setattr__(self, "control_mm", control_mm)
        object.__setattr__(self, "origin_mm", tuple(origin_mm.tolist()))
        object.__setattr__(self, "spacing_mm", tuple(spacing_mm.tolist()))
        object.__setattr__(self, "times_s", times_s)
        object.__setattr__(self, "weights", weights)

    @classmethod
    def of_displacements(
        cls, displacements_mm: np.ndarray, grid: Grid, times_s: "ArrayLike", spacing_mm: float, rank: int = 2
    ) -> "Deformation":
        """Returns the deformation closest to displacements w, as image registration gives them at every voxel.

        displacements_mm: (T, nz, ny, nx, 3) in mm, x y z, at the voxel centres of ``grid`` and times_s (T,) in s. A singular
        value decomposition makes at most ``rank`` fields of them, with control points ``spacing_mm`` apart. Each field's
        largest absolute weight is 1. Raises InputError for other shapes, values not finite, times that do not rise, and a
        rank or spacing out of range."""
        times_s = checks.numbers("times_s", times_s, (None,))
        dense_mm = checks.numbers("displacements_mm", displacements_mm, (len(times_s), *grid.shape, 3))
        checks.whole("rank", rank, 1, 1000)
        rows = dense_mm.reshape(len(times_s), -1)
        # The left singular vectors of ``rows``, at less cost: this matrix is (T, T), and ``rows`` has 3 columns per voxel.
        squares, vectors = np.linalg.eigh(rows @ rows.T)
        weights = vectors[:, ::-1][:, : min(rank, len(times_s))]
        largest = np.abs(weights).max(0)
        fields_mm = (weights * largest).T @ rows
        checks.within("spacing_mm", spacing_mm, max(grid.size_mm) / 1000, np.inf)
        control_mm, origin_mm = fitted_control_mm(fields_mm.reshape(-1, *dense_mm.shape[1:]), grid, spacing_mm)
        return cls(control_mm, origin_mm, spacing_mm, times_s, weights / largest)

    def __repr__(self) -> str:
        rank, nz, ny, nx, _ = self.control_mm.shape
        return f"Deformation(rank {rank}, {nz} x {ny} x {nx} control points, {len(self.times_s)} times)"

    @property
    def rank(self) -> int:
        """The number of fields R."""
        return len(self.control_mm)

    @property
    def is_still(self) -> bool:
        """Whether all displacements are 0."""
        return not np.any(self.reach_mm * np.abs(self.weights).max(axis=0))

    @property
    def reach_mm(self) -> np.ndarray:
        """The length of each field's longest control vector, (R,) in mm. At weight 1 a field displaces no point further."""
        return np.asarray(np.linalg.norm(self.control_mm, axis=-1).max(axis=(1, 2, 3)))

    @property
    def fastest_mm_per_s(self) -> float:
        """A speed in mm/s that no point of the object exceeds."""
        rates_per_s = np.abs(np.diff(self.weights, axis=0)) / np.diff(self.times_s)[:, None]
        return float((rates_per_s @ self.reach_mm).max(initial=0.0))

    def scaled(self, factor: float) -> "Deformation":
        """Returns the deformation with all lengths multiplied by ``factor``."""
        origin, spacing = (tuple(np.multiply(factor, three).tolist()) for three in (self.origin_mm, self.spacing_mm))
        return replace(self, control_mm=factor * self.control_mm, origin_mm=origin, spacing_mm=spacing)

    def weights_at(self, times_s: "ArrayLike") -> np.ndarray:
        """Returns the weights φ_r (n, R) of the fields at times (n,) in s."""
        times = np.atleast_1d(checks.numbers("times_s", times_s))
        return np.stack([np.interp(times, self.times_s, column) for column in self.weights.T], -1)

    def displacement_mm(self, points_mm: "ArrayLike", weights: "ArrayLike") -> np.ndarray:
        """Returns displacements w (n, 3) float64 in mm at points (n, 3), x y z, for fields weighted by ``weights`` (R,)."""
        control_mm = self._state(weights)
        place = self._in_spacings(points_mm).T[::-1]
        components = [
            scipy.ndimage.map_coordinates(control_mm[..., i], place, order=3, prefilter=False, mode="grid-constant")
            for i in range(3)
        ]
        return np.stack(components, -1)

    def jacobian(self, points_mm: "ArrayLike", weights: "ArrayLike") -> np.ndarray:
        """Returns the derivative ∂w_i/∂y_j (n, 3, 3) at points (n, 3), x y z, for fields weighted by ``weights`` (R,)."""
        places_mm, control_mm = checks.numbers("points_mm", points_mm, (None, 3)).T[::-1], self._state(weights)
        slopes = [
            np.einsum("na,nb,nc,abci->ni", *self._splines(places_mm, 2 - j), control_mm, optimize=True) for j in range(3)
        ]
        return np.stack(slopes, -1)

    def on_grid_mm(self, grid: Grid, weights: "ArrayLike") -> np.ndarray:
        """Returns displacements w (nz, ny, nx, 3) float32 in mm, x y z, at voxel centres of ``grid``. weights: (R,)."""
        along_z, along_y, along_x = self.bases(grid)
        rows = np.einsum("zk,kyxi->zyxi", along_z, self._state(weights), optimize=True)
        planes = np.einsum("yk,zkxi->zyxi", along_y, rows, optimize=True).astype(np.float32)
        return np.einsum("xk,zyki->zyxi", along_x.astype(np.float32), planes, optimize=True)

    def inverse_on_grid_mm(self, grid: Grid, weights: "ArrayLike") -> np.ndarray:
        """Returns displacements u (nz, ny, nx, 3) float32 in mm: matter at x in the reference volume has moved to x + u(x).

        u(x) = −w(x + u(x)) is iterated from u = 0. Raises InputError if this does not converge, as where the field folds."""
        z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
        centres_mm = np.stack([x.ravel(), y.ravel(), z.ravel()], -1)
        return self.inverse_mm(centres_mm, weights).reshape(*grid.shape, 3).astype(np.float32)

    def inverse_mm(self, points_mm: np.ndarray, weights: "ArrayLike") -> np.ndarray:
        """Returns the displacement u of ``inverse_on_grid_mm`` at points (n, 3), x y z, as (n, 3) float64 in mm."""
        moved_mm = np.zeros_like(points_mm)
        for _ in range(_MOST_STEPS):
            next_mm = -self.displacement_mm(points_mm + moved_mm, weights)
            change_mm, moved_mm = np.abs(next_mm - moved_mm).max(initial=0.0), next_mm
            if change_mm < _CLOSE * np.min(self.spacing_mm):
                return moved_mm
        found = f"no inverse: its points still move {change_mm:.3g} mm after {_MOST_STEPS} steps"
        raise InputError("deformation", found, "a field whose gradient stays below 1", "use a smoother or smaller field")

    def smallest_determinant(self, grid: Grid | None = None) -> float:
        """Returns the smallest det(I + ∂w/∂y) over the voxel centres of ``grid`` and ``times_s``. If it is 0 or less, the
        deformation folds matter over itself.

        Without a grid, points half a control spacing apart are tested. To save time, weights are rounded to a 16th of each
        field's largest weight, and a point whose slopes stay below 1e-4 counts as having the determinant 1."""
        grid = grid or self._half_spacing_grid()
        slopes = np.stack([self._slopes(grid, control_mm) for control_mm in self.control_mm])  # (R, 3, 3, n): ∂(U_r)_i/∂y_j
        largest = np.abs(self.weights).max(axis=0)
        step = np.maximum(largest / _LEVELS, np.finfo(float).tiny)
        states = np.unique(np.round(self.weights / step), axis=0) * step
        varies = (np.abs(slopes).max(axis=(1, 2)) * largest[:, None]).sum(0) > _FLAT
        slopes = slopes[..., varies]
        smallest = np.inf if varies.all() else 1.0
        if not varies.any():
            return smallest
        for weights in states:
            smallest = min(smallest, float(_determinant(np.tensordot(weights, slopes, 1)).min()))
        return smallest

    def _state(self, weights: "ArrayLike") -> np.ndarray:
        """Returns the fields' control vectors summed with ``weights`` (R,), as (nz, ny, nx, 3) in mm."""
        return np.tensordot(checks.numbers("weights", weights, (self.rank,)), self.control_mm, 1)

    def _in_spacings(self, points_mm: "ArrayLike") -> np.ndarray:
        return (checks.numbers("points_mm", points_mm, (None, 3)) - self.origin_mm) / self.spacing_mm

    def bases(self, grid: Grid, slope_along: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the splines' values β³ along z, y and x at the voxel centres of ``grid``, each (voxels, control points).
        slope_along: an axis (0: z) for which the slope of β³ in 1/mm is returned instead."""
        return triple(self._splines(grid.axes_mm(), slope_along))

    def _splines(self, places_mm: Sequence[np.ndarray], slope_along: int | None) -> Iterator[np.ndarray]:
        """Yields the matrices of ``bases`` for places (n,) in mm along z, y and x."""
        axes = zip(places_mm, self.origin_mm[::-1], np.broadcast_to(self.spacing_mm, 3)[::-1], strict=True)
        for axis, (place_mm, origin_mm, step_mm) in enumerate(axes):
            offset = (place_mm[:, None] - origin_mm) / step_mm - np.arange(self.control_mm.shape[1 + axis])
            yield cubic_slope(offset) / step_mm if axis == slope_along else cubic(offset)

    def _slopes(self, grid: Grid, control_mm: np.ndarray) -> np.ndarray:
        """Returns ∂U_i/∂y_j (3, 3, n) at the voxel centres of a grid, for one field's control vectors."""
        result = np.empty((3, 3, int(np.prod(grid.shape))), np.float32)
        for j in range(3):
            values = np.einsum("zk,yl,xm,klmi->izyx", *self.bases(grid, 2 - j), control_mm, optimize=True)
            result[:, j] = values.reshape(3, -1)
        return result

    def _half_spacing_grid(self) -> Grid:
        spacing_mm = np.broadcast_to(self.spacing_mm, 3)[::-1]
        counts = np.array(self.control_mm.shape[1:4])
        shape = 2 * (counts + 3) + 1  # beyond the outermost control points the field falls to 0 within two more spacings
        centre_mm = np.array(self.origin_mm)[::-1] + spacing_mm * (counts - 1) / 2
        return Grid(tuple(shape.tolist()), tuple((spacing_mm / 2).tolist()), tuple(centre_mm.tolist()))


def control_points(
    grid: Grid, spacing_mm: float, margin_mm: float = 0.0
) -> tuple[tuple[float, float, float], tuple[int, int, int]]:
    """Returns origin x, y, z in mm and counts (nz, ny, nx) of control points that cover a grid and ``margin_mm`` around it.

    The control points extend one spacing or more beyond the margin: a spline at a point needs the nearest four per axis."""
    counts = [int(np.ceil((side_mm + 2 * margin_mm) / spacing_mm)) + 3 for side_mm in grid.size_mm]
    first_mm = [middle - (n - 1) / 2 * spacing_mm for middle, n in zip(grid.offset_mm, counts, strict=True)]
    return (first_mm[2], first_mm[1], first_mm[0]), (counts[0], counts[1], counts[2])


def fitted_control_mm(fields_mm: np.ndarray, grid: Grid, spacing_mm: float) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Fits splines to fields (R, nz, ny, nx, 3) on ``grid``. Returns control vectors (R, cz, cy, cx, 3), and x, y, z in mm
    of the first one. The basis is a product over the axes: the least squares are solved along one axis after the other."""
    origin_mm, counts = control_points(grid, spacing_mm)
    empty = Deformation(np.zeros((1, *counts, 3)), origin_mm, spacing_mm, np.zeros(1), np.zeros((1, 1)))
    inverses = [np.linalg.pinv(matrix, rcond=1e-3) for matrix in empty.bases(grid)]
    fitted = [np.einsum("kz,ly,mx,zyxi->klmi", *inverses, one.astype(np.float64), optimize=True) for one in fields_mm]
    return np.stack(fitted), origin_mm


def cubic(offset: np.ndarray) -> np.ndarray:
    """Returns the centred cubic B-spline β³ at offsets in units of the control spacing. It is 0 beyond ±2."""
    size = np.abs(offset)
    return np.asarray(np.maximum(2 - size, 0) ** 3 - 4 * np.maximum(1 - size, 0) ** 3) / 6


def cubic_slope(offset: np.ndarray) -> np.ndarray:
    """Returns the derivative of β³ at offsets in units of the control spacing."""
    size = np.abs(offset)
    return np.asarray(-np.sign(offset) * (np.maximum(2 - size, 0) ** 2 - 4 * np.maximum(1 - size, 0) ** 2)) / 2


def _determinant(slopes: np.ndarray) -> np.ndarray:
    (a, b, c), (d, e, f), (g, h, i) = slopes + np.eye(3)[:, :, None]
    return np.asarray(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
