"""Gaussians of an object that moves, in float64: the twin of cl/splat_states.cl and of splats that are drawn in states.

It moves a cloud as a value: means by the inverse of the field, covariances by its Jacobian."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Deformation, Gaussians
from phyradgs_cl.fields.gaussians import MEAN
from phyradgs_cl.operators.twins.splat import moving_frame, precision_matrices, splat_frame


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
    rows: np.ndarray, table: TimeCells, detector_shape: tuple[int, int], deformation: Deformation, affine: bool = False,
    pixel_variance: float = 0.0,
) -> np.ndarray:
    """Returns the merged frame (nv, nu) of a reference's parameter rows (11, G), whose cells see it in their own states."""

    def cloud_at(time_s: float) -> np.ndarray:
        return moved_rows(rows, deformation, deformation.weights_at(time_s)[0])

    if table.is_moving:
        return moving_frame(rows, table, detector_shape, affine=affine, pixel_variance=pixel_variance, cloud_at=cloud_at)
    frame = np.zeros(detector_shape)
    for cell in range(table.count):
        own = {name: getattr(table, name)[[cell]] for name in ("pose", "time_s", "line_start", "line_stop", "weight")}
        frame += splat_frame(cloud_at(table.time_s[cell]), replace(table, **own), detector_shape, affine=affine)
    return frame
