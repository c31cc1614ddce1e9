"""The scan and the runs of splats that ranks share, as threads (test_shared_runs.py) and under MPI (mpi_work.py); laws of
splatting are asked of the same scan."""

import numpy as np

from phyradgs_cl.acquisition import ConeGeometry, MicroViews, Protocol, Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.optim import DensityControl
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.splats.method import SplatRun
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.start import first_population, internal_scale
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

CONTROL = DensityControl(every=6, start_iteration=5, threshold=1e-6)
OPTIONS = SplatOptions(motion=MicroViews(4, 2), iterations=21, gaussians=300, tv_edge=8, batch=4, control=CONTROL)


def small_scan(half_size_mm: float = 1.0) -> Scan:
    """Shepp–Logan, 6 frames of 24² over 20° each; attenuation goes as one over the size."""
    pitch_mm = 3.9 / 24 * half_size_mm
    geometry = ConeGeometry(5 * half_size_mm, 7.5 * half_size_mm, (24, 24), (pitch_mm, pitch_mm))
    source = AnalyticSource(shepp_logan(half_size_mm), geometry)
    options = SimulationOptions(Protocol(views=6, exposure_deg=20.0))
    return simulate(source, geometry, Grid.cube(16, 2 * half_size_mm), options)


def started(scan: Scan, options: SplatOptions, rt: Runtime) -> SplatRun:
    fdk = static_fdk(rt, scan)
    scale = internal_scale(fdk, scan.grid)
    rng = np.random.default_rng(1)
    grid = scan.grid.scaled(1 / scale.length_mm)
    population = first_population(fdk / scale.density_per_mm, grid, options, rng)
    return SplatRun(rt, scan, options, scale, population, rng)
