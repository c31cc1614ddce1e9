"""Slabs of a parallel scan: the volume of the whole scan, rows read alone, an interrupted run that continues."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from tolerances import FLOAT32

from phyradgs_cl import api
from phyradgs_cl.acquisition import CircularOrbit, ConstantSpeed, ParallelGeometry, PerRow, Scan, Shutter
from phyradgs_cl.acquisition.slabs import slab
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_volume, write_scan
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors.plan import plan_run
from phyradgs_cl.workflow import load_scan, run_reconstruction
from phyradgs_cl.workflow.slabs import Slabs, rows_of, surely_fits

pytestmark = pytest.mark.slow
ROWS, SIDE, VIEWS = 26, 24, 30
GRID = Grid((24, SIDE, SIDE), (0.08, 0.08, 0.08), (0.02, 0.0, 0.0))


@pytest.fixture(scope="module")
def path(rt, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fly-scan whose rows are read over most of a frame, last row first."""
    geometry = ParallelGeometry((ROWS, SIDE), 0.08, (0.03, 0.01))
    orbit, shutter = CircularOrbit(geometry, ConstantSpeed(0.2, np.pi / VIEWS)), Shutter(0.4, 0.5, "rows", -1)
    start_s, path = np.arange(float(VIEWS)), tmp_path_factory.mktemp("slabs") / "scan.h5"
    scan = Scan(np.zeros((VIEWS, ROWS, SIDE), np.float32), geometry, orbit, shutter, start_s, GRID)
    tables = [PerRow().cells(scan, f) for f in range(VIEWS)]
    frames = RayOperator(rt, GRID, (ROWS, SIDE), tables).forward(shepp_logan(0.9).voxelise(GRID))
    write_scan(path, Scan(frames, geometry, orbit, shutter, start_s, GRID))
    return path


@pytest.mark.parametrize(
    ("method", "options", "limit"),
    [("fbp", {"motion": api.LineMiddles()}, FLOAT32), ("fista", {"iterations": 6}, 0.03)],
)
def test_slabs_make_up_the_volume_of_the_whole_scan(rt, path: Path, tmp_path: Path, method, options, limit) -> None:
    """FBP: the same. ``fista``: the prior's weight and the subsets' order follow the noise of the rows that are read."""
    plan, volumes = plan_run(method, options), []
    for name, slabs in {"whole": Slabs(), "slabs": Slabs(None, 9), "rows": Slabs((9, 18), 0)}.items():
        run_reconstruction(plan, path, tmp_path / f"{name}.h5", lambda: rt, slabs=slabs)
        volumes.append(read_volume(tmp_path / f"{name}.h5"))
    whole, joined, rows = volumes
    peak = whole.values.max()
    assert joined.grid == whole.grid and np.abs(joined.values - whole.values).max() <= limit * peak
    part = rows.grid.slices_in(whole.grid)
    assert part is not None and np.abs(rows.values - whole.values[part]).max() <= limit * peak
    assert not list(tmp_path.glob("*.slabs"))


def test_an_interrupted_run_continues_with_the_slabs_that_it_lacks(rt, path: Path, tmp_path: Path) -> None:
    plan, output, seen = plan_run("sirt", {"iterations": 3}), tmp_path / "v.h5", []

    def stop_in_the_second(progress) -> None:
        seen.append(progress.quantity)
        if "slab 2" in progress.quantity and len(seen) < 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_reconstruction(plan, path, output, lambda: rt, stop_in_the_second, slabs=Slabs(None, 9))
    assert [one.name for one in (tmp_path / "v.h5.slabs").glob("*.npy")] == ["0-9.npy"] and not output.exists()
    seen.extend([""] * 100)
    with pytest.raises(InputError, match="other slabs"):
        run_reconstruction(plan, path, output, lambda: rt, resume=True, slabs=Slabs(None, 8))
    run_reconstruction(plan, path, output, lambda: rt, stop_in_the_second, resume=True, slabs=Slabs(None, 9))
    assert not any("slab 1" in quantity for quantity in seen[100:])
    run_reconstruction(plan, path, tmp_path / "w.h5", lambda: rt, slabs=Slabs(None, 9))
    np.testing.assert_array_equal(read_volume(output).values, read_volume(tmp_path / "w.h5").values)


def test_rows_are_read_without_the_others_and_bad_ones_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken, own = [], h5py.Dataset.__getitem__
    with monkeypatch.context() as patch:
        patch.setattr(h5py.Dataset, "__getitem__", lambda self, key: taken.append((self.name, key)) or own(self, key))
        load_scan(path, rows=(4, 6))
    frames = [key for name, key in taken if name.endswith("detector/data")]
    assert frames == [(..., slice(4, 6), slice(None))], frames
    scan = load_scan(path)
    for first, stop in ((5, 5), (-1, 3), (3, 27)):
        with pytest.raises(InputError, match="--rows"):
            slab(scan, first, stop)
    with pytest.raises(InputError, match="--rows"):
        rows_of("3-9")


def test_a_scan_beyond_the_memory_is_cut_by_itself(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scan = load_scan(path)
    assert Slabs().of(scan) == []
    monkeypatch.setattr("phyradgs_cl.workflow.slabs.host_bytes", lambda: 2 * 4 * 4 * VIEWS * SIDE * 20)  # 20 rows of 26
    assert Slabs().of(scan) == [(0, 12), (12, 24), (24, 26)] and not surely_fits(path)
    poses = np.concatenate([scan.trajectory.pose(f, scan.frame_start_s[[f]]) for f in range(VIEWS)])
    poses[::2, 5] += 0.01
    assert Slabs().of(Scan.from_poses(scan.projections, poses, GRID, is_parallel=True)) == []  # slices may need other rows
