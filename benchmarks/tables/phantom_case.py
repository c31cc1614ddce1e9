"""The paper's real-phantom study, simulated: a double-layer sphere phantom on a C-arm, scored against a pseudo-truth.

64 stop-and-shoot projections reconstructed with R2-Gaussian are the reference that a real study has. Here the true phantom
is known as well, and the beads give roundness, edge sharpness and bias."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from phyradgs_cl import resource
from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import load_scanner, with_detector_count
from phyradgs_cl.metrics import compare
from phyradgs_cl.phantoms import EllipsoidPhantom, sphere_phantom
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate
from tables.case import FLY, HeldOutViews, stop_and_shoot
from tables.metrics import Bead, edge_sharpness, regional_bias, roundness
from tables.raw_counts import Panel, measured_attenuation
from tables.sizes import BenchSize

PSEUDO = "pseudo-truth"
PSEUDO_VIEWS = 64
PANEL = Panel()
JITTER_DEG = 0.1  # wander of the gantry about constant speed, which the encoder records
DETECTOR_OFFSET_MM = (1.3, -2.1)
# Beads of 0.04/mm, as aluminium has near 80 keV, in a holder of 0.006/mm.
_ATTENUATION_FACTOR = 4.0
HOLDER, BEADS = 1, 2


class PhantomCase:
    """The sphere phantom on the C-arm of ``data/carm.toml``. ``pseudo_truth`` is asked for when results are scored."""

    def __init__(
        self,
        rt: Runtime,
        size: BenchSize,
        protocol: Protocol,
        axis: str,
        seed: int,
        pseudo_truth: Callable[[], np.ndarray],
    ) -> None:
        self._rt, self._protocol, self._axis, self._seed = rt, protocol, axis, seed
        self.geometry, self.grid = c_arm(size)
        self.phantom = phantom_in(self.grid)
        self._source = AnalyticSource(self.phantom, self.geometry)
        self._pseudo_truth = pseudo_truth
        self._scans: dict[str, Scan] = {}
        self._views: HeldOutViews | None = None
        self.truth = self.phantom.voxelise(self.grid, 4)

    def scan(self, acquisition: str) -> Scan:
        """Returns the fly-scan, the stop-and-shoot scan at its mid-window angles, or the scan of the pseudo-truth."""
        if acquisition not in self._scans:
            self._scans[acquisition] = self._measured(acquisition)
        return self._scans[acquisition]

    def measure(self, volume: np.ndarray) -> dict[str, float]:
        """Returns numbers against the pseudo-truth (…_pseudo) and the truth, on held-out views, and of the beads' shape."""
        if self._views is None:
            where = (self.geometry, self.grid, self._protocol, self._axis)
            self._views = HeldOutViews(self._rt, self._source, *where)
        against = {f"{name}_pseudo": value for name, value in compare(volume, self._pseudo_truth()).items()}
        return {**compare(volume, self.truth), **against, **self._views.measure(volume), **self.shape(volume)}

    def shape(self, volume: np.ndarray) -> dict[str, float]:
        """Returns roundness, edge rise and bias of a volume (z, y, x)."""
        beads = beads_of(self.phantom)
        bias = regional_bias(volume, self.truth, self._labels())
        return {
            **roundness(volume, self.grid, beads),
            **edge_sharpness(volume, self.grid, beads),
            "bias_balls": bias.get(BEADS, np.nan),
            "bias_holder": bias.get(HOLDER, np.nan),
        }

    def references(self) -> dict[str, Callable[[], dict[str, float]]]:
        """Returns the truth's own shape, which voxels limit, and the pseudo-truth's distance from it."""
        return {"truth": lambda: self.shape(self.truth), PSEUDO: self._measure_pseudo}

    def _measure_pseudo(self) -> dict[str, float]:
        numbers = self.measure(self._pseudo_truth())
        return {name: value for name, value in numbers.items() if not name.endswith("_pseudo")}

    def _labels(self) -> np.ndarray:
        """Returns labels (z, y, x): 1 in voxels of holder alone, 2 in those of beads alone, 0 in mixed voxels and air."""
        holder = self.phantom.ellipsoids[0].attenuation_per_mm
        bead = holder + self.phantom.ellipsoids[1].attenuation_per_mm
        labels = np.zeros(self.truth.shape, np.int8)
        labels[np.isclose(self.truth, holder, rtol=1e-4)] = HOLDER
        labels[np.isclose(self.truth, bead, rtol=1e-4)] = BEADS
        return labels

    def _measured(self, acquisition: str) -> Scan:
        protocol = self._protocol if acquisition == FLY else stop_and_shoot(self._protocol)
        if acquisition == PSEUDO:
            protocol = replace(protocol, views=PSEUDO_VIEWS)
        options = SimulationOptions(
            protocol=protocol,
            readout_axis=self._axis,
            detector_model="intensity",
            jitter_deg=JITTER_DEG if acquisition == FLY else 0.0,
            seed=self._seed,
        )
        title = f"sphere phantom, {acquisition}"
        scan = simulate(self._source, self.geometry, self.grid, options, reference=self.truth, title=title)
        rng = np.random.default_rng([self._seed, 1])  # jitter has drawn from the first stream
        frames, unusable = measured_attenuation(scan.projections, PANEL, rng)
        mask = unusable.astype(np.uint8) if unusable.any() else None
        return replace(scan, projections=frames, pixel_mask=mask)


def c_arm(size: BenchSize) -> tuple[ConeGeometry, Grid]:
    """Returns the C-arm of ``data/carm.toml`` with the size's pixels and a shifted panel, and the grid on its box."""
    scanner = load_scanner("carm", resource("data"))
    panel = with_detector_count(scanner.geometry, size.pixels, size.pixels)
    geometry = replace(panel, detector_offset_mm=DETECTOR_OFFSET_MM)
    return geometry, Grid.cube(size.voxels, max(scanner.grid.size_mm))


def phantom_in(grid: Grid) -> EllipsoidPhantom:
    """Returns the sphere phantom in the box of a grid, as dense as metal in plastic."""
    phantom = sphere_phantom(grid.half_longest_mm)
    bodies = (
        replace(e, attenuation_per_mm=_ATTENUATION_FACTOR * e.attenuation_per_mm) for e in phantom.ellipsoids
    )
    return EllipsoidPhantom(tuple(bodies), phantom.name)


def beads_of(phantom: EllipsoidPhantom) -> list[Bead]:
    """Returns the beads of the sphere phantom: every body but the first, which holds them."""
    return [Bead(e.centre_mm, e.semi_axes_mm[0]) for e in phantom.ellipsoids[1:]]
