"""A scan made small enough to be reconstructed many times: fewer frames, blocks of pixels, coarse voxels."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from phyradgs_cl.acquisition import ConeGeometry, Scan, Shutter
from phyradgs_cl.check.variants import path_of, with_path
from phyradgs_cl.fields import Grid

_MOST_FRAMES = 60
_LEAST_VALID = 0.5  # of a block's pixels
_MOST_VOXELS = 64  # per side
_MARGIN = 1  # voxels: an object that fills the box, cut off at coarse voxels' centres, fits better where it is made smaller
_SMOOTH = 0.8  # of a block: standard deviation
_KEPT_COLUMNS = 12  # of blocks, where the panel has as many


@dataclass(frozen=True)
class Level:
    """How coarse: at most ``columns`` pixels along the detector's longer side, ``voxels`` per pixel at the axis."""

    columns: int
    voxels: float


QUICK = Level(20, 1.0)
FINE = Level(32, 1.0)


def coarse(scan: Scan, level: Level) -> Scan:
    """The scan with at most 60 frames, spread evenly, its pixels averaged in blocks, and a grid to match; no reference. Rows
    and columns that fill no block are left out at the far end; a block of lines opens when its lines do on average."""
    shape = scan.geometry.detector_shape
    block = min(math.ceil(max(shape) / level.columns), shape[0], max(1, shape[1] // _KEPT_COLUMNS))
    small = binned(smooth(fewer_frames(scan, _MOST_FRAMES), _SMOOTH * block), block)
    return replace(small, grid=coarse_grid(scan.grid, small.geometry, level.voxels))


def smooth(scan: Scan, pixels: float) -> Scan:
    """Frames smoothed by a Gaussian of ``pixels``, from valid pixels only: blocks then miss nothing that is finer."""
    if pixels <= 0.5:
        return scan
    sigma = (0, pixels, pixels)
    p = np.asarray(scan.projections, np.float32)
    if scan.pixel_mask is None:
        return replace(scan, projections=gaussian_filter(p, sigma, truncate=3))
    valid = scan.valid.astype(np.float32)
    weight = gaussian_filter(valid, sigma, truncate=3)
    mean = gaussian_filter(p * valid, sigma, truncate=3) / np.maximum(weight, 1e-6)
    return replace(scan, projections=mean)


def fewer_frames(scan: Scan, most: int) -> Scan:
    """At most ``most`` frames, spread evenly over the scan; the trajectory still counts them as they were."""
    if scan.frames <= most:
        return scan
    return some_frames(scan, np.unique(np.linspace(0, scan.frames - 1, most).round().astype(int)))


def some_frames(scan: Scan, chosen: np.ndarray) -> Scan:
    """The chosen frames (indices), their trajectory counting them as they were."""
    path = path_of(scan)
    numbers = chosen if path.frames is None else path.frames[chosen]
    mask = scan.pixel_mask
    return replace(
        scan,
        projections=scan.projections[chosen],
        trajectory=replace(path, frames=numbers),
        frame_start_s=np.asarray(scan.frame_start_s)[chosen],
        pixel_mask=mask if mask is None or np.ndim(mask) == 2 else np.asarray(mask)[chosen],
    )


def binned(scan: Scan, block: int) -> Scan:
    """Blocks of ``block`` × ``block`` pixels as one pixel each: the mean of those that are valid, masked below half."""
    rows, columns = (n // block for n in scan.geometry.detector_shape)
    if block == 1:
        return replace(scan, reference=None)
    shape = (scan.frames, rows, block, columns, block)
    inside = (slice(None), slice(rows * block), slice(columns * block))
    weight = scan.valid[inside].reshape(shape)
    values = np.asarray(scan.projections)[inside].reshape(shape)
    share = weight.mean((2, 4))
    mean = (values * weight).mean((2, 4)) / np.where(share > 0, share, 1.0)
    geometry = _binned_panel(scan.geometry, block)
    shutter, later_s = _binned_shutter(scan, block)
    return replace(
        scan,
        projections=mean.astype(np.float32),
        geometry=geometry,
        trajectory=with_path(scan, block=block).trajectory,
        shutter=shutter,
        frame_start_s=np.asarray(scan.frame_start_s) + later_s,
        pixel_mask=share < _LEAST_VALID if (share < _LEAST_VALID).any() else None,
        reference=None,
    )


def coarse_grid(grid: Grid, geometry: ConeGeometry, voxels: float) -> Grid:
    """The same box and a voxel around it, in cubes (nearly) of a pixel at the axis over ``voxels`` wide, never
    finer than the scan's own."""
    pixel_mm = min(geometry.pixel_size_mm) / geometry.magnification
    wanted_mm = max(pixel_mm / voxels, max(grid.size_mm) / _MOST_VOXELS, min(grid.voxel_size_mm))
    shape = [max(1, math.ceil(side / wanted_mm - 1e-6)) for side in grid.size_mm]
    voxel = [side / n for side, n in zip(grid.size_mm, shape, strict=True)]
    nz, ny, nx = (n + 2 * _MARGIN for n in shape)
    return Grid((nz, ny, nx), (voxel[0], voxel[1], voxel[2]), grid.offset_mm)


def _binned_panel(geometry: ConeGeometry, block: int) -> ConeGeometry:
    """The panel of the whole blocks; pixels that are left out at the far end move its middle."""
    shape = tuple(n // block for n in geometry.detector_shape)
    lost = [n - m * block for n, m in zip(geometry.detector_shape, shape, strict=True)]
    pitch, offset = geometry.pixel_size_mm, geometry.detector_offset_mm
    return replace(
        geometry,
        detector_shape=(shape[0], shape[1]),
        pixel_size_mm=(pitch[0] * block, pitch[1] * block),
        detector_offset_mm=(offset[0] - lost[0] / 2 * pitch[0], offset[1] - lost[1] / 2 * pitch[1]),
    )


def _binned_shutter(scan: Scan, block: int) -> tuple[Shutter, float]:
    """(the shutter of the blocks of lines, how much later than the frame's the first of them opens)."""
    shutter, lines = scan.shutter, scan.lines
    each_s = shutter.readout_s / max(lines - 1, 1)
    blocks = lines // block
    lost = lines - blocks * block if shutter.direction < 0 else 0  # the far end is read first
    later_s = (lost + (block - 1) / 2) * each_s
    pulse_s = shutter.pulse_s and (shutter.pulse_s[0] - later_s, shutter.pulse_s[1])
    return replace(shutter, readout_s=(blocks - 1) * block * each_s, pulse_s=pulse_s), later_s
