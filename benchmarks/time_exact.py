"""Measures error and cost of three ways to project a moving gantry: static, M×N micro-views, and splats exact in time.

    python benchmarks/time_exact.py [--detector 512] [--gaussians 20000] [--repeats 7] [--device D] [--json FILE]

One frame of the rapid protocol (14.4° of exposure, readout 0.86 of it). Errors are relative (RMS over RMS) to a reference
that takes every row at --samples times of its own exposure: the mean over single random Gaussians with scales of 0.5 to
4 % of the half-width, and that of a Shepp-Logan cloud. Costs are of another cloud, of scales of 0.8 to 3 %: the smallest
time of several runs in turn, of all kernels forward and backward: on CPUs processor time, which other programs disturb
little, on GPUs the kernels'.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from measuring import finish, parser_of, random_cloud

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, make_protocol
from phyradgs_cl.acquisition.cells import (
    exact_cells,
    micro_view_cells,
    per_line_cells,
    segments_for,
    static_cells,
)
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector
from phyradgs_cl.reconstructors.splats.start import initial_cloud
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import pad_rows
from phyradgs_cl.simulation import phantom_scene

MICRO_VIEWS = ((8, 5), (16, 5), (16, 15))
BOUNDS = (0.02, 0.01, 0.007, 0.005, 0.002, 0.001)
SEGMENTS = (2, 3, 4, 6, 8)
SCALES = (0.008, 0.03)  # scales of the timed cloud
FINE_BOUND = 0.001  # bound of the rules, where K is given
_FOOTPRINTS = 12_000_000  # Gaussians in cells at one time, for the reference


@dataclass(frozen=True)
class Model:
    """One way to see the frame: its time cells and the bound of its rules."""

    name: str
    table: TimeCells
    time_error: float = 0.005


def models_of(where: tuple) -> list[Model]:
    """``where``: trajectory, shutter, frame, start in seconds, lines."""
    found = [Model("static", static_cells(*where))]
    found += [Model(f"micro-views {m}x{n}", micro_view_cells(*where, m, n)) for m, n in MICRO_VIEWS]
    for bound in BOUNDS:
        table = exact_cells(*where, segments_for(*where[:4], bound))
        found.append(Model(f"exact, bound {bound:g}", table, bound))
    found += [Model(f"exact, K = {k}", exact_cells(*where, k), FINE_BOUND) for k in SEGMENTS]
    return found


def shepp_logan_cloud(rt: Runtime, geometry: ConeGeometry, count: int, edge: int = 64) -> np.ndarray:
    """Returns Gaussians (11, G) drawn from a voxelised Shepp-Logan head, as the first cloud of a reconstruction is."""
    grid = Grid.cube(edge, 2.0)
    scene = phantom_scene(rt, "shepp-logan", geometry, grid, edge, "rows", 0)
    usual = {"threshold": 0.05, "density_share": 0.15, "scale_bounds": (0.001, 1.0), "scale_factor": 1.0}
    cloud = initial_cloud(scene.reference, grid, count, **usual, rng=np.random.default_rng(0))
    rows = cloud.rows()
    return rows[:, np.argsort(rows[2])]


def reference_frame(rt: Runtime, rows: np.ndarray, table: TimeCells, width: int) -> np.ndarray:
    """Returns the frame (lines, width) of a table with many cells, a batch of Gaussians at a time."""
    projector, cells = SplatProjector(rt, table.lines, width), DeviceCells.upload(rt, table)
    step = max(_FOOTPRINTS // table.count // 16, 1) * 16
    frame = np.zeros((table.lines, width))
    for first in range(0, rows.shape[1], step):
        frame += projector.project(rows[:, first : first + step], cells)
    return frame


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def errors(
    rt: Runtime, models: list[Model], reference: TimeCells, clouds: list[np.ndarray]
) -> dict[str, float]:
    """Returns the mean over the clouds of each model's relative error."""
    width = reference.lines
    expected = [reference_frame(rt, rows, reference, width) for rows in clouds]
    found = {}
    for model in models:
        projector = SplatProjector(rt, width, width, time_error=model.time_error)
        cells = DeviceCells.upload(rt, model.table)
        each = [relative(projector.project(rows, cells), e) for rows, e in zip(clouds, expected, strict=True)]
        found[model.name] = float(np.mean(each))
    return found


class Bench:
    """A model ready to run forward and backward on one cloud."""

    def __init__(self, rt: Runtime, model: Model, gaussians: DeviceGaussians, by_image: DeviceArray) -> None:
        self.rt, self.gaussians, self.by_image = rt, gaussians, by_image
        lines = model.table.lines
        self.projector = SplatProjector(rt, lines, lines, time_error=model.time_error)
        self.cells = DeviceCells.upload(rt, model.table)
        self.gradients = rt.zeros((13, gaussians.stride))
        self.best = {"forward": np.inf, "backward": np.inf}

    def forward(self) -> None:
        self.projector.forward(self.gaussians, self.cells)

    def backward(self) -> None:
        self.projector.backward(self.gaussians, self.cells, self.by_image, self.gradients)

    def run(self, keep: bool) -> None:
        for name, call in (("forward", self.forward), ("backward", self.backward)):
            seconds = self._seconds(call)
            if keep:
                self.best[name] = min(self.best[name], seconds)

    def _seconds(self, call: Callable[[], None]) -> float:
        """Returns processor time on CPUs, kernel time on GPUs."""
        self.rt.kernel_uses()
        started = time.process_time()
        call()
        kernels = sum(use.seconds for use in self.rt.kernel_uses().values())
        return kernels if self.rt.pixel_items else time.process_time() - started

    def facts(self) -> dict[str, object]:
        return {
            "poses": self.cells.count,
            "forward_ms": 1e3 * self.best["forward"],
            "backward_ms": 1e3 * self.best["backward"],
        }


def costs(rt: Runtime, models: list[Model], count: int, repeats: int) -> dict[str, dict[str, object]]:
    rng = np.random.default_rng(2)
    lines = models[0].table.lines
    gaussians = DeviceGaussians.upload(rt, random_cloud(count, SCALES, rng))
    by_image = rt.upload(pad_rows(rng.normal(size=(lines, lines))))
    benches = {m.name: Bench(rt, m, gaussians, by_image) for m in models}
    for repeat in range(repeats + 1):
        for bench in benches.values():
            bench.run(keep=repeat > 0)
    result = {}
    for name, bench in benches.items():
        bench.forward()
        result[name] = bench.facts()
    return result


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--detector", type=int, default=512)
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--singles", type=int, default=24, help="random Gaussians whose errors are averaged")
    parser.add_argument("--cloud", type=int, default=2000, help="Gaussians of the Shepp-Logan cloud")
    parser.add_argument("--samples", type=int, default=200, help="times per row of the reference")
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    rt = Runtime(arguments.device, profile=True)
    n = arguments.detector
    geometry, protocol = ConeGeometry(5.0, 7.0, (n, n), (4.0 / n,) * 2), make_protocol("rapid")
    orbit = protocol.orbit(geometry)
    assert isinstance(orbit, CircularOrbit)
    where = (orbit, protocol.shutter(), 0, 0.0, n)
    models, reference = models_of(where), per_line_cells(*where, arguments.samples)
    singles = random_cloud(arguments.singles, (0.005, 0.04), np.random.default_rng(1))
    by_gaussian = errors(rt, models, reference, list(singles.T[..., None]))
    by_cloud = errors(rt, models, reference, [shepp_logan_cloud(rt, geometry, arguments.cloud)])
    rows = costs(rt, models, arguments.gaussians, arguments.repeats)
    for name, row in rows.items():
        row |= {"error_gaussians": by_gaussian[name], "error_shepp_logan": by_cloud[name]}
    path = arguments.json
    facts = {name: value for name, value in vars(arguments).items() if name not in ("json", "quick")}
    finish({"device": rt.device.name, "lanes": rt.lanes, **facts, "models": rows}, path)


if __name__ == "__main__":
    main()
