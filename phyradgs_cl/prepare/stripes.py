"""Removes stripes in sinograms of many views: columns that fluctuate, do not respond, or are wrong in all or some views.

Vo, Atwood and Drakopoulos, Opt. Express 26 (2018) 28396. Neighbouring columns of a sinogram (view, column) record nearly the
same values, in another order of views. Sorted by value they hardly differ, so a median across sorted columns gives what a
column should have recorded. It replaces the column, back in the order of its views. Columns that fluctuate or do not respond
have no such order: they are first interpolated from their neighbours.

The paper replaces every column, which blurs a scan of a few hundred columns. Here a column is replaced only if it deviates
from the sorted median much more than the columns at both sides, and than its mirror image about the axis. An edge of the
object spreads over many columns, shows at one side only, or has a mirror image."""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.bad_pixels import axis_column
from phyradgs_cl.prepare.rings import mirror_columns
from phyradgs_cl.prepare.step import Facts, MakeModel, StepOptions, fill_lines, unmasked_frames

_LEAST_VIEWS = 60  # fewest views: the method assumes that neighbouring columns record the same values, which takes this many
_LEAST = 2e-3  # a stripe whose line integrals deviate by less is left alone: its gain is off by less than 0.2 %
_NEAR = 5  # each side of a column is represented by the median of this many columns
_FLUCTUATING = 3.0  # a column fluctuates if it changes this many times as much between views as the columns at both sides
_UNRESPONSIVE = 10.0  # a column does not respond if it varies this many times less than the columns at both sides
_END = 5.0  # the panel's last column may be bad if it differs from its neighbour this many times as much as the next do
_MIRRORED = 2.0  # an edge shows in the mirror image too: a stripe deviates this many times as much as its image
_SMALLEST = 1e-6  # least spread of a column, in line integrals, as a divisor: the spread of a stuck pixel is 0


@dataclass(frozen=True)
class StripeOptions(StepOptions, step="stripes"):
    """Options of the step ``stripes``. width: columns over which the median is taken; stripes are narrower than half of it.
    ratio: a stripe deviates at least this many times as much as the columns at both sides; 0 replaces all columns."""

    width: int = checks.ranged(5, 3, 999)
    ratio: float = checks.ranged(3.0, 0, 100)


def remove_stripes(
    frames: np.ndarray, *, width: int = 5, ratio: float = 3.0, axis_column: float | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns line integrals (F, v, u) float32 without stripes, and two masks (v, u) bool: pixels that were interpolated,
    and pixels that were replaced after sorting.

    width, ratio: as in ``StripeOptions``. axis_column: the column of the axis, about which columns are mirrored; None: the
    middle. Every detector row is filtered separately."""
    mirrored = mirror_columns(frames.shape[2], axis_column)
    clean = np.array(frames, np.float32)
    interpolated, replaced = (np.zeros(frames.shape[1:], bool) for _ in range(2))
    for row in range(frames.shape[1]):
        sinogram = clean[:, row]
        # The median change from view to view: an object changes slowly, or passes in a few views, and hardly adds to it.
        fluctuation = np.median(np.abs(np.diff(sinogram, 2, axis=0)), axis=0) / np.sqrt(6)
        low, high = np.percentile(sinogram, (25, 75), axis=0)
        interpolated[row] = _stand_out(fluctuation, _FLUCTUATING, mirrored)
        unresponsive = _stand_out(1 / np.maximum(high - low, _SMALLEST), _UNRESPONSIVE, mirrored)
        interpolated[row, 1:-1] |= unresponsive[1:-1]  # in the last column, an object may end
        fill_lines(sinogram.T, interpolated[row])
        order = np.argsort(sinogram, axis=0, kind="stable")
        ranked = np.take_along_axis(sinogram, order, axis=0)
        smooth = _across(ranked, width)
        replaced[row] = _stand_out(np.abs(ranked - smooth).mean(axis=0), ratio, mirrored)
        columns = np.flatnonzero(replaced[row])
        sinogram[order[:, columns], columns] = smooth[:, columns]
    return clean, interpolated, replaced


def _across(ranked: np.ndarray, width: int) -> np.ndarray:
    """Returns the median across ``width`` sorted columns (view, column). Beyond an end the last column counts again, so that
    a slope, as of an object that the panel cuts off, stays. That column is its neighbour instead if it differs far more from
    it, in most views, than the next columns do from theirs."""
    smooth = scipy.ndimage.median_filter(ranked, (1, width), mode="nearest")
    for side in (1, -1):
        steps = np.abs(np.diff(ranked[:, ::side][:, :4]))
        if np.median(steps[:, 0]) > _END * steps[:, 1:].mean(axis=0).max():
            smooth[:, ::side][:, 0] = ranked[:, ::side][:, 1]
    return smooth


def _stand_out(values: np.ndarray, ratio: float, mirrored: np.ndarray) -> np.ndarray:
    """Returns the columns, bool (u,), whose ``values`` exceed ``_LEAST``, ``ratio`` times those at both sides, and twice
    those of their mirror image, if ``mirrored`` has one. A ratio of 0 chooses all columns."""
    if ratio == 0:
        return np.ones(len(values), bool)
    columns, usual = np.arange(len(values)), scipy.ndimage.median_filter(values, _NEAR)
    left, right = (usual[np.clip(columns + side, 0, len(values) - 1)] for side in (-_NEAR + 1, _NEAR - 1))
    stands_out = values > np.maximum(ratio * np.maximum(left, right), _LEAST)
    stands_out[mirrored[::-1]] &= values[mirrored[::-1]] > _MIRRORED * scipy.ndimage.maximum_filter(values, 3)[mirrored]
    return stands_out


def correct_stripes(scan: Scan, options: StripeOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """Returns the scan without stripes; unchanged if there are none. Raises InputError for few views or a narrow panel."""
    if scan.frames < _LEAST_VIEWS:
        expected = f"at least {_LEAST_VIEWS}, in which neighbouring columns record the same values"
        raise InputError("--steps stripes", f"{scan.frames} views", expected, "leave the step out: rings needs fewer")
    if options.width > scan.projections.shape[2]:
        expected = f"no more than the panel's {scan.projections.shape[2]} columns"
        raise InputError("stripes.width", str(options.width), expected, "state fewer columns")
    clean, interpolated, replaced = remove_stripes(
        unmasked_frames(scan), width=options.width, ratio=options.ratio, axis_column=axis_column(scan)
    )
    facts: Facts = {"interpolated": int(np.count_nonzero(interpolated)), "replaced": int(np.count_nonzero(replaced))}
    return (replace(scan, projections=clean) if (interpolated | replaced).any() else scan), facts
