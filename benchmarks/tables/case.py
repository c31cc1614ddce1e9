"""Cases: one object scanned by one protocol with one seed, by a moving gantry and by one at rest, and their scores."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan
from phyradgs_cl.acquisition.cells import static_cells
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import compare
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import FrameSource, Scene, SimulationOptions, VolumeSource, simulate
from tables.metrics import compare_projections

FLY, STILL = "fly-scan", "stop-and-shoot"


def stop_and_shoot(protocol: Protocol) -> Protocol:
    """Returns the stop-and-shoot protocol at the mid-window angles of a fly-scan."""
    return replace(protocol, is_fly=False)


def held_out(protocol: Protocol) -> Protocol:
    """Returns stop-and-shoot poses half-way between the mid-window angles of a scan."""
    return replace(protocol, is_fly=False, start_deg=protocol.start_deg + protocol.step_deg / 2)


class HeldOutViews:
    """Noise-free projections of the truth between the training angles, and of results from the same poses."""

    def __init__(
        self,
        rt: Runtime,
        source: FrameSource,
        geometry: ConeGeometry,
        grid: Grid,
        protocol: Protocol,
        axis: str,
    ) -> None:
        shutter, start_s = protocol.shutter(axis), protocol.frame_start_s()
        orbit, lines = held_out(protocol).orbit(geometry), shutter.lines(geometry.detector_shape)
        self._cells = [
            static_cells(orbit, shutter, f, float(start_s[f]), lines) for f in range(protocol.views)
        ]
        self._rt, self._geometry, self._grid, self._axis = rt, geometry, grid, axis
        self._reference = self._project(source)

    def measure(self, volume: np.ndarray) -> dict[str, float]:
        """Returns the 2D PSNR and SSIM of a result (z, y, x) in 1/mm."""
        source = VolumeSource(self._rt, volume, self._grid, self._geometry, self._axis)
        return compare_projections(self._project(source), self._reference)

    def _project(self, source: FrameSource) -> np.ndarray:
        return np.stack([source.frame(cells, "log", 1.0) for cells in self._cells])


class SyntheticCase:
    """A volume on the published scanner with TIGRE's noise. Scans are made when they are first asked for."""

    def __init__(
        self, rt: Runtime, scene: Scene, geometry: ConeGeometry, protocol: Protocol, axis: str, seed: int
    ) -> None:
        self._rt, self._scene, self._geometry = rt, scene, geometry
        self._protocol, self._axis, self._seed = protocol, axis, seed
        self._scans: dict[str, Scan] = {}
        self._views: HeldOutViews | None = None
        self.truth = scene.reference

    def scan(self, acquisition: str) -> Scan:
        """Returns the scan of one acquisition, with noise."""
        if acquisition not in self._scans:
            moving = acquisition == FLY
            options = SimulationOptions(
                protocol=self._protocol if moving else stop_and_shoot(self._protocol),
                readout_axis=self._axis,
                noise="tigre",
                seed=self._seed,
            )
            where = (self._scene.source, self._geometry, self._scene.grid, options)
            self._scans[acquisition] = simulate(*where, reference=self.truth, title=self._scene.title)
        return self._scans[acquisition]

    def measure(self, volume: np.ndarray) -> dict[str, float]:
        """Returns 3D PSNR and SSIM against the truth, and 2D ones against held-out views."""
        if self._views is None:
            where = (self._geometry, self._scene.grid, self._protocol, self._axis)
            self._views = HeldOutViews(self._rt, self._scene.source, *where)
        return {**compare(volume, self.truth), **self._views.measure(volume)}

    def warn_of_inverse_crime(self) -> None:
        """Warns where the volume's file has no more voxels than the benchmark's grid."""
        self._scene.warn_of_inverse_crime()
