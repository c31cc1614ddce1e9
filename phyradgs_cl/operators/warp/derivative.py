"""Derivatives of a moving object's frames A v by its displacement field w = Σ_r φ_r U_r: by the coefficients of the fields
U_r, and by the weights φ_r. With w_k of the state k and the slope ∇v of the cubic volume:

    J d = Σ_k P_k (∇v(y + w_k) · Σ_r φ_r,k B d_r),    Jᵀ y = Bᵀ Σ_k φ_r,k ∇v(y + w_k) P_kᵀ y"""

from collections.abc import Callable

import numpy as np
import scipy

from phyradgs_cl.fields.deformation import cubic, cubic_slope
from phyradgs_cl.operators.warp.operator import WarpedOperator
from phyradgs_cl.operators.warp.volume import VolumeWarp
from phyradgs_cl.runtime import DeviceArray

_REACH = 2  # voxels: as far as a coefficient of cl/warp.cl counts
_BORDER = 4  # coefficients before and behind the volume, as in cl/warp.cl
_SETTLES = 8  # voxels of zeros more, within which coefficients fall to 3e-5


class FieldDerivative:
    """The derivative at one volume (nz, ny, nx) in 1/mm and at the field of ``operator``; shares of states are constants.

    Coefficients (R, cz, cy, cx, 3) are in mm as those of a ``Deformation``. Holds three volumes per state on the host."""

    def __init__(self, operator: WarpedOperator, volume: np.ndarray) -> None:
        assert isinstance(operator.warp, VolumeWarp)
        self.operator, states = operator, operator.warp.states
        self.weights = states.weights
        self._bases = [matrix.astype(np.float32) for matrix in states.deformation.bases(operator.grid)]
        voxel_mm = np.array(operator.grid.voxel_size_mm[::-1])
        self._fields_mm = states.fields_mm
        displacements = {k: np.tensordot(self.weights[k], states.fields_mm, 1) / voxel_mm for k in operator.states}
        per_mm = (1 / voxel_mm).astype(np.float32)
        self.slopes = {k: warp_slopes(volume, displacement) * per_mm for k, displacement in displacements.items()}

    def forward(self, change_mm: np.ndarray) -> np.ndarray:
        """Returns J d: the change of the frames (F, rows, columns) float32 for a change of the coefficients."""
        fields_mm = np.stack([self._on_grid(one) for one in change_mm])
        return self._projected(lambda k: np.tensordot(self.weights[k].astype(np.float32), fields_mm, 1))

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        """Returns Jᵀ y (R, cz, cy, cx, 3) float64 of frames (F, rows, columns)."""
        rt = self.operator.rt
        by_field = np.zeros_like(self._fields_mm)
        for k, volume in self.operator.backprojections(rt.upload(frames, np.float32)):
            pulled = self.slopes[k] * rt.download(volume)[..., None]
            for r, weight in enumerate(self.weights[k].astype(np.float32)):
                by_field[r] += weight * pulled
        along_z, along_y, along_x = self._bases
        return np.stack([
            np.einsum("zk,yl,xm,zyxi->klmi", along_z, along_y, along_x, one, optimize=True) for one in by_field
        ]).astype(np.float64)  # fmt: skip

    def by_weights(self) -> np.ndarray:
        """Returns the change of the frames (R, F, rows, columns) float32 for a unit of each weight at all times."""
        return np.stack([self._projected(dict.fromkeys(self.slopes, field).__getitem__) for field in self._fields_mm])

    def _projected(self, field_of: Callable[[int], np.ndarray]) -> np.ndarray:
        rt = self.operator.rt
        frames = rt.empty(self.operator.frames_shape)

        def volume_of(k: int) -> DeviceArray:
            return rt.upload(np.einsum("zyxi,zyxi->zyx", self.slopes[k], field_of(k)), np.float32)

        self.operator.project(volume_of, frames)
        return rt.download(frames)

    def _on_grid(self, control_mm: np.ndarray) -> np.ndarray:
        along_z, along_y, along_x = self._bases
        values = np.einsum("zk,yl,xm,klmi->zyxi", along_z, along_y, along_x, control_mm.astype(np.float32), optimize=True)
        return np.asarray(values)


def warp_slopes(volume: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Returns ∇v(y + w(y)) (nz, ny, nx, 3) float32 per voxel, x y z, of the volume (nz, ny, nx) by cubic splines, 0 outside,
    for w (nz, ny, nx, 3) in voxels."""
    wide = scipy.ndimage.spline_filter(np.pad(volume, _BORDER + _SETTLES), output=np.float32)
    padded = np.ascontiguousarray(wide[(slice(_SETTLES, -_SETTLES),) * 3])
    strides = (padded.shape[1] * padded.shape[2], padded.shape[2], 1)
    corner, weights, slopes, is_inside = np.int64(0), [], [], np.bool_(True)
    for axis, (side, stride) in enumerate(zip(volume.shape, strides, strict=True)):
        index = np.arange(side, dtype=np.float32).reshape([-1 if a == axis else 1 for a in range(3)])
        wanted = index + displacement[..., 2 - axis].astype(np.float32)
        place = np.clip(wanted, -_REACH, side - 1 + _REACH)
        first = np.floor(place) + 1 - _REACH
        corner = corner + (first.astype(np.int64) + _BORDER) * stride
        distances = [place - first - tap for tap in range(2 * _REACH)]
        weights.append([cubic(distance) for distance in distances])
        slopes.append([cubic_slope(distance) for distance in distances])
        is_inside = is_inside & (place == wanted)
    flat, (wz, wy, wx), (dz, dy, dx) = padded.ravel(), weights, slopes
    total = np.zeros((3, *volume.shape), np.float32)
    for k, j in np.ndindex(2 * _REACH, 2 * _REACH):
        row = [flat[corner + np.dot((k, j, i), strides)] for i in range(2 * _REACH)]
        value = sum(weight * sample for weight, sample in zip(wx, row, strict=True))
        total[0] += wz[k] * wy[j] * sum(slope * sample for slope, sample in zip(dx, row, strict=True))
        total[1] += wz[k] * dy[j] * value
        total[2] += dz[k] * wy[j] * value
    return np.moveaxis(total * is_inside, 0, -1)
