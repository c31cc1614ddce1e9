"""The scan and the runs of splats that ranks share, as threads (test_shared_runs.py) and under MPI (mpi_work.py)."""

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


def small_scan() -> Scan:
    geometry = ConeGeometry(5, 7.5, (24, 24), (3.9 / 24, 3.9 / 24))
    source = AnalyticSource(shepp_logan(1.0), geometry)
    options = SimulationOptions(Protocol(views=6, exposure_deg=20.0))
    return simulate(source, geometry, Grid.cube(16, 2.0), options)


def started(scan: Scan, options: SplatOptions, rt: Runtime) -> SplatRun:
    fdk = static_fdk(rt, scan)
    scale = internal_scale(fdk, scan.grid)
    rng = np.random.default_rng(1)
    grid = scan.grid.scaled(1 / scale.length_mm)
    population = first_population(fdk / scale.density_per_mm, grid, options, rng)
    return SplatRun(rt, scan, options, scale, population, rng)
