"""What is done to frames before a method sees them: lag undone or ignored, and the median filter."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from tolerances import FLOAT32

from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan
from phyradgs_cl.detector.effects import lagged
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors import Preprocessing, plan_run, preprocessing_of, reconstruct
from phyradgs_cl.reconstructors.checkpoint import RUN, with_identity
from phyradgs_cl.reconstructors.preprocess import prepared
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

pytestmark = pytest.mark.slow

GEOMETRY = ConeGeometry(5.0, 7.0, (16, 16), (0.25, 0.25))


@pytest.fixture(scope="module")
def scan() -> Scan:
    options = SimulationOptions(protocol=Protocol(views=6, exposure_deg=10.0), peak=3.0)
    grid = Grid.cube(12, 2.0)
    return simulate(AnalyticSource(shepp_logan(1.0), GEOMETRY), GEOMETRY, grid, options)


@pytest.mark.parametrize("method", ["FDK", "Fista-TV", "phyradgs"])
def test_a_grid_that_is_chosen_is_the_scans_for_every_method(rt, scan, method) -> None:
    """Bit for bit, and the volume has it; methods are named in any case."""
    few = {} if method == "FDK" else {"iterations": 2}
    chosen = {"size": (8, 9, 10), "roi_mm": (-0.8, 0.7, -0.9, 0.9, -1.0, 0.9)}
    found = reconstruct(scan, plan_run(method, few | chosen), rt)
    other = reconstruct(replace(scan, grid=Preprocessing(**chosen).of(scan.grid)), plan_run(method, few), rt)
    assert found.grid == other.grid and found.grid.shape == found.volume.shape == (8, 9, 10)
    np.testing.assert_array_equal(found.volume, other.volume)


def test_lag_is_undone_unless_it_is_to_be_ignored(rt, scan) -> None:
    slow = replace(scan, projections=lagged(scan.projections, 0.2).astype(np.float32), lag=0.2)
    assert prepared(slow, Preprocessing(ignore_lag=True)) is slow and prepared(scan, Preprocessing()) is scan
    undone = prepared(slow, Preprocessing()).projections
    np.testing.assert_allclose(undone, scan.projections, atol=FLOAT32 * np.exp(3.0))
    cases = (scan, Preprocessing()), (slow, Preprocessing()), (slow, Preprocessing(ignore_lag=True))
    volumes = [reconstruct(s, replace(plan_run("fdk"), preprocessing=before), rt).volume for s, before in cases]
    undone, ignored = (np.abs(volume - volumes[0]).max() for volume in volumes[1:])
    assert undone < 1e-3 * np.abs(volumes[0]).max() < ignored


def test_options_by_name() -> None:
    assert preprocessing_of({"holdout": 3, "ignore_lag": True}) == Preprocessing(ignore_lag=True, holdout=3.0)
    assert preprocessing_of({"size": [4, 5, 6], "voxel_mm": 2}).facts() == {
        "size": (4, 5, 6), "voxel_mm": (2.0, 2.0, 2.0), "ignore_lag": False
    }  # fmt: skip


@dataclass(frozen=True)
class Newer(Preprocessing):
    """The options of a later version, with one more."""

    younger: float = 0.0


def test_a_checkpoint_from_before_an_option_is_taken_where_the_option_has_its_default(rt, scan) -> None:
    """Of the preprocessing, and of a step: the older checkpoint has neither."""

    def stop(progress) -> None:
        raise KeyboardInterrupt

    plan = plan_run("sirt", {"iterations": 3, "steps": "rings", "rings": {"window": 5}})
    state = dict(reconstruct(scan, plan, rt, report=stop).state)
    identity = json.loads(str(state.pop(RUN)))
    identity["input"]["rings"] = {}
    del state["checksum"], identity["input"]["ignore_lag"]
    older = with_identity(state, identity)
    with pytest.raises(InputError, match=r"other input.rings.window \(10, now 5\)"):
        reconstruct(scan, plan, rt, resume=older)
    usual = replace(plan, preprocessing=Newer(steps="rings"))
    assert reconstruct(scan, usual, rt, resume=older).volume.any()
    with pytest.raises(InputError, match="other input.younger"):
        reconstruct(scan, replace(plan, preprocessing=Newer(steps="rings", younger=1.0)), rt, resume=older)
