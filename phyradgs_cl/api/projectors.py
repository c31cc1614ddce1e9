"""The paper's projector, and the voxels' one, of a whole scan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.acquisition.motion import motion_of
from phyradgs_cl.api.devices import Device, runtime_of
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.fields.gaussians import DENSITY, MEAN, QUATERNION, ROWS, SCALE
from phyradgs_cl.operators import DEFAULT_CUTOFF_SIGMA, DeviceCells, RayOperator, SplatProjector
from phyradgs_cl.operators.splats.projector import DEFAULT_TIME_ERROR


def ray_operator(
    scan: Scan, motion: str | Motion = "per-row", *, grid: Grid | None = None, device: Device = None
) -> RayOperator:
    """Joseph's projector of a scan and its exact transpose: volumes (nz, ny, nx) to frames (F, rows, columns).

    motion: how frames see the moving gantry (docs/methods.md, but ``exact``). grid: the scan's own when None, in mm.
    device: what ``--device`` takes, or a Runtime. Raises InputError for a motion with cells that move.
    """
    tables = [motion_of(motion).cells(scan, frame).still() for frame in range(scan.frames)]
    return RayOperator(runtime_of(device), grid or scan.grid, scan.geometry.detector_shape, tables)


class Projector:
    """The paper's projector Φ: Gaussians to the frames of a scan, exactly integrated, and its gradients.

    motion: any model of docs/methods.md that splats have. frames: which of the scan's, None for all. Averages line
    integrals over an exposure. Parameter rows (11, G) are mean x y z and three scales in mm, quaternion w x y z, density
    in 1/mm. cutoff_sigma: where a Gaussian ends, 0 nowhere. affine: R2-Gaussian's approximation. device: what
    ``--device`` takes, or a Runtime. Raises InputError for rows and frames that do not fit.
    """

    def __init__(
        self,
        scan: Scan,
        motion: str | Motion = "micro-views",
        *,
        frames: Sequence[int] | None = None,
        cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA,
        affine: bool = False,
        device: Device = None,
    ) -> None:
        rt, model = runtime_of(device), motion_of(motion)
        chosen = range(scan.frames) if frames is None else frames
        self._length_mm = scan.grid.half_longest_mm  # the kernels' float32 likes lengths of order 1
        tables = [model.cells(scan, f).scaled(1 / self._length_mm) for f in chosen]
        self._cells = [DeviceCells.upload(rt, table) for table in tables]
        self._readout, detector_shape = scan.shutter.readout, scan.geometry.detector_shape
        self.frames_shape = (len(self._cells), *detector_shape)
        shape = self._readout.shape(detector_shape)
        self._splat = SplatProjector(
            rt, *shape, affine=affine, cutoff_sigma=cutoff_sigma, time_error=getattr(model, "time_error", DEFAULT_TIME_ERROR)
        )

    def __call__(self, gaussians: Gaussians) -> np.ndarray:
        """Line integrals (F, rows, columns) float32 of a cloud in mm."""
        return self.project_rows(gaussians.rows())

    def project_rows(self, rows: np.ndarray) -> np.ndarray:
        """The same of parameter rows (11, G); quaternions of any length."""
        inside, _ = self._internal(rows)
        frames = [self._splat.project(inside, cells) for cells in self._cells]
        return np.stack([self._readout.frames(frame) for frame in frames]) * np.float32(self._length_mm)

    def rows_gradient(self, rows: np.ndarray, by_frames: np.ndarray) -> np.ndarray:
        """dL/drows (11, G) of rows (11, G) and dL/dframes (F, rows, columns)."""
        inside, norms = self._internal(rows)
        checks.shape("by_frames", by_frames, self.frames_shape)
        total = np.zeros(inside.shape)
        for cells, by_frame in zip(self._cells, by_frames, strict=True):
            by_line = np.ascontiguousarray(self._readout.frames(by_frame), np.float32)
            total += self._splat.project_adjoint(inside, cells, by_line * np.float32(self._length_mm))
        total[MEAN] /= self._length_mm
        total[SCALE] /= self._length_mm
        total[QUATERNION] /= norms
        return total.astype(np.float32)

    def of_densities(self, gaussians: Gaussians) -> DensityOperator:
        """The part that is linear: densities (G,) of this cloud to frames."""
        return DensityOperator(self, gaussians)

    def _internal(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows in internal lengths with unit quaternions, and the quaternions' norms (G,)."""
        checks.shape("rows", rows, (ROWS, None))
        inside = np.array(rows, np.float64)
        norms = np.linalg.norm(inside[QUATERNION], axis=0)
        inside[MEAN] /= self._length_mm
        inside[SCALE] /= self._length_mm
        inside[QUATERNION] /= norms
        return inside, norms


class DensityOperator:
    """A ``Projector`` of Gaussians that stay where they are: linear in their densities (G,) in 1/mm."""

    def __init__(self, projector: Projector, gaussians: Gaussians) -> None:
        self._projector, self._rows = projector, gaussians.rows()
        self.volume_shape, self.frames_shape = (gaussians.count,), projector.frames_shape

    def forward(self, density: np.ndarray) -> np.ndarray:
        """Densities (G,) to frames (F, rows, columns)."""
        checks.shape("density", density, self.volume_shape)
        rows = self._rows.copy()
        rows[DENSITY] = density
        return self._projector.project_rows(rows)

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        """Frames (F, rows, columns) to densities (G,)."""
        return self._projector.rows_gradient(self._rows, frames)[DENSITY]
