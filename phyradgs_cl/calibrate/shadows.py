"""Computes the expected frames of a phantom of known shape in closed form, each line at its own times."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.detector.attenuation import TRANSMISSION_FLOOR
from phyradgs_cl.phantoms import EllipsoidPhantom

DENSITY = 6  # index in a placement, which is turn (rotation vector, rad), shift (mm), density
_MARGIN = 1.2  # margin of a shadow's half-width, for an oblique panel


@dataclass(frozen=True, eq=False)
class BeadOperator:
    """Frames (F, rows, columns) of a phantom seen along the lines of ``tables``, by a detector of ``model``.

    ``samples``: rays along each side of a pixel. ``clipped_noise``: standard deviation of noise that was clipped at 0; 0
    where none was."""

    phantom: EllipsoidPhantom
    tables: Sequence[TimeCells]
    shape: tuple[int, int]
    model: str
    samples: int
    clipped_noise: float

    def forward(self, placement: np.ndarray) -> np.ndarray:
        """Returns the line integrals of the phantom at a placement (7,)."""
        pose, weight = _poses_by_line(self.tables)
        frames, lines, samples = weight.shape
        turn = Rotation.from_rotvec(placement[:3]).as_matrix()
        places, steps = pose[:, :2] - placement[3:DENSITY], pose[:, 2:]
        if self.tables[0].is_parallel:
            places[:, 0] = pose[:, 0]  # a turn does not move the direction of parallel rays
        is_rows = self.tables[0].axis == "rows"
        panel_lines = _PanelLines(
            source=places[:, 0] @ turn, first=places[:, 1] @ turn, line_step=steps[:, int(is_rows)] @ turn,
            pixel_step=steps[:, 1 - int(is_rows)] @ turn,
            line=np.tile(np.repeat(np.arange(lines), samples), frames),
            pixels=self.shape[1] if is_rows else self.shape[0],
            is_parallel=self.tables[0].is_parallel,
        )
        total = np.zeros((frames, lines, panel_lines.pixels))
        for p in panel_lines.integrals(self.phantom, self.samples):
            p = placement[DENSITY] * p.reshape(frames, lines, samples, -1)
            total += np.einsum("fls,flsp->flp", weight, p if self.model == "log" else np.exp(-p)) / self.samples**2
        expected = total if self.model == "log" else -np.log(np.maximum(total, TRANSMISSION_FLOOR))
        if self.clipped_noise > 0:
            expected = _mean_of_clipped(expected, self.clipped_noise)
        return np.ascontiguousarray(expected if is_rows else expected.swapaxes(1, 2), np.float32)


def _mean_of_clipped(p: np.ndarray, sigma: float) -> np.ndarray:
    """Returns the mean of max(p + noise, 0) for normal noise. Clipping raises air more than faint shadows."""
    ratio = p / sigma
    return p * scipy.special.ndtr(ratio) + sigma * np.exp(-(ratio**2) / 2) / math.sqrt(2 * math.pi)


def _poses_by_line(tables: Sequence[TimeCells]) -> tuple[np.ndarray, np.ndarray]:
    """Returns poses (F · lines · S, 4, 3) and weights (F, lines, S) of every line of every frame, at S times each."""
    poses, weights = [], []
    for table in tables:
        counts = table.line_stop - table.line_start
        cell = np.repeat(np.arange(table.count), counts)
        line = table.line_start[cell] + np.arange(cell.size) - np.repeat(np.cumsum(counts) - counts, counts)
        cell = cell[np.argsort(line, kind="stable")]
        poses.append(table.pose[cell].reshape(-1, 4, 3))
        weights.append(table.weight[cell].reshape(table.lines, -1))
    return np.concatenate(poses), np.stack(weights)


@dataclass(frozen=True, eq=False)
class _PanelLines:
    """N lines of a panel, each at one time, in the phantom's frame of reference.

    - source, first (N, 3): the source and the middle of the panel's first pixel, mm.
    - line_step, pixel_step (N, 3): the steps to the next line and to the next of its ``pixels``. line (N,): the line's
      number.
    - is_parallel: ``source`` is the rays' direction."""

    source: np.ndarray
    first: np.ndarray
    line_step: np.ndarray
    pixel_step: np.ndarray
    line: np.ndarray
    pixels: int
    is_parallel: bool

    def integrals(self, phantom: EllipsoidPhantom, samples: int) -> Iterator[np.ndarray]:
        """Yields line integrals (N, pixels), float32, for each of samples² points of a pixel's area."""
        shadows = [(body, *self._shadow(np.array(body.ends_mm), body.reach_mm)) for body in phantom.ellipsoids]
        offsets = (np.arange(samples) + 0.5) / samples - 0.5
        for across, along in itertools.product(offsets, offsets):
            total = np.zeros((len(self.line), self.pixels), np.float32)
            for body, lines, start, width in shadows:
                pixel = start[:, None] + np.arange(width)
                source = self.source[lines]
                first = self.first[lines] + (self.line[lines, None] + across) * self.line_step[lines]
                first = first if self.is_parallel else first - source
                ray = first[:, None] + (pixel[..., None] + along) * self.pixel_step[lines][:, None]
                starts, rays = np.repeat(source, width, axis=0), ray.reshape(-1, 3)
                if self.is_parallel:  # integrate from one side of the body to the other
                    reach = 2 * (np.abs(rays).max(initial=0.0) + np.abs(body.ends_mm).max() + body.reach_mm)
                    starts, rays = rays - reach * starts, 2 * reach * starts
                fraction = body.chord_fraction(starts, rays)
                value = body.attenuation_per_mm * fraction * np.sqrt(np.einsum("ij,ij->i", rays, rays))
                total[lines[:, None], pixel] += value.reshape(pixel.shape)
            yield total

    @cached_property
    def _panel_axes(self) -> tuple[tuple[np.ndarray, ...], ...]:
        """Vectors (N, 3) whose inner products with a place are its distance from the source (in panel distances), its line
        and its pixel. Each comes with the products of the source and of the first pixel (N,), and with its length (N,).

        In a parallel beam the distance is 1, and lines and pixels are those that a ray through the place meets."""
        normal = np.cross(self.line_step, self.pixel_step)
        to_panel = self.source if self.is_parallel else self.first - self.source
        vectors = [normal / np.sum(normal * to_panel, -1, keepdims=True)]
        vectors += [step / np.sum(step**2, -1, keepdims=True) for step in (self.line_step, self.pixel_step)]
        if self.is_parallel:
            vectors = [vector - np.sum(vector * self.source, -1, keepdims=True) * vectors[0] for vector in vectors]
        products = [[np.sum(vector * place, -1) for place in (self.source, self.first)] for vector in vectors]
        if self.is_parallel:
            products[0][0] = -np.ones(len(self.line))
        return tuple((v, *both, np.linalg.norm(v, axis=-1)) for v, both in zip(vectors, products, strict=True))

    def _shadow(self, ends_mm: np.ndarray, reach_mm: float) -> tuple[np.ndarray, np.ndarray, int]:
        """Returns the lines (n,) that may see a body, the first pixel (n,) in each, and the number of pixels."""
        (depth, depth_of_source, *_), *axes = self._panel_axes
        lowest, highest = [], []
        for end_mm in ends_mm:
            magnification = 1 / (depth @ end_mm - depth_of_source)
            for vector, of_source, of_first, per_mm in axes:
                centre = of_source - of_first + magnification * (vector @ end_mm - of_source)
                reach = _MARGIN * reach_mm * np.abs(magnification) * per_mm + 1
                lowest.append(centre - reach)
                highest.append(centre + reach)
        line_from, pixel_from = (np.minimum(lowest[k], lowest[k + 2]) for k in (0, 1))
        line_to, pixel_to = (np.maximum(highest[k], highest[k + 2]) for k in (0, 1))
        lines = np.flatnonzero(
            (self.line >= line_from) & (self.line <= line_to) & (pixel_to >= 0) & (pixel_from <= self.pixels - 1)
        )
        first = np.clip(np.floor(pixel_from[lines]), 0, self.pixels - 1).astype(int)
        last = np.clip(np.ceil(pixel_to[lines]), 0, self.pixels - 1).astype(int)
        width = int((last - first).max(initial=0)) + 1
        return lines, np.minimum(first, self.pixels - width), width
