"""Makes a scan small enough to be reconstructed many times: fewer frames, pixels averaged in blocks, larger voxels."""

import math
from dataclasses import replace

import numpy as np
import scipy  # its parts load only when they are used, which saves time

from phyradgs_cl.acquisition.altered.variants import altered_trajectory, with_trajectory
from phyradgs_cl.acquisition.geometry import ConeGeometry, Geometry
from phyradgs_cl.acquisition.scan import Scan
from phyradgs_cl.fields import Grid

MOST_FRAMES = 60  # most frames of a coarse scan
QUICK_COLUMNS = 20  # most blocks of pixels along the panel's longer side, for quick searches of a parameter
FINE_COLUMNS = 32  # most blocks of pixels along the panel's longer side, for fine searches of a parameter
SMOOTHING = 0.8  # standard deviation, in blocks, of the Gaussian that smooths frames before pixels are averaged
_LEAST_VALID = 0.5  # a block with a smaller fraction of valid pixels is masked
_MOST_VOXELS = 64  # most voxels along the grid's longest side, without the margin
_MARGIN = 1  # voxels of air on each side of a grid: without them, too small a pixel size fits a large object best
_OBJECT_SHARE = 0.02  # a column shows the object if (its largest line integral) / (the scan's largest) is above this
_LEAST_COLUMNS = 12  # least number of blocks from left to right, if the panel has at least as many columns
_NARROW = 3  # divides a block's side if the panel is lower than two blocks, because one row of blocks tells little


def coarse(scan: Scan, columns: int, most_frames: int = MOST_FRAMES) -> Scan:
    """Returns the scan with at most ``most_frames`` frames, pixels averaged in blocks, a coarse grid, and no true volumes.

    The panel's longer side has at most ``columns`` blocks. It has more if the panel would else have fewer than 12 blocks
    from left to right, or fewer than two from bottom to top."""
    shape = scan.geometry.detector_shape
    block = min(math.ceil(max(shape) / columns), max(1, shape[1] // _LEAST_COLUMNS))
    if 2 * block > shape[0]:
        block = math.ceil(block / _NARROW)
    small = binned(fewer_frames(scan, most_frames), block, SMOOTHING * block)
    return replace(small, grid=coarse_grid(scan.grid, small.geometry))


def smooth(scan: Scan, pixels: float | tuple[float, float]) -> Scan:
    """Returns the scan with frames smoothed by a Gaussian, so that averaging blocks does not alias. Masked pixels have no
    weight.

    pixels: the standard deviation in pixels, or a pair (v, u). If neither exceeds 0.5, the scan is returned unchanged."""
    v_px, u_px = pixels if isinstance(pixels, tuple) else (pixels, pixels)
    if max(v_px, u_px) <= 0.5:
        return scan
    sigma = (0, v_px, u_px)
    p = np.asarray(scan.projections, np.float32)
    if scan.pixel_mask is None:
        return replace(scan, projections=scipy.ndimage.gaussian_filter(p, sigma, truncate=3))
    valid = scan.valid.astype(np.float32)
    weight = scipy.ndimage.gaussian_filter(valid, sigma, truncate=3)
    return replace(scan, projections=scipy.ndimage.gaussian_filter(p * valid, sigma, truncate=3) / np.maximum(weight, 1e-6))


def fewer_frames(scan: Scan, most: int) -> Scan:
    """Returns the scan with at most ``most`` of its frames, spread evenly."""
    return scan if scan.frames <= most else some_frames(scan, spread_evenly(scan.frames, most))


def spread_evenly(count: int, most: int) -> np.ndarray:
    """Returns at most ``most`` of the indices below ``count``, spread evenly, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def some_frames(scan: Scan, frames: np.ndarray) -> Scan:
    """Returns the scan with only the frames whose indices are in ``frames``. Its trajectory translates the new frame numbers
    to the old ones."""
    trajectory = altered_trajectory(scan)
    mask = scan.pixel_mask
    return replace(
        scan,
        projections=scan.projections[frames],
        trajectory=replace(trajectory, frames=trajectory.frame_numbers(scan)[frames]),
        frame_start_s=np.asarray(scan.frame_start_s)[frames],
        pixel_mask=mask if mask is None or np.ndim(mask) == 2 else np.asarray(mask)[frames],
    )


def binned(scan: Scan, block: int, smoothing_px: float = 0.0) -> Scan:
    """Returns the scan with blocks of ``block`` × ``block`` pixels averaged to one pixel, and without true volumes.

    smoothing_px: the standard deviation of a Gaussian that smooths the frames before; 0 does not. A block is never larger
    than the panel. Only valid pixels are averaged. A block is masked if fewer than half of its pixels are valid. The last
    rows and columns are dropped if they fill no block. A block of lines opens at the mean of its lines' opening times."""
    if block == 1 and not smoothing_px:
        return replace(scan, reference=None, moving_truth=None)
    panel = scan.geometry.detector_shape
    height, width = blocks = tuple(min(block, count) for count in panel)
    plain, smoothed = ([_averages(*sides, px) for sides in zip(panel, blocks, strict=True)] for px in (0.0, smoothing_px))

    def average(image: np.ndarray, weights: list[np.ndarray]) -> np.ndarray:
        return np.asarray(weights[0] @ image @ weights[1].T)

    # one frame after the other, because copies of all would take much memory
    mean, valid_share = np.empty((2, scan.frames, panel[0] // height, panel[1] // width), np.float32)
    for frame, (p, valid) in enumerate(zip(scan.projections, scan.valid, strict=True)):
        weight = valid.astype(np.float32)
        mean[frame] = average(p * weight, smoothed) / np.maximum(average(weight, smoothed), 1e-6)
        valid_share[frame] = average(weight, plain)
    is_masked = valid_share < _LEAST_VALID - 1e-6  # less the rounding of the sum
    of_lines = width if scan.shutter.axis == "columns" else height
    shutter, later_s = scan.shutter.of_lines(scan.lines, 0, scan.lines // of_lines * of_lines, of_lines)
    return replace(
        scan, projections=mean, geometry=_binned_panel(scan.geometry, height, width),
        trajectory=with_trajectory(scan, blocks=blocks).trajectory, shutter=shutter,
        frame_start_s=np.asarray(scan.frame_start_s) + later_s,
        pixel_mask=is_masked if is_masked.any() else None, reference=None, moving_truth=None,
    )


def _averages(count: int, block: int, smoothing_px: float) -> np.ndarray:
    """Returns the weights (blocks, count) float32 of ``count`` pixels in the means of blocks, of smoothed pixels."""
    means = np.kron(np.eye(count // block), np.full(block, 1 / block))
    means = np.pad(means, ((0, 0), (0, count % block)))
    smoothed = scipy.ndimage.gaussian_filter1d(means, smoothing_px, truncate=3) if smoothing_px else means
    return np.asarray(smoothed, np.float32)


def coarse_grid(grid: Grid, geometry: Geometry) -> Grid:
    """Returns a coarse grid of the box of ``grid``, with a margin of one voxel on each side. The coarse voxels are about as
    large as a pixel of ``geometry`` scaled to the axis, but never smaller than the voxels of ``grid``, nor than 1/64 of the
    box's longest side."""
    height_mm, width_mm = (pitch / geometry.magnification for pitch in geometry.pixel_size_mm)
    least_mm = max(max(grid.size_mm) / _MOST_VOXELS, min(grid.voxel_size_mm))
    wanted_mm = (max(height_mm, least_mm), *(max(width_mm, least_mm),) * 2)
    shape = [max(1, math.ceil(side / wanted - 1e-6)) for side, wanted in zip(grid.size_mm, wanted_mm, strict=True)]
    voxel = [side / n for side, n in zip(grid.size_mm, shape, strict=True)]
    nz, ny, nx = (n + 2 * _MARGIN for n in shape)
    return Grid((nz, ny, nx), (voxel[0], voxel[1], voxel[2]), grid.offset_mm)


def around_object(scan: Scan, spare_columns: float = 0.0) -> Scan:
    """Returns a coarse scan with its grid cut, in y and x, to a box around the object that the frames show.

    A grid of the whole field of view has much air. With few frames, voxels of air let a wrong geometry fit better than the
    right one. spare_columns: by how many columns the axis may be off. The object's radius on the panel grows by as many.
    A scan whose grid is off the axis, or whose frames show nothing, is returned unchanged."""
    geometry, grid = scan.geometry, scan.grid
    columns = np.where(scan.valid, scan.projections, 0).max((0, 1))
    shown = np.flatnonzero(columns > _OBJECT_SHARE * columns.max())
    if any(grid.offset_mm[1:]) or not shown.size:
        return scan
    pitch_mm, offset_mm = geometry.pixel_size_mm[1], geometry.detector_offset_mm[1]
    edges_mm = (shown[[0, -1]] - (columns.size - 1) / 2) * pitch_mm + offset_mm
    radius_mm = float(np.abs(edges_mm).max()) + (0.5 + spare_columns) * pitch_mm
    if isinstance(geometry, ConeGeometry):
        radius_mm = geometry.source_to_axis_mm * math.sin(math.atan2(radius_mm, geometry.source_to_detector_mm))
    nz, *sides = grid.shape
    ny, nx = (
        min(count, math.ceil(2 * radius_mm / voxel_mm) + 2 * _MARGIN)
        for count, voxel_mm in zip(sides, grid.voxel_size_mm[1:], strict=True)
    )
    return replace(scan, grid=replace(grid, shape=(nz, ny, nx)))


def _binned_panel(geometry: Geometry, height: int, width: int) -> Geometry:
    """Returns the geometry of a panel whose pixels are blocks of ``height`` × ``width`` pixels. The last rows and columns
    are dropped if they fill no block, which moves the panel's middle."""
    (rows, columns), (pitch_v_mm, pitch_u_mm) = geometry.detector_shape, geometry.pixel_size_mm
    offset_v_mm, offset_u_mm = geometry.detector_offset_mm
    offset_mm = offset_v_mm - rows % height / 2 * pitch_v_mm, offset_u_mm - columns % width / 2 * pitch_u_mm
    return replace(
        geometry, detector_shape=(rows // height, columns // width), detector_offset_mm=offset_mm,
        pixel_size_mm=(pitch_v_mm * height, pitch_u_mm * width),
    )  # fmt: skip
