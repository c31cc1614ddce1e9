"""Pixels that a method does not see, and how far its volume is from them; voxels beyond the box that it fills and that are
not kept."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import prepare, reconstruct, simulate
from phyradgs_cl.errors import InputError, OutOfMemoryError
from phyradgs_cl.fields import GridChoice
from phyradgs_cl.reconstructors import Preprocessing
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
    usual = {"device": rt, "report": False, **some}
    one, two = (reconstruct(s, method, **usual, holdout=2.0) for s in (scan, replace(scan, projections=frames)))
    np.testing.assert_array_equal(one.volume, two.volume)
    assert one.facts[HELD_OUT]["holdout_rms"] < 1 < two.facts[HELD_OUT]["holdout_rms"]
    assert HELD_OUT not in reconstruct(scan, method, **usual).facts


def test_the_error_is_least_where_noise_is_not_fitted_and_no_less_than_noise(rt, scan) -> None:
    """The residual of the frames that are seen falls all the way; the error of those that are not tells the best."""
    found = {}
    for iterations in (2, 10, 40):
        usual = {"noise_stop": 0.0, "motion": "per-row", "holdout": 3.0, "device": rt, "report": False}
        result = reconstruct(scan, "cgls", iterations=iterations, **usual)
        errors, mse = result.facts[HELD_OUT], float(np.mean((result.volume - scan.reference) ** 2))
        found[iterations] = errors["holdout_rms"], mse, result.record[-1]["residual"]
        assert errors["holdout_rms"] > 0.95 * errors["holdout_noise_rms"] > 0
    rms, mse, residual = ({n: values[k] for n, values in found.items()} for k in range(3))
    assert min(rms, key=rms.__getitem__) == min(mse, key=mse.__getitem__) == 10
    assert residual[40] < residual[10] < residual[2]


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
        reconstruct(blind, "fdk", holdout=2.0, device=rt)
    assert "holdout" not in Preprocessing().facts() and Preprocessing(holdout=2).facts()["holdout"] == 2


PART = GridChoice(roi_mm=0.9, margin_mm=(0, 0.3, 0.3))


@pytest.fixture(scope="module")
def small(rt) -> Scan:
    return simulate("jaw", size=12, detector=18, views=8, truncation=0.3, device=rt)


def stop(progress) -> None:
    if progress.iteration == 2:
        raise KeyboardInterrupt


def test_a_margin_is_filled_and_discarded(rt, small, tmp_path) -> None:
    """Bit for bit a part of the run on all voxels, held-out pixels compared with all of them; an interrupted run goes on to
    the same bits, but with no other margin."""
    box = PART.of(small.grid)
    wide = PART.with_margin(box)
    assert wide.shape[0] == box.shape[0] and wide.shape[1] > box.shape[1]
    for method, more in (("sirt", {"holdout": 2.0}), ("phyradgs", {"gaussians": 50})):
        usual = {"iterations": 4, "device": rt, "report": False, **more}
        chosen = {"roi_mm": PART.roi_mm, "margin_mm": PART.margin_mm}
        whole, found = reconstruct(small, method, grid=wide, **usual), reconstruct(small, method, **chosen, **usual)
        assert found.grid == box, method
        np.testing.assert_array_equal(found.volume, whole.volume[box.slices_in(wide)])
        assert found.facts.get(HELD_OUT) == whole.facts.get(HELD_OUT)
        assert getattr(found.gaussians, "count", 0) == getattr(whole.gaussians, "count", 0)
    chosen = {**chosen, "iterations": 4, "device": rt}
    part = reconstruct(small, "sirt", **{**chosen, "report": stop}, on_interrupt="return")
    assert part.grid == box and part.state is not None
    rest = reconstruct(small, "sirt", **chosen, resume=part)
    np.testing.assert_array_equal(rest.volume, reconstruct(small, "sirt", **chosen).volume)
    with pytest.raises(InputError, match="resume: found a run with other input"):
        reconstruct(small, "sirt", **{**chosen, "margin_mm": 0.1}, resume=part)


def test_margins_that_would_do_nothing_or_are_too_wide_for_memory_are_refused(rt, small) -> None:
    none, plain = (reconstruct(small, "fdk", **more, device=rt).volume for more in ({"margin_mm": 0}, {}))
    np.testing.assert_array_equal(none, plain)
    with pytest.raises(InputError, match="margin_mm: found method fdk with extrapolate=none.*extrapolate=reprojected"):
        reconstruct(small, "fdk", margin_mm=0.3, device=rt)
    with pytest.raises(InputError, match="margin_mm: found .*without a method"):
        prepare(small, "sparks", margin_mm=0.3, device=rt)
    with pytest.raises(OutOfMemoryError, match=r"narrower margin_mm \(with it the grid has \d+ × \d+ × \d+ voxels\)"):
        reconstruct(small, "sirt", margin_mm=1000 * max(small.grid.voxel_size_mm), iterations=1, device=rt)


def test_volumes_on_the_way_are_those_of_the_box(rt, small) -> None:
    shown = []
    for method, more in (("fista", {}), ("phyradgs", {"gaussians": 50})):
        usual = {"iterations": 4, "device": rt, "roi_mm": PART.roi_mm, "margin_mm": PART.margin_mm, **more}
        found = reconstruct(small, method, **usual, report=lambda at: shown.append(at.volume and at.volume()))
        for volume, grid in filter(None, shown):
            assert volume.shape == grid.shape
            np.testing.assert_allclose(grid.box_mm, found.grid.box_mm, atol=max(grid.voxel_size_mm))  # may be coarser
    assert any(shown)
