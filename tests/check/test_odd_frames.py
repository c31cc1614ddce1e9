"""Frames that do not belong to a scan are found at its ends, in its middle and beside the frames that are fitted. Its ends
are not blamed for a drift, nor right frames for edges along a few rays."""

from dataclasses import replace

import numpy as np
import pytest
from check_kit import cone_scan, some_frames
from parallel_kit import BODIES, line_integrals, parallel_scan
from scipy.ndimage import shift

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Scan, Shutter
from phyradgs_cl.acquisition.altered.coarse import QUICK_COLUMNS, coarse, spread_evenly
from phyradgs_cl.acquisition.trajectory import CircularOrbit, ConstantSpeed
from phyradgs_cl.check.consistency import check_consistency, odd_frames, repeated_frames
from phyradgs_cl.check.detector import check_gain
from phyradgs_cl.check.finding import OK, SUSPICIOUS
from phyradgs_cl.check.run import quick_scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom, rotation_about_z

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
    "faint": lambda frame: 0.7 * frame, "rolled": lambda frame: np.roll(frame, 6, axis=1), "black": lambda frame: frame + 9,
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


@pytest.fixture(scope="module")
def long() -> Scan:
    """More views than a check fits."""
    return cone_scan(BODIES, np.arange(110) * 360 / 110, 0.003)


BESIDE = [int(frame) for frame in np.setdiff1d(np.arange(110), spread_evenly(110, 60))][3::12]  # not fitted


@pytest.mark.parametrize(("order", "changes", "said"), [
    ([], {BESIDE[0]: "moved", BESIDE[1] + 1: "faint", BESIDE[2]: "mirrored"},
     f"frames {BESIDE[0]}, {BESIDE[1] + 1}, {BESIDE[2]} (from 0) do not fit the others"),
    ([BESIDE[0], BESIDE[2]], {}, f"frames {BESIDE[0]} and {BESIDE[2]} (from 0) fit if their order is exchanged"),
    ([BESIDE[1], BESIDE[3] + 1], {}, f"frames {BESIDE[1]} and {BESIDE[3] + 1} (from 0) fit if their order is exchanged"),
    ([], {BESIDE[1]: "black"}, f"frame {BESIDE[1]} is unlike all others (black, bright, or no image)"),
    ([], {BESIDE[3]: "the last"}, f"frame {BESIDE[3]} is frame {BESIDE[3] - 1} recorded twice"),
    ([], {}, None),
])  # fmt: skip
def test_every_frame_of_a_long_scan_is_looked_at(rt, long, order, changes, said) -> None:
    frames = long.projections.copy()
    frames[order] = frames[order[::-1]]
    for at, change in changes.items():
        frames[at] = frames[at - 1] if change == "the last" else CHANGES[change](frames[at])
    verdict, text = answer(rt, replace(long, projections=frames))
    assert (verdict, text) == (SUSPICIOUS, said) if said else verdict == OK


def test_a_step_of_the_gain_is_placed_among_the_frames_of_the_file(rt, long) -> None:
    frames = long.projections + 0.1 * (np.arange(110) >= 80)[:, None, None]
    text = check_gain(rt, coarse(replace(long, projections=frames.astype(np.float32)), QUICK_COLUMNS)).text
    before, after = (int(word) for word in text.split("between frames ")[1].split(" (")[0].split(" and "))
    assert before < 80 <= after <= before + 2


@pytest.mark.parametrize("half_mm", [0.08, 0.12])
def test_views_along_a_plate_are_not_odd(rt, half_mm) -> None:
    """Without noise the usual residual is tiny, and rays along the plate leave several times as much."""
    plate = EllipsoidPhantom((Ellipsoid((0.0, 0.0, 0.0), (1.1, half_mm, 0.9), 1.0, rotation_about_z(0.2)),), "plate")
    assert answer(rt, cone_scan(plate, np.arange(90) * 4.0, 0.0))[0] == OK


@pytest.mark.parametrize("light", [0.0, 0.01, 0.05])
def test_doubles_are_found_at_every_place_and_uneven_light_and_a_blank_frame_make_none(arcs, light) -> None:
    """Each frame has noise of its own."""
    scan = arcs["cone, full"]
    rng = np.random.default_rng(4)
    p = scan.projections + rng.normal(0, 0.002, scan.projections.shape) + rng.normal(0, light, (len(scan.projections), 1, 1))
    assert repeated_frames(replace(scan, projections=p)) == []
    for f in (1, 2, 3, 30, len(p) - 3, len(p) - 2, len(p) - 1):
        doubled, blank = p.copy(), p.copy()
        doubled[f], blank[f] = p[f - 1], 0
        assert repeated_frames(replace(scan, projections=doubled)) == [f]
        assert repeated_frames(replace(scan, projections=blank)) == []
        assert light or odd_frames(blank, None) == [f]
