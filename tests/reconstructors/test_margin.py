"""Voxels beyond the box that a method fills and that are not kept: what is left is the box of a run on all of them."""

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import prepare, reconstruct, simulate
from phyradgs_cl.errors import InputError, OutOfMemoryError
from phyradgs_cl.fields import GridChoice
from phyradgs_cl.reconstructors.result import HELD_OUT

pytestmark = pytest.mark.slow

PART = GridChoice(roi_mm=0.9, margin_mm=(0, 0.3, 0.3))


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    return simulate("jaw", size=12, detector=18, views=8, truncation=0.3, device=rt)


def stop(progress) -> None:
    if progress.iteration == 2:
        raise KeyboardInterrupt


def test_a_margin_is_filled_and_discarded(rt, scan, tmp_path) -> None:
    """Bit for bit a part of the run on all voxels, held-out pixels compared with all of them; an interrupted run goes on to
    the same bits, but with no other margin."""
    box = PART.of(scan.grid)
    wide = PART.with_margin(box)
    assert wide.shape[0] == box.shape[0] and wide.shape[1] > box.shape[1]
    for method, more in (("sirt", {"holdout": 2.0}), ("phyradgs", {"gaussians": 50})):
        usual = {"iterations": 4, "device": rt, "report": False, **more}
        chosen = {"roi_mm": PART.roi_mm, "margin_mm": PART.margin_mm}
        whole, found = reconstruct(scan, method, grid=wide, **usual), reconstruct(scan, method, **chosen, **usual)
        assert found.grid == box, method
        np.testing.assert_array_equal(found.volume, whole.volume[box.slices_in(wide)])
        assert found.facts.get(HELD_OUT) == whole.facts.get(HELD_OUT)
        assert getattr(found.gaussians, "count", 0) == getattr(whole.gaussians, "count", 0)
    chosen = {**chosen, "iterations": 4, "device": rt}
    part = reconstruct(scan, "sirt", **{**chosen, "report": stop}, on_interrupt="return")
    assert part.grid == box and part.state is not None
    rest = reconstruct(scan, "sirt", **chosen, resume=part)
    np.testing.assert_array_equal(rest.volume, reconstruct(scan, "sirt", **chosen).volume)
    with pytest.raises(InputError, match="resume: found a run with other input"):
        reconstruct(scan, "sirt", **{**chosen, "margin_mm": 0.1}, resume=part)


def test_margins_that_would_do_nothing_or_are_too_wide_for_memory_are_refused(rt, scan) -> None:
    none, plain = (reconstruct(scan, "fdk", **more, device=rt).volume for more in ({"margin_mm": 0}, {}))
    np.testing.assert_array_equal(none, plain)
    with pytest.raises(InputError, match="margin_mm: found method fdk with extrapolate=none.*extrapolate=reprojected"):
        reconstruct(scan, "fdk", margin_mm=0.3, device=rt)
    with pytest.raises(InputError, match="margin_mm: found .*without a method"):
        prepare(scan, "sparks", margin_mm=0.3, device=rt)
    with pytest.raises(OutOfMemoryError, match=r"narrower margin_mm \(with it the grid has \d+ × \d+ × \d+ voxels\)"):
        reconstruct(scan, "sirt", margin_mm=1000 * max(scan.grid.voxel_size_mm), iterations=1, device=rt)


def test_volumes_on_the_way_are_those_of_the_box(rt, scan) -> None:
    shown = []
    for method, more in (("fista", {}), ("phyradgs", {"gaussians": 50})):
        usual = {"iterations": 4, "device": rt, "roi_mm": PART.roi_mm, "margin_mm": PART.margin_mm, **more}
        found = reconstruct(scan, method, **usual, report=lambda at: shown.append(at.volume and at.volume()))
        for volume, grid in filter(None, shown):
            assert volume.shape == grid.shape
            np.testing.assert_allclose(grid.box_mm, found.grid.box_mm, atol=max(grid.voxel_size_mm))  # may be coarser
    assert any(shown)
