"""What is written comes back: every trajectory, shutter, mask and quantity of the scan format."""

from __future__ import annotations

import dataclasses

import h5py
import numpy as np
import pytest

from phyradgs_cl.acquisition import (
    CircularOrbit,
    ConeGeometry,
    ConstantSpeed,
    EncoderTable,
    FrameSweeps,
    MicroViews,
    PoseTable,
    Saturation,
    Shutter,
    SpeedRamp,
    Static,
)
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import default_grid, file_kind, read_scan, scan_summary, sha256_of, write_scan

ANGLE_TOLERANCE_RAD = 1e-12  # degrees in the file: two roundings of angles of order 1
LENGTH_TOLERANCE_MM = 1e-9  # that angle at 785 mm
RAMP_TOLERANCE_MM = 2e-6  # a speed ramp is stored as straight pieces, a nanoradian off at 1200 mm


def same_poses(scan, again, tolerance_mm=LENGTH_TOLERANCE_MM) -> None:
    """Both scans put the gantry at the same places during every exposure and readout."""
    for frame, start_s in enumerate(scan.frame_start_s):
        last_s = scan.shutter.span_s if scan.is_fly else 0.0
        ours = scan.trajectory.pose(frame, start_s + np.linspace(0, last_s, 7))
        theirs = again.trajectory.pose(frame, again.frame_start_s[frame] + np.linspace(0, last_s, 7))
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=tolerance_mm)


def test_fields_come_back(tmp_path, make_scan) -> None:
    mask = np.zeros((3, 5), bool)
    mask[1, 2] = True
    reference = np.arange(24, dtype=np.float32).reshape(2, 3, 4) / 100
    facts = {"provenance": {"seed": 3, "method": "made up"}, "saturation": Saturation(4095.0, 0.25)}
    scan = make_scan(pixel_mask=mask, reference=reference, **facts)
    write_scan(tmp_path / "scan.h5", scan)
    again = read_scan(tmp_path / "scan.h5", counts_to_attenuation)
    assert again.saturation == scan.saturation
    np.testing.assert_array_equal(again.projections, scan.projections)
    assert again.projections.dtype == np.float32
    np.testing.assert_array_equal(again.reference, reference)
    np.testing.assert_array_equal(again.pixel_mask, mask)
    np.testing.assert_array_equal(again.frame_start_s, scan.frame_start_s)
    for name in ("shutter", "grid", "is_fly", "detector_model", "title", "provenance"):
        assert getattr(again, name) == getattr(scan, name), name
    for field in dataclasses.fields(scan.geometry):
        ours, theirs = getattr(scan.geometry, field.name), getattr(again.geometry, field.name)
        np.testing.assert_allclose(theirs, ours, rtol=1e-15, err_msg=field.name)
    same_poses(scan, again)


def kinematics(name: str):
    wander = np.cumsum(np.random.default_rng(1).uniform(0, 0.02, 60))
    return {
        "constant": ConstantSpeed(0.3, 0.1),
        "backwards": ConstantSpeed(0.3, -0.1),
        "ramp": SpeedRamp(0.3, 0.1, 0.02),
        "encoder": EncoderTable(np.linspace(0.5, 5.6, 60), wander),
    }[name]


@pytest.mark.parametrize("name", ["constant", "backwards", "ramp", "encoder"])
def test_kinematics_come_back(tmp_path, make_scan, name) -> None:
    scan = make_scan()
    scan = dataclasses.replace(scan, trajectory=CircularOrbit(scan.geometry, kinematics(name)))
    write_scan(tmp_path / "scan.h5", scan)
    again = read_scan(tmp_path / "scan.h5", counts_to_attenuation)
    assert again.is_fly
    assert isinstance(
        again.trajectory.kinematics, FrameSweeps if name in ("constant", "backwards") else EncoderTable
    )
    same_poses(scan, again, RAMP_TOLERANCE_MM if name == "ramp" else LENGTH_TOLERANCE_MM)


def wobbling_table(scan) -> PoseTable:
    time_s = np.linspace(0.4, 5.7, 25)
    table = scan.geometry.pose(0.2 * time_s)
    return PoseTable(
        time_s, table + np.random.default_rng(2).normal(0, 0.5, table.shape) * np.repeat([1, 1, 0, 0], 3)
    )


def test_pose_table_comes_back(tmp_path, make_scan) -> None:
    scan = make_scan()
    scan = dataclasses.replace(scan, trajectory=wobbling_table(scan))
    write_scan(tmp_path / "scan.h5", scan)
    again = read_scan(tmp_path / "scan.h5", counts_to_attenuation)
    np.testing.assert_array_equal(again.trajectory.table, scan.trajectory.table)
    assert again.is_fly
    same_poses(scan, again)


@pytest.mark.parametrize("kind", ["sweeps", "encoder", "poses"])
def test_standing_gantry_stays_static_with_the_same_poses(tmp_path, make_scan, kind) -> None:
    scan = make_scan(is_fly=False)
    if kind == "encoder":
        scan = dataclasses.replace(scan, trajectory=CircularOrbit(scan.geometry, kinematics("encoder")))
    if kind == "poses":
        scan = dataclasses.replace(scan, trajectory=wobbling_table(scan))
    write_scan(tmp_path / "scan.h5", scan)
    again = read_scan(tmp_path / "scan.h5", counts_to_attenuation)
    assert not again.is_fly
    for frame in range(scan.frames):  # the pose that a reconstruction uses
        ours, theirs = (MicroViews().cells(s, frame).pose for s in (scan, again))
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=LENGTH_TOLERANCE_MM)


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("readout_s", [0.0, 0.3])
def test_shutters_come_back(tmp_path, make_scan, axis, direction, readout_s) -> None:
    shutter = Shutter(0.8, readout_s, axis, direction)
    write_scan(tmp_path / "scan.h5", make_scan(shutter=shutter))
    assert read_scan(tmp_path / "scan.h5", counts_to_attenuation).shutter == shutter


@pytest.mark.parametrize("is_fly", [True, False])
def test_pulse_and_lag_come_back(tmp_path, make_scan, is_fly) -> None:
    path = tmp_path / "scan.h5"
    write_scan(path, make_scan())
    with h5py.File(path) as file:
        assert not {"pulse_start", "pulse_length", "lag"} & set(file["entry/phyradgs"])
    assert read_scan(path, counts_to_attenuation).lag == 0
    pulsed = Shutter(0.8, 1.2, "columns", -1, (0.25, 0.5))
    scan = make_scan(shutter=pulsed, lag=0.04, is_fly=is_fly)
    assert scan.pixel_mask[:, 0].all() and not scan.pixel_mask[:, 2:].any()  # column 0 opens last, at 1.2 s
    write_scan(path, scan)
    again = read_scan(path, counts_to_attenuation)
    assert (again.shutter, again.lag) == (pulsed, 0.04)
    np.testing.assert_array_equal(again.pixel_mask, scan.pixel_mask)
    for frame in range(scan.frames):
        ours, theirs = (Static().cells(s, frame).pose for s in (scan, again))
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=LENGTH_TOLERANCE_MM)
    facts = scan_summary(path)
    assert (facts["pulse_start_s"], facts["pulse_length_s"], facts["lag"]) == (0.25, 0.5, 0.04)
    assert facts["dark_lines"] == 2


def test_a_standing_gantry_on_a_pose_table_keeps_its_pulsed_pose(tmp_path, make_scan) -> None:
    pulsed = Shutter(0.8, 0.3, "columns", -1, (0.2, 0.2))
    scan = make_scan(is_fly=False, shutter=pulsed)
    scan = dataclasses.replace(scan, trajectory=wobbling_table(scan))
    write_scan(tmp_path / "scan.h5", scan)
    again = read_scan(tmp_path / "scan.h5", counts_to_attenuation)
    assert again.shutter.pulse_s is None
    for frame in range(scan.frames):
        ours, theirs = (Static().cells(s, frame).pose for s in (scan, again))
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=LENGTH_TOLERANCE_MM)


@pytest.mark.parametrize(
    ("name", "value", "culprit"),
    [
        ("lag", 1.0, "lag"),
        ("lag", -0.1, "lag"),
        ("pulse_length", 0.0, "pulse_length"),
        ("pulse_start", 7.0, "pulse_start"),
        ("pulse_start", None, "pulse_start"),
    ],
)
def test_impossible_pulses_and_lags_are_named(tmp_path, make_scan, name, value, culprit) -> None:
    path = tmp_path / "scan.h5"
    write_scan(path, make_scan(shutter=Shutter(0.8, 0.3, "columns", -1, (0.25, 0.5)), lag=0.1))
    with h5py.File(path, "r+") as file:
        if value is None:
            del file[f"entry/phyradgs/{name}"]
        else:
            file[f"entry/phyradgs/{name}"][...] = value
    with pytest.raises(InputError, match=f"/entry/phyradgs/{culprit}"):
        read_scan(path, counts_to_attenuation)


def test_fly_rule_follows_motion_and_exposure(tmp_path, make_scan) -> None:
    path = tmp_path / "scan.h5"
    write_scan(path, make_scan())
    assert read_scan(path, counts_to_attenuation).is_fly
    with h5py.File(path, "r+") as file:
        file["entry/instrument/detector/count_time"][...] = 0.0
    assert not read_scan(path, counts_to_attenuation).is_fly
    write_scan(path, make_scan())
    with h5py.File(path, "r+") as file:
        del file["entry/sample/rotation_angle_end"]
    again = read_scan(path, counts_to_attenuation)
    assert not again.is_fly and again.shutter.exposure_s == 0.8
    np.testing.assert_array_equal(
        again.trajectory.kinematics.angle_end_rad, again.trajectory.kinematics.angle_start_rad
    )


def test_poses_win_over_encoder_over_angles(tmp_path, make_scan) -> None:
    path, scan = tmp_path / "scan.h5", make_scan()
    with_encoder = dataclasses.replace(scan, trajectory=CircularOrbit(scan.geometry, kinematics("encoder")))
    write_scan(path, dataclasses.replace(scan, trajectory=wobbling_table(scan)))
    write_scan(tmp_path / "encoder.h5", with_encoder)
    with h5py.File(path, "r+") as file, h5py.File(tmp_path / "encoder.h5") as other:
        other.copy("entry/phyradgs/kinematics", file["entry/phyradgs"])
    assert isinstance(read_scan(path, counts_to_attenuation).trajectory, PoseTable)
    with h5py.File(path, "r+") as file:
        del file["entry/phyradgs/poses"]
    same_poses(with_encoder, read_scan(path, counts_to_attenuation))


def counts_scan(make_scan):
    """Raw counts made here with flats, darks and an invalid frame between the projections."""
    scan = make_scan()
    key = np.array([1, 2, 0, 0, 3, 1, 0, 2, 0])
    flat, dark = np.linspace(40000, 50000, 15).reshape(3, 5), np.linspace(90, 110, 15).reshape(3, 5)
    data = np.empty((len(key), 3, 5))
    data[key == 1], data[key == 2], data[key == 3] = flat, dark, 12345
    data[key == 0] = dark + (flat - dark) * np.exp(-scan.projections)
    return scan, key, np.round(data).astype(np.uint16)


def test_counts_lose_flats_darks_and_invalid_frames(tmp_path, make_scan) -> None:
    scan, key, data = counts_scan(make_scan)
    path = tmp_path / "scan.h5"
    write_scan(path, scan, data=data, image_key=key, quantity="counts")
    with h5py.File(path) as file:
        assert file["entry/instrument/detector/data"].dtype == np.uint16
        assert all(len(file[name]) == 9 for name in ("entry/sample/rotation_angle", "entry/data/image_key"))
    again = read_scan(path, counts_to_attenuation)
    flat, dark = np.round(data[0].astype(float)), np.round(data[1].astype(float))
    expected = -np.log((data[key == 0] - dark) / (flat - dark))
    np.testing.assert_allclose(again.projections, expected, rtol=0, atol=2e-6)  # float32 near 4
    np.testing.assert_allclose(again.frame_start_s, scan.frame_start_s)
    same_poses(scan, again)
    assert again.pixel_mask is None


def test_masks_of_frames_follow_their_frames(tmp_path, make_scan) -> None:
    scan, key, data = counts_scan(make_scan)
    mask = np.zeros((4, 3, 5), np.int32)
    mask[[0, 1, 2, 3], [0, 1, 2, 0], [4, 3, 2, 1]] = [1, 2, 64, 256]  # NeXus puts reasons into bits
    write_scan(
        tmp_path / "scan.h5",
        dataclasses.replace(scan, pixel_mask=mask),
        data=data,
        image_key=key,
        quantity="counts",
    )
    again = read_scan(tmp_path / "scan.h5", counts_to_attenuation)
    np.testing.assert_array_equal(again.pixel_mask, mask != 0)


def test_pixels_that_the_conversion_rejects_join_the_mask(tmp_path, make_scan) -> None:
    scan, key, data = counts_scan(make_scan)
    mask = np.zeros((3, 5), bool)
    mask[2, 4] = True
    data[6, 1, 1] = 0  # below the dark: third projection
    write_scan(
        tmp_path / "scan.h5",
        dataclasses.replace(scan, pixel_mask=mask),
        data=data,
        image_key=key,
        quantity="counts",
    )
    again = read_scan(tmp_path / "scan.h5", counts_to_attenuation)
    expected = np.repeat(mask[None], 4, 0)
    expected[2, 1, 1] = True
    np.testing.assert_array_equal(again.pixel_mask, expected)


def test_transmission_is_converted(tmp_path, make_scan) -> None:
    scan = make_scan()
    data = np.exp(-scan.projections)
    write_scan(tmp_path / "scan.h5", scan, data=data, image_key=np.zeros(4, int), quantity="transmission")
    again = read_scan(tmp_path / "scan.h5", counts_to_attenuation)
    np.testing.assert_allclose(again.projections, scan.projections, atol=1e-5)


def test_masked_pixels_may_be_nan(tmp_path, make_scan) -> None:
    scan = make_scan(pixel_mask=np.arange(15).reshape(3, 5) == 7)
    scan.projections[1, 1, 2] = np.nan
    write_scan(tmp_path / "scan.h5", scan)
    again = read_scan(tmp_path / "scan.h5", counts_to_attenuation)
    assert np.isfinite(again.projections).all()
    assert np.broadcast_to(again.pixel_mask, again.projections.shape)[1, 1, 2]


UNITS = {
    "instrument/detector/x_pixel_size": [("um", 1e3), ("m", 1e-3), ("cm", 0.1), ("millimetre", 1.0)],
    "instrument/detector/distance": [("m", 1e-3)],
    "instrument/source/distance": [("m", 1e-3), ("m", -1e-3)],
    "instrument/detector/count_time": [("ms", 1e3), ("us", 1e6)],
    "instrument/detector/frame_start_time": [("ms", 1e3)],
    "sample/rotation_angle": [("rad", np.pi / 180)],
    "phyradgs/grid/voxel_size": [("m", 1e-3)],
    "phyradgs/detector_offset": [("um", 1e3)],
    "phyradgs/reference/volume": [("1/cm", 10.0), ("1/m", 1e3)],
}


@pytest.mark.parametrize("name, unit, factor", [(n, u, f) for n, us in UNITS.items() for u, f in us])
def test_units_are_converted(tmp_path, make_scan, name, unit, factor) -> None:
    path, scan = tmp_path / "scan.h5", make_scan(reference=np.full((2, 3, 4), 0.02, np.float32))
    write_scan(path, scan)
    with h5py.File(path, "r+") as file:
        dataset = file[f"entry/{name}"]
        dataset[...] = dataset[...] * factor
        dataset.attrs["units"] = unit
    again = read_scan(path, counts_to_attenuation)
    np.testing.assert_allclose(again.reference, scan.reference, rtol=1e-6)
    np.testing.assert_allclose(again.grid.voxel_size_mm, scan.grid.voxel_size_mm)
    assert again.shutter.exposure_s == pytest.approx(0.8)
    same_poses(scan, again)


def test_missing_units_are_assumed_and_said(tmp_path, make_scan, caplog) -> None:
    path, scan = tmp_path / "scan.h5", make_scan()
    write_scan(path, scan)
    with h5py.File(path, "r+") as file:
        del file["entry/instrument/detector/distance"].attrs["units"]
    again = read_scan(path, counts_to_attenuation)
    assert again.geometry.source_to_detector_mm == pytest.approx(1200)
    assert "/entry/instrument/detector/distance: no units attribute; mm assumed" in caplog.text


@pytest.mark.parametrize("rotates", ["sample", None])
def test_angles_of_the_sample_turn_the_other_way(tmp_path, make_scan, rotates) -> None:
    path, scan = tmp_path / "scan.h5", make_scan()
    write_scan(path, scan)
    with h5py.File(path, "r+") as file:
        for name in ("rotation_angle", "rotation_angle_end"):
            attributes = file[f"entry/sample/{name}"].attrs
            assert attributes.pop("rotates") == "gantry"
            if rotates:
                attributes["rotates"] = rotates
    again = read_scan(path, counts_to_attenuation)
    ours = scan.trajectory.angle_rad(2, np.array([3.1, 3.9]))
    np.testing.assert_allclose(
        again.trajectory.angle_rad(2, np.array([3.1, 3.9])), -ours, atol=ANGLE_TOLERANCE_RAD
    )


def test_an_encoder_that_turns_the_other_way_is_said(tmp_path, make_scan, caplog) -> None:
    path, scan = tmp_path / "scan.h5", make_scan()
    write_scan(
        path, dataclasses.replace(scan, trajectory=CircularOrbit(scan.geometry, kinematics("encoder")))
    )
    read_scan(path, counts_to_attenuation)
    assert "from rotation_angle" not in caplog.text
    with h5py.File(path, "r+") as file:
        file["entry/phyradgs/kinematics/angle_deg"].attrs["rotates"] = "sample"
    read_scan(path, counts_to_attenuation)
    assert "from rotation_angle" in caplog.text


def test_grid_is_derived_and_said(tmp_path, make_scan, caplog) -> None:
    path, scan = tmp_path / "scan.h5", make_scan()
    write_scan(path, scan)
    with h5py.File(path, "r+") as file:
        del file["entry/phyradgs/grid"]
    again = read_scan(path, counts_to_attenuation)
    assert again.grid == default_grid(scan.geometry)
    assert "no grid" in caplog.text
    assert scan_summary(path)["grid_stored"] is False


def test_default_grid_is_what_the_cone_covers() -> None:
    geometry = ConeGeometry(500.0, 1000.0, (40, 60), (2.0, 2.0))
    grid = default_grid(geometry)
    assert grid.voxel_size_mm == (1.0, 1.0, 1.0)  # a pixel seen at the axis, magnification 2
    half_side_mm = 500 * 60 / np.hypot(60, 1000)  # distance from the axis to the ray of the panel's edge
    assert grid.shape == (int(np.ceil(2 * half_side_mm)),) * 3
    assert default_grid(dataclasses.replace(geometry, detector_offset_mm=(0.0, 30.0))).shape > grid.shape


def test_another_entry_name_and_inner_links_are_followed(tmp_path, make_scan) -> None:
    path, scan = tmp_path / "scan.h5", make_scan()
    write_scan(path, scan)
    with h5py.File(path, "r+") as file:
        file.move("entry", "entry0000")
        del file.attrs["default"], file["entry0000/data"]
        file.move("entry0000/instrument/detector/data", "raw")
        file["entry0000/instrument/detector/data"] = h5py.SoftLink("/raw")
    again = read_scan(path, counts_to_attenuation)
    np.testing.assert_array_equal(again.projections, scan.projections)


def test_summary_tells_shape_timing_and_hash(tmp_path, make_scan) -> None:
    path = tmp_path / "scan.h5"
    scan, key, data = counts_scan(make_scan)
    write_scan(path, scan, data=data, image_key=key, quantity="counts")
    facts = scan_summary(path)
    expected = {"projections": 4, "flats": 2, "darks": 2, "invalid": 1, "fly_scan": True, "reference": False}
    assert {name: facts[name] for name in expected} == expected
    assert facts["exposure_arc_deg"] == pytest.approx(3.0)
    assert facts["span_arc_deg"] == pytest.approx(3.0 * 1.1 / 0.8)
    assert facts["last_angle_deg"] == pytest.approx(58.0)
    assert facts["sha256"] == sha256_of(path) and len(sha256_of(path)) == 64
    assert file_kind(path) == "scan"


def test_arguments_that_do_not_fit_are_refused(tmp_path, make_scan) -> None:
    scan, key, data = counts_scan(make_scan)
    path = tmp_path / "scan.h5"
    for arguments in (
        {"quantity": "hounsfield"},
        {"quantity": "counts"},
        {"data": data, "image_key": key, "quantity": "attenuation"},
        {"data": data, "image_key": key[:-1], "quantity": "counts"},
        {"data": data, "image_key": np.zeros(9, int), "quantity": "counts"},
        {"data": data[:, :, :4], "image_key": key, "quantity": "counts"},
    ):
        with pytest.raises(InputError):
            write_scan(path, scan, **arguments)
    with pytest.raises(InputError, match="exposure"):
        write_scan(path, make_scan(shutter=Shutter(0.0, 0.3)))
    assert list(tmp_path.iterdir()) == []


def test_anisotropic_grid_comes_back(tmp_path, make_scan) -> None:
    grid = Grid((2, 3, 4), (0.1, 0.2, 0.3), (5.0, 6.0, 7.0))
    write_scan(tmp_path / "scan.h5", make_scan(grid=grid))
    assert read_scan(tmp_path / "scan.h5", counts_to_attenuation).grid == grid
