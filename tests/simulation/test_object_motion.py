"""Objects that move while they are scanned: every line sees them where they are at its own times."""

from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import assert_near
from memory_limits import room_for
from tolerances import FLOAT32, MOVING_FRAME

from phyradgs_cl import simulation
from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Protocol, Scan, pixel_centres
from phyradgs_cl.acquisition.cells import per_line_cells
from phyradgs_cl.detector import average
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, control_points, deformed
from phyradgs_cl.io import Scanner, Volume
from phyradgs_cl.phantoms import moving_sphere
from phyradgs_cl.simulation import ObjectMotion, SimulationOptions, VolumeSource, scanner_options, simulate

SHAPE = (12, 16)
GEOMETRY = ConeGeometry(5.0, 7.5, SHAPE, (3.0 / 12, 3.9 / 16))
GRID = Grid.cube(40, 2.0)
BOX = Grid.cube(16, 2.0)
FLY = Protocol(views=3, exposure_deg=12.0, readout_ratio=0.5, exposure_s=0.1)
START_MM, SPEED_MM_PER_S, SIGMA_MM = np.array([0.1, -0.3, -0.2]), np.array([-0.05, 0.14, 0.08]), 0.2


def translation(speed_mm_per_s: np.ndarray, last_s: float) -> Deformation:
    """The field of an object that moves as a whole: w = −speed · t."""
    origin_mm, counts = control_points(GRID, 0.5)
    control_mm = np.broadcast_to(-speed_mm_per_s, (1, *counts, 3))
    return Deformation(control_mm, origin_mm, 0.5, np.array([0.0, last_s]), np.array([[0.0], [last_s]]))


def blob(centre_mm: np.ndarray) -> np.ndarray:
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij")
    square = sum((c - middle) ** 2 for c, middle in zip((x, y, z), centre_mm, strict=True))
    return np.exp(-square / (2 * SIGMA_MM**2)).astype(np.float32)


def blob_integrals(pose: np.ndarray, centre_mm: np.ndarray) -> np.ndarray:
    """Line integrals (rows, columns) of the blob: √(2π) σ exp(−d² / 2σ²) at the ray's distance d from its centre."""
    along = pixel_centres(pose, SHAPE) - pose[:3]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    to_centre = centre_mm - pose[:3]
    distance = np.linalg.norm(to_centre - (along @ to_centre)[..., None] * along, axis=-1)
    return np.sqrt(2 * np.pi) * SIGMA_MM * np.exp(-(distance**2) / (2 * SIGMA_MM**2))


def frames_of(rt, options: SimulationOptions, deformation: Deformation, volume: np.ndarray) -> Scan:
    make = lambda state: VolumeSource(rt, state, GRID, GEOMETRY, options.readout_axis)  # noqa: E731
    return simulate(simulation.DeformedSource(rt, volume, GRID, deformation, 2.0 / 20, make), GEOMETRY, BOX, options)


@pytest.mark.parametrize("model", ["log", "intensity"])
@pytest.mark.parametrize(("axis", "is_fly"), [("rows", True), ("columns", True), ("rows", False)])
def test_every_line_sees_a_moving_blob_where_it_is(rt, model, axis, is_fly) -> None:
    """In closed form. At rest, or seen at the frame's first light, it would be wrong by fifty times as much."""
    protocol = Protocol(views=3, exposure_deg=80.0, readout_ratio=0.5, is_fly=is_fly)
    options = SimulationOptions(protocol, axis, 1, model, time_samples=4)
    scan = frames_of(rt, options, translation(SPEED_MM_PER_S, protocol.window_s()[1]), blob(START_MM))
    expected, at_first_light = np.zeros(scan.projections.shape), np.zeros(scan.projections.shape)
    lines, samples = scan.shutter.lines(SHAPE), 4 if is_fly else 1
    for frame, start_s in enumerate(scan.frame_start_s):
        table = per_line_cells(scan.trajectory, scan.shutter, frame, float(start_s), lines, samples)
        times_s = table.time_s if is_fly else np.full(lines, start_s + scan.shutter.middle_s)
        for frames, when_s in ((expected, times_s), (at_first_light, np.full(len(times_s), start_s))):
            centres_mm = START_MM + np.outer(when_s, SPEED_MM_PER_S)
            rays = [blob_integrals(pose, centre_mm) for pose, centre_mm in zip(table.pose, centres_mm, strict=True)]
            for line in range(lines):
                where = (line, slice(None)) if axis == "rows" else (slice(None), line)
                own = np.stack([rays[cell][where] for cell in np.flatnonzero(table.line_start == line)])
                frames[frame][where] = average(own, np.full(len(own), 1 / len(own)), model)
    assert_near(scan.projections, expected, MOVING_FRAME)
    assert np.abs(scan.projections - at_first_light).max() > 10 * MOVING_FRAME * expected.max()


@pytest.mark.parametrize("model", ["log", "intensity"])
def test_many_states_of_an_object_that_rests_are_one_frame(rt, model) -> None:
    """Only air moves: cells that project other states average as if there were one."""
    volume = blob(np.zeros(3))
    volume[:, :, :20] = 0
    field = translation(np.array([0.0, 1.0, 1.0]), 1.0)
    control_mm = field.control_mm.copy()
    control_mm[:, :, :, 2:] = 0  # their splines reach the middle
    options = SimulationOptions(FLY, detector_model=model, time_samples=3, peak=5.0)
    moving = frames_of(rt, options, replace(field, control_mm=control_mm), volume)
    resting = simulate(VolumeSource(rt, volume, GRID, GEOMETRY, "rows"), GEOMETRY, BOX, options)
    assert_near(moving.projections, resting.projections, FLOAT32)


def test_states_made_on_the_host_are_those_of_the_device(rt) -> None:
    """Where the device has room for a projector, and none for the fields."""
    field, options = translation(SPEED_MM_PER_S, FLY.window_s()[1]), SimulationOptions(FLY, time_samples=3)
    on_device = frames_of(rt, options, field, blob(START_MM)).projections
    with room_for(rt, 5 * 40**3 * 4):
        on_host = frames_of(rt, options, field, blob(START_MM)).projections
    assert_near(on_host, on_device, FLOAT32)


SCANNER = replace(simulation.scanner_for("r2", 16), geometry=GEOMETRY, grid=BOX)


def scan_of(rt, of: object, scanner: Scanner = SCANNER, **options: object) -> Scan:
    chosen = scanner_options(scanner, "rapid", views=3, time_samples=2, **options)
    return simulation.simulated_scan(rt, of, scanner, chosen, size=16)


@pytest.mark.parametrize("of", ["shepp-logan", "foot"])
def test_without_amplitude_every_bit_stays(rt, of) -> None:
    for noise in ("none", "beer"):
        rests, still = (scan_of(rt, of, noise=noise, motion_of_object=m) for m in (None, ObjectMotion("breathing", 0.0)))
        np.testing.assert_array_equal(rests.projections, still.projections)
        np.testing.assert_array_equal(rests.reference, still.reference)
    for state in still.moving_truth.volumes:
        np.testing.assert_array_equal(state, still.reference)


@pytest.mark.parametrize("of", ["shepp-logan", Volume(blob(np.zeros(3)), GRID)], ids=["phantom", "volume"])
def test_the_truth_of_states_is_the_deformed_object(rt, of) -> None:
    motion = ObjectMotion("breathing", amplitude=0.3, period_s=2.0, jitter=0.0, states=4)
    scan = scan_of(rt, of, motion_of_object=motion, peak=2.0)
    truth = scan.moving_truth
    assert truth.volumes.shape == (4, *scan.grid.shape) and truth.deformation.rank == 2
    assert np.abs(scan.projections - scan_of(rt, of, peak=2.0).projections).max() > 0.05
    for time_s, state in zip(truth.times_s, truth.volumes, strict=True):
        coarse = deformed(scan.reference, scan.grid, truth.deformation, truth.deformation.weights_at(time_s)[0])
        error, change = np.linalg.norm(coarse - state), np.linalg.norm(scan.reference - state)
        assert error < 0.5 * change  # one is deformed in voxels twice as large
    assert scan.provenance["motion_of_object"]["kind"] == "breathing"


def test_breathing_returns_and_does_not_go_back_the_way_it_came() -> None:
    motion = ObjectMotion("breathing", amplitude_mm=0.2, period_s=4.0, jitter=0.1)
    field, height_mm = motion.deformation(BOX, 0.0, 40.0), np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    path_mm = np.stack([field.displacement_mm(height_mm, weights) for weights in field.weights_at(np.arange(0, 40, 0.05))])
    base, top = path_mm[:, 0], path_mm[:, 1]
    assert np.abs(top).max() == pytest.approx(0.2, rel=0.1) and np.abs(base).max() < 0.02
    deepest = np.flatnonzero(np.diff(np.sign(np.diff(top[:, 2]))) < 0) * 0.05
    periods_s = np.diff(deepest)
    assert len(deepest) in (9, 10, 11) and 0.05 < periods_s.std() < 1 and periods_s.mean() == pytest.approx(4, rel=0.1)
    rising, half_way = np.diff(top[:, 2], append=0) > 0, np.abs(top[:, 2] - 0.1) < 0.02
    aside = [np.abs(top[half_way & way, 1]).mean() for way in (rising, ~rising)]
    assert aside[1] > 1.5 * aside[0]
    np.testing.assert_array_equal(motion.deformation(BOX, 0.0, 40.0).weights, field.weights)
    assert not np.array_equal(replace(motion, seed=1).deformation(BOX, 0.0, 40.0).times_s, field.times_s)


def test_drying_never_returns_and_sliding_leaves_the_surroundings() -> None:
    drying = ObjectMotion("drying", amplitude_mm=0.2).deformation(BOX, 0.0, 30.0)
    assert (np.diff(drying.weights, axis=0) > 0).all() and not drying.weights[0].any()
    assert drying.displacement_mm([[0.0, 0.0, 1.0]], [1.0, 1.0])[0] == pytest.approx([0, 0, 0.2], abs=0.03)
    assert drying.displacement_mm([[0.8, 0.0, -0.8]], [0.0, 1.0])[0] == pytest.approx([0.08, 0, 0], abs=0.01)
    sliding = ObjectMotion("sliding", amplitude_mm=0.3, radius=0.5).deformation(BOX, 0.0, 30.0)
    inside, outside = sliding.displacement_mm([[0.3, 0.0, 0.5], [0.75, 0.0, 0.5]], [1.0])
    assert inside == pytest.approx([0, 0, 0.3], abs=0.01) and not outside.any()
    assert {np.sign(w) for w in sliding.weights.ravel().round(9)} == {-1, 0, 1}
    for kind, amplitude in (("breathing", 0.4), ("drying", 0.4), ("sliding", 0.1)):
        assert ObjectMotion(kind, amplitude=amplitude).deformation(BOX, 0.0, 30.0).smallest_determinant() > 0.3


def test_states_stand_in_one_breath_or_over_the_whole_scan() -> None:
    steady = ObjectMotion("breathing", jitter=0.0, period_s=4.0, states=4)
    np.testing.assert_allclose(steady.state_times_s(1.0, 21.0), [9.5, 10.5, 11.5, 12.5])
    np.testing.assert_allclose(ObjectMotion("drying", states=2).state_times_s(0.0, 8.0), [2.0, 6.0])
    np.testing.assert_allclose(steady.state_times_s(0.0, 2.0), [0.25, 0.75, 1.25, 1.75])


@pytest.mark.parametrize(("text", "subject"), [
    ("", "kind"), ('kind = "breathing"\nspeed = 3', "speed"), ('kind = "drying"\nsettling_s = 0', "settling_s"),
    ('kind = "drying"\nperiod_s = 3.0', "period_s"), ('kind = "breathing"\nstates = 2.5', "states"),
    ('kind = "breathing"\namplitude = 0.1\namplitude_mm = 3', "amplitude"),
])  # fmt: skip
def test_wrong_files_are_named_in_one_line_and_others_say_what_they_mean(tmp_path, text, subject) -> None:
    path = tmp_path / "motion.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        simulation.load_object_motion(path)
    assert caught.value.subject == f"{path} {subject}" and "\n" not in str(caught.value)
    path.write_text('kind = "breathing"\namplitude_mm = 2\nperiod_s = 3.5\njitter = 0\nseed = 4\nstates = 6\n')
    expected = ObjectMotion("breathing", amplitude_mm=2.0, period_s=3.5, jitter=0.0, seed=4, states=6)
    assert simulation.load_object_motion(path) == expected
    assert scanner_options(SCANNER, "rapid", motion_of_object=path).motion_of_object == expected


def test_objects_that_move_fast_are_sampled_finely() -> None:
    slow, fast = (ObjectMotion("sliding", amplitude_mm=0.3, period_s=period_s) for period_s in (40.0, 0.4))
    rapid = Protocol(exposure_deg=14.4)
    speeds = [motion.deformation(BOX, 0.0, 4.0).fastest_mm_per_s for motion in (slow, fast)]
    counts = [simulation.default_time_samples(rapid, BOX, speed) for speed in speeds]
    path_mm = 0.3 * 2 * np.pi / 0.4  # of the fastest second, in steps of half a voxel of 0.125 mm
    assert counts == [8, pytest.approx(path_mm / 0.0625, rel=0.03)]
    assert moving_sphere(1.0, period_s=2.0).fastest_mm_per_s == pytest.approx(0.25)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_lines_see_a_moving_sphere_where_it_is(rt, beam) -> None:
    """RTK's sphere, written out line by line; its states are those of the frames of a cycle."""
    panel = GEOMETRY if beam == "cone" else ParallelGeometry(SHAPE, (2.8 / 12, 2.8 / 16))
    scanner = replace(SCANNER, geometry=panel)
    options = scanner_options(scanner, "rapid", views=12, exposure_deg=30.0, time_samples=2)
    scan = simulation.simulated_scan(rt, "moving-sphere", scanner, options, size=16, pixel_samples=1)
    phantom = moving_sphere(1.0)
    for frame, line in [(0, 0), (5, 6), (7, 11)]:
        rays = []
        for share in (0.25, 0.75):
            time_s = frame + line / (SHAPE[0] - 1) * 0.86 + share
            pose = panel.pose(np.deg2rad(30.0 * time_s))
            pixels = pixel_centres(pose, SHAPE)[line]
            start = pose[:3] if beam == "cone" else pixels - 10 * pose[:3]
            rays.append(phantom.at(time_s).line_integrals(start, pixels if beam == "cone" else pixels + 10 * pose[:3]))
        np.testing.assert_allclose(scan.projections[frame, line], np.mean(rays, axis=0), atol=FLOAT32)
    np.testing.assert_allclose(scan.moving_truth.times_s, np.arange(8))
    np.testing.assert_array_equal(scan.moving_truth.volumes[3], phantom.at(3.0).voxelise(scan.grid, 4))
    assert scan.moving_truth.deformation is None
    with pytest.raises(InputError, match="--motion-of-object"):
        scan_of(rt, "moving-sphere", motion_of_object=ObjectMotion("drying"))
