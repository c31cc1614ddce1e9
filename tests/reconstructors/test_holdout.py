"""Pixels that a method does not see, and how far its volume is from them."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import prepare, simulate
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors import Preprocessing, RunPlan, method_options, reconstruct
from phyradgs_cl.reconstructors.projected import held_out, holdout_errors
from phyradgs_cl.reconstructors.result import HELD_OUT, Reconstruction

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    usual = {"size": 24, "detector": 48, "views": 24, "exposure_deg": 8.0, "peak": 3.0, "noise": "beer", "dose": 1e3}
    return simulate("jaw", device=rt, **usual)


@pytest.mark.parametrize("method, some", [("fdk", {}), ("sirt", {"iterations": 3}), ("phyradgs", {"iterations": 10})])
def test_no_method_sees_what_is_held_out(rt, scan, method, some) -> None:
    options, before = method_options(method, None, some), Preprocessing(holdout=2.0)
    held = held_out(scan, 2.0)
    assert 0.015 < held.mean() < 0.025
    frames = scan.projections.copy()
    frames[held] = 7.0
    plan = RunPlan(method, options, preprocessing=before)
    one, two = (reconstruct(s, plan, rt) for s in (scan, replace(scan, projections=frames)))
    np.testing.assert_array_equal(one.volume, two.volume)
    assert one.facts[HELD_OUT]["holdout_rms"] < 1 < two.facts[HELD_OUT]["holdout_rms"]
    assert HELD_OUT not in reconstruct(scan, RunPlan(method, options), rt).facts


def test_the_error_is_least_where_noise_is_not_fitted_and_no_less_than_noise(rt, scan) -> None:
    """The residual of the frames that are seen falls all the way; the error of those that are not tells the best."""
    found = {}
    for iterations in (2, 10, 80):
        options = method_options("cgls", None, {"iterations": iterations, "noise_stop": 0.0, "motion": "per-row"})
        result = reconstruct(scan, RunPlan("cgls", options, preprocessing=Preprocessing(holdout=3.0)), rt)
        errors = result.facts[HELD_OUT]
        mse = float(np.mean((result.volume - scan.reference) ** 2))
        found[iterations] = errors["holdout_rms"], mse, result.record[-1]["residual"]
        assert errors["holdout_rms"] > 0.95 * errors["holdout_noise_rms"] > 0
    rms, mse, residual = ({n: values[k] for n, values in found.items()} for k in range(3))
    assert min(rms, key=rms.__getitem__) == min(mse, key=mse.__getitem__) == 10
    assert residual[80] < residual[10] < residual[2]


def test_noise_is_told_where_the_held_out_pixels_lie(rt, scan) -> None:
    clean = simulate("jaw", device=rt, size=24, detector=48, views=24, exposure_deg=8.0, peak=3.0, noise="none")
    held = held_out(scan, 5.0)
    true = float(np.sqrt(np.mean((scan.projections - clean.projections)[held] ** 2)))
    truth = Reconstruction(scan.reference, scan.grid)
    errors = holdout_errors(rt, scan, held, truth.volume, truth.grid)
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
        reconstruct(blind, RunPlan("fdk", method_options("fdk"), preprocessing=Preprocessing(holdout=2.0)), rt)
    assert "holdout" not in Preprocessing().facts() and Preprocessing(holdout=2).facts()["holdout"] == 2
