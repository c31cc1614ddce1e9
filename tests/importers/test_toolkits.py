"""Geometries of TIGRE and LEAP: each against its own formula."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import tifffile
import writers_of_importers as w
from conftest_of_importers import GEOMETRY, WORLD_POINTS, pose_at, projected

from phyradgs_cl.acquisition import CircularOrbit, ParallelGeometry, PoseTable
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan, recognise

pytestmark = pytest.mark.slow
SQUARE = replace(GEOMETRY, detector_offset_mm=(3.0, -5.0))  # whole and half pixels, which text keeps to the bit
FLAT = ParallelGeometry((10, 14), (3.0, 2.5), (3.0, -5.0))


@pytest.mark.parametrize("geometry", [SQUARE, FLAT], ids=["cone", "parallel"])
@pytest.mark.parametrize("form", ["leap", "tigre"])
def test_pixels_and_geometry_are_those_of_the_scan(tmp_path, make_truth, assert_same, form, geometry) -> None:
    writer, name = w.WRITERS[form]
    truth = make_truth(geometry=geometry)
    truth = replace(truth, scan=replace(truth.scan, grid=replace(truth.scan.grid, voxel_size_mm=(2.0, 1.5, 1.5))))
    path = writer(tmp_path / name, truth)
    assert recognise(path) == form
    scan = import_scan(path)
    assert isinstance(scan.trajectory, CircularOrbit) and scan.geometry == geometry and scan.grid == truth.scan.grid
    assert_same(scan, truth, grid=False, pixels=0)


def leap_pixels(points: np.ndarray, phi_deg: float, values: dict[str, float]) -> np.ndarray:
    """(row, column) of points by LEAP's formula: u = (x · θ⊥ + τ) / (R − x · θ), v = x_z / (R − x · θ)."""
    phi = np.deg2rad(phi_deg) - np.pi / 2
    theta, across = np.array([np.cos(phi), np.sin(phi), 0]), np.array([-np.sin(phi), np.cos(phi), 0])
    depth = values["sod"] - points @ theta
    u, v = (values["sdd"] * part / depth for part in (points @ across + values["tau"], points[:, 2]))
    column = u / values["pixelWidth"] + values["centerCol"]
    return np.stack([v / values["pixelHeight"] + values["centerRow"], column], -1)


def test_leap_s_formula_sees_points_where_our_poses_do(tmp_path, make_truth, caplog) -> None:
    """τ above 0 moves source and panel against the columns; equal steps begin at 0°; frames may be TIFFs."""
    truth = make_truth()
    path = w.write_leap(tmp_path / "a", truth, tau=2.5, phis=None, angularRange=-300.0)
    values, scan = {**w.leap_values(truth), "tau": 2.5}, import_scan(path / "params.txt")
    for frame in range(6):
        expected = leap_pixels(WORLD_POINTS, -50.0 * frame, values)
        np.testing.assert_allclose(projected(pose_at(scan, frame, 0.5), WORLD_POINTS), expected, atol=1e-6)
    assert "no phis (angularRange in equal steps from 0°)" in caplog.text
    (path / "g.npy").unlink()
    for i, image in enumerate(truth.scan.projections):
        tifffile.imwrite(path / f"g_{i}.tif", image)
    assert recognise(path) == "leap"
    np.testing.assert_array_equal(import_scan(path).projections, truth.scan.projections)


def test_leap_s_modular_beam_is_a_table_of_views(tmp_path, make_truth, assert_same) -> None:
    truth = make_truth()
    source, first, step_u, step_v = GEOMETRY.pose(truth.angle_rad).reshape(-1, 4, 3).swapaxes(0, 1)
    centre = first + 6.5 * step_u + 4.5 * step_v
    vectors = {"sourcePositions": source, "moduleCenters": centre, "rowVectors": step_v / 3.0, "colVectors": step_u / 2.5}
    lines = {name: ", ".join(map(repr, table.ravel().tolist())) for name, table in vectors.items()}
    path = w.write_leap(tmp_path / "a", truth, **{**lines, "geometry": "modular", "phis": None})
    scan = import_scan(path)
    assert isinstance(scan.trajectory, PoseTable)
    assert_same(scan, truth, grid=False)
    with pytest.raises(InputError, match="rotates with format leap, which states every view"):
        import_scan(path, ImportOptions(rotates="sample"))


RAW = {"_Frames.xml": "1.his", "ProjectionInfo.xml": "1.hnd", "Scan.xml": "1.xim", "a.ora.xml": "b.ora.xml"}


def test_raw_projections_are_recognised_and_name_the_package_that_reads_them(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "itk", None)
    for description, projection in RAW.items():
        (folder := tmp_path / projection).mkdir()
        for name in (description, projection):
            (folder / name).touch()
        assert recognise(folder) == recognise(folder / description) == "rtk-projections"
        with pytest.raises(InputError, match=r"phyradgs-cl\[rtk\]"):
            import_scan(folder)


def test_tigre_s_centre_of_rotation_and_values_per_frame(tmp_path, make_truth) -> None:
    truth = make_truth(geometry=SQUARE)
    offsets = np.tile([3.0, -5.0], (6, 1)) + np.arange(6)[:, None] * [0.5, 0.25]
    scan = import_scan(w.write_tigre(tmp_path / "a.pkl", truth, COR=1.5, offDetector=offsets))
    assert isinstance(scan.trajectory, PoseTable)
    for frame in range(6):
        geometry = replace(SQUARE, detector_offset_mm=tuple(offsets[frame].tolist()))
        pose = geometry.pose(truth.angle_rad[frame])
        pose[:6] += np.tile(1.5 * pose[6:9] / 2.5, 2)
        expected = projected(pose, WORLD_POINTS)
        np.testing.assert_allclose(projected(pose_at(scan, frame, 0.5), WORLD_POINTS), expected, atol=1e-6)
