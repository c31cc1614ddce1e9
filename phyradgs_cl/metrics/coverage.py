"""Tests the error bars of voxels (standard deviations σ in 1/mm) against a true volume: the fraction of errors within the
bars, and (mean σ)/(RMS error)."""

from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from phyradgs_cl.drawing import SOFT, new_figure, style_axes
from phyradgs_cl.metrics.quality import Metric

Array = NDArray[np.floating]
COVERAGE = {
    "within_doubt": Metric("within σ", "", ".3f"),
    "within_doubt_95": Metric("within the 95 % bar", "", ".3f"),
    "doubt_over_error": Metric("mean σ / RMS error", "", ".3f"),
}
_OBJECT, _AROUND = 0.01, 2  # errors count where the true volume exceeds 1 % of its maximum, and up to 2 voxels around


def object_voxels(truth: Array) -> NDArray[np.bool_]:
    """Returns the object's voxels, bool (nz, ny, nx): those above 1 % of the maximum of ``truth``, and two around them."""
    return np.asarray(scipy.ndimage.binary_dilation(truth > _OBJECT * truth.max(), iterations=_AROUND))


def coverage(sigma: Array, volume: Array, truth: Array, multiple_95: float) -> dict[str, float]:
    """Returns, over the object's voxels, the fractions of errors within σ and within ``multiple_95`` σ, and (mean σ)/(RMS
    error). sigma: σ; sigma, volume, truth: (nz, ny, nx) in 1/mm. multiple_95: (95 % bar)/σ."""
    inside = object_voxels(truth)
    size, bar = np.abs(volume.astype(np.float64) - truth)[inside], sigma[inside].astype(np.float64)
    over_error = float(bar.mean() / (np.sqrt(np.mean(size**2)) or np.inf))
    return dict(zip(COVERAGE, [*(float(np.mean(size <= k * bar)) for k in (1.0, multiple_95)), over_error], strict=True))


def reliability_png(path: str | Path, sigma: Array, volume: Array, truth: Array, multiple_95: float) -> None:
    """Plots the size of errors against σ in a PNG file. The object's voxels are sorted by σ and divided into tenths. A tenth
    has two points at its mean σ: the 68th percentile of its absolute errors, and (95th percentile)/``multiple_95``. If the
    error bars are right, the points lie on the dashed line. Other arguments are as in ``coverage``."""
    inside = object_voxels(truth)
    size, bar = np.abs(volume.astype(np.float64) - truth)[inside], sigma[inside].astype(np.float64)
    tenths = [part for part in np.array_split(np.argsort(bar, kind="stable"), 10) if part.size]
    stated = [bar[part].mean() for part in tenths]
    axes = (figure := new_figure(4.5, 4.0)).subplots()
    axes.plot([0, max(stated)], [0, max(stated)], "--", color=SOFT)
    for share, multiple in ((68, 1.0), (95, multiple_95)):
        of_tenths = [np.percentile(size[part], share) / multiple for part in tenths]
        axes.plot(stated, of_tenths, "o-", label=f"{share} % of the errors / {multiple:.3g}")
    style_axes(axes, "σ, 1/mm", "error, 1/mm")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=110, format="png")
