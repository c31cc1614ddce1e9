"""A first comparison of methods: a sweep over fly-scans of two built-in phantoms, in a minute or two."""

from collections.abc import Callable
from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.io.output import make_folder
from phyradgs_cl.reconstructors import usual_preset
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import scanner_for, scanner_options
from phyradgs_cl.workflow.scans import SimulationJob, run_simulation
from phyradgs_cl.workflow.sweep.grid import Setting, SweepGrid, Table

PHANTOMS, VOXELS, PIXELS, ITERATIONS = ("foot", "jaw"), 32, 64, 600
_ROWS: tuple[tuple[str, Table], ...] = (
    ("fdk", {"motion": "static"}),
    ("fista-tv", {"motion": "per-row"}),
    ("fista", {"motion": "static"}),
    ("fista", {"motion": "per-row"}),
    ("r2", {"motion": "static"}),
    ("phyradgs", {"motion": "static"}),
    ("phyradgs", {"motion": "micro-views", "strips": 8, "sub_intervals": 5}),
    ("phyradgs", {"motion": "exact"}),
)


def quick_grid(
    folder: Path, make_runtime: Callable[[], Runtime], *, seed: int = 0, iterations: int = ITERATIONS
) -> SweepGrid:
    """Simulates the missing scans in ``folder``/scans; returns a sweep of every method, with and without motion, over them.
    seed: of noise, cloud and frame order. iterations: of splats. Raises OutputError for a folder that cannot be made."""
    checks.within("--iterations", iterations, 0, 10_000_000)
    settings = []
    for method, motion in _ROWS:
        splats = {"iterations": iterations} if method in ("r2", "phyradgs") else {}
        settings.append(Setting(method, usual_preset(method), {**motion, **splats}, {}))
    scans = {name: folder / "scans" / f"{name}_seed{seed}.h5" for name in PHANTOMS}
    missing = [name for name, path in scans.items() if not path.exists()]
    if missing:
        make_folder(folder / "scans", folder)
        rt = make_runtime()
        for name in missing:
            _simulate(scans[name], name, seed, rt)
    return SweepGrid(tuple(scans.values()), tuple(settings), (seed,))


def _simulate(path: Path, phantom: str, seed: int, rt: Runtime) -> None:
    scanner = scanner_for("r2", PIXELS)
    options = scanner_options(scanner, "rapid", noise="tigre", seed=seed)
    job = SimulationJob(path, phantom=phantom, size=VOXELS)
    run_simulation(job, scanner, options, rt, lambda done, total: None)
