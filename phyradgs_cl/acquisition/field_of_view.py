"""What a circular scan sees, and grids that see less."""

import math

import numpy as np

from phyradgs_cl.acquisition.geometry import ConeGeometry
from phyradgs_cl.fields import Grid


def field_of_view_mm(geometry: ConeGeometry) -> tuple[float, float, float]:
    """Half sides (z, y, x) of the box about the origin that the cones of a full turn fill: radius DSO·sin(atan(half
    width/DSD)), the far edge of a shifted panel, and the cone's height behind the axis at that radius."""
    sides = zip(geometry.detector_shape, geometry.pixel_size_mm, geometry.detector_offset_mm, strict=True)
    half_height_mm, half_width_mm = (count * pitch / 2 + abs(offset) for count, pitch, offset in sides)
    half_fan_rad = math.atan2(half_width_mm, geometry.source_to_detector_mm)
    radius_mm = geometry.source_to_axis_mm * math.sin(half_fan_rad)
    behind_mm = geometry.source_to_axis_mm + radius_mm
    return half_height_mm * behind_mm / geometry.source_to_detector_mm, radius_mm, radius_mm


def default_grid(geometry: ConeGeometry) -> Grid:
    """The cube that is as wide as the field of view of a full turn, but no higher than what a panel of few rows sees, in
    voxels of one pixel pitch at the axis."""
    half_height_mm, radius_mm, _ = field_of_view_mm(geometry)
    voxel_mm = min(geometry.pixel_size_mm) / geometry.magnification
    wide = max(1, math.ceil(2 * radius_mm / voxel_mm))
    high = max(1, min(wide, round(2 * half_height_mm / voxel_mm)))
    return Grid((high, wide, wide), (voxel_mm,) * 3)


def misses(grid: Grid, geometry: ConeGeometry) -> bool:
    """Whether no voxel of ``grid`` is in the field of view."""
    low_mm, high_mm = grid.box_mm.T
    half_mm = np.array(field_of_view_mm(geometry))
    return bool(np.any((low_mm >= half_mm) | (high_mm <= -half_mm)))


def hidden(grid: Grid, pose: np.ndarray, detector_shape: tuple[int, int]) -> str:
    """Where all of ``grid`` lies that no ray of a pose (12,) meets: behind the panel, or beside the rays; else nothing."""
    source, first, step_u, step_v = pose.reshape(4, 3)
    rows, columns = detector_shape
    edges = [(-0.5, -0.5), (columns - 0.5, -0.5), (columns - 0.5, rows - 0.5), (-0.5, rows - 0.5)]
    rays = np.array([first + u * step_u + v * step_v - source for u, v in edges])
    corners = np.stack(np.meshgrid(*grid.box_mm[::-1], indexing="ij"), -1).reshape(-1, 3) - source
    away = np.cross(step_u, step_v)
    away = away * np.sign(away @ rays[0])
    sides = np.cross(rays, np.roll(rays, -1, axis=0))
    inward = sides * np.sign(sides @ rays.sum(axis=0))[:, None]
    if (corners @ away > rays[0] @ away).all():
        return "behind the panel"
    planes = np.concatenate([inward, away[None]])  # of the pyramid of rays, and the source's own
    return "beside the rays" if (corners @ planes.T < 0).all(axis=0).any() else ""


def panel_behind_mm(grid: Grid, pose: np.ndarray) -> float:
    """How far behind the middle of ``grid`` the panel of a pose (12,) stands; below half the grid's width it stands in it,
    and rays end there."""
    source, first, step_u, step_v = pose.reshape(4, 3)
    away = np.cross(step_u, step_v)
    away = away * np.sign(away @ (first - source)) / np.linalg.norm(away)
    return float((first - np.array(grid.offset_mm)[::-1]) @ away)


def cuts(grid: Grid, whole: Grid, geometry: ConeGeometry) -> bool:
    """Whether ``grid`` ends, by more than a voxel, inside of what is seen of the box of ``whole``."""
    half_mm = np.array(field_of_view_mm(geometry))
    low_mm, high_mm = np.clip(whole.box_mm.T, -half_mm, half_mm)
    begin_mm, end_mm = grid.box_mm.T
    return bool(np.any((begin_mm - low_mm > grid.voxel_size_mm) | (high_mm - end_mm > grid.voxel_size_mm)))
