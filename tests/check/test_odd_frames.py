"""Frames that do not belong to a scan are found at its ends as in its middle, and its ends are not blamed for a drift."""

from dataclasses import replace

import numpy as np
import pytest
from check_kit import some_frames
from parallel_kit import BODIES, line_integrals, parallel_scan
from scipy.ndimage import shift

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Scan, Shutter
from phyradgs_cl.acquisition.trajectory import CircularOrbit, ConstantSpeed
from phyradgs_cl.check.consistency import check_consistency, repeated_frames
from phyradgs_cl.check.finding import OK, SUSPICIOUS
from phyradgs_cl.check.run import quick_scan
from phyradgs_cl.fields import Grid

pytestmark = pytest.mark.slow

@pytest.fixture(scope="module")
def arcs(scan_of) -> dict[str, Scan]:
    cone = scan_of(ConeGeometry(5.0, 7.0, (32, 32), (0.125, 0.125)), views=60, exposure_deg=6.0, readout_ratio=0.5)
    return {
        "half a turn": parallel_scan(30), "its end too": parallel_scan(31, with_end=True),
        "cone, 216°": some_frames(cone, slice(36)), "cone, full": cone,
        "strip": strip_scan(60, 180.0, 192),
    }  # fmt: skip


def answer(rt, scan: Scan) -> tuple[str, str]:
    finding = check_consistency(rt, quick_scan(scan), scan).finding
    return finding.verdict, finding.text.split(";")[0]


CHANGES = {
    "moved": lambda frame: shift(frame, (0, 2), order=1, mode="nearest"), "mirrored": lambda frame: frame[:, ::-1],
    "faint": lambda frame: 0.7 * frame, "rolled": lambda frame: np.roll(frame, 6, axis=1),
}  # fmt: skip


@pytest.mark.parametrize(("arc", "at", "change"), [
    ("half a turn", [0], "moved"), ("cone, 216°", [18], "moved"), ("cone, 216°", [35], "mirrored"),
    ("its end too", [0, 30], "faint"), ("strip", [0], "rolled"), ("strip", [58], "rolled"),
])  # fmt: skip
def test_odd_frames_alone_are_named_wherever_they_are(rt, arcs, arc, at, change) -> None:
    frames = arcs[arc].projections.copy()
    frames[at] = [CHANGES[change](frame) for frame in frames[at]]
    named = f"frames {at[0]}, {at[1]} (from 0) do" if len(at) == 2 else f"frame {at[0]} (from 0) does"
    assert answer(rt, replace(arcs[arc], projections=frames)) == (SUSPICIOUS, f"{named} not fit the others")


def strip_scan(views: int, turn_deg: float, columns: int, rows: int = 2) -> Scan:
    """A right scan of a wide, low panel, as of a synchrotron: a fit of coarse voxels leaves the ends of its arc five times
    the usual residual."""
    pitch_mm = 3.2 / columns
    geometry = ParallelGeometry((rows, columns), pitch_mm)
    orbit = CircularOrbit(geometry, ConstantSpeed(0.3, np.deg2rad(turn_deg) / (views - 1)))
    frames = [line_integrals(BODIES, orbit.pose(f, np.array(float(f))), (rows, columns)) for f in range(views)]
    noise = np.random.default_rng(0).normal(0, 0.001, (views, rows, columns))
    grid = Grid((rows, columns, columns), (pitch_mm,) * 3)
    return Scan(np.array(frames) + noise, geometry, orbit, Shutter(0.0), np.arange(float(views)), grid, False)


@pytest.mark.parametrize(
    ("views", "turn_deg", "columns", "gain"), [(61, 180.0, 192, 0.02), (61, 170.0, 192, 0.0), (91, 180.0, 320, 0.0)]
)
def test_the_ends_of_a_right_arc_are_not_odd(rt, views, turn_deg, columns, gain) -> None:
    """Nor are they where the contrast drifts by 2 %."""
    scan = strip_scan(views, turn_deg, columns)
    contrast = 1 + np.linspace(-gain / 2, gain / 2, views)[:, None, None]
    assert answer(rt, replace(scan, projections=scan.projections * contrast))[0] == OK


def test_frames_that_agree_in_masked_pixels_alone_are_not_repeated(arcs) -> None:
    scan = arcs["cone, full"]
    p = scan.projections + np.random.default_rng(0).normal(scale=0.01, size=scan.projections.shape).astype(np.float32)
    mask = np.zeros(p.shape, bool)
    mask[20:22] = True
    mask[20:22, 12:16, :2] = False
    filled = np.where(mask, p[20], p)
    assert repeated_frames(replace(scan, projections=filled, pixel_mask=mask)) == []
    assert repeated_frames(replace(scan, projections=np.where(mask, p[20], p[[*range(20), 20, 20, *range(22, 60)]]))) == [21]
