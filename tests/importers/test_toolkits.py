"""Geometries of TIGRE and LEAP: each against its own formula."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import writers_of_importers as w
from conftest_of_importers import GEOMETRY, WORLD_POINTS, pose_at, projected

from phyradgs_cl.acquisition import CircularOrbit, ParallelGeometry, PoseTable
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers import ImportOptions, import_scan, recognise

pytestmark = pytest.mark.slow
SQUARE = replace(GEOMETRY, detector_offset_mm=(3.0, -5.0))  # whole and half pixels, which text keeps to the bit
FLAT = ParallelGeometry((10, 14), (3.0, 2.5), (3.0, -5.0))


@pytest.mark.parametrize("geometry", [SQUARE, FLAT], ids=["cone", "parallel"])
@pytest.mark.parametrize("form", ["leap", "tigre"])
def test_pixels_and_geometry_are_those_of_the_scan(tmp_path, make_truth, assert_same, form, geometry) -> None:
    writer, name = w.WRITERS[form]
    truth = make_truth(geometry=geometry)
    grid = replace(truth.scan.grid, voxel_size_mm=(2.0, 1.5, 1.5))
    if geometry is FLAT:  # LEAP's volume of a parallel beam has the panel's rows, wherever these are
        grid = Grid((10, 9, 8), (3.0, 1.5, 1.5), (3.0, -2.0, 3.0))
    truth = replace(truth, scan=replace(truth.scan, grid=grid, reference=None))
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


@pytest.mark.parametrize("row", [0.0, 4.5, 12.0])
def test_leap_s_volume_of_a_parallel_beam_is_tied_to_the_panel_s_rows(tmp_path, make_truth, caplog, row) -> None:
    """Slice k lies at (k − centerRow) · pixelHeight, by LEAP's z_0; its offsetZ is always 0."""
    truth, volume = make_truth(geometry=FLAT), {"numZ": 10, "voxelHeight": "3.000001", "centerRow": row}
    grid = import_scan(w.write_leap(tmp_path / "a", truth, **volume, offsetZ=7.0)).grid
    assert grid.box_mm[0] == pytest.approx((-3.0 * (row + 0.5), 3.0 * (9.5 - row)), abs=1e-4)
    assert "offsetZ is not used" in caplog.text
    for i, (name, value) in enumerate({"numZ": 9, "voxelHeight": 2.0}.items()):
        with pytest.raises(InputError, match=f"{name}: found {value:g}; expected (10|3), the panel's"):
            import_scan(w.write_leap(tmp_path / str(i), truth, **{**volume, name: value}))
    none = import_scan(w.write_leap(tmp_path / "b", truth, numZ=None))
    assert none.grid.box_mm[0].mean() == pytest.approx(FLAT.detector_offset_mm[0], abs=3.0)


@pytest.mark.parametrize("long", [1.0, 0.25, 3.0])
def test_leap_s_modular_beam_is_a_table_of_views(tmp_path, make_truth, assert_same, long) -> None:
    """Vectors of rows and columns are directions, which LEAP makes orthogonal."""
    truth = make_truth()
    source, first, step_u, step_v = GEOMETRY.pose(truth.angle_rad).reshape(-1, 4, 3).swapaxes(0, 1)
    centre = first + 6.5 * step_u + 4.5 * step_v
    skew = (step_v / 3.0 + 4e-4 * (long != 1) * step_u / 2.5) * np.linspace(1, long, len(step_v))[:, None]
    vectors = {"sourcePositions": source, "moduleCenters": centre, "rowVectors": skew, "colVectors": step_u / 2.5 * long}

    def written(name: str, **changed: np.ndarray) -> Path:
        lines = {key: ", ".join(map(repr, table.ravel().tolist())) for key, table in (vectors | changed).items()}
        return w.write_leap(tmp_path / name, truth, **{**lines, "geometry": "modular", "phis": None})

    scan = import_scan(path := written("a"))
    assert isinstance(scan.trajectory, PoseTable)
    assert_same(scan, truth, grid=False)
    with pytest.raises(InputError, match="rotates with format leap, which states every view"):
        import_scan(path, ImportOptions(rotates="sample"))
    with pytest.raises(InputError, match="colVectors: found a vector of length 0 in view 2"):
        import_scan(written("b", colVectors=step_u * (np.arange(6) != 2)[:, None]))
    with pytest.raises(InputError, match="rowVectors: found 87.71° to colVectors; expected 90°"):
        import_scan(written("c", rowVectors=step_v / 3.0 + 0.04 * step_u / 2.5))


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


@pytest.mark.parametrize("protocol", range(6))
def test_tigre_s_geometry_of_every_protocol(tmp_path, make_truth, assert_same, protocol) -> None:
    """Protocols 0 and 1 make objects by a function of copyreg."""
    truth = make_truth(geometry=SQUARE)
    assert_same(import_scan(w.write_tigre(tmp_path / "a.pkl", truth, protocol)), truth, grid=False, pixels=0)
