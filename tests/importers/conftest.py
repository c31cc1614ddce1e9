"""One small scan of an asymmetric object in closed form: foreign files are written from it, imports must end at it."""

import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.acquisition import pixel_centres
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.api import CircularOrbit, ConeGeometry, FrameSweeps, ParallelGeometry, Scan, Shutter
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_scan, write_scan
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

collect_ignore = [] if importlib.util.find_spec("itk") else ["test_rtk_projections.py"]
# With import-mode importlib nothing in this folder has a name of its own: tests import the helpers by these.
sys.modules["conftest_of_importers"] = sys.modules[__name__]
for _helper in ("laboratory", "writers"):
    _file = Path(__file__).with_name(f"{_helper}.py")
    _spec = importlib.util.spec_from_file_location(f"{_helper}_of_importers", _file)
    sys.modules[_spec.name] = importlib.util.module_from_spec(_spec)
    _spec.loader.exec_module(sys.modules[_spec.name])

FRAMES = 6
# No two lengths alike and nothing centred, so that every exchange of axes, signs or factors shows.
GEOMETRY = ConeGeometry(500.0, 800.0, (10, 14), (3.0, 2.5), (4.0, -6.0))
GRID = Grid((7, 9, 8), (2.0, 1.5, 1.75), (1.0, -2.0, 3.0))
WORLD_POINTS = np.array([[3.0, -2.0, 1.0], [-4.0, 3.0, 4.5], [1.0, 5.0, -4.0], [0.0, 0.0, 0.0]])
AXES_MM = ((5.0, 4.0, 3.0), (2.0, 2.5, 1.5), (1.5, 1.0, 2.0))
BALLS = EllipsoidPhantom(tuple(map(Ellipsoid, WORLD_POINTS[:3], AXES_MM, (0.03, 0.08, 0.12))), "three balls")
RTOL = 1e-6


@dataclass(frozen=True)
class Truth:
    """What a foreign file describes: the scan, and the gantry's angle at every frame's opening (F,) rad."""

    scan: Scan
    angle_rad: np.ndarray


def projected(pose: np.ndarray, points: np.ndarray, is_parallel: bool = False) -> np.ndarray:
    """Pixels (n, 2) as (row, column) where world points (n, 3) fall for a pose (12,): plain linear algebra."""
    source, first, step_u, step_v = pose.reshape(4, 3)
    found = []
    for point in points:  # start + s ray = first + c step_u + r step_v
        start, ray = (point, source) if is_parallel else (source, point - source)
        found.append(np.linalg.solve(np.stack([ray, -step_u, -step_v], 1), first - start)[:0:-1])
    return np.array(found)


def image(geometry: Geometry, angle_rad: float) -> np.ndarray:
    """Line integrals (v, u) of the three balls."""
    pose = geometry.pose(angle_rad)
    if isinstance(geometry, ParallelGeometry):
        pixels = pixel_centres(pose, geometry.detector_shape)
        return BALLS.line_integrals(pixels - 99 * pose[:3], pixels + 99 * pose[:3])
    return BALLS.line_integrals(pose[:3], pixel_centres(pose, geometry.detector_shape))


@pytest.fixture
def make_truth() -> Callable[..., Truth]:
    """The factory of scans, ``truth``."""
    return truth


def truth(fly: bool = False, axis: str = "rows", direction: int = 1, geometry: Geometry = GEOMETRY) -> Truth:
    """A scan; ``fly`` turns the gantry on during the exposures (frames show its opening pose)."""
    angle_rad = np.deg2rad(10.0 + 25.0 * np.arange(FRAMES))
    frames = np.stack([image(geometry, a) for a in angle_rad]).astype(np.float32)
    exposure_s, frame_time_s = 0.4, 1.25
    start_s = np.arange(FRAMES) * frame_time_s
    arc = np.deg2rad(25.0) * exposure_s / frame_time_s if fly else 0.0
    shutter = Shutter(exposure_s, 0.3, axis, direction) if fly else Shutter(0.0)
    sweeps = FrameSweeps(start_s, shutter.exposure_s, angle_rad, angle_rad + arc)
    orbit, reference = CircularOrbit(geometry, sweeps), BALLS.voxelise(GRID)
    return Truth(Scan(frames, geometry, orbit, shutter, start_s, GRID, fly, reference=reference), angle_rad)


@pytest.fixture
def assert_same(tmp_path) -> Callable[..., None]:
    """Compares an imported scan, through a file of ours, with the same scan written natively."""

    def stored(scan: Scan, name: str) -> Scan:
        write_scan(tmp_path / name, scan)
        return read_scan(tmp_path / name, counts_to_attenuation)

    def compare(found: Scan, truth: Truth, *, grid: bool = True, timing: bool = True, pixels: float = RTOL) -> None:
        ours, native = stored(found, "imported.h5"), stored(truth.scan, "native.h5")
        assert ours.projections.shape == native.projections.shape
        valid = np.ones(native.projections.shape, bool)
        if ours.pixel_mask is not None:
            valid &= ~np.broadcast_to(ours.pixel_mask, valid.shape)
        worst = np.abs(ours.projections - native.projections)[valid].max()
        assert worst <= pixels * native.projections.max() and ours.is_fly == native.is_fly
        if timing:
            compare_timing(ours, native)
        compare_poses(ours, native)
        if grid:
            assert ours.grid.shape == native.grid.shape
            np.testing.assert_allclose(ours.grid.voxel_size_mm, native.grid.voxel_size_mm, rtol=RTOL)
            np.testing.assert_allclose(ours.grid.offset_mm, native.grid.offset_mm, rtol=RTOL, atol=RTOL)
            np.testing.assert_allclose(ours.reference, native.reference, rtol=RTOL, atol=1e-9)

    return compare


def compare_timing(ours: Scan, native: Scan) -> None:
    """Exposure, readout, reading order, and the times between frames."""
    assert ours.shutter.exposure_s == pytest.approx(native.shutter.exposure_s, rel=RTOL)
    assert ours.shutter.readout_s == pytest.approx(native.shutter.readout_s, rel=RTOL)
    if native.is_fly:
        assert (ours.shutter.axis, ours.shutter.direction) == (native.shutter.axis, native.shutter.direction)
        elapsed = [scan.frame_start_s - scan.frame_start_s[0] for scan in (ours, native)]
        np.testing.assert_allclose(*elapsed, rtol=RTOL, atol=1e-9)


def pose_at(scan: Scan, frame: int, share: float) -> np.ndarray:
    """The pose (12,) after a share of a frame's window."""
    return scan.trajectory.pose(frame, scan.frame_start_s[frame] + share * np.array([scan.shutter.span_s]))[0]


def compare_poses(ours: Scan, native: Scan) -> None:
    """Where world points fall, at five shares of every frame's window."""
    assert ours.is_parallel == native.is_parallel
    for frame in range(native.frames):
        for share in (0.0, 0.3, 0.5, 0.8, 1.0):
            our, their = pose_at(ours, frame, share), pose_at(native, frame, share)
            seen = (projected(pose, WORLD_POINTS, native.is_parallel) for pose in (our, their))
            np.testing.assert_allclose(*seen, rtol=0, atol=RTOL)
            np.testing.assert_allclose(our, their, rtol=0, atol=1e-5)
