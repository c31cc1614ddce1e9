"""What is written comes back: every trajectory, shutter, mask and quantity of the scan format."""

from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from damage import attribute, on, removed, value

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, EncoderTable, Saturation
from phyradgs_cl.acquisition.geometry import ParallelGeometry, default_grid
from phyradgs_cl.acquisition.plausible import blur_facts
from phyradgs_cl.api import FrameSweeps, MicroViews, PoseTable, Scan, Shutter, SpeedRamp, Static
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gating
from phyradgs_cl.io import file_kind, read_scan, scan_summary, sha256_of, write_scan

ANGLE_TOLERANCE_RAD = 1e-12  # degrees in the file: two roundings of angles of order 1
LENGTH_TOLERANCE_MM = 1e-9  # that angle at 785 mm
RAMP_TOLERANCE_MM = 2e-6  # a speed ramp is stored as straight pieces, a nanoradian off at 1200 mm


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "scan.h5"


def again_of(path: Path, scan: Scan | None = None, **data: object) -> Scan:
    """What is read of the file, or of the scan once it is written there."""
    if scan is not None:
        write_scan(path, scan, **data)
    return read_scan(path, counts_to_attenuation)


def same_poses(scan, again, tolerance_mm=LENGTH_TOLERANCE_MM) -> None:
    """Both scans put the gantry at the same places during every exposure and readout."""
    for frame, start_s in enumerate(scan.frame_start_s):
        last_s = scan.shutter.span_s if scan.is_fly else 0.0
        ours = scan.trajectory.pose(frame, start_s + np.linspace(0, last_s, 7))
        theirs = again.trajectory.pose(frame, again.frame_start_s[frame] + np.linspace(0, last_s, 7))
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=tolerance_mm)


def same_cells(motion, scan, again) -> None:
    """The poses that a reconstruction uses."""
    for frame in range(scan.frames):
        ours, theirs = (motion.cells(s, frame).pose for s in (scan, again))
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=LENGTH_TOLERANCE_MM)


def test_fields_come_back(path, make_scan) -> None:
    mask = np.zeros((3, 5), bool)
    mask[1, 2] = True
    reference = np.arange(24, dtype=np.float32).reshape(2, 3, 4) / 100
    facts = {"provenance": {"seed": 3, "method": "made up"}, "saturation": Saturation(4095.0, 0.25)}
    scan = make_scan(pixel_mask=mask, reference=reference, **facts)
    again = again_of(path, scan)
    assert again.saturation == scan.saturation
    np.testing.assert_array_equal(again.projections, scan.projections)
    assert again.projections.dtype == np.float32
    np.testing.assert_array_equal(again.reference, reference)
    np.testing.assert_array_equal(again.pixel_mask, mask)
    np.testing.assert_array_equal(again.frame_start_s, scan.frame_start_s)
    for name in ("shutter", "grid", "is_fly", "detector_model", "title", "provenance"):
        assert getattr(again, name) == getattr(scan, name), name
    for field in fields(scan.geometry):
        ours, theirs = getattr(scan.geometry, field.name), getattr(again.geometry, field.name)
        np.testing.assert_allclose(theirs, ours, rtol=1e-15, err_msg=field.name)
    same_poses(scan, again)


FRAME_TIMES = {
    "starts": lambda scan: scan.frame_start_s, "middles": lambda scan: scan.middle_times_s,
    "ends": lambda scan: scan.frame_start_s + scan.shutter.span_s,
    "jitter": lambda scan: scan.frame_start_s + [0, 0.1, 0, 0.2],
    "many": lambda scan: np.linspace(scan.frame_start_s[0], 6.0, 50), "few": lambda scan: np.array([0.0, 7.0]),
}  # fmt: skip


def test_a_signal_or_a_phase_keeps_its_values_and_times(path, make_scan) -> None:
    pulsed = Shutter(0.8, 0.3, "columns", -1, pulse_s=(0.1, 0.5))
    for name, times in FRAME_TIMES.items():
        for is_phase, scan in ((False, make_scan()), (True, make_scan(shutter=pulsed)), (False, make_scan(is_fly=False))):
            values = np.random.default_rng(0).uniform(size=len(times_s := times(scan)))
            again = again_of(path, replace(scan, gating=Gating(times_s, values, is_phase))).gating
            assert again.is_phase == is_phase
            np.testing.assert_array_equal([again.times_s, again.values], [times_s, values], err_msg=name)


def test_a_signal_of_poses_at_rest_moves_with_them(path, make_scan) -> None:
    """They are stored without exposure, so that the start of a frame stands for its middle."""
    scan = along("poses", make_scan(is_fly=False))
    for times_s in (scan.middle_times_s, scan.frame_start_s):
        gated = replace(scan, gating=Gating(times_s, np.arange(4.0)))
        write_scan(path, gated)
        again = again_of(path)
        np.testing.assert_allclose(again.gating.at(again.middle_times_s), gated.gating.at(scan.middle_times_s), atol=1e-9)
        np.testing.assert_array_equal(again.gating.values, gated.gating.values)


def test_a_signal_beside_flats_and_darks_comes_back(path, make_scan) -> None:
    scan, counts = counts_scan(make_scan)
    for is_phase, name in ((False, "a signal"), (True, "a phase")):
        gating = Gating(scan.frame_start_s + scan.shutter.span_s / 2, np.linspace(0, 0.9, scan.frames) ** 2, is_phase)
        again = again_of(path, replace(scan, gating=gating), **counts).gating
        assert again.is_phase == is_phase and scan_summary(path)["gating"] == name
        np.testing.assert_array_equal([again.times_s, again.values], [gating.times_s, gating.values])
        with h5py.File(path, "r+") as file:
            file["entry/phyradgs/gating"]["signal" if is_phase else "phase"] = np.zeros(9)
        with pytest.raises(InputError, match="gating/signal: found a signal beside a phase"):
            again_of(path)


WANDER = np.cumsum(np.random.default_rng(1).uniform(0, 0.02, 60))
KINEMATICS = {
    "constant": ConstantSpeed(0.3, 0.1), "backwards": ConstantSpeed(0.3, -0.1),
    "ramp": SpeedRamp(0.3, 0.1, 0.02),
    "encoder": EncoderTable(np.linspace(0.5, 5.6, 60), WANDER),
}  # fmt: skip


def along(trajectory: str, scan: Scan) -> Scan:
    """The scan on a circle with one of ``KINEMATICS``, or on a table of poses that wobble."""
    if trajectory in KINEMATICS:
        return replace(scan, trajectory=CircularOrbit(scan.geometry, KINEMATICS[trajectory]))
    time_s = np.linspace(0.4, 5.7, 25)
    table = scan.geometry.pose(0.2 * time_s)
    table += np.random.default_rng(2).normal(0, 0.5, table.shape) * np.repeat([1, 1, 0, 0], 3)
    return replace(scan, trajectory=PoseTable(time_s, table))


def test_trajectories_come_back(path, make_scan) -> None:
    for name in (*KINEMATICS, "poses"):
        scan = along(name, make_scan())
        again = again_of(path, scan)
        assert again.is_fly, name
        if name == "poses":
            np.testing.assert_array_equal(again.trajectory.table, scan.trajectory.table)
        else:
            kind = FrameSweeps if name in ("constant", "backwards") else EncoderTable
            assert isinstance(again.trajectory.kinematics, kind), name
        same_poses(scan, again, RAMP_TOLERANCE_MM if name == "ramp" else LENGTH_TOLERANCE_MM)


def test_standing_gantry_stays_static_with_the_same_poses(path, make_scan) -> None:
    still = make_scan(is_fly=False)
    for scan in (still, along("encoder", still), along("poses", still)):
        again = again_of(path, scan)
        assert not again.is_fly
        same_cells(MicroViews(), scan, again)
    pulsed = along("poses", make_scan(is_fly=False, shutter=Shutter(0.8, 0.3, "columns", -1, (0.2, 0.2))))
    again = again_of(path, pulsed)
    assert again.shutter.pulse_s is None
    same_cells(Static(), pulsed, again)


def test_shutters_come_back(path, make_scan) -> None:
    for shutter in map(Shutter, 8 * [0.8], 4 * [0.0, 0.3], 4 * ["rows"] + 4 * ["columns"], 2 * [1, 1, -1, -1]):
        assert again_of(path, make_scan(shutter=shutter)).shutter == shutter


@pytest.mark.parametrize("is_fly", [True, False])
def test_pulse_and_lag_come_back(path, make_scan, is_fly) -> None:
    write_scan(path, make_scan())
    with h5py.File(path) as file:
        assert not {"pulse_start", "pulse_length", "lag"} & set(file["entry/phyradgs"])
    assert again_of(path).lag == 0
    pulsed = Shutter(0.8, 1.2, "columns", -1, (0.25, 0.5))
    scan = make_scan(shutter=pulsed, lag=0.04, is_fly=is_fly)
    assert scan.pixel_mask[:, 0].all() and not scan.pixel_mask[:, 2:].any()  # column 0 opens last, at 1.2 s
    again = again_of(path, scan)
    assert (again.shutter, again.lag) == (pulsed, 0.04)
    np.testing.assert_array_equal(again.pixel_mask, scan.pixel_mask)
    same_cells(Static(), scan, again)
    facts = scan_summary(path)
    assert (facts["pulse_start_s"], facts["pulse_length_s"], facts["lag"]) == (0.25, 0.5, 0.04)
    assert facts["dark_lines"] == 2


def test_fly_rule_follows_motion_and_exposure(path, make_scan) -> None:
    assert again_of(path, make_scan()).is_fly
    on("entry/instrument/detector/count_time", value(0.0))(path)
    assert not again_of(path).is_fly
    write_scan(path, make_scan())
    on("entry/sample/rotation_angle_end", removed)(path)
    again = again_of(path)
    assert not again.is_fly and again.shutter.exposure_s == 0.8
    sweeps = again.trajectory.kinematics
    np.testing.assert_array_equal(sweeps.angle_end_rad, sweeps.angle_start_rad)


def test_poses_win_over_encoder_over_angles(path, make_scan, tmp_path) -> None:
    with_encoder = along("encoder", make_scan())
    write_scan(path, along("poses", make_scan()))
    write_scan(tmp_path / "encoder.h5", with_encoder)
    with h5py.File(path, "r+") as file, h5py.File(tmp_path / "encoder.h5") as other:
        other.copy("entry/phyradgs/kinematics", file["entry/phyradgs"])
    assert isinstance(again_of(path).trajectory, PoseTable)
    on("entry/phyradgs/poses", removed)(path)
    same_poses(with_encoder, again_of(path))


def counts_scan(make_scan) -> tuple[Scan, dict[str, object]]:
    """A scan, and as how it is to be stored: raw counts with flats, darks and an invalid frame between the projections."""
    scan, key = make_scan(), np.array([1, 2, 0, 0, 3, 1, 0, 2, 0])
    flat, dark = np.linspace(40000, 50000, 15).reshape(3, 5), np.linspace(90, 110, 15).reshape(3, 5)
    data = np.empty((len(key), 3, 5))
    data[key == 1], data[key == 2], data[key == 3] = flat, dark, 12345
    data[key == 0] = dark + (flat - dark) * np.exp(-scan.projections)
    return scan, {"data": np.round(data).astype(np.uint16), "image_key": key, "quantity": "counts"}


def test_counts_lose_flats_darks_and_invalid_frames(path, make_scan) -> None:
    scan, counts = counts_scan(make_scan)
    again, data = again_of(path, scan, **counts), counts["data"]
    with h5py.File(path) as file:
        assert file["entry/instrument/detector/data"].dtype == np.uint16
        assert all(len(file[name]) == 9 for name in ("entry/sample/rotation_angle", "entry/data/image_key"))
    flat, dark = data[:2].astype(float)
    expected = -np.log((data[counts["image_key"] == 0] - dark) / (flat - dark))
    np.testing.assert_allclose(again.projections, expected, rtol=0, atol=2e-6)  # float32 near 4
    np.testing.assert_allclose(again.frame_start_s, scan.frame_start_s)
    same_poses(scan, again)
    assert again.pixel_mask is None


def test_masks_of_frames_follow_their_frames(path, make_scan) -> None:
    """And pixels that the conversion rejects join the mask."""
    (scan, counts), mask = counts_scan(make_scan), np.zeros((4, 3, 5), np.int32)
    mask[[0, 1, 2, 3], [0, 1, 2, 0], [4, 3, 2, 1]] = [1, 2, 64, 256]  # NeXus puts reasons into bits
    np.testing.assert_array_equal(again_of(path, replace(scan, pixel_mask=mask), **counts).pixel_mask, mask != 0)
    mask = np.arange(15).reshape(3, 5) == 14
    counts["data"][6, 1, 1] = 0  # below the dark: third projection
    expected = np.repeat(mask[None], 4, 0)
    expected[2, 1, 1] = True
    np.testing.assert_array_equal(again_of(path, replace(scan, pixel_mask=mask), **counts).pixel_mask, expected)


def test_transmission_is_converted_and_masked_pixels_may_be_nan(path, make_scan) -> None:
    scan, how = make_scan(), {"image_key": np.zeros(4, int), "quantity": "transmission"}
    again = again_of(path, scan, data=np.exp(-scan.projections), **how)
    np.testing.assert_allclose(again.projections, scan.projections, atol=1e-5)
    scan = make_scan(pixel_mask=np.arange(15).reshape(3, 5) == 7)
    scan.projections[1, 1, 2] = np.nan
    again = again_of(path, scan)
    assert np.isfinite(again.projections).all()
    assert np.broadcast_to(again.pixel_mask, again.projections.shape)[1, 1, 2]


UNITS = {
    "instrument/detector/x_pixel_size": [("um", 1e3), ("cm", 0.1), ("millimetre", 1.0)],
    "instrument/source/distance": [("m", 1e-3), ("m", -1e-3)], "instrument/detector/count_time": [("us", 1e6)],
    "instrument/detector/frame_start_time": [("ms", 1e3)], "sample/rotation_angle": [("rad", np.pi / 180)],
    "phyradgs/grid/voxel_size": [("m", 1e-3)], "phyradgs/detector_offset": [("um", 1e3)],
    "phyradgs/reference/volume": [("1/cm", 10.0), ("1/m", 1e3)],
}


def test_units_are_converted(path, make_scan) -> None:
    scan = make_scan(reference=np.full((2, 3, 4), 0.02, np.float32))
    for name, units in UNITS.items():
        for unit, factor in units:
            write_scan(path, scan)
            with h5py.File(path, "r+") as file:
                dataset = file[f"entry/{name}"]
                dataset[...] = dataset[...] * factor
                dataset.attrs["units"] = unit
            again = again_of(path)
            np.testing.assert_allclose(again.reference, scan.reference, rtol=1e-6, err_msg=f"{name} in {unit}")
            np.testing.assert_allclose(again.grid.voxel_size_mm, scan.grid.voxel_size_mm)
            assert again.shutter.exposure_s == pytest.approx(0.8), (name, unit)
            same_poses(scan, again)


def test_what_is_assumed_is_said(path, make_scan, caplog) -> None:
    scan = make_scan()
    write_scan(path, scan)
    with h5py.File(path, "r+") as file:
        del file["entry/instrument/detector/distance"].attrs["units"], file["entry/phyradgs/grid"]
    again = again_of(path)
    assert again.geometry.source_to_detector_mm == pytest.approx(1200)
    assert "/entry/instrument/detector/distance: no units attribute; mm assumed" in caplog.text
    assert again.grid == default_grid(scan.geometry) and "no grid" in caplog.text
    assert scan_summary(path)["grid_stored"] is False


@pytest.mark.parametrize("rotates", ["sample", None])
def test_angles_of_the_sample_turn_the_other_way(path, make_scan, caplog, rotates) -> None:
    """An encoder that turns the other way is said."""
    write_scan(path, scan := make_scan())
    with h5py.File(path, "r+") as file:
        for name in ("rotation_angle", "rotation_angle_end"):
            attributes = file[f"entry/sample/{name}"].attrs
            assert attributes.pop("rotates") == "gantry"
            if rotates:
                attributes["rotates"] = rotates
    ours, theirs = (one.trajectory.angle_rad(2, np.array([3.1, 3.9])) for one in (scan, again_of(path)))
    np.testing.assert_allclose(theirs, -ours, atol=ANGLE_TOLERANCE_RAD)
    again_of(path, along("encoder", scan))
    assert "from rotation_angle" not in caplog.text
    on("entry/phyradgs/kinematics/angle_deg", attribute("rotates", "sample"))(path)
    again_of(path)
    assert "from rotation_angle" in caplog.text


def test_default_grid_is_what_the_cone_covers() -> None:
    grid = default_grid(geometry := ConeGeometry(500.0, 1000.0, (40, 60), (2.0, 2.0)))
    assert grid.voxel_size_mm == (1.0, 1.0, 1.0)  # a pixel seen at the axis, magnification 2
    half_side_mm = 500 * 60 / np.hypot(60, 1000)  # distance from the axis to the ray of the panel's edge
    wide = int(np.ceil(2 * half_side_mm))
    assert grid.shape == (round(80 * (500 + half_side_mm) / 1000), wide, wide)  # as high as it sees behind the axis
    assert default_grid(replace(geometry, detector_shape=(90, 60))).shape == (wide,) * 3
    assert default_grid(replace(geometry, detector_shape=(1, 60))).shape == (1, wide, wide)
    assert default_grid(ParallelGeometry((90, 60), 2.0)).shape == (90, 60, 60)  # each row sees slices of its own


def test_another_entry_name_and_inner_links_are_followed(path, make_scan) -> None:
    write_scan(path, scan := make_scan())
    with h5py.File(path, "r+") as file:
        file.move("entry", "entry0000")
        del file.attrs["default"], file["entry0000/data"]
        file.move("entry0000/instrument/detector/data", "raw")
        file["entry0000/instrument/detector/data"] = h5py.SoftLink("/raw")
    np.testing.assert_array_equal(again_of(path).projections, scan.projections)


def test_summary_tells_shape_timing_and_hash(path, make_scan) -> None:
    scan, counts = counts_scan(make_scan)
    write_scan(path, scan, **counts)
    facts = scan_summary(path)
    expected = {"projections": 4, "flats": 2, "darks": 2, "invalid": 1, "fly_scan": True, "reference": False}
    assert {name: facts[name] for name in expected} == expected and facts["exposure_arc_deg"] == pytest.approx(3.0)
    assert {name: facts[name] for name in blur_facts(scan)} == pytest.approx(blur_facts(scan)) and blur_facts(scan)
    assert (facts["span_arc_deg"], facts["last_gantry_angle_deg"]) == pytest.approx((3.0 * 1.1 / 0.8, 58.0))
    assert facts["sha256"] == sha256_of(path) and len(sha256_of(path)) == 64 and file_kind(path) == "scan"


def test_a_summary_has_no_times_of_a_scan_that_stops_and_counts_the_flats_that_were_applied(path, make_scan) -> None:
    """Where frames start that stand still is their order alone, in units of a second."""
    made, counts = counts_scan(make_scan)
    write_scan(path, again_of(path, made, **counts))  # as `prepare` does
    facts = scan_summary(path)
    assert (facts["flats"], facts["flats_applied"], facts["darks_applied"]) == (0, 2, 2) and "scan_s" in facts
    angle_rad = np.deg2rad([10.0, 25.0, 40.0, 58.0])
    for exposure_s in (0.0, 0.2):
        start_s, shutter = np.arange(4.0), Shutter(exposure_s)
        orbit = CircularOrbit(made.geometry, FrameSweeps(start_s, 0.0, angle_rad, angle_rad))
        write_scan(path, make_scan(trajectory=orbit, shutter=shutter, frame_start_s=start_s, is_fly=False))
        facts = scan_summary(path)
        expected = {"exposure_s", "readout_s"} if exposure_s else set()
        assert {name for name in facts if name.endswith("_s") or name.startswith("readout")} == expected
        assert facts["last_gantry_angle_deg"] == pytest.approx(58.0)


def test_arguments_that_do_not_fit_are_refused(path, make_scan) -> None:
    scan, counts = counts_scan(make_scan)
    wrong = {"image_key": counts["image_key"][:-1]}, {"image_key": np.zeros(9, int)}, {"data": counts["data"][:, :, :4]}
    for arguments in (
        {"quantity": "hounsfield"}, {"quantity": "counts"},
        *(counts | change for change in ({"quantity": "attenuation"}, *wrong)),
    ):  # fmt: skip
        with pytest.raises(InputError):
            write_scan(path, scan, **arguments)
    with pytest.raises(InputError, match="exposure"):
        write_scan(path, make_scan(shutter=Shutter(0.0, 0.3)))
    assert list(path.parent.iterdir()) == []
