"""Fits a field to a scan's rays, step by step. The state between two steps can be stored."""

import json

import numpy as np
import torch

from phyradgs_cl.acquisition import OwnTimes, PerRow, Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.neural import rays
from phyradgs_cl.neural.field import NeuralField, repeatable, to_array, to_tensor, voxel_values
from phyradgs_cl.neural.options import LineOptions, NeuralOptions

_BETAS, _EPSILON = (0.9, 0.999), 1e-8  # Adam's decay rates of both moments, and the addend to its denominator
_POINTS_ON_CPU = 2**14  # most points at which a CPU evaluates the field at once: as many as its cache holds
_POINTS_ELSEWHERE = 2**20  # most points at which another device evaluates the field at once: as many as a GPU holds


class Trainer:
    """Fits a field to a scan's rays. Holds the field, its optimiser and the random draws, which change from step to step.

    Lengths are in units of half the volume's longest side, attenuation in units of ``density_per_mm``."""

    def __init__(
        self, scan: Scan, options: NeuralOptions, field: NeuralField, device: torch.device,
        density_per_mm: float, seed: int,
    ) -> None:
        self.scan, self.options, self.device = scan, options, device
        self.field = field.to(device)
        self.density_per_mm = density_per_mm
        self.unit = density_per_mm * scan.grid.half_longest_mm  # unit of line integrals
        self.rng = np.random.default_rng(seed)
        motion = options.motion
        if type(motion) is PerRow:  # the field evaluates single rays, so common times would save nothing
            motion = OwnTimes(motion.of(scan).sub_intervals)
        tables = [motion.cells(scan, frame).still() for frame in range(scan.frames)]
        self.rays = [rays.ExposureRays.of_cells(table, scan.grid) for table in tables]
        times = self.rays[0].times
        stated = scan.detector_model if options.detector_model == "scan" else options.detector_model
        self.model = stated if times > 1 else "log"  # with a single value both models agree
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
    def passes(self) -> int:
        """The number of whole passes over the frames so far."""
        return self.steps // self.scan.frames

    @property
    def parameters(self) -> int:
        """The number of fitted parameters."""
        return sum(p.numel() for p in self.field.parameters())

    def step(self) -> None:
        """Draws pixels of one frame, steps down the gradient of their squared error, and appends the loss to ``losses``."""
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

    def volume(self, grid: Grid) -> np.ndarray:
        """Returns the field in the voxels (nz, ny, nx) of the scan's grid in mm, in 1/mm."""
        unit_grid = Grid(grid.shape, grid.scaled(1 / grid.half_longest_mm).voxel_size_mm)
        points = self.options.voxel_points
        values = voxel_values(self.field, unit_grid, self.device, self.points_at_once, points)
        return values * np.float32(self.density_per_mm)

    def state(self) -> dict[str, np.ndarray]:
        """Returns the arrays that the next step depends on, and the losses of the pass so far."""
        moments = [self._flat([self._moments(p)[k] for p in self.field.parameters()]) for k in range(2)]
        return {
            "parameters": self._flat([p.detach() for p in self.field.parameters()]),
            "moments": np.stack(moments),
            "steps": np.array(self.steps),
            "updates": np.array(self.updates),
            "queue": np.array(self.queue, np.int64),
            "rng": np.array(json.dumps(self.rng.bit_generator.state)),
            "losses": np.array(self.losses, np.float64),
        }

    def restore(self, parameters: np.ndarray, moments: np.ndarray, updates: int) -> None:
        """Sets the field's values (n,) and Adam's moments (2, n) after this number of ``updates``."""
        first = 0
        with torch.no_grad():
            for p in self.field.parameters():
                part = slice(first, first + p.numel())
                p.copy_(to_tensor(parameters[part], self.device).reshape(p.shape))
                mean, square = (to_tensor(m[part], self.device).reshape(p.shape) for m in moments)
                if updates:
                    step = torch.tensor(float(updates))
                    self._adam.state[p] = {"step": step, "exp_avg": mean, "exp_avg_sq": square}
                first += p.numel()
        self.updates = updates

    def _shuffled(self) -> list[int]:
        return self.rng.permutation(self.scan.frames).tolist()

    def _rate(self) -> float:
        options = self.options
        if options.rate_step:
            return options.rate * options.rate_factor ** (self.passes // options.rate_step)
        return options.rate * options.rate_factor ** (self.steps / (options.iterations * self.scan.frames))

    def _pixels(self, frame: int) -> np.ndarray:
        """Returns the pixels (R, 2) of a frame that may be used and whose rays can meet the volume."""
        scan, options = self.scan, self.options
        usable = np.zeros(scan.geometry.detector_shape, bool)
        usable[self._shadows[frame]] = True
        if scan.pixel_mask is not None:
            mask = np.asarray(scan.pixel_mask)
            usable &= (mask[frame] if mask.ndim == 3 else mask) == 0
        if options.positive_only:
            usable &= scan.projections[frame] > 0
        if isinstance(options, LineOptions):
            return rays.windows_and_scattered_pixels(
                usable, options.rays, options.windows, options.window, self.rng
            )
        return rays.scattered_pixels(usable, options.rays, self.rng)

    def _loss_and_gradient(self, frame: int, pixels: np.ndarray) -> float:
        """Returns the mean squared error in internal units. Its gradient is added up in the parameters."""
        exposure = self.rays[frame]
        times = rays.chosen_times(len(pixels), exposure.times, self.times, self.rng)
        shifts = rays.sample_shifts(times.size, self.samples, self.options.jitter, self.rng)
        shifts = shifts.reshape(*times.shape, -1)
        measured = self.scan.projections[frame][tuple(pixels.T)].astype(np.float32) / np.float32(self.unit)
        # Gradients of chunks add up to the whole gradient; a chunk needs less memory.
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
        """Returns the squared errors (R,) of pixels with rays (R, s, 3) at some of their ``times``."""
        from_, along, shift = (
            to_tensor(a.reshape(-1, a.shape[-1]).astype(np.float32), self.device)
            for a in (source, direction, shifts)
        )
        integrals = rays.line_integrals(self.field, from_, along, self._half_sides, self.samples, shift)
        integrals = integrals.reshape(source.shape[:2])
        wanted = to_tensor(measured, self.device)
        if self.model == "intensity":
            return (rays.intensity_average(integrals, self.unit) - wanted) ** 2
        return rays.log_squares(integrals, wanted, times)

    def _moments(self, parameter: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        state = self._adam.state.get(parameter)
        if not state:
            return torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state["exp_avg"], state["exp_avg_sq"]

    @staticmethod
    def _flat(tensors: list[torch.Tensor]) -> np.ndarray:
        return np.concatenate([to_array(t).ravel() for t in tensors])
