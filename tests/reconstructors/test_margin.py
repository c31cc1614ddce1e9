"""Voxels beyond the box that a method fills and that are not kept: what is left is the box of a run on all of them."""

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import Reconstruction, prepare, reconstruct, simulate
from phyradgs_cl.errors import InputError, OutOfMemoryError
from phyradgs_cl.fields import Grid, GridChoice
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


def test_what_belongs_to_voxels_is_cut_with_them() -> None:
    grid = Grid((4, 5, 6), (1.0, 1.0, 1.0))
    values = np.arange(120, dtype=np.float32).reshape(grid.shape)
    inner = grid.part((1, 1, 1), (2, 3, 4))
    found = Reconstruction(values, grid).within(inner)
    assert found.grid == inner
    np.testing.assert_array_equal(found.volume, values[1:3, 1:4, 1:5])
    assert (of_another := Reconstruction(values[:2], grid.part((0, 0, 0), (2, 5, 6)))).within(inner) is of_another


def test_where_a_margin_would_do_nothing_it_is_refused(rt, scan) -> None:
    with pytest.raises(InputError, match="margin_mm: found method fdk with extrapolate=none.*extrapolate=reprojected"):
        reconstruct(scan, "fdk", margin_mm=0.3, device=rt)
    with pytest.raises(InputError, match="margin_mm: found .*without a method"):
        prepare(scan, "sparks", margin_mm=0.3, device=rt)


def test_no_margin_is_none_and_one_too_wide_for_memory_is_named(rt, scan) -> None:
    np.testing.assert_array_equal(
        reconstruct(scan, "fdk", margin_mm=0, device=rt).volume, reconstruct(scan, "fdk", device=rt).volume
    )
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


def test_a_plot_says_that_the_margin_is_gone(rt, scan) -> None:
    for more, expected in (({}, False), ({"margin_mm": 0.3}, True)):
        figure = reconstruct(scan, "sirt", roi_mm=0.9, iterations=2, device=rt, report=False, **more).plot(scan, device=rt)
        titles = [axes.get_title() for part in figure.subfigs for axes in part.axes]
        assert any("without the margin" in title for title in titles) == expected
