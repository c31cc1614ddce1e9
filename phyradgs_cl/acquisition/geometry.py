"""Cone-beam geometry: where source and detector stand at a gantry angle.

A *pose* is 12 numbers in world coordinates (mm): source, centre of pixel (0, 0), the step from column to column (û·du)
and from row to row (v̂·dv). Operators take poses, never angles.
"""

from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.errors import InputError

POSE_LENGTH = 12


@dataclass(frozen=True)
class ConeGeometry:
    """A circular cone-beam orbit about +z with a flat panel: ``detector_shape`` counts (rows, columns),
    ``pixel_size_mm`` is (dv, du), ``detector_offset_mm`` (v, u) shifts the panel's centre from the central ray."""

    source_to_axis_mm: float
    source_to_detector_mm: float
    detector_shape: tuple[int, int]
    pixel_size_mm: tuple[float, float]
    detector_offset_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("source_to_axis_mm", "source_to_detector_mm"):
            if not (np.isfinite(length := float(getattr(self, name))) and length > 0):
                raise InputError(name, str(length), "a positive length in mm")
        if len(self.detector_shape) != 2 or min(self.detector_shape) < 1:
            expected = "two counts (rows, columns) of at least 1"
            raise InputError("detector_shape", str(self.detector_shape), expected)
        if len(self.pixel_size_mm) != 2 or not all(np.isfinite(d) and d > 0 for d in self.pixel_size_mm):
            raise InputError("pixel_size_mm", str(self.pixel_size_mm), "two positive lengths in mm (v, u)")
        if len(self.detector_offset_mm) != 2 or not np.all(np.isfinite(self.detector_offset_mm)):
            expected = "two finite lengths in mm (v, u)"
            raise InputError("detector_offset_mm", str(self.detector_offset_mm), expected)

    def pose(self, angle_rad: np.ndarray | float) -> np.ndarray:
        """Poses (..., 12) float64 at gantry angles (...) (design: source at (DSO cos θ, DSO sin θ, 0))."""
        angle = np.asarray(angle_rad, dtype=np.float64)
        cos, sin, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
        radial = np.stack([cos, sin, zero], -1)
        u_hat = np.stack([-sin, cos, zero], -1)
        v_hat = np.stack([zero, zero, zero + 1.0], -1)
        (nv, nu), (dv, du), (off_v, off_u) = self.detector_shape, self.pixel_size_mm, self.detector_offset_mm
        behind_axis_mm = self.source_to_detector_mm - self.source_to_axis_mm
        first_pixel = (
            -behind_axis_mm * radial
            + (off_u - (nu - 1) / 2 * du) * u_hat
            + (off_v - (nv - 1) / 2 * dv) * v_hat
        )
        return np.concatenate([self.source_to_axis_mm * radial, first_pixel, du * u_hat, dv * v_hat], -1)

    def scaled(self, factor: float) -> "ConeGeometry":
        """The same geometry with every length multiplied by ``factor``."""
        dv, du = self.pixel_size_mm
        off_v, off_u = self.detector_offset_mm
        return replace(
            self,
            source_to_axis_mm=self.source_to_axis_mm * factor,
            source_to_detector_mm=self.source_to_detector_mm * factor,
            pixel_size_mm=(dv * factor, du * factor),
            detector_offset_mm=(off_v * factor, off_u * factor),
        )

    def finer(self, factor: int) -> "ConeGeometry":
        """The same panel with every pixel cut into ``factor`` by ``factor``."""
        rows, columns = self.detector_shape
        dv, du = self.pixel_size_mm
        return replace(
            self, detector_shape=(rows * factor, columns * factor), pixel_size_mm=(dv / factor, du / factor)
        )

    @property
    def magnification(self) -> float:
        """Detector size over object size at the axis."""
        return self.source_to_detector_mm / self.source_to_axis_mm


def pixel_centres(pose: np.ndarray, detector_shape: tuple[int, int]) -> np.ndarray:
    """World coordinates (..., nv, nu, 3) of all pixel centres of poses (..., 12)."""
    nv, nu = detector_shape
    pose = np.asarray(pose, dtype=np.float64)[..., None, None, :]
    columns, rows = np.arange(nu)[None, :, None], np.arange(nv)[:, None, None]
    return pose[..., 3:6] + columns * pose[..., 6:9] + rows * pose[..., 9:12]


def transpose_pose(pose: np.ndarray) -> np.ndarray:
    """The same poses (..., 12) for an image whose rows and columns are exchanged."""
    return np.concatenate([pose[..., :6], pose[..., 9:12], pose[..., 6:9]], -1)
