"""The rays of a step: its pixels and times, their rays over the exposure, and a field's integrals along them.

Scattered pixels and windows are SAX-NeRF's masked local–global sampling (Cai et al., CVPR 2024)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

_BEYOND_VOLUME = 2.0  # distance from the volume's middle, in its longest half-sides, that is beyond every corner
Field = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True, eq=False)
class ExposureRays:
    """The rays of one frame's pixels.

    - pose (C, 12): in units of half the volume's longest side about the volume's centre.
    - cell (K, lines): the cell of each of a line's K times, which have equal weights.
    - axis: whether lines are rows or columns. is_parallel: poses begin with the rays' direction."""

    pose: np.ndarray
    cell: np.ndarray
    axis: str
    is_parallel: bool = False

    @classmethod
    def of_cells(cls, table: TimeCells, grid: Grid) -> "ExposureRays":
        """Returns the rays of cells of fixed pose in mm, for a volume on ``grid`` in mm.

        Raises InputError for a table whose lines have different numbers of cells or different weights."""
        centre, unit = np.array(grid.offset_mm[::-1]), grid.half_longest_mm
        pose = table.pose.copy()
        if not table.is_parallel:
            pose[:, :3] -= centre
        pose[:, 3:6] -= centre
        weight = table.layer_weights
        if not np.allclose(weight, 1 / len(weight)):
            expected = "equal weights for a neural field"
            raise InputError("--motion", "times of a line that do not weigh the same", expected)
        cell = np.zeros(weight.shape, np.int64)
        for number, (layer, start, stop) in enumerate(
            zip(table.layer_numbers, table.line_start, table.line_stop, strict=True)
        ):
            cell[layer, start:stop] = number
        return cls(pose / unit, cell, table.axis, table.is_parallel)

    @property
    def times(self) -> int:
        """The number K of times of each line."""
        return len(self.cell)

    def __call__(self, pixels: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns sources and unit directions (R, s, 3) of pixels (R, 2), row and column, at some of their times (R, s).

        Parallel rays begin in front of the volume."""
        rows, columns = pixels.T
        line = rows if self.axis == "rows" else columns
        pose = self.pose[self.cell[times, line[:, None]]]  # (R, s, 12)
        along_row, down = columns[:, None, None], rows[:, None, None]
        centre = pose[..., 3:6] + along_row * pose[..., 6:9] + down * pose[..., 9:12]
        direction = pose[..., :3] if self.is_parallel else centre - pose[..., :3]
        direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        if self.is_parallel:
            depth = np.einsum("rsi,rsi->rs", centre, direction)[..., None]
            return centre - (depth + _BEYOND_VOLUME) * direction, direction
        return pose[..., :3], direction

    def shadow(self, half_sides: np.ndarray, detector_shape: tuple[int, int]) -> tuple[slice, slice]:
        """Returns rows and columns that hold every pixel whose rays meet a box of ``half_sides`` (x, y, z) about 0."""
        corners = np.array(np.meshgrid(*[(-h, h) for h in half_sides], indexing="ij")).reshape(3, -1).T
        source, first, steps = self.pose[:, None, :3], self.pose[:, None, 3:6], self.pose[:, None, 6:12]
        to_corner = corners - source  # (C, 8, 3)
        along, to_first = (source, first - corners) if self.is_parallel else (to_corner, first - source)
        matrix = np.stack(np.broadcast_arrays(along, -steps[..., :3], -steps[..., 3:]), -1)
        try:
            place = np.linalg.solve(matrix, to_first[..., None])[..., 0]
        except np.linalg.LinAlgError:
            place = np.full(to_corner.shape, np.nan)
        scale, column, row = np.moveaxis(place, -1, 0)
        is_behind = not self.is_parallel and np.any(scale <= 0)
        if is_behind or not np.all(np.isfinite(scale)):  # the panel cannot see a corner
            return slice(0, detector_shape[0]), slice(0, detector_shape[1])
        return _within(row, detector_shape[0]), _within(column, detector_shape[1])


def _within(place: np.ndarray, count: int) -> slice:
    first = int(np.clip(np.floor(place.min()), 0, count - 1))
    return slice(first, int(np.clip(np.ceil(place.max()) + 1, first + 1, count)))


def scattered_pixels(usable: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Returns ``count`` of the usable pixels (rows, columns) bool, as (R, 2) row, column. No pixel comes twice."""
    where = np.flatnonzero(usable)
    chosen = rng.choice(where, min(count, where.size), replace=False, shuffle=False)
    return np.stack(np.unravel_index(chosen, usable.shape), -1)


def windows_and_scattered_pixels(
    usable: np.ndarray, count: int, windows: int, edge: int, rng: np.random.Generator
) -> np.ndarray:
    """Draws the pixels (R, 2) of ``windows`` windows of ``edge``² usable pixels, and ``count`` scattered ones outside them.

    Windows are tiles of the frame. There are fewer windows if fewer tiles are usable throughout."""
    down, across = (n // edge for n in usable.shape)
    tiles = usable[: down * edge, : across * edge].reshape(down, edge, across, edge).all(axis=(1, 3))
    whole = np.flatnonzero(tiles)
    chosen = rng.choice(whole, min(windows, whole.size), replace=False, shuffle=False)
    corner = np.stack(np.unravel_index(chosen, tiles.shape), -1) * edge
    inside = np.stack(np.meshgrid(np.arange(edge), np.arange(edge), indexing="ij"), -1).reshape(-1, 2)
    local = (corner[:, None] + inside).reshape(-1, 2)
    rest = usable.copy()
    rest[local[:, 0], local[:, 1]] = False
    return np.concatenate([local, scattered_pixels(rest, count, rng)])


def chosen_times(pixels: int, times: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws ``count`` of the ``times`` of every pixel, (pixels, count). No time comes twice, and all are equally likely."""
    if count >= times:
        return np.broadcast_to(np.arange(times), (pixels, times))
    return np.argsort(rng.random((pixels, times)), axis=1)[:, :count]


def box_span(
    source: torch.Tensor, direction: torch.Tensor, half_sides: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns (first distance, length) (R,) of rays (R, 3) in a box of ``half_sides`` (3,) about 0. Length 0: no meeting.

    Directions have unit length. A ray begins at its source."""
    tiny = torch.finfo(direction.dtype).tiny
    slope = torch.where(direction.abs() < tiny, torch.full_like(direction, tiny), direction)
    one, other = (-half_sides - source) / slope, (half_sides - source) / slope
    first = torch.minimum(one, other).amax(-1).clamp(min=0)
    last = torch.maximum(one, other).amin(-1)
    return first, (last - first).clamp(min=0)


def sample_shifts(rays: int, samples: int, jitter: str, rng: np.random.Generator) -> np.ndarray:
    """Returns the place of each sample in its interval, 0 to 1: (R, 1) for one shift per ray or none, else (R, samples)."""
    if jitter == "none":
        return np.full((rays, 1), 0.5, np.float32)
    return rng.random((rays, samples if jitter == "sample" else 1), np.float32)


def line_integrals(
    field: Field, source: torch.Tensor, direction: torch.Tensor, half_sides: torch.Tensor, samples: int,
    shifts: torch.Tensor,
) -> torch.Tensor:
    """Returns the integrals (R,) of a field along rays (R, 3), a sample in each of ``samples`` intervals in the box.

    ``shifts``: from ``sample_shifts``. With uniformly drawn shifts the expectation is the integral itself, for any field."""
    first, length = box_span(source, direction, half_sides)
    step = length / samples
    number = torch.arange(samples, dtype=source.dtype, device=source.device)
    distance = first[:, None] + (number + shifts) * step[:, None]
    positions = source[:, None] + distance[..., None] * direction[:, None]
    return field(positions.reshape(-1, 3)).reshape(len(source), samples).sum(1) * step


def intensity_average(integrals: torch.Tensor, unit: float) -> torch.Tensor:
    """Returns −ln(mean over K of exp(−unit · p)) / unit (R,) of the integrals p (R, K) at a pixel's times."""
    return (math.log(integrals.shape[1]) - torch.logsumexp(-unit * integrals, 1)) / unit


def log_squares(integrals: torch.Tensor, measured: torch.Tensor, times: int) -> torch.Tensor:
    """Returns squared errors (R,) of the mean over all K ``times`` of a pixel, estimated from s of them, integrals (R, s).

    The square of a mean over a random subset is too large by the subset's variance. The spread of the s samples, times
    (1/s − 1/K), estimates this variance. Without it, expectation and gradient are those of all K times."""
    count = integrals.shape[1]
    squares = (integrals.mean(1) - measured) ** 2
    return squares if count == times else squares - (1 / count - 1 / times) * integrals.var(1, unbiased=True)
