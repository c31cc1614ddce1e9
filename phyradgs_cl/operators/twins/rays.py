"""Float64 twins in NumPy of the ray-driven projector, its transpose, and the voxel-driven backprojections; for objects that
move, also of the warps of volumes and the displacement of Gaussians.

The projector sums Joseph's samples ray by ray. The backprojections compute the ray of every voxel. With one pose per line
they search all lines for the one onto which the voxel is projected."""

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.ndimage import map_coordinates

from phyradgs_cl.acquisition.geometry import pixel_centres, transpose_pose
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Deformation, Gaussians, Grid
from phyradgs_cl.fields.deformation import cubic
from phyradgs_cl.fields.gaussians import MEAN
from phyradgs_cl.operators.rays.layout import some_cells
from phyradgs_cl.operators.twins.splat import moving_frame, precision_matrices, splat_frame

_REACH = 2  # distance in voxels up to which a spline coefficient acts: points further than this outside the volume get 0
_BORDER = 4  # width in voxels around the volume in which spline coefficients are kept
_ROUNDING = 1e-3  # as ROUNDING of cl/common/line_backprojection.h, in pixels
_NOWHERE = -9.0  # index of a sample outside every volume
Volume = np.ndarray


def joseph_image(
    volume: np.ndarray, grid: Grid, pose: np.ndarray, detector_shape: tuple[int, int], is_parallel: bool = False
) -> np.ndarray:
    """Returns the line integrals (nv, nu) of a volume (nz, ny, nx) in 1/mm from one pose (12,) in mm."""
    image = np.zeros(detector_shape)
    padded = np.pad(volume.astype(np.float64), 1)
    for index, points, step_mm in _rays(grid, pose, np.ones(detector_shape, bool), is_parallel):
        samples = map_coordinates(padded, np.moveaxis(points[..., ::-1], -1, 0) + 1, order=1, mode="constant")
        image[index] = samples.sum(axis=-1) * step_mm
    return image


def joseph_adjoint(image: np.ndarray, grid: Grid, pose: np.ndarray, is_parallel: bool = False) -> np.ndarray:
    """Returns the transpose of ``joseph_image``: pixels (nv, nu) backprojected to a volume (nz, ny, nx)."""
    padded = np.zeros([n + 2 for n in grid.shape])
    for index, points, step_mm in _rays(grid, pose, image != 0, is_parallel):
        touching = np.all((points > -1) & (points < grid.shape[::-1]), axis=-1)
        value = np.broadcast_to((image[index] * step_mm)[:, None], touching.shape)[touching]
        whole = np.floor(points[touching])
        rest = points[touching] - whole
        for corner in np.ndindex(2, 2, 2):
            share = np.prod(np.where(corner, rest, 1 - rest), axis=1)
            x, y, z = (whole + corner).astype(int).T + 1
            np.add.at(padded, (z, y, x), value * share)
    return padded[1:-1, 1:-1, 1:-1]


def ray_frame(
    volume: np.ndarray, grid: Grid, table: TimeCells, detector_shape: tuple[int, int], model: str = "log"
) -> np.ndarray:
    """Returns the frame (rows, columns) of a volume (nz, ny, nx) in 1/mm, averaged over the time cells of ``table``. model:
    "log" averages line integrals, "intensity" averages intensities."""
    frame = np.zeros(detector_shape)
    for cell in range(table.count):
        image = joseph_image(volume, grid, table.pose[cell], detector_shape, table.is_parallel)
        where = _lines(table, cell)
        seen = np.exp(-image[where]) if model == "intensity" else image[where]
        frame[where] += table.readout.spread(table.weights_of(cell)) * seen
    return -np.log(frame) if model == "intensity" else frame


def ray_volume(frame: np.ndarray, grid: Grid, table: TimeCells) -> np.ndarray:
    """Transpose of ``ray_frame`` with the model "log": returns a volume (nz, ny, nx) from a frame (rows, columns)."""
    volume = np.zeros(grid.shape)
    for cell in range(table.count):
        image = np.zeros(frame.shape)
        where = _lines(table, cell)
        image[where] = table.readout.spread(table.weights_of(cell)) * frame[where]
        volume += joseph_adjoint(image, grid, table.pose[cell], table.is_parallel)
    return volume


def intensity_volume(frame: np.ndarray, volume: np.ndarray, grid: Grid, table: TimeCells) -> np.ndarray:
    """Transpose of the derivative of ``ray_frame`` at ``volume`` with the model "intensity": returns a volume (nz, ny, nx)
    from a frame (rows, columns)."""
    result = np.zeros(grid.shape)
    for cell, share in _shares(volume, grid, table, frame.shape):
        result += joseph_adjoint(share * frame, grid, table.pose[cell], table.is_parallel)
    return result


def _shares(
    volume: np.ndarray, grid: Grid, table: TimeCells, detector_shape: tuple[int, ...]
) -> Iterator[tuple[int, np.ndarray]]:
    """Yields each cell's number and the fractions (rows, columns) of the pixels' light that arrive in it: 0 on lines that
    the cell does not serve."""
    shape = (detector_shape[0], detector_shape[1])
    total = np.exp(-ray_frame(volume, grid, table, shape, "intensity"))
    for cell in range(table.count):
        share, where = np.zeros(shape), _lines(table, cell)
        light = np.exp(-joseph_image(volume, grid, table.pose[cell], shape, table.is_parallel)[where])
        share[where] = table.readout.spread(table.weights_of(cell)) * light / total[where]
        yield cell, share


def _lines(table: TimeCells, cell: int) -> tuple[slice, slice]:
    lines = slice(int(table.line_start[cell]), int(table.line_stop[cell]))
    return (lines, slice(None)) if table.axis == "rows" else (slice(None), lines)


def _rays(
    grid: Grid, pose: np.ndarray, wanted: np.ndarray, is_parallel: bool
) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]]:
    """Yields for each axis the pixels in the mask ``wanted`` whose rays run mostly along it: their index, sample points
    (pixels, n, 3) as voxel indices x y z, and the length of ray per sample (pixels,) in mm."""
    pitch, first = np.array(grid.voxel_size_mm[::-1]), np.array(grid.first_centre_mm[::-1])
    pixels = (pixel_centres(pose, wanted.shape) - first) / pitch
    source = (pose[:3] - first) / pitch
    directions = np.broadcast_to(pose[:3] / pitch, pixels.shape) if is_parallel else pixels - source
    main = np.argmax(np.abs(directions), axis=-1)
    for axis in range(3):
        index = np.nonzero(wanted & (main == axis))
        end, d, planes = pixels[index][:, None], directions[index][:, None], np.arange(grid.shape[2 - axis])
        points = end + (planes[:, None] - end[..., [axis]]) / d[..., [axis]] * d
        points[..., axis] = planes
        if not is_parallel:  # planes beyond the source or the pixel have no sample
            points[(planes - source[axis]) * (planes - end[..., axis]) > 0] = _NOWHERE
        yield index, points, np.linalg.norm(d * pitch, axis=-1)[:, 0] / np.abs(d[:, 0, axis])


def backprojection(
    frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid, is_parallel: bool = False,
    push_mm: np.ndarray | None = None, power: int = 2,
) -> np.ndarray:
    """Returns the volume (nz, ny, nx) Σ_f weight_f / z^power · frame_f(u, v), for frames (F, rows, columns), pose (F, 12)
    mm and weight (F,), as ``backproject`` does.

    push_mm: (F, nz, ny, nx, 3) how far each voxel's matter has moved at the time of each frame, x, y, z."""
    volume = np.zeros(grid.shape)
    pushes: Iterable[np.ndarray | float] = [0.0] * len(frames) if push_mm is None else push_mm
    for frame, one, share, moved in zip(frames.astype(np.float64), pose, weight, pushes, strict=True):
        u, v, depth = detector_position(one, grid, is_parallel, moved)
        inside = (depth > 0) & _on(u, frame.shape[1]) & _on(v, frame.shape[0])
        seen = map_coordinates(frame, [v[inside], u[inside]], order=1, mode="nearest")
        volume[inside] += share / depth[inside] ** power * seen
    return volume


def lines_backprojection(
    frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid, axis: str = "rows",
    is_parallel: bool = False, push_mm: np.ndarray | None = None, power: int = 2,
) -> np.ndarray:
    """Returns what ``backproject_lines`` returns, (nz, ny, nx), by its definition. pose (F, lines, 12) in mm; other
    arguments as in ``backprojection``."""
    speed_power = 2 if axis == "columns" and power == 2 else 1
    if axis == "columns":
        frames, pose = frames.transpose(0, 2, 1), transpose_pose(pose)
    lines = frames.shape[1]
    volume = np.zeros(grid.shape)
    pushes: Iterable[np.ndarray | float] = [0.0] * len(frames) if push_mm is None else push_mm
    for frame, poses, share, moved in zip(frames.astype(np.float64), pose, weight, pushes, strict=True):
        positions = [detector_position(p, grid, is_parallel, moved) for p in poses]
        u, v, depth = (np.stack(parts) for parts in zip(*positions, strict=True))
        ahead = v - np.arange(lines)[:, None, None, None]  # changes its sign at the line that sees the voxel
        if lines > 1:
            volume += share * _seen(frame, u, ahead, depth, power, speed_power)
    return volume


def detector_position(
    pose: np.ndarray, grid: Grid, is_parallel: bool = False, push_mm: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns pixel column u, pixel row v and depth, (nz, ny, nx) each, of voxel centres displaced by ``push_mm`` (nz, ny,
    nx, 3).

    Solves x − source = depth (d00 + u eu + v ev), where d00 goes from the source to pixel (0, 0). In a parallel beam
    x − pixel (0, 0) = u eu + v ev + t direction, and the depth is 1."""
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    if isinstance(push_mm, np.ndarray):
        x, y, z = x + push_mm[..., 0], y + push_mm[..., 1], z + push_mm[..., 2]
    if is_parallel:
        offset = np.stack([x, y, z]).reshape(3, -1) - pose[3:6, None]
        u, v, t = np.linalg.solve(np.stack([pose[6:9], pose[9:12], pose[0:3]], -1), offset).reshape(3, *grid.shape)
        return u, v, np.ones_like(t)
    offset = np.stack([x, y, z]).reshape(3, -1) - pose[0:3, None]
    basis = np.stack([pose[6:9], pose[9:12], pose[3:6] - pose[0:3]], -1)
    u, v, depth = np.linalg.solve(basis, offset).reshape(3, *grid.shape)
    with np.errstate(divide="ignore", invalid="ignore"):  # depth may be 0: such a voxel has no image
        return u / depth, v / depth, depth


def _seen(
    frame: np.ndarray, u: np.ndarray, ahead: np.ndarray, depth: np.ndarray, power: int, speed_power: int
) -> np.ndarray:
    """Returns what a frame adds to each voxel, (nz, ny, nx). u, ahead, depth (lines, nz, ny, nx), in the pose of each line:
    the voxel's pixel along the line, the line onto which it is projected minus the pose's own line, and its depth. power,
    speed_power: exponents of the depth, and of the rate at which the readout crosses the voxel's image."""
    lines, width = frame.shape
    low = np.arange(lines - 1)[:, None, None, None]
    speeds = ahead[:-1] - ahead[1:]
    line_of_seen = low + ahead[:-1] / np.where(speeds > 0, speeds, np.nan)
    off = np.abs(line_of_seen - np.clip(line_of_seen, low, low + 1))
    crossing = (off == 0) | (off <= _ROUNDING) & ((line_of_seen < 0) | (line_of_seen > lines - 1))
    sees, line = crossing.any(axis=0) & (depth.min(axis=0) > 0), np.argmax(crossing, axis=0)

    def at(values: np.ndarray, number: np.ndarray) -> np.ndarray:  # 1 where the frame does not see the voxel
        return np.where(sees, np.take_along_axis(values, number[None], axis=0)[0], 1.0)

    speed, t = at(speeds, line), np.clip(at(line_of_seen, line) - line, 0, 1)
    here, there = (
        map_coordinates(frame, [number, x], order=1, mode="nearest") * _on(x, width)
        for number, x in ((number, at(u, number)) for number in (line, line + 1))
    )
    middle = (1 - t) * at(depth, line) + t * at(depth, line + 1)
    return np.where(sees, ((1 - t) * here + t * there) / (middle**power * speed**speed_power), 0.0)


def _on(position: np.ndarray, count: int) -> np.ndarray:
    """Returns whether positions are on ``count`` pixels, but for rounding."""
    return (position >= -_ROUNDING) & (position <= count - 1 + _ROUNDING)


def warp_forward(volume: Volume, displacement: np.ndarray) -> Volume:
    """Returns the warped volume v(y + w(y)), (nz, ny, nx). v interpolates a volume by cubic splines, and the displacement w
    (nz, ny, nx, 3) is in voxels, x, y, z. v is 0 further than ``_REACH`` voxels outside the volume."""
    padded = _coefficients(np.pad(np.asarray(volume, np.float64), _BORDER))
    result = np.zeros(volume.shape)
    for place, weight in _taps(displacement):
        result += weight * padded[place]
    return result


def warp_adjoint(values: Volume, displacement: np.ndarray) -> Volume:
    """Returns the transpose of ``warp_forward`` at ``values`` (nz, ny, nx)."""
    padded = np.zeros([n + 2 * _BORDER for n in values.shape])
    for place, weight in _taps(displacement):
        np.add.at(padded, place, weight * values)
    inner = slice(_BORDER, -_BORDER)
    return _coefficients(padded)[inner, inner, inner]


def _coefficients(values: Volume) -> Volume:
    """Returns the coefficients of the cubic spline through values (nz, ny, nx), which are 0 outside, by convolution with
    its impulse response."""
    for axis, side in enumerate(values.shape):
        distance = np.abs(np.subtract.outer(np.arange(side), np.arange(side)))
        response = np.sqrt(3) * (np.sqrt(3) - 2) ** distance
        values = np.moveaxis(np.tensordot(response, values, (1, axis)), 0, axis)
    return values


def _taps(displacement: np.ndarray) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """Yields, for each of the 4³ coefficients that act on a displaced voxel, its indices in the padded volume and weight."""
    shape = displacement.shape[:3]
    places = np.indices(shape) + np.moveaxis(np.asarray(displacement, np.float64), -1, 0)[::-1]
    sides = np.reshape(shape, (3, 1, 1, 1))
    is_inside = ((places >= -_REACH) & (places <= sides - 1 + _REACH)).all(axis=0)
    places = np.clip(places, -_REACH, sides - 1 + _REACH)
    first = np.floor(places).astype(int) + 1 - _REACH
    for tap in np.ndindex(*(2 * _REACH,) * 3):
        index = first + np.reshape(tap, (3, 1, 1, 1))
        z, y, x = index + _BORDER
        yield (z, y, x), is_inside * cubic(places - index).prod(axis=0)


def moved_rows(rows: np.ndarray, deformation: Deformation, weights: np.ndarray) -> np.ndarray:
    """Returns the parameter rows (11, G) of Gaussians moved from the reference to the state with field weights (R,)."""
    mean = rows[MEAN].T + deformation.inverse_mm(rows[MEAN].T, weights)
    for _ in range(2):  # Newton's steps: tests by central differences of frames need more digits than inverse_mm has
        off = mean + deformation.displacement_mm(mean, weights) - rows[MEAN].T
        pull = np.eye(3) + deformation.jacobian(mean, weights)
        mean = mean - np.linalg.solve(pull, off[..., None])[..., 0]
    pull = np.eye(3) + deformation.jacobian(mean, weights)
    covariance = np.linalg.inv(np.einsum("gji,gjk,gkl->gil", pull, precision_matrices(rows), pull))
    return Gaussians.of_covariance(mean, covariance, rows[-1]).rows()


def deformed_frame(
    rows: np.ndarray, table: TimeCells, detector_shape: tuple[int, int], deformation: Deformation, affine: bool = False
) -> np.ndarray:
    """Returns the frame (nv, nu) of an object that moves, summed over all time cells. rows (11, G): its Gaussians in the
    reference state. A cell projects them at its time; a moving cell also takes their centres at both of its ends."""

    def cloud_at(time_s: float) -> np.ndarray:
        return moved_rows(rows, deformation, deformation.weights_at(time_s)[0])

    if table.is_moving:
        return moving_frame(rows, table, detector_shape, affine=affine, cloud_at=cloud_at)
    frame = np.zeros(detector_shape)
    for cell in range(table.count):
        frame += splat_frame(cloud_at(table.time_s[cell]), some_cells(table, [cell]), detector_shape, affine=affine)
    return frame
