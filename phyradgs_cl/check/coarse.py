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
_NARROW = 3  # times the columns, where the panel is lower than a block: a row of few blocks says little


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
    block = min(math.ceil(max(shape) / level.columns), max(1, shape[1] // _KEPT_COLUMNS))
    if block > shape[0]:
        block = max(shape[0], math.ceil(block / _NARROW))
    small = binned(smooth(fewer_frames(scan, _MOST_FRAMES), _SMOOTH * block), block)
    return replace(small, grid=coarse_grid(scan.grid, small.geometry, level.voxels))


def smooth(scan: Scan, pixels: float | tuple[float, float]) -> Scan:
    """Frames smoothed by a Gaussian of ``pixels``, or as many across rows and columns, from valid pixels only: blocks then
    miss nothing that is finer."""
    v_px, u_px = pixels if isinstance(pixels, tuple) else (pixels, pixels)
    if max(v_px, u_px) <= 0.5:
        return scan
    sigma = (0, v_px, u_px)
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
    """Blocks of ``block`` × ``block`` pixels as one pixel each, no larger than the panel: the mean of those that are valid,
    masked below half."""
    if block == 1:
        return replace(scan, reference=None)
    high, wide = blocks = blocks_of(scan.geometry, block)
    rows, columns = scan.geometry.detector_shape[0] // high, scan.geometry.detector_shape[1] // wide
    shape = (scan.frames, rows, high, columns, wide)
    inside = (slice(None), slice(rows * high), slice(columns * wide))
    weight = scan.valid[inside].reshape(shape)
    values = np.asarray(scan.projections)[inside].reshape(shape)
    share = weight.mean((2, 4))
    mean = (values * weight).mean((2, 4)) / np.where(share > 0, share, 1.0)
    geometry = _binned_panel(scan.geometry, blocks)
    shutter, later_s = _binned_shutter(scan, blocks[scan.shutter.axis == "columns"])
    return replace(
        scan,
        projections=mean.astype(np.float32),
        geometry=geometry,
        trajectory=with_path(scan, blocks=blocks).trajectory,
        shutter=shutter,
        frame_start_s=np.asarray(scan.frame_start_s) + later_s,
        pixel_mask=share < _LEAST_VALID if (share < _LEAST_VALID).any() else None,
        reference=None,
    )


def blocks_of(geometry: ConeGeometry, block: int) -> tuple[int, int]:
    """Rows and columns of a block of ``block`` pixels per side: a panel of few rows is no higher."""
    rows, columns = geometry.detector_shape
    return min(block, rows), min(block, columns)


def coarse_grid(grid: Grid, geometry: ConeGeometry, voxels: float) -> Grid:
    """The same box and a voxel around it, in voxels of (nearly) a pixel at the axis over ``voxels``, never finer than the
    scan's own."""
    high_mm, wide_mm = (pitch / geometry.magnification / voxels for pitch in geometry.pixel_size_mm)
    least_mm = max(max(grid.size_mm) / _MOST_VOXELS, min(grid.voxel_size_mm))
    wanted_mm = (max(high_mm, least_mm), *(max(wide_mm, least_mm),) * 2)
    shape = [max(1, math.ceil(side / wanted - 1e-6)) for side, wanted in zip(grid.size_mm, wanted_mm, strict=True)]
    voxel = [side / n for side, n in zip(grid.size_mm, shape, strict=True)]
    nz, ny, nx = (n + 2 * _MARGIN for n in shape)
    return Grid((nz, ny, nx), (voxel[0], voxel[1], voxel[2]), grid.offset_mm)


def _binned_panel(geometry: ConeGeometry, blocks: tuple[int, int]) -> ConeGeometry:
    """The panel of the whole blocks; pixels that are left out at the far end move its middle."""
    shape = [n // block for n, block in zip(geometry.detector_shape, blocks, strict=True)]
    lost = [n % block for n, block in zip(geometry.detector_shape, blocks, strict=True)]
    pitch, offset = geometry.pixel_size_mm, geometry.detector_offset_mm
    return replace(
        geometry,
        detector_shape=(shape[0], shape[1]),
        pixel_size_mm=(pitch[0] * blocks[0], pitch[1] * blocks[1]),
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
