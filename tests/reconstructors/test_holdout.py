"""Pixels that a method does not see, and how far its volume is from them."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import prepare, simulate
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors import Preprocessing, plan_run, reconstruct
from phyradgs_cl.reconstructors.projected import held_out, holdout_errors
from phyradgs_cl.reconstructors.result import HELD_OUT

pytestmark = pytest.mark.slow


USUAL = {"size": 24, "detector": 48, "views": 24, "exposure_deg": 8.0, "peak": 3.0}


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    return simulate("jaw", device=rt, noise="beer", dose=1e3, **USUAL)


@pytest.mark.parametrize("method, some", [("fdk", {}), ("sirt", {"iterations": 3}), ("phyradgs", {"iterations": 10})])
def test_no_method_sees_what_is_held_out(rt, scan, method, some) -> None:
    held = held_out(scan, 2.0)
    assert 0.015 < held.mean() < 0.025
    frames = scan.projections.copy()
    frames[held] = 7.0
    plan = plan_run(method, {**some, "holdout": 2.0})
    one, two = (reconstruct(s, plan, rt) for s in (scan, replace(scan, projections=frames)))
    np.testing.assert_array_equal(one.volume, two.volume)
    assert one.facts[HELD_OUT]["holdout_rms"] < 1 < two.facts[HELD_OUT]["holdout_rms"]
    assert HELD_OUT not in reconstruct(scan, plan_run(method, some), rt).facts


def test_the_error_is_least_where_noise_is_not_fitted_and_no_less_than_noise(rt, scan) -> None:
    """The residual of the frames that are seen falls all the way; the error of those that are not tells the best."""
    found = {}
    for iterations in (2, 10, 80):
        changes = {"iterations": iterations, "noise_stop": 0.0, "motion": "per-row", "holdout": 3.0}
        result = reconstruct(scan, plan_run("cgls", changes), rt)
        errors, mse = result.facts[HELD_OUT], float(np.mean((result.volume - scan.reference) ** 2))
        found[iterations] = errors["holdout_rms"], mse, result.record[-1]["residual"]
        assert errors["holdout_rms"] > 0.95 * errors["holdout_noise_rms"] > 0
    rms, mse, residual = ({n: values[k] for n, values in found.items()} for k in range(3))
    assert min(rms, key=rms.__getitem__) == min(mse, key=mse.__getitem__) == 10
    assert residual[80] < residual[10] < residual[2]


def test_noise_is_told_where_the_held_out_pixels_lie(rt, scan) -> None:
    clean, held = simulate("jaw", device=rt, noise="none", **USUAL), held_out(scan, 5.0)
    true = float(np.sqrt(np.mean((scan.projections - clean.projections)[held] ** 2)))
    errors = holdout_errors(rt, scan, held, scan.reference, scan.grid)
    assert errors["holdout_noise_rms"] == pytest.approx(true, rel=0.15)
    assert errors["holdout_pixels"] == held.sum()


def test_what_cannot_be_held_out_is_refused(rt, scan) -> None:
    for wrong in (-1.0, 51.0):
        with pytest.raises(InputError, match="holdout"):
            Preprocessing(holdout=wrong)
    with pytest.raises(InputError, match="without a method"):
        prepare(scan, "sparks", device=rt, holdout=2.0)
    blind = replace(scan, pixel_mask=np.ones(scan.projections.shape[1:], bool))
    with pytest.raises(InputError, match="0 pixels.*at least one"):
        reconstruct(blind, plan_run("fdk", {"holdout": 2.0}), rt)
    assert "holdout" not in Preprocessing().facts() and Preprocessing(holdout=2).facts()["holdout"] == 2
