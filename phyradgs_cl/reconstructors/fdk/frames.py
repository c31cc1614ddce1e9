"""Changes frames before FDK's filter: continues detector rows beyond the panel, and removes motion blur along the angle.

Rows continue so that the filter does not ring where they are cut off. Only the way ``reprojected`` uses the object itself.

- cosine: rows fall to 0 along a quarter of a cosine (similar to Ohnesorge et al., Med. Phys. 27 (2000) 39).
- cylinder: rows continue as chords of a cylinder, from their last values and slope (Hsieh et al., Med. Phys. 31 (2004)
  2385). A parabola through the squares of the row gives its attenuation.
- reprojected: FISTA-TV reconstructs a volume on a grid that holds the whole object, and its projections continue the rows.

Deblurring: in a parallel beam, an exposure over an arc Δθ averages the sinogram with a box along the angle. A pixel sees the
mean of p(θ, s) over [θ − Δθ/2, θ + Δθ/2], whatever the object. Along the views this is a convolution, which a Wiener filter
inverts: with H(f) = sinc(f Δθ) it multiplies by (1 + λ) H / (H² + λ), where λ = (power of noise)/(power of signal). With
λ = 0, noise would grow without bound at the zeros of H. Rows that open later see the same box at other angles. A full turn
is periodic; after half a turn the frames repeat, mirrored at the axis."""

import numpy as np
import scipy

from phyradgs_cl.acquisition import LineMiddles, Motion, PerRow, Scan
from phyradgs_cl.acquisition.altered.angles import exposure_arc_rad
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.operators.rays.layout import voxel_matrices
from phyradgs_cl.operators.rays.subrays import subrays_of
from phyradgs_cl.reconstructors.fdk.views import Views
from phyradgs_cl.reconstructors.result import ProgressReport, labelled
from phyradgs_cl.reconstructors.voxels import fista_tv
from phyradgs_cl.reconstructors.voxels.fista_tv import FistaTvOptions
from phyradgs_cl.runtime import Runtime

WAYS = ("none", "cosine", "cylinder", "reprojected")
_SHARE = 0.5  # "cosine" and "cylinder" extend rows at each side by this fraction of the panel's columns
_SLOPE_PIXELS = 5  # the slope at a row's end is taken over this many pixels, to lower its noise
_NOISE = 0.01  # a row that ends below this fraction of the line integrals' 99.9th percentile ends in air, and continues as 0
_UNEVEN = 0.02  # views are evenly spaced if no angular step differs from the median step by more than this fraction
_REACH = 8  # the end views of an arc are repeated over this many times an exposure's arc, so that the filter meets no edge
_FULL_TURN = 1.5  # if a gap is wider than this many median steps, the views cover less than a full turn


def extrapolated(frames: np.ndarray, way: str) -> tuple[np.ndarray, int]:
    """Returns ``frames`` (F, v, u) continued by n columns at both sides, (F, v, u + 2 n), and n. way: cosine or cylinder."""
    count = max(1, round(_SHARE * frames.shape[2]))
    beyond = np.arange(1, count + 1)
    least = _NOISE * float(np.percentile(frames, 99.9))
    curvature = _curvature(frames)
    sides = []
    for rows in (frames[..., ::-1], frames):  # reversed for the first side, so that rows end at its edge
        pixels = min(_SLOPE_PIXELS, rows.shape[-1])
        end = rows[..., -pixels:].astype(np.float64)
        edge, slope = end.mean(-1, keepdims=True), (end[..., -1:] - end[..., :1]) / max(pixels - 1, 1)
        edge = np.where(edge > least, edge, 0)
        if way == "cosine":
            sides.append(edge * np.cos(np.pi / 2 * beyond / count))
        else:
            sides.append(_chords(edge, slope, curvature, beyond))
    return np.concatenate([sides[0][..., ::-1], frames, sides[1]], axis=-1).astype(np.float32), count


def _chords(edge: np.ndarray, slope: np.ndarray, curvature: np.ndarray, beyond: np.ndarray) -> np.ndarray:
    """Returns line integrals p (F, v, n) at distances d (n,) in pixels beyond the panel: p² = edge² + 2 edge slope d − a d².

    edge, slope: line integral at a row's end, and its change per pixel. A rising slope counts as 0. curvature: a, which is
    raised so that p reaches 0 within the n pixels. beyond: d."""
    falling, reach = np.minimum(slope, 0), beyond[-1]
    widest = (edge**2 + 2 * reach * edge * falling) / reach**2
    squares = edge**2 + 2 * edge * falling * beyond - np.maximum(curvature, widest) * beyond**2
    return np.sqrt(np.maximum(squares, 0))


def _curvature(frames: np.ndarray) -> np.ndarray:
    """Returns a ≥ 0 (F, v, 1): the median over frames of a in fits c + b d − a d² to each row's squares at d pixels."""
    u = np.linspace(-1, 1, frames.shape[2])
    basis = np.stack([np.ones_like(u), u, u**2], axis=1)
    squares = np.maximum(frames, 0).astype(np.float64) ** 2
    down = -(squares @ np.linalg.pinv(basis)[2]) * (2 / max(frames.shape[2] - 1, 1)) ** 2
    return np.broadcast_to(np.maximum(np.median(down, axis=0), 0)[None, :, None], (*frames.shape[:2], 1))


_ITERATIONS = 30  # iterations of FISTA-TV for the volume whose projections continue the rows
_MOST = 2.0  # "reprojected" extends rows at each side by at most this many panel widths


def whole_object(scan: Scan, motion: Motion, rt: Runtime, report: ProgressReport) -> np.ndarray:
    """Returns a volume (nz, ny, nx) in 1/mm on the scan's grid that explains the scan's frames, by FISTA-TV.

    Raises KeyboardInterrupt when the user stops the run, because FDK has no checkpoints."""
    at_times: Motion = PerRow(sub_intervals=2) if isinstance(motion, LineMiddles) else motion
    options = FistaTvOptions(motion=at_times, iterations=_ITERATIONS)
    report = labelled("rows beyond the panel", report)
    return fista_tv.METHOD.run(scan, options, rt, report=report).complete().volume


def reprojected(
    rt: Runtime, frames: np.ndarray, views: Views, volume: np.ndarray, grid: Grid
) -> tuple[np.ndarray, int]:
    """Continues line integrals ``frames`` (F, v, u) by projections of a ``volume`` (nz, ny, nx) in 1/mm on ``grid``. Returns
    (F, v, u + 2 n) float32, and n."""
    count = _columns_beyond(views, grid)
    wide = views.extended((count, count))
    lines, by_line = wide.shape[wide.axis == "columns"], wide.pose[:, None] if wide.pose.ndim == 2 else wide.pose
    tables = [_cells(poses, lines, wide.axis, wide.is_parallel) for poses in by_line]
    operator = RayOperator(rt, grid, wide.shape, tables, subrays=subrays_of(grid, tables))
    continued = operator.forward(np.ascontiguousarray(volume, np.float32))
    continued[..., count : count + frames.shape[2]] = frames
    return continued, count


def _cells(pose: np.ndarray, lines: int, axis: str, is_parallel: bool) -> TimeCells:
    """Returns the time cells of a frame with fixed poses: ``pose`` (1, 12) for all lines, or (lines, 12), one for each."""
    ends = np.linspace(0, lines, len(pose) + 1).round().astype(np.int32)
    weight = np.ones(len(pose))
    return TimeCells(pose, 0 * weight, ends[:-1], ends[1:], weight, lines, axis, is_parallel=is_parallel)


def _columns_beyond(views: Views, grid: Grid) -> int:
    """Returns how many columns each side needs so that panels of all poses see the whole grid; at most two widths."""
    columns, sides = views.shape[1], [(-0.5, voxels - 0.5) for voxels in grid.shape[::-1]]
    corners = np.stack([*np.meshgrid(*sides), np.ones((2, 2, 2))]).reshape(4, 8)
    matrices = voxel_matrices(views.pose.reshape(-1, 12), grid, views.is_parallel).reshape(-1, 3, 4)
    along_row, _, depth = np.moveaxis(matrices @ corners, 1, 0)  # the depth is 1 in the panel's plane
    column = along_row / np.maximum(depth, 1e-6)
    beyond = max(-float(column.min()), float(column.max()) - (columns - 1))
    return int(np.clip(np.ceil(beyond), 0, round(_MOST * columns)))


def deblurred(scan: Scan, frames: np.ndarray, angle_rad: np.ndarray, noise: float) -> np.ndarray:
    """Returns the frames (F, rows, columns) float32 without motion blur along the angle, as if the gantry stopped for each
    view. angle_rad (F,): gantry angles at the frames' middles. noise: λ = (power of noise)/(power of signal).

    Raises InputError unless the views, in any order, are evenly spaced in angle, apart from one gap."""
    arc_rad = exposure_arc_rad(scan)
    if arc_rad == 0:
        return frames
    order = np.argsort(np.mod(angle_rad, 2 * np.pi), kind="stable")
    turned = np.mod(angle_rad, 2 * np.pi)[order]
    gaps_rad = np.diff(turned, append=turned[0] + 2 * np.pi)
    start = (int(np.argmax(gaps_rad)) + 1) % len(order)
    step_rad = float(np.median(gaps_rad))
    is_full = gaps_rad.max() < _FULL_TURN * step_rad
    if np.abs(np.delete(gaps_rad, start - 1) / step_rad - 1).max(initial=0) > _UNEVEN:
        expected = "views at evenly spaced angles"
        raise InputError("option deblur", "views at uneven angles", expected, "leave it out, or take an iterative method")
    order = np.roll(order, -start)
    count = len(order)
    is_half = abs(count * step_rad - np.pi) < step_rad / 2
    pad = 0 if is_full or is_half else min(count - 1, int(np.ceil(_REACH * arc_rad / step_rad)))
    length = 2 * count if is_half else count + 2 * pad
    box = np.sinc(np.arange(length // 2 + 1) / length * arc_rad / step_rad)
    response = ((1 + noise) * box / (box**2 + noise)).astype(np.float32)
    result = np.empty_like(frames)
    for row in range(frames.shape[1]):
        line = frames[order, row]
        if is_half:
            line = np.concatenate([line, _mirrored(line, scan)])
        elif pad:
            line = np.pad(line, ((pad, pad), (0, 0)), mode="edge")
        spectrum = scipy.fft.rfft(line, axis=0, workers=-1) * response[:, None]
        result[order, row] = scipy.fft.irfft(spectrum, length, axis=0, workers=-1)[pad : pad + count]
    return result


def _mirrored(line: np.ndarray, scan: Scan) -> np.ndarray:
    """Returns one row of all views, ``line`` (F, columns), as seen from the other side: mirrored at the column of the axis.
    Columns whose mirror image lies beyond the panel take the row's outermost value."""
    columns = line.shape[1]
    axis = (columns - 1) / 2 - scan.geometry.detector_offset_mm[1] / scan.geometry.pixel_size_mm[1]
    at = np.clip(2 * axis - np.arange(columns), 0, columns - 1)
    low = np.minimum(at.astype(int), max(columns - 2, 0))
    share = (at - low).astype(np.float32)
    return line[:, low] * (1 - share) + line[:, np.minimum(low + 1, columns - 1)] * share
