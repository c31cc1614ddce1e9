"""Figures of scans and results draw the values of the arrays."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from phyradgs_cl.api import Reconstruction, Shutter, reconstruct

pytestmark = pytest.mark.slow


def titles(figure: Figure) -> list[str]:
    return [axes.get_title() for axes in figure.axes if axes.get_title()]


def images(figure: Figure) -> list[np.ndarray]:
    return [np.asarray(image.get_array()) for axes in figure.axes for image in axes.get_images()]


def test_a_frame_has_its_picture_its_windows_and_its_arc(scan) -> None:
    mask = np.zeros(scan.geometry.detector_shape)
    mask[3, 4] = 1
    pulsed = replace(scan, pixel_mask=mask, shutter=Shutter(1.0, 0.86, "rows", -1, (0.4, 0.6)))
    figure = pulsed.plot(2)
    assert titles(figure) == ["frame 2 of 6: line integrals", "gantry from 120.0° to 175.8°"]
    (picture,) = images(figure)
    known = np.isfinite(picture)
    np.testing.assert_array_equal(picture[known], scan.projections[2][known])
    assert not known[3, 4]
    said = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert "1 mm" in said  # the bar of a panel of 4 mm
    windows = figure.axes[1]
    assert windows.get_xlabel() == "time after the frame's start (s)" and windows.get_ylabel() == "detector row"
    low, high = windows.dataLim.intervalx
    assert (low, high) == pytest.approx((0.0, 1.86))
    still = replace(scan, is_fly=False).plot()
    assert "the gantry stands still" in {text.get_text() for axes in still.axes for text in axes.texts}


def test_a_result_has_slices_convergence_and_a_residual(rt, scan) -> None:
    result = reconstruct(scan, "sirt", iterations=4, motion="per-row", device=rt)
    alone = result.plot()
    assert [t.split(",")[0] for t in titles(alone)] == ["result"] * 3 + ["convergence"]
    np.testing.assert_array_equal(images(alone)[1], result.volume[:, 6])
    curve = next(axes for axes in alone.axes if axes.get_title() == "convergence")
    np.testing.assert_array_equal(curve.lines[0].get_ydata(), [line["residual"] for line in result.record])
    assert curve.get_ylabel() == "residual" and curve.get_xlabel() == "iteration"
    assert "0.5 mm" in {text.get_text() for axes in alone.axes for text in axes.texts}
    whole = result.plot(scan, frame=3, device=rt)
    assert len(images(whole)) == 3 * 3 + 2 and len(images(Reconstruction(result.volume, result.grid).plot())) == 3
    np.testing.assert_array_equal(images(whole)[-2], scan.projections[3])
    residual = images(whole)[-1]
    share = np.linalg.norm(residual) / np.linalg.norm(scan.projections[3])
    assert 0 < share < 1 and f"RMS {100 * share:.2g} %" in titles(whole)[-1]


def test_pyplot_shows_it_where_somebody_has_imported_that(scan, monkeypatch) -> None:
    import matplotlib.pyplot as plt

    figure = scan.plot()
    assert plt.fignum_exists(figure.number)
    plt.close(figure)
    monkeypatch.delitem(sys.modules, "matplotlib.pyplot")
    assert not hasattr(scan.plot(), "number")
