"""Geometries of ASTRA and TIGRE: points fall where those programs' own definitions put them."""

from types import SimpleNamespace

import numpy as np
import pytest

from phyradgs_cl import api
from phyradgs_cl.acquisition import CircularOrbit, PoseTable
from phyradgs_cl.api import ConeGeometry, Gaussians, Grid, ParallelGeometry, Scan, splat_operator
from phyradgs_cl.errors import InputError

pytestmark = pytest.mark.slow
RNG = np.random.default_rng(5)
POINTS = RNG.uniform(-18, 18, (4, 3))  # x y z, mm
PANEL, ANGLES = (23, 29), np.array([0.3, 1.7, 2.9, 4.4])
FRAMES = np.zeros((4, *PANEL), np.float32)
PIXEL = 0.05


def tigre(**changes: object) -> SimpleNamespace:
    """A TIGRE geometry with different lengths and nothing centred."""
    own = {
        "mode": "cone", "DSO": 400.0, "DSD": 700.0, "nDetector": np.array(PANEL), "dDetector": np.array([4.0, 3.5]),
        "offDetector": np.array([5.0, -4.0]), "nVoxel": np.array([8, 10, 12]), "dVoxel": np.array([5.0, 4.5, 4.0]),
        "offOrigin": np.array([1.0, -2.0, 3.0]),
    }  # fmt: skip
    return SimpleNamespace(**{**own, **changes})


def tigre_pixels(geo: SimpleNamespace, i: int) -> np.ndarray:
    """(row, column) of the points in frame i: the object turns by −α in front of a source on the x axis."""
    at = {name: np.broadcast_to(getattr(geo, name, 0.0), 4)[i] for name in ("DSO", "DSD", "COR")}
    off_v, off_u = np.broadcast_to(geo.offDetector, (4, 2))[i]
    x = np.cos(ANGLES[i]) * POINTS[:, 0] + np.sin(ANGLES[i]) * POINTS[:, 1]
    y = -np.sin(ANGLES[i]) * POINTS[:, 0] + np.cos(ANGLES[i]) * POINTS[:, 1] - at["COR"]
    larger = at["DSD"] / (at["DSO"] - x)
    v, u = larger * POINTS[:, 2] - off_v, larger * y - off_u
    return np.stack([v / 4.0 + (PANEL[0] - 1) / 2, u / 3.5 + (PANEL[1] - 1) / 2], -1)


def drawn_pixels(scan: Scan, rt) -> np.ndarray:
    """(F, points, 2): the centre of each small Gaussian's picture, as our projector draws it."""
    found = []
    for point in POINTS:
        dot = Gaussians(point[None], np.full((1, 3), 2.5), np.array([[1.0, 0, 0, 0]]), np.ones(1))
        frames = splat_operator(scan, "static", cutoff_sigma=0.0, device=rt)(dot).astype(np.float64)
        grid = np.indices(frames.shape[1:])
        found.append(np.einsum("fvu,kvu->fk", frames, grid) / frames.sum(axis=(1, 2))[:, None])
    return np.stack(found, 1)


OWN = {"DSO": np.array([400.0, 410.0, 395.0, 402.0]), "offDetector": np.array([[5.0, -4.0], [2, 1], [0, 3], [-1, 6]])}


@pytest.mark.parametrize("changes", [{}, {"COR": 3.0}, OWN], ids=["circular", "centre of rotation", "own of every frame"])
def test_points_fall_where_tigre_puts_them(rt, changes, caplog) -> None:
    geo = tigre(**changes)
    scan = Scan.from_tigre(geo, ANGLES, FRAMES)
    assert "degrees" not in caplog.text
    Scan.from_tigre(geo, np.rad2deg(ANGLES), FRAMES)
    assert "4 frames over 234.9 rad: are they degrees?" in caplog.text
    assert np.abs(drawn_pixels(scan, rt) - np.stack([tigre_pixels(geo, i) for i in range(4)])).max() < PIXEL
    assert isinstance(scan.trajectory, CircularOrbit if len(changes) == 0 else (PoseTable, CircularOrbit))
    assert scan.grid == Grid((8, 10, 12), (5.0, 4.5, 4.0), (1, -2, 3))


def test_masked_pixels_may_hold_anything_whoever_says_the_geometry() -> None:
    mask = np.zeros(PANEL, bool)
    mask[:2] = True
    frames = np.where(mask, np.nan, FRAMES)
    frames[:, 1] = 1e9  # a broken line
    cone = ConeGeometry(400.0, 700.0, PANEL, (4.0, 3.5))
    makers = {
        "from_poses": lambda values: Scan.from_poses(values, cone.pose(ANGLES), pixel_mask=mask),
        "from_tigre": lambda values: Scan.from_tigre(tigre(), ANGLES, values, pixel_mask=mask),
        "static_scan": lambda values: api.static_scan(values, cone, np.rad2deg(ANGLES), mask=mask),
    }
    for name, make in makers.items():
        scan = make(frames)
        assert np.isfinite(scan.projections).all() and not scan.valid[:, :2].any() and scan.valid[:, 2:].all(), name
        if name != "static_scan":  # which masks them itself
            with pytest.raises(InputError, match="projections: found 4 NaN"):
                make(np.where(np.arange(PANEL[0] * PANEL[1]).reshape(PANEL) == 99, np.nan, frames))


def astra_vectors() -> np.ndarray:
    """Cones that wobble: every frame with its own source, panel, pitch and tilt."""
    vectors = np.zeros((4, 12))
    for i, angle in enumerate(ANGLES):
        out, along = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
        vectors[i, :3] = (400 + 3 * i) * out + [0, 0, 2.0 * i]
        vectors[i, 3:6] = -300 * out + 4 * along + [0, 0, -3.0]
        vectors[i, 6:9] = 3.5 * along + [0, 0, 0.05 * i]
        vectors[i, 9:12] = [0.1, -0.05 * i, 4.0]
    return vectors


@pytest.mark.parametrize("is_parallel", [False, True])
def test_points_fall_where_astra_puts_them_and_the_vectors_come_back(rt, tmp_path, is_parallel) -> None:
    """``cone_vec`` and ``parallel3d_vec``: rays of any length that rise, panels that lean and lie anywhere on them."""
    vectors = astra_vectors()
    if is_parallel:
        vectors[:, :3] = [[-2 * np.cos(a), -2 * np.sin(a), 0.01 * i] for i, a in enumerate(ANGLES)]
    scan = Scan.from_astra(FRAMES, vectors, is_parallel=is_parallel)
    assert scan.is_parallel == isinstance(scan.geometry, ParallelGeometry) == is_parallel
    assert isinstance(scan.trajectory, PoseTable)
    expected = np.zeros((4, 4, 2))
    for i, v in enumerate(vectors):
        for k, point in enumerate(POINTS):  # point + t·ray = panel + a·u + b·v
            ray = v[:3] if is_parallel else point - v[:3]
            a, b, _ = np.linalg.solve(np.stack([v[6:9], v[9:12], -ray], 1), point - v[3:6])
            expected[i, k] = b + (PANEL[0] - 1) / 2, a + (PANEL[1] - 1) / 2
    assert np.abs(drawn_pixels(scan, rt) - expected).max() < PIXEL
    if is_parallel:
        vectors[:, :3] /= np.linalg.norm(vectors[:, :3], axis=1, keepdims=True)
    np.testing.assert_allclose(scan.astra_vectors(), vectors, atol=1e-9)
    api.save_scan(tmp_path / "s.h5", scan)
    np.testing.assert_allclose((stored := api.load_scan(tmp_path / "s.h5")).astra_vectors(), vectors, atol=1e-6)
    assert stored.is_parallel == is_parallel


def test_tigre_s_parallel_mode_is_astra_s_parallel_geometry(rt, tmp_path) -> None:
    """On a circle, which files hold as angles; distances are not used, and COR moves the panel."""
    scan = Scan.from_tigre(tigre(mode="parallel", DSO=None, DSD=None, COR=1.5), ANGLES, FRAMES)
    assert isinstance(scan.trajectory, CircularOrbit) and scan.title == "parallel-beam scan"
    assert scan.geometry.detector_offset_mm == pytest.approx((5.0, -2.5))
    v = POINTS[:, 2] - 5.0
    for i, angle in enumerate(ANGLES):
        u = np.cos(angle) * POINTS[:, 1] - np.sin(angle) * POINTS[:, 0] + 2.5
        expected = np.stack([v / 4.0 + (PANEL[0] - 1) / 2, u / 3.5 + (PANEL[1] - 1) / 2], -1)
        assert np.abs(drawn_pixels(scan, rt)[i] - expected).max() < PIXEL
    back = Scan.from_astra(FRAMES, scan.astra_vectors(), scan.grid, is_parallel=True)
    assert back.geometry.pixel_size_mm == pytest.approx((4.0, 3.5)) and isinstance(back.trajectory, CircularOrbit)
    api.save_scan(tmp_path / "s.h5", back)
    np.testing.assert_allclose(api.load_scan(tmp_path / "s.h5").astra_vectors(), scan.astra_vectors(), atol=1e-9)


def test_rows_may_run_down(rt, scan) -> None:
    """ASTRA's users often let v point down: the volume does not care."""
    still, vectors = Scan.from_astra(scan.projections, scan.astra_vectors(), scan.grid), scan.astra_vectors()
    vectors[:, 9:12] *= -1
    down = Scan.from_astra(scan.projections[:, ::-1], vectors, scan.grid)
    for method in ({"method": "fdk"}, {"method": "sirt", "iterations": 3}):
        up, turned = (api.reconstruct(s, device=rt, **method).volume for s in (still, down))
        assert np.abs(up - turned).max() < 1e-4 * up.max(), method
