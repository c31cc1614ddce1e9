"""Draws figures of results: methods on one scan, and what check and calibrate correct. Phantoms are the package's own.

They are computed on the default OpenCL device, in about ten minutes of processor time."""

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phyradgs_cl.acquisition import CircularOrbit, Scan
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, perturb
from phyradgs_cl.api import calibrate, reconstruct, simulate
from phyradgs_cl.check import check
from phyradgs_cl.drawing import SAMPLE
from phyradgs_cl.metrics import psnr
from phyradgs_cl.runtime import Runtime

_HEIGHT = 0.28  # height of the drawn slice over the volume's height
_CROP = slice(0.28, 0.98), slice(0.33, 0.69)  # part of that slice along y and x that holds the foot
_SMALL = 10


def methods_figure() -> Figure:
    """Draws five methods with their defaults on the scan of `make demo`, with known motion, and the truth.

    phyradgs has 33.2 dB after its 3,000 iterations, and 34.5 dB if `--iterations 2000` is stated."""
    scan = simulate("foot", size=64, detector=128, noise="tigre", dose=1e4, electronic_noise=10.0, seed=0)
    figure = Figure(figsize=(10.5, 4.1), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    for each, method in zip(axes, ("fdk", "sirt", "fista-tv", "fista", "phyradgs"), strict=False):
        _draw_slice(each, reconstruct(scan, method).volume, scan, method)
    _draw_slice(axes[-1], scan.reference, scan, "truth")
    return figure


def check_figure(size: int = 48) -> Figure:
    """Draws a scan whose panel is three pixels off its stated place, before and after `check --fix-offset`."""
    offset_mm = 3 * 4 / (2 * size)
    right = simulate("foot", size=size, detector=2 * size, noise="tigre", dose=1e4, detector_offset_mm=(0.0, offset_mm))
    stated = _with_offset(right, 0.0)
    found = check(stated, Runtime(None))
    fixed = _with_offset(right, found.offset_mm)
    figure = Figure(figsize=(10.5, 2.55), layout="constrained")
    axes = figure.subplots(1, 3)
    for each, scan, title in zip(axes, (stated, fixed), ("as stated", "after --fix-offset"), strict=False):
        _draw_slice(each, reconstruct(scan).volume, right, title)
    _draw_slice(axes[-1], right.reference, right, "truth")
    (line,) = (one for one in found.findings if one.question == "centre of rotation")
    figure.suptitle(f"{line.verdict}: {line.question}: {line.text}", fontsize=_SMALL, color=SAMPLE)
    return figure


def calibrate_figure(size: int = 48) -> Figure:
    """Draws a scan whose panel is shifted, rolled and tilted without a statement of it, before and after `calibrate`."""
    right = simulate("foot", size=size, detector=2 * size, noise="tigre", dose=1e4)
    planted = {"offset-u": 2.5 * 4 / (2 * size), "roll": 2.0, "tilt-v": 1.0}  # in mm, degrees
    shift_mm, roll_rad, tilt_rad = planted["offset-u"], np.deg2rad(planted["roll"]), np.deg2rad(planted["tilt-v"])
    stated = perturb(right, GeometryCorrection(offset_u_mm=-shift_mm, roll_rad=-roll_rad, tilt_v_rad=-tilt_rad))
    found = calibrate(stated, "offset,roll,tilt")
    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    axes = figure.subplots(2, 3)
    limit = float(np.percentile(np.abs(found.before[0]), 99.5))
    states = ((stated, found.before, "before"), (found.scan, found.after, "after"))
    for row, (scan, residuals, when), rms in zip(axes, states, found.residual_rms, strict=True):
        low, high = (round(share * len(residuals[0])) for share in (0.15, 0.85))
        shown = residuals[0][low:high, low:high]
        row[0].imshow(shown, cmap="RdBu_r", vmin=-limit, vmax=limit, origin="lower", interpolation="nearest")
        row[0].set_title(f"{when}: residual of frame 0 (RMS of all {rms:.2g})", fontsize=_SMALL)
        row[0].set_axis_off()
        _draw_slice(row[1], reconstruct(scan).volume, right, when)
    _draw_slice(axes[0, 2], right.reference, right, "truth")
    lines = [f"{'':9s}{'stated':>7s}{'found':>17s}{'true':>6s}"]
    for one in (one for one in found.parameters if one.name in planted):
        value = "-" if one.found is None else f"{one.found:.4f} ± {one.deviation:.4f}"
        true = one.stated + planted[one.name]
        lines.append(f"{one.name:9s}{one.stated:7.3f}{value:>17s}{true:6.3g} {one.unit}")
    axes[1, 2].text(0, 0.5, "\n".join(lines), family="monospace", fontsize=8.5, linespacing=1.8, va="center")
    axes[1, 2].set_axis_off()
    return figure


def _with_offset(scan: Scan, offset_u_mm: float) -> Scan:
    """Returns the scan with its panel stated at this offset."""
    assert isinstance(scan.trajectory, CircularOrbit)
    geometry = replace(scan.geometry, detector_offset_mm=(0.0, offset_u_mm))
    return replace(scan, geometry=geometry, trajectory=replace(scan.trajectory, geometry=geometry))


def _draw_slice(axes: Axes, volume: np.ndarray, scan: Scan, title: str) -> None:
    """Draws one slice of a volume (z, y, x), on the grey scale of the scan's truth, with the volume's PSNR."""
    truth = scan.reference
    assert truth is not None
    z = round(_HEIGHT * truth.shape[0])
    part = z, *(slice(round(s.start * n), round(s.stop * n)) for s, n in zip(_CROP, truth.shape[1:], strict=True))
    axes.imshow(volume[part].T, cmap="gray", vmin=0, vmax=float(truth[part].max()), origin="lower")
    axes.set_title(title if volume is truth else f"{title}: {psnr(volume, truth):.1f} dB", fontsize=_SMALL)
    axes.set_axis_off()
