"""The usual steps on clean scans, which they leave bit for bit, and on rings in many views. Objects in closed form."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, Protocol, Scan
from phyradgs_cl.acquisition.trajectory import FrameSweeps
from phyradgs_cl.api import compare, prepare, reconstruct
from phyradgs_cl.detector import pixel_gains, tigre_noise
from phyradgs_cl.fields import Grid
from phyradgs_cl.prepare import DEFAULT_STEPS, PREPARED_KEY

VIEWS, PANEL, VOXELS = 180, 48, 32
# Ellipsoids: attenuation per mm, centre x, y, z and half axes x, y, z in mm.
HEAD = [(0.3, 0, 0, 0, 0.75, 0.6, 0.8), (-0.1, 0, 0, 0, 0.68, 0.53, 0.72), (0.4, 0.3, 0.1, 0.1, 0.12, 0.2, 0.3)]
TUBE = [(0.5, 0, 0, 0, 0.7, 0.7, 9), (-0.5, 0, 0, 0, 0.64, 0.64, 9), (0.4, 0.2, 0.1, 0, 0.3, 0.25, 0.5)]
GRAINS = [(0.5, 0.6 * np.cos(k), 0.6 * np.sin(k), 0.5 * np.sin(3 * k), 0.15, 0.15, 0.15) for k in range(7)]
OBJECTS = {"head": HEAD, "tube about the axis": TUBE, "grains": GRAINS}
# source to axis and to panel in mm: a cone of 31°, and nearly parallel rays
CONE, PARALLEL = (5.0, 7.0), (500.0, 501.0)

Make = Callable[..., Scan]


@pytest.fixture(scope="module")
def make() -> Make:
    """(object, distances, arc in degrees, gains' spread) → a stop-and-shoot scan of 28,000 photons."""

    def scan(name: str, distances: tuple[float, float], arc_deg: float = 360.0, rings: float = 0.0) -> Scan:
        width_mm = 2.6 * distances[1] / distances[0]
        geometry = ConeGeometry(*distances, (PANEL, PANEL), (width_mm / PANEL,) * 2)
        start_s, angle_rad = Protocol(views=VIEWS).frame_start_s(), np.deg2rad(np.arange(VIEWS) * arc_deg / VIEWS)
        orbit = CircularOrbit(geometry, FrameSweeps(start_s, 1.0, angle_rad, angle_rad))
        frames = np.stack([_line_integrals(orbit, f, start_s[f], OBJECTS[name]) for f in range(VIEWS)])
        rng = np.random.default_rng(5)
        frames = tigre_noise(frames, 28_000, 10.0, rng)
        if rings:
            frames = frames - np.log(pixel_gains((PANEL, PANEL), rings, rng)).astype(np.float32)
        grid = Grid.cube(VOXELS, 2.0)
        z, y, x = np.meshgrid(*[(np.arange(VOXELS) - (VOXELS - 1) / 2) * 2 / VOXELS] * 3, indexing="ij")
        truth = sum(
            a * ((((x - cx) / hx) ** 2 + ((y - cy) / hy) ** 2 + ((z - cz) / hz) ** 2) <= 1)
            for a, cx, cy, cz, hx, hy, hz in OBJECTS[name]
        )
        return Scan(
            projections=frames, geometry=geometry, trajectory=orbit, shutter=Protocol(views=VIEWS).shutter(),
            frame_start_s=start_s, grid=grid, is_fly=False, reference=np.asarray(truth, np.float32),
        )  # fmt: skip

    return scan


def _line_integrals(orbit: CircularOrbit, frame: int, time_s: float, ellipsoids: list[tuple[float, ...]]) -> np.ndarray:
    """A frame (v, u) float32: the chords of ellipsoids, from pixel centres."""
    source, corner, u, v = orbit.pose(frame, np.array([time_s]))[0].reshape(4, 3)
    row, column = np.mgrid[:PANEL, :PANEL]
    ray = corner + column[..., None] * u + row[..., None] * v - source
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    total = np.zeros((PANEL, PANEL))
    for attenuation, *shape in ellipsoids:
        centre, half = np.array(shape[:3]), np.array(shape[3:])
        along, away = ray / half, (source - centre) / half
        a, b, c = (along**2).sum(-1), along @ away, away @ away - 1
        total += attenuation * 2 * np.sqrt(np.maximum(b**2 - a * c, 0)) / a
    return total.astype(np.float32)


@pytest.mark.parametrize("arc_deg", [360.0, 200.0])
@pytest.mark.parametrize("distances", [CONE, PARALLEL], ids=["cone", "parallel"])
@pytest.mark.parametrize("name", OBJECTS)
def test_a_clean_scan_stays_bit_for_bit(rt, make, name, distances, arc_deg) -> None:
    clean = make(name, distances, arc_deg)
    prepared = prepare(clean, DEFAULT_STEPS, device=rt)
    np.testing.assert_array_equal(prepared.projections, clean.projections)
    assert prepared.valid.all() and prepared.provenance[PREPARED_KEY][-1]["result"] == "nothing to do"


@pytest.mark.parametrize("rings", [0.01, 0.02, 0.05])
@pytest.mark.parametrize(("name", "share"), [("grains", 0.75), ("head", 0.65)])
def test_most_of_what_rings_cost_comes_back(rt, make, name, share, rings) -> None:
    """Three quarters, and less where 48 columns hold an object with many edges about the axis."""

    def psnr_db(scan: Scan) -> float:
        return float(compare(reconstruct(scan, "fdk", device=rt).volume, scan.reference)["psnr_db"])

    ringed = make(name, CONE, rings=rings)
    clean_db, ringed_db = psnr_db(make(name, CONE)), psnr_db(ringed)
    prepared = prepare(ringed, DEFAULT_STEPS, device=rt)
    assert ringed_db < clean_db - 0.2
    assert psnr_db(prepared) - ringed_db > share * (clean_db - ringed_db), (clean_db, ringed_db, psnr_db(prepared))
    assert prepared.provenance[PREPARED_KEY][-1]["spread"] == pytest.approx(rings, rel=0.15)


def _spoilt(clean: Scan, rows: slice, columns: slice, gain: float) -> Scan:
    frames = clean.projections.copy()
    frames[:, rows, columns] -= np.float32(np.log(gain))
    return replace(clean, projections=frames)


@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize(
    ("rows", "columns", "gain", "words"),
    [
        (slice(None), slice(8, 9), 1.01, "1 column, gain off by 1.0 %"),
        (slice(None), slice(31, 32), 1.03, "1 column, gain off by 3.0 %"),
        (slice(20, 23), slice(5, 8), 1.05, "9 pixels, gain off by 5."),
    ],
)
def test_a_single_gain_is_regained_and_nothing_else_changes(rt, make, name, rows, columns, gain, words) -> None:
    clean = make(name, CONE)
    prepared = prepare(_spoilt(clean, rows, columns, gain), "rings", device=rt)
    left = np.abs((prepared.projections - clean.projections).mean(axis=0))
    assert left[rows, columns].mean() < 0.2 * np.log(gain)
    left[rows, columns] = 0
    assert not left.any()
    assert prepared.provenance[PREPARED_KEY][-1]["single"].startswith(words)


def test_what_mirrors_itself_or_stands_at_the_axis_is_the_objects(rt, make) -> None:
    """A line at both sides of the axis, and one beside the axis, could be the object's: they stay."""
    clean = make("head", CONE)
    both = _spoilt(_spoilt(clean, slice(None), slice(8, 9), 1.03), slice(None), slice(39, 40), 1.03)
    for scan in (both, _spoilt(clean, slice(None), slice(24, 25), 1.03)):
        np.testing.assert_array_equal(prepare(scan, "rings", device=rt).projections, scan.projections)


def test_a_gap_that_moves_on_is_no_spark(rt, make) -> None:
    """A bright pixel that the frames before and after show too is the object's; in a single frame it is a spark."""
    clean = make("head", CONE)
    frames = clean.projections.copy()
    for f in range(60, 120):
        frames[f, 24, 20 + f // 30] -= 0.25
    moving = replace(clean, projections=frames.copy())
    frames[30, 24, 24] -= 0.25
    both = prepare(replace(clean, projections=frames), "sparks", device=rt)
    assert prepare(moving, "sparks", device=rt).valid[61:119].all()
    assert not both.valid[30, 24, 24] and both.valid[30].sum() == PANEL**2 - 1
