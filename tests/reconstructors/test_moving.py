"""Objects that move in an unknown way: the signal of their motion, their field, their volume."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl import acquisition
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, PerRow, Scan, Shutter
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Gating, Grid, MovingTruth, control_points, deformed
from phyradgs_cl.metrics import compare
from phyradgs_cl.operators.warp.operator import projector_of
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors import ObjectMotion, Reconstruction, plan_run, reconstruct
from phyradgs_cl.reconstructors.moving import motion_line
from phyradgs_cl.reconstructors.moving import signal as signals
from phyradgs_cl.reconstructors.moving.method import FieldSearch, initial_field
from phyradgs_cl.reconstructors.moving.signal import MotionSignal, TemporalSplines, motion_signal
from phyradgs_cl.reconstructors.result import MOTION_FOUND, Progress

pytestmark = pytest.mark.slow

FRAMES, PERIOD_S, STEP_S = 90, 3.1, 0.5


def shroud_scan(height_of, noise: float = 0.05) -> Scan:
    """Frames of a horizontal edge at a height in rows, (F,) of the times (F,) in s, whose width changes with the angle."""
    geometry, start_s = ConeGeometry(5.0, 7.0, (24, 20), (0.2, 0.2)), STEP_S * np.arange(FRAMES)
    turn_rad, rows = 2 * np.pi / (FRAMES * STEP_S), np.arange(24)
    edge = 1 / (1 + np.exp((rows - 12 - height_of(start_s + 0.2)[:, None]) / 1.5))
    width = 1 + 0.3 * np.cos(2 * turn_rad * start_s) + 0.1 * np.sin(3 * turn_rad * start_s)
    frames = (edge * width[:, None])[:, :, None] + np.random.default_rng(0).normal(0, noise, (FRAMES, 24, 20))
    orbit = CircularOrbit(geometry, ConstantSpeed(0.0, turn_rad))
    return Scan(frames.astype(np.float32), geometry, orbit, Shutter(0.4), start_s, Grid.cube(8, 2.0))


def test_the_signal_has_the_period_and_the_curve_of_the_motion_beside_masked_pixels() -> None:
    def phase(t):  # of breaths that differ in length
        return 2 * np.pi * t / PERIOD_S + 0.3 * np.sin(0.2 * t)

    scan = shroud_scan(lambda t: 2 * np.cos(phase(t)))
    frames, mask = scan.projections.copy(), np.zeros((24, 20), np.uint8)
    frames[:, 3, 5], mask[3, 5] = 1e6, 1
    signal = motion_signal(replace(scan, projections=frames, pixel_mask=mask))
    assert signal.period_s == pytest.approx(PERIOD_S, rel=0.03)
    curve = np.cos(phase(signal.times_s))
    assert abs(np.corrcoef(signal.values, curve)[0, 1]) > 0.95
    assert np.abs(signal.values).max() == pytest.approx(1)
    quadrature = signal.pair()[:, 1]
    assert abs(np.corrcoef(quadrature, np.sin(phase(signal.times_s)))[0, 1]) > 0.9


@pytest.mark.parametrize("height_of", [np.zeros_like, lambda t: 3 * np.exp(-t / 15.0)], ids=["rest", "settling"])
def test_what_does_not_repeat_has_no_period(height_of) -> None:
    assert motion_signal(shroud_scan(height_of)).period_s is None


GRID, SHAPE = Grid.cube(12, 2.0), (18, 18)
ITERATIONS, ROUNDS = 11, 3  # three rounds of the search, and eight passes


def breathing_scan(rt, amplitude_mm: float, is_parallel: bool = False) -> Scan:
    """Forty frames of an object whose top rises and falls, of other angles than those of its breaths."""
    origin_mm, counts = control_points(GRID, 0.5)
    control_mm = np.zeros((1, *counts, 3))
    control_mm[0, ..., 2] = amplitude_mm * np.clip((origin_mm[2] + 0.5 * np.arange(counts[0]) + 1) / 2, 0, 1)[:, None, None]
    times_s = np.linspace(0, 17, 171)
    truth = Deformation(control_mm, origin_mm, 0.5, times_s, np.cos(2 * np.pi * times_s / 2.3)[:, None])
    cone, parallel = ConeGeometry(5.0, 7.0, SHAPE, (4 / 18, 4 / 18)), acquisition.ParallelGeometry(SHAPE, 2.8 / 18)
    geometry, start_s = parallel if is_parallel else cone, 0.4 * np.arange(40)
    orbit, fine = CircularOrbit(geometry, ConstantSpeed(0.0, 2 * np.pi / 16)), GRID.finer(2)
    empty = Scan(np.zeros((40, *SHAPE), np.float32), geometry, orbit, Shutter(0.3), start_s, GRID)
    tables, volume = [PerRow(3).cells(empty, f) for f in range(40)], shepp_logan(0.9).voxelise(fine)
    frames = projector_of(rt, fine, tables, truth)(rt, fine, SHAPE, tables).forward(volume)
    frames += np.random.default_rng(0).normal(0, 0.005, frames.shape).astype(np.float32)
    reference = volume.reshape(12, 2, 12, 2, 12, 2).mean((1, 3, 5))
    at_s = 7 + 2.3 * np.arange(4) / 4
    states = np.stack([deformed(reference, GRID, truth, truth.weights_at(time_s)[0]) for time_s in at_s])
    return replace(empty, projections=frames, reference=reference, moving_truth=MovingTruth(at_s, states, truth))


def run(rt, scan: Scan, method: str = "moving", iterations: int = ITERATIONS, motion=None, **more) -> Reconstruction:
    return reconstruct(scan, plan_run(method, {"iterations": iterations}, object_motion=motion), rt, **more)


def mean_psnr_db(result: Reconstruction, scan: Scan) -> float:
    """Over the true states, of which the volume shows those that its deformation says."""
    field, truth = result.deformation, scan.moving_truth
    weights = [None] * len(truth.times_s) if field is None else field.weights_at(truth.times_s)
    shown = (result.volume if one is None else deformed(result.volume, GRID, field, one) for one in weights)
    return float(np.mean([compare(one, true)["psnr_db"] for one, true in zip(shown, truth.volumes, strict=True)]))


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    return breathing_scan(rt, 0.3)


@pytest.fixture(scope="module")
def result(rt, scan) -> Reconstruction:
    return run(rt, scan)


def test_an_unknown_motion_is_found_and_taken_out(rt, scan, result) -> None:
    found, passes = result.facts[MOTION_FOUND], ITERATIONS - ROUNDS
    assert found["moves"] and found["period_s"] == pytest.approx(2.3, rel=0.05) and found["gain"] > 0.2
    assert mean_psnr_db(result, scan) > mean_psnr_db(run(rt, scan, "fista", passes), scan) + 2.25
    again = run(rt, scan, "fista", passes, ObjectMotion(result.deformation))
    np.testing.assert_array_equal(result.volume, again.volume)


def test_parallel_beams_show_an_unknown_motion_too(rt) -> None:
    scan = breathing_scan(rt, 0.3, is_parallel=True)
    found = run(rt, scan, iterations=3).facts[MOTION_FOUND]
    assert found["moves"] and found["period_s"] == pytest.approx(2.3, rel=0.05) and found["gain"] > 0.2


def test_it_resumes_with_the_same_bits_from_the_search_and_from_the_passes(rt, scan, result) -> None:
    state = None
    for at in (1, 6):

        def stop(progress: Progress, at: int = at) -> None:
            assert progress.iterations == ITERATIONS
            assert progress.volume()[0].shape == GRID.shape
            if progress.iteration >= at:
                raise KeyboardInterrupt

        part = run(rt, scan, report=stop, resume=state)
        state = part.state
        assert part.facts["interrupted_at"] == at and (part.deformation is None) == (at < 2)
        with pytest.raises(InputError, match="checkpoint"):
            run(rt, scan, resume={**state, "field_control" if at > 1 else "control_mm": np.zeros(3)})
    rest = run(rt, scan, resume=state)
    np.testing.assert_array_equal(rest.volume, result.volume)
    np.testing.assert_array_equal(rest.deformation.control_mm, result.deformation.control_mm)
    assert rest.facts[MOTION_FOUND] == result.facts[MOTION_FOUND]


def test_an_object_at_rest_stays_at_rest(rt) -> None:
    still = breathing_scan(rt, 0.0)
    result, plain = run(rt, still, iterations=6), run(rt, still, "fista", 4)
    assert not result.facts[MOTION_FOUND]["moves"] and result.deformation.is_still
    np.testing.assert_array_equal(result.volume, plain.volume)


def loaded(path, scan: Scan):
    return signals.signal_of(signals.load_gating(str(path), scan), scan, f"gating {path}")


def test_a_signal_of_a_file_is_followed_and_others_are_refused(scan, tmp_path) -> None:
    times_s, path = np.linspace(-1, 22, 200), tmp_path / "breath.csv"
    path.write_text("time_s,height\n" + "\n".join(f"{t},{5 + np.cos(2 * np.pi * t / 2.3)}" for t in times_s))
    signal = loaded(path, scan)
    assert signal.period_s == pytest.approx(2.3, rel=0.03) and np.abs(signal.values).max() == pytest.approx(1)
    for text, found in {
        "": "0 lines of numbers", "0,1\n1,2\n2,3\n3,4\n": "4 times from 0 to 3 s", "0\n1\n2\n40\n": "4 values without times",
        "0,1\n1,1\n1,2\n40,1\n": "some are equal", "0,1\n1,1,7\n2,2\n40,1\n": "not two numbers", "a,b\nc,d\n": "'c'",
        "0,nan\n1,1\n2,2\n40,1\n": "1 lines with NaN", "0,5\n1,5\n2,5\n40,5\n": "the same value 5",
    }.items():  # fmt: skip
        path.write_text(text)
        with pytest.raises(InputError, match=f"gating .*{found}"):
            loaded(path, scan)
    with pytest.raises(InputError, match=r"No such file.*check the path"):
        loaded(tmp_path / "none.csv", scan)
    with pytest.raises(InputError, match="gating"):
        plan_run("moving", {"gating": "breaths"})


def test_a_signal_that_does_not_repeat_is_followed_without_a_period(scan, tmp_path) -> None:
    times_s, path = np.linspace(-1, 22, 400), tmp_path / "drying.csv"
    path.write_text("\n".join(f"{t},{np.exp(-t / 5)}" for t in times_s), encoding="utf-8-sig")
    signal = loaded(path, scan)
    assert signal.period_s is None and len(signal.values) == 400
    field = initial_field(scan, signal, 16.0, 0.0)
    assert field.temporal.shape[0] < 40
    assert np.corrcoef(field.deformation().weights_at(times_s[20:300])[:, 0], np.exp(-times_s[20:300] / 5))[0, 1] > 0.99
    found = {"moves": True, "follows": True, "period_s": None, "gain": 0.4, "rms_mm": 0.1}
    assert "following a signal; " in motion_line(found) and "free in time" in motion_line({**found, "follows": False})


def test_long_and_uneven_signals() -> None:
    """A belt's 60,000 values, and pauses between them, in which the quadrature goes on."""
    long_s = np.arange(60_000) / 100
    assert signals.period_of(long_s, np.cos(2 * np.pi * long_s / 4)) == pytest.approx(4, rel=0.01)
    times_s = np.sort(np.random.default_rng(0).uniform(0, 40, 500))
    later = MotionSignal(times_s, np.cos(2 * np.pi * times_s / 4)).pair()[:, 1]
    assert np.corrcoef(later, np.sin(2 * np.pi * times_s / 4))[0, 1] > 0.97


def test_the_search_sees_every_breath_of_a_long_scan(rt, scan) -> None:
    start_s, frames = 0.4 * np.arange(700), np.zeros((700, *SHAPE), np.float32)
    many = replace(scan, projections=frames, frame_start_s=start_s, moving_truth=None)
    for knot_s, frames in ((0.4, 699), (10.0, 600)):
        signal = MotionSignal(many.middle_times_s, np.cos(start_s), knot_s=knot_s)
        assert FieldSearch(rt, many, PerRow(), signal, 1, 0.01).scan.frames == frames


def test_phases_of_a_file_or_of_the_scan_are_followed(rt, scan, tmp_path) -> None:
    """One a frame, in cycles, which wrap around."""
    phase = (0.1 + scan.middle_times_s / 2.3) % 1
    stated = replace(scan, gating=Gating(scan.middle_times_s, phase, is_phase=True))
    path = tmp_path / "phase.csv"
    path.write_text("phase\n" + "\n".join(str(float(one)) for one in phase))
    for signal in (loaded(path, scan), signals.signal_of(stated.gating, stated, "gating scan")):
        assert signal.period_s == pytest.approx(2.3)
        field = initial_field(scan, signal, 16.0, 0.0)
        weights = field.deformation().weights_at(signal.times_s)
        for column, wave in zip(weights.T, (np.cos, np.sin), strict=True):
            assert np.corrcoef(column, wave(2 * np.pi * phase))[0, 1] > 0.98
    path.write_text("phase\n" + "0.5\n" * scan.frames)
    with pytest.raises(InputError, match=r"phase\.csv: found the same value 0\.5 throughout"):
        loaded(path, scan)
    with pytest.raises(InputError, match="gating: found scan, and no gating"):
        reconstruct(scan, plan_run("moving", {"gating": "scan"}), rt)


def test_splines_sum_to_one_and_bending_is_none_of_a_rigid_motion() -> None:
    splines, times_s = TemporalSplines.of_step(1.0, 8.0, 0.9), np.linspace(1, 8, 50)
    np.testing.assert_allclose(splines.at(times_s).sum(1), 1)
    curve = np.stack([times_s, np.cos(times_s)], -1)
    np.testing.assert_allclose(splines.at(times_s) @ splines.fit(times_s, curve), curve, atol=0.02)
    bend, rigid = signals.Bending((5, 4, 6)), np.ones((2, 5, 4, 6, 3))
    np.testing.assert_allclose(bend(rigid), 0, atol=1e-12)
    x, y = np.random.default_rng(0).normal(size=(2, 2, 5, 4, 6, 3))
    assert np.vdot(bend(x), y) == pytest.approx(np.vdot(x, bend(y))) and np.vdot(bend(x), x) > 0
