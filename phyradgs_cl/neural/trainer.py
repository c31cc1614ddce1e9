"""Fits a neural field to a scan's rays, step by step. The state between two steps can be stored.

A step's pixels are scattered ones and whole windows: SAX-NeRF's masked local–global sampling (Cai et al., CVPR 2024)."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn.utils import parameters_to_vector

from phyradgs_cl.acquisition import OwnTimes, PerRow, Scan
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.neural.field import NeuralField, repeatable, to_array, to_tensor, voxel_values
from phyradgs_cl.neural.options import LineOptions, NeuralOptions

_BETAS, _EPSILON = (0.9, 0.999), 1e-8  # Adam's decay rates of both moments, and the constant added to its denominator
_MOMENTS = "exp_avg", "exp_avg_sq"  # PyTorch's names of Adam's moments
_POINTS_ON_CPU = 2**14  # most points at which a CPU evaluates the field at once: their values fit in its cache
_POINTS_ELSEWHERE = 2**20  # most points at which any other device evaluates the field at once: they fit in a GPU's memory
_BEYOND_VOLUME = 2.0  # parallel rays begin this many halves of the volume's longest side from its centre: beyond its corners
Field = Callable[[torch.Tensor], torch.Tensor]


class Trainer:
    """Fits a field to a scan's rays, in steps that ``reconstructors.loop`` runs. A step uses one frame, an iteration uses
    all frames. A trainer holds what changes from step to step: the field, its optimiser and the random draws.

    Lengths are in units of half the volume's longest side, attenuation in units of ``density_per_mm``."""

    quantity, remedy, finished = "loss", "check the scan for extreme values, or lower the rate", None

    def __init__(
        self, scan: Scan, options: NeuralOptions, field: NeuralField, device: torch.device,
        density_per_mm: float, seed: int,
    ) -> None:
        self.scan, self.options, self.device, self.iterations = scan, options, device, options.iterations
        self.field = field.to(device)
        self.density_per_mm = density_per_mm
        self.unit = density_per_mm * scan.grid.half_longest_mm  # internal unit of line integrals
        self.rng = np.random.default_rng(seed)
        motion = options.motion
        if type(motion) is PerRow:  # the field is evaluated for each ray, so sharing times between lines saves nothing
            motion = OwnTimes(motion.of(scan).sub_intervals)
        tables = [motion.cells(scan, frame).still() for frame in range(scan.frames)]
        self.rays = [ExposureRays.of_cells(table, scan.grid) for table in tables]
        times = self.rays[0].times
        stated = scan.detector_model if options.detector_model == "scan" else options.detector_model
        self.model = stated if times > 1 else "log"  # with a single time the log model and the intensity model agree
        self.times = options.times_for(times, self.model)
        self.samples = options.samples_for(max(scan.grid.shape), times)
        self.points_at_once = _POINTS_ON_CPU if device.type == "cpu" else _POINTS_ELSEWHERE
        half_sides = np.array(scan.grid.size_mm[::-1]) / 2 / scan.grid.half_longest_mm
        self._shadows = [one.shadow(half_sides, scan.geometry.detector_shape) for one in self.rays]
        self._half_sides = to_tensor(half_sides.astype(np.float32), device)
        self._adam = torch.optim.Adam(self.field.parameters(), options.rate, _BETAS, _EPSILON)
        self.steps, self.updates, self.queue = 0, 0, self._shuffled()
        self.losses: list[float] = []

    @property
    def iteration(self) -> int:
        """Number of times that the training has used all frames."""
        return self.steps // self.scan.frames

    @property
    def parameters(self) -> int:
        return sum(p.numel() for p in self.field.parameters())

    def step(self) -> None:
        """Draws pixels of one frame, steps down the gradient of their squared error, and adds the loss to ``losses``."""
        if self.steps % self.scan.frames == 0:
            self.losses = []
        frame = self.queue.pop()
        pixels = self._pixels(frame)
        for group in self._adam.param_groups:
            group["lr"] = self._rate()
        loss = 0.0
        if len(pixels):
            with repeatable(self.device):
                self._adam.zero_grad(set_to_none=True)
                loss = self._loss_and_gradient(frame, pixels)
                self._adam.step()
            self.updates += 1
        self.losses.append(loss)
        self.steps += 1
        if not self.queue:
            self.queue = self._shuffled()

    def measures(self) -> dict[str, float]:
        return {"loss": float(np.mean(self.losses))}

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        """Returns the field in the voxels (nz, ny, nx) of the scan's grid, in 1/mm, and the grid."""
        grid = self.scan.grid
        unit_grid = Grid(grid.shape, grid.scaled(1 / grid.half_longest_mm).voxel_size_mm)
        points = self.options.voxel_points
        values = voxel_values(self.field, unit_grid, self.device, self.points_at_once, points)
        return values * np.float32(self.density_per_mm), grid

    def state(self) -> dict[str, np.ndarray]:
        own = list(self.field.parameters())
        moments = [[self._adam.state.get(p, {}).get(name, torch.zeros_like(p)) for p in own] for name in _MOMENTS]
        return {
            "parameters": to_array(parameters_to_vector(own)),
            "moments": np.stack([to_array(parameters_to_vector(of_all)) for of_all in moments]),
            "steps": np.array(self.steps),
            "updates": np.array(self.updates),
            "queue": np.array(self.queue, np.int64),
            "rng": np.array(json.dumps(self.rng.bit_generator.state)),
            "losses": np.array(self.losses, np.float64),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continues from what ``state`` returned, with the field's parameters (n,) and Adam's moments (2, n)."""
        self.rng.bit_generator.state = json.loads(str(state["rng"]))
        self.steps, self.updates = int(state["steps"]), int(state["updates"])
        self.queue, self.losses = state["queue"].tolist(), state["losses"].tolist()
        own, arrays = list(self.field.parameters()), (state["parameters"], *state["moments"])
        parts = (to_tensor(array, self.device).split([p.numel() for p in own]) for array in arrays)
        with torch.no_grad():
            for p, *all_three in zip(own, *parts, strict=True):
                values, *moments = (one.reshape(p.shape).clone() for one in all_three)
                p.copy_(values)
                if self.updates:
                    step = torch.tensor(float(self.updates))
                    self._adam.state[p] = {"step": step, **dict(zip(_MOMENTS, moments, strict=True))}

    def _shuffled(self) -> list[int]:
        return self.rng.permutation(self.scan.frames).tolist()

    def _rate(self) -> float:
        options = self.options
        if options.rate_step:
            return options.rate * options.rate_factor ** (self.iteration // options.rate_step)
        return options.rate * options.rate_factor ** (self.steps / (options.iterations * self.scan.frames))

    def _pixels(self, frame: int) -> np.ndarray:
        """Draws pixels (R, 2) of a frame, among those that are valid and whose rays can meet the volume."""
        scan, options = self.scan, self.options
        usable = np.zeros(scan.geometry.detector_shape, bool)
        usable[self._shadows[frame]] = True
        if scan.pixel_mask is not None:
            usable &= np.broadcast_to(scan.pixel_mask, scan.projections.shape)[frame] == 0
        if options.positive_only:
            usable &= scan.projections[frame] > 0
        if isinstance(options, LineOptions):
            return windows_and_scattered_pixels(
                usable, options.rays, options.windows, options.window, self.rng
            )
        return scattered_pixels(usable, options.rays, self.rng)

    def _loss_and_gradient(self, frame: int, pixels: np.ndarray) -> float:
        """Returns the mean squared error in internal units. Adds its gradient to the gradients of the field's parameters."""
        exposure = self.rays[frame]
        times = chosen_times(len(pixels), exposure.times, self.times, self.rng)
        shifts = sample_shifts(times.size, self.samples, self.options.jitter, self.rng)
        shifts = shifts.reshape(*times.shape, -1)
        measured = self.scan.projections[frame][tuple(pixels.T)].astype(np.float32) / np.float32(self.unit)
        # Pixels are taken in chunks, to save memory. The chunks' gradients add up to the gradient of all pixels.
        at_once = max(self.points_at_once // (self.samples * self.times), 1)
        total = 0.0
        for start in range(0, len(pixels), at_once):
            part = slice(start, start + at_once)
            source, direction = exposure(pixels[part], times[part])
            squares = self._squares(source, direction, shifts[part], measured[part], exposure.times)
            loss = squares.sum() / len(pixels)
            loss.backward()
            total += float(loss.detach())
        return total

    def _squares(
        self, source: np.ndarray, direction: np.ndarray, shifts: np.ndarray, measured: np.ndarray, times: int
    ) -> torch.Tensor:
        """Returns the squared errors (R,) of R pixels. source, direction (R, s, 3): rays at s of each pixel's K ``times``.
        shifts (R, s, 1 or samples): what ``sample_shifts`` returns. measured (R,): line integrals in internal units."""
        from_, along, shift = (
            to_tensor(a.reshape(-1, a.shape[-1]).astype(np.float32), self.device)
            for a in (source, direction, shifts)
        )
        integrals = line_integrals(self.field, from_, along, self._half_sides, self.samples, shift)
        integrals = integrals.reshape(source.shape[:2])
        wanted = to_tensor(measured, self.device)
        if self.model == "intensity":
            return (intensity_average(integrals, self.unit) - wanted) ** 2
        return log_squares(integrals, wanted, times)


@dataclass(frozen=True, eq=False)
class ExposureRays:
    """The rays of one frame's pixels.

    - pose (C, 12): the pose of each time cell, in units of half the volume's longest side about the volume's centre.
    - cell (K, lines): the number of the time cell for each of a line's K times. All times have equal weights.
    - axis: whether lines are rows or columns. is_parallel: poses begin with the direction of the rays."""

    pose: np.ndarray
    cell: np.ndarray
    axis: str
    is_parallel: bool = False

    @classmethod
    def of_cells(cls, table: TimeCells, grid: Grid) -> "ExposureRays":
        """Returns the rays of time cells of fixed pose in mm, for a volume on ``grid`` in mm.

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
        return len(self.cell)

    def __call__(self, pixels: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the sources and unit directions (R, s, 3) of s rays for each of R pixels. pixels (R, 2): row and column.
        times (R, s): which of a line's K times each ray has.

        The source of a parallel ray is a point on the ray in front of the volume."""
        rows, columns = pixels.T
        line = rows if self.axis == "rows" else columns
        pose = self.pose[self.cell[times, line[:, None]]]  # the pose of each ray, (R, s, 12)
        along_row, down = columns[:, None, None], rows[:, None, None]
        centre = pose[..., 3:6] + along_row * pose[..., 6:9] + down * pose[..., 9:12]
        direction = pose[..., :3] if self.is_parallel else centre - pose[..., :3]
        direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        if self.is_parallel:
            depth = np.einsum("rsi,rsi->rs", centre, direction)[..., None]
            return centre - (depth + _BEYOND_VOLUME) * direction, direction
        return pose[..., :3], direction

    def shadow(self, half_sides: np.ndarray, detector_shape: tuple[int, int]) -> tuple[slice, slice]:
        """Returns the rows and columns of all pixels whose rays may meet a box of ``half_sides`` (x, y, z) about 0."""
        corners = np.array(np.meshgrid(*[(-h, h) for h in half_sides], indexing="ij")).reshape(3, -1).T
        source, first, steps = self.pose[:, None, :3], self.pose[:, None, 3:6], self.pose[:, None, 6:12]
        to_corner = corners - source  # from each source to each corner of the box, (C, 8, 3)
        along, to_first = (source, first - corners) if self.is_parallel else (to_corner, first - source)
        matrix = np.stack(np.broadcast_arrays(along, -steps[..., :3], -steps[..., 3:]), -1)
        try:
            place = np.linalg.solve(matrix, to_first[..., None])[..., 0]
        except np.linalg.LinAlgError:
            place = np.full(to_corner.shape, np.nan)
        scale, column, row = np.moveaxis(place, -1, 0)
        is_behind = not self.is_parallel and np.any(scale <= 0)
        if is_behind or not np.all(np.isfinite(scale)):  # no ray meets some corner: all pixels are taken
            return slice(0, detector_shape[0]), slice(0, detector_shape[1])
        return _within(row, detector_shape[0]), _within(column, detector_shape[1])


def _within(place: np.ndarray, count: int) -> slice:
    first = int(np.clip(np.floor(place.min()), 0, count - 1))
    return slice(first, int(np.clip(np.ceil(place.max()) + 1, first + 1, count)))


def scattered_pixels(usable: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws up to ``count`` different pixels, (R, 2) row and column, from the ``usable`` ones, bool (rows, columns)."""
    where = np.flatnonzero(usable)
    chosen = rng.choice(where, min(count, where.size), replace=False, shuffle=False)
    return np.stack(np.unravel_index(chosen, usable.shape), -1)


def windows_and_scattered_pixels(
    usable: np.ndarray, count: int, windows: int, edge: int, rng: np.random.Generator
) -> np.ndarray:
    """Draws the pixels (R, 2) of ``windows`` windows of ``edge``² usable pixels, and ``count`` scattered ones outside them.

    Windows are tiles of the frame. If fewer than ``windows`` tiles have only usable pixels, there are fewer windows."""
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
    """Draws ``count`` different numbers from 0 to ``times`` − 1 for each pixel, (pixels, count), all equally likely. If
    ``count`` is at least ``times``, returns all these numbers, (pixels, times)."""
    if count >= times:
        return np.broadcast_to(np.arange(times), (pixels, times))
    return np.argsort(rng.random((pixels, times)), axis=1)[:, :count]


def box_span(
    source: torch.Tensor, direction: torch.Tensor, half_sides: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns at which distance (R,) from its source each ray enters a box of ``half_sides`` (3,) about 0, and its length
    (R,) in the box, 0 if it misses the box. Rays begin at ``source`` (R, 3), and ``direction`` (R, 3) has length 1."""
    tiny = torch.finfo(direction.dtype).tiny
    slope = torch.where(direction.abs() < tiny, torch.full_like(direction, tiny), direction)
    one, other = (-half_sides - source) / slope, (half_sides - source) / slope
    first = torch.minimum(one, other).amax(-1).clamp(min=0)
    last = torch.maximum(one, other).amin(-1)
    return first, (last - first).clamp(min=0)


def sample_shifts(rays: int, samples: int, jitter: str, rng: np.random.Generator) -> np.ndarray:
    """Returns places of samples in their intervals, 0 to 1: (R, samples), or (R, 1) for one place in all of a ray's."""
    if jitter == "none":
        return np.full((rays, 1), 0.5, np.float32)
    return rng.random((rays, samples if jitter == "sample" else 1), np.float32)


def line_integrals(
    field: Field, source: torch.Tensor, direction: torch.Tensor, half_sides: torch.Tensor, samples: int,
    shifts: torch.Tensor,
) -> torch.Tensor:
    """Returns the integrals (R,) of a field along rays (R, 3), with one sample in each of ``samples`` intervals in the box.

    ``shifts``: what ``sample_shifts`` returns. If they are drawn uniformly, the expected result is the exact integral."""
    first, length = box_span(source, direction, half_sides)
    step = length / samples
    number = torch.arange(samples, dtype=source.dtype, device=source.device)
    distance = first[:, None] + (number + shifts) * step[:, None]
    positions = source[:, None] + distance[..., None] * direction[:, None]
    return field(positions.reshape(-1, 3)).reshape(len(source), samples).sum(1) * step


def intensity_average(integrals: torch.Tensor, unit: float) -> torch.Tensor:
    """Returns the measurement (R,) of a detector that averages intensity, from the line integrals (R, K) at a pixel's K
    times. Both are in multiples of ``unit``."""
    return (math.log(integrals.shape[1]) - torch.logsumexp(-unit * integrals, 1)) / unit


def log_squares(integrals: torch.Tensor, measured: torch.Tensor, times: int) -> torch.Tensor:
    """Returns squared errors (R,) of pixels' means over all K ``times``, estimated from line integrals (R, s) at s times.

    The squared error of a subset's mean is too large by the variance of that mean. This variance is estimated as (1/s − 1/K)
    times the variance of the s values, and subtracted. In expectation, error and gradient are then those of all K times."""
    count = integrals.shape[1]
    squares = (integrals.mean(1) - measured) ** 2
    return squares if count == times else squares - (1 / count - 1 / times) * integrals.var(1, unbiased=True)
