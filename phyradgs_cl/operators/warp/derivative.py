"""Derivatives of a moving object's frames A v by its displacement field w = Σ_r φ_r U_r: by the coefficients of the fields
U_r, and by the weights φ_r. With w_k of the state k and the slope ∇v of the trilinear volume:

    J d = Σ_k P_k (∇v(y + w_k) · Σ_r φ_r,k B d_r),    Jᵀ y = Bᵀ Σ_k φ_r,k ∇v(y + w_k) P_kᵀ y"""

from collections.abc import Callable
from functools import partial

import numpy as np

from phyradgs_cl.operators.warp.operator import WarpedOperator
from phyradgs_cl.runtime import DeviceArray


class FieldDerivative:
    """The derivative at one volume (nz, ny, nx) in 1/mm and at the field of ``operator``; shares of states are constants.

    Coefficients (R, cz, cy, cx, 3) are in mm as those of a ``Deformation``. Holds three volumes per state on the host."""

    def __init__(self, operator: WarpedOperator, volume: np.ndarray) -> None:
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
        return np.stack([self._projected(partial(_same_for_all, field)) for field in self._fields_mm])

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


def _same_for_all(field_mm: np.ndarray, state: int) -> np.ndarray:
    return field_mm


def warp_slopes(volume: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Returns ∇v(y + w(y)) (nz, ny, nx, 3) float32 per voxel, x y z, of the trilinear volume (nz, ny, nx), 0 outside, for w
    (nz, ny, nx, 3) in voxels. At a voxel's plane it is the slope on the far side."""
    padded = np.pad(np.asarray(volume, np.float32), 1)
    sides = np.array(volume.shape)
    below, share, is_inside = [], [], np.ones(volume.shape, bool)
    for axis in range(3):
        index = np.arange(sides[axis], dtype=np.float32).reshape([-1 if a == axis else 1 for a in range(3)])
        place = index + displacement[..., 2 - axis].astype(np.float32)
        is_inside &= (place >= -1) & (place < sides[axis])
        first = np.clip(np.floor(place), -1, sides[axis] - 1)
        below.append(first.astype(np.int64) + 1)
        share.append(np.clip(place - first, 0, 1))
    _, ny, nx = padded.shape
    flat, strides = padded.ravel(), (ny * nx, nx, 1)
    corner = sum(first * stride for first, stride in zip(below, strides, strict=True))
    c = {bits: flat[corner + np.dot(bits, strides)] for bits in np.ndindex(2, 2, 2)}
    sz, sy, sx = share
    rows = {(j, k): (1 - sx) * c[j, k, 0] + sx * c[j, k, 1] for j, k in np.ndindex(2, 2)}
    planes = [(1 - sy) * rows[j, 0] + sy * rows[j, 1] for j in (0, 1)]
    along_z = planes[1] - planes[0]
    along_y = (1 - sz) * (rows[0, 1] - rows[0, 0]) + sz * (rows[1, 1] - rows[1, 0])
    along_x = sum(
        (sz if j else 1 - sz) * (sy if k else 1 - sy) * (c[j, k, 1] - c[j, k, 0]) for j, k in np.ndindex(2, 2)
    )
    return np.stack([along_x, along_y, along_z], -1) * is_inside[..., None]
