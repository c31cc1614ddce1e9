"""Objects that move, in float64: warps of volumes, and Gaussians in their states."""

from collections.abc import Iterator

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Deformation, Gaussians
from phyradgs_cl.fields.deformation import cubic
from phyradgs_cl.fields.gaussians import MEAN
from phyradgs_cl.operators.rays.layout import some_cells
from phyradgs_cl.operators.twins.splat import moving_frame, precision_matrices, splat_frame

_REACH = 2  # voxels: as far as a coefficient counts
_BORDER = 4  # coefficients before and behind the volume
Volume = np.ndarray


def warp_forward(volume: Volume, displacement: np.ndarray) -> Volume:
    """Returns v(y + w(y)) (nz, ny, nx) by cubic splines, 0 further than ``_REACH`` outside, for w (nz, ny, nx, 3) in
    voxels, components x, y, z."""
    padded = _coefficients(np.pad(np.asarray(volume, np.float64), _BORDER))
    result = np.zeros(volume.shape)
    for place, weight in _taps(displacement):
        result += weight * padded[place]
    return result


def warp_adjoint(values: Volume, displacement: np.ndarray) -> Volume:
    """Returns the transpose of ``warp_forward`` at ``values`` (nz, ny, nx)."""
    padded = np.zeros([n + 2 * _BORDER for n in values.shape])
    for place, weight in _taps(displacement):
        np.add.at(padded, place, weight * values)
    inner = slice(_BORDER, -_BORDER)
    return _coefficients(padded)[inner, inner, inner]


def _coefficients(values: Volume) -> Volume:
    """Returns the coefficients of the cubic spline through values (nz, ny, nx) between zeros, by its impulse response."""
    for axis, side in enumerate(values.shape):
        distance = np.abs(np.subtract.outer(np.arange(side), np.arange(side)))
        response = np.sqrt(3) * (np.sqrt(3) - 2) ** distance
        values = np.moveaxis(np.tensordot(response, values, (1, axis)), 0, axis)
    return values


def _taps(displacement: np.ndarray) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """Yields indices into the volume with its border, and weights, for the neighbours of each place."""
    shape = displacement.shape[:3]
    places = np.indices(shape) + np.moveaxis(np.asarray(displacement, np.float64), -1, 0)[::-1]
    sides = np.reshape(shape, (3, 1, 1, 1))
    is_inside = ((places >= -_REACH) & (places <= sides - 1 + _REACH)).all(axis=0)
    places = np.clip(places, -_REACH, sides - 1 + _REACH)
    first = np.floor(places).astype(int) + 1 - _REACH
    for tap in np.ndindex(*(2 * _REACH,) * 3):
        index = first + np.reshape(tap, (3, 1, 1, 1))
        z, y, x = index + _BORDER
        yield (z, y, x), is_inside * cubic(places - index).prod(axis=0)


def moved_rows(rows: np.ndarray, deformation: Deformation, weights: np.ndarray) -> np.ndarray:
    """Returns parameter rows (11, G) of a reference in one state, of ``weights`` (R,); the peaks of densities stay."""
    mean = rows[MEAN].T + deformation.inverse_mm(rows[MEAN].T, weights)
    for _ in range(2):  # Newton steps: differences of frames need more digits
        off = mean + deformation.displacement_mm(mean, weights) - rows[MEAN].T
        pull = np.eye(3) + deformation.jacobian(mean, weights)
        mean = mean - np.linalg.solve(pull, off[..., None])[..., 0]
    pull = np.eye(3) + deformation.jacobian(mean, weights)
    covariance = np.linalg.inv(np.einsum("gji,gjk,gkl->gil", pull, precision_matrices(rows), pull))
    return Gaussians.of_covariance(mean, covariance, rows[-1]).rows()


def deformed_frame(
    rows: np.ndarray, table: TimeCells, detector_shape: tuple[int, int], deformation: Deformation, affine: bool = False
) -> np.ndarray:
    """Returns the merged frame (nv, nu) of a reference's parameter rows (11, G), whose cells see it in their own states."""

    def cloud_at(time_s: float) -> np.ndarray:
        return moved_rows(rows, deformation, deformation.weights_at(time_s)[0])

    if table.is_moving:
        return moving_frame(rows, table, detector_shape, affine=affine, cloud_at=cloud_at)
    frame = np.zeros(detector_shape)
    for cell in range(table.count):
        frame += splat_frame(cloud_at(table.time_s[cell]), some_cells(table, [cell]), detector_shape, affine=affine)
    return frame
