"""An object that changes during its scan: projectors of a stack of states, and the method ``changing``."""

import re
from dataclasses import replace

import numpy as np
import pytest
from ray_tables import noise
from tolerances import ADJOINT, RAYS

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, PerRow, Scan, Shutter
from phyradgs_cl.fields import Grid, States
from phyradgs_cl.metrics import compare
from phyradgs_cl.operators import IntensityOperator, RayOperator
from phyradgs_cl.operators.warp.operator import projector_of
from phyradgs_cl.reconstructors import Reconstruction, plan_run, reconstruct
from phyradgs_cl.reconstructors.projected import frame_pairs

pytestmark = pytest.mark.slow

GRID = Grid.cube(20, 2.0)
SHAPE = (20, 24)
GEOMETRY = ConeGeometry(8.0, 12.0, SHAPE, (0.19, 0.19))
FRAMES, TURNS = 80, 4
STATE_TIMES_S = np.array([8.0, 24.0, 40.0, 56.0, 72.0])


def empty_scan(frames: int = FRAMES) -> Scan:
    """A scan without gaps: every frame is exposed for 1 s, and its lines one after the other."""
    speed_rad_s = 2 * np.pi * TURNS / FRAMES
    orbit, start_s = CircularOrbit(GEOMETRY, ConstantSpeed(0.0, speed_rad_s)), np.arange(frames, dtype=float)
    return Scan(np.zeros((frames, *SHAPE), np.float32), GEOMETRY, orbit, Shutter(0.8, 0.2), start_s, GRID)


def changing_object() -> States:
    """A cylinder in which one ball disappears after state 1, while another one grows denser from state to state."""
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij")
    body = 0.3 * ((x**2 + y**2 < 0.7**2) & (np.abs(z) < 0.8))
    first, second = (((x - at) ** 2 + y**2 + (z - 0.2) ** 2 < 0.2**2) for at in (-0.35, 0.35))
    volumes = [body + 0.5 * first * (k < 2) + 0.15 * k * second for k in range(len(STATE_TIMES_S))]
    return States(STATE_TIMES_S, np.array(volumes, np.float32))


def operators(rt, scan: Scan, times_s: np.ndarray) -> tuple[RayOperator, RayOperator]:
    tables = [PerRow(sub_intervals=3).cells(scan, f) for f in range(scan.frames)]
    make = projector_of(rt, GRID, tables, None, times_s)
    return make(rt, GRID, SHAPE, tables), RayOperator(rt, GRID, SHAPE, tables)


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    scan, truth = empty_scan(), changing_object()
    operator, _ = operators(rt, scan, truth.times_s)
    frames = operator.forward(truth.volumes)
    return replace(scan, projections=frames + 0.01 * noise(frames.shape, 3).astype(np.float32))


def run(rt, scan: Scan, method: str = "changing", **options) -> Reconstruction:
    return reconstruct(scan, plan_run(method, {"motion": "per-row", **options}), rt)


def psnr_db(result: Reconstruction, truth: States) -> list[float]:
    states = [result.volume if result.states is None else result.states.at(t) for t in truth.times_s]
    return [compare(one, true)["psnr_db"] for one, true in zip(states, truth.volumes, strict=True)]


def test_each_line_sees_the_state_of_its_own_time(rt) -> None:
    scan, truth = empty_scan(), changing_object()
    operator, alone = operators(rt, scan, truth.times_s)
    frames = operator.forward(truth.volumes)
    of_states = [alone.forward(volume) for volume in truth.volumes]
    for frame in (0, 10, 40, 79):  # wholly in one state
        np.testing.assert_array_equal(frames[frame], of_states[np.abs(STATE_TIMES_S - frame - 0.5).argmin()][frame])
    first, second = of_states[0][15], of_states[1][15]  # from 15 s to 16.0 s: the border of two states
    assert first.any() and np.abs(first - second).max() > 1e-3
    border = operators(rt, scan, STATE_TIMES_S - 0.5)[0].forward(truth.volumes)[15]
    np.testing.assert_array_equal(border[[0, -1]], [first[0], second[-1]])
    tables = [PerRow(sub_intervals=3).cells(scan, f) for f in range(4)]
    makes = projector_of(rt, GRID, tables, None, truth.times_s), RayOperator
    pairs = zip(makes, (truth.volumes, truth.volumes[0]), strict=True)
    averaged, alone = (IntensityOperator(rt, GRID, SHAPE, tables, make).expected(volumes) for make, volumes in pairs)
    np.testing.assert_allclose(averaged, alone, rtol=0, atol=RAYS * alone.max())


def test_transpose_subsets_and_equal_states(two_rt) -> None:
    scan, rng = empty_scan(12), np.random.default_rng(1)
    operator, alone = operators(two_rt, scan, np.array([1.0, 6.0, 11.0]))
    stack = rng.random((3, *GRID.shape)).astype(np.float32)
    frames = rng.random((12, *SHAPE)).astype(np.float32)
    forward, back = operator.forward(stack), operator.adjoint(frames)
    products = np.vdot(forward.astype(float), frames), np.vdot(stack.astype(float), back)
    assert abs(products[0] / products[1] - 1) < ADJOINT
    np.testing.assert_array_equal(operator.subset([7, 2]).forward(stack), forward[[7, 2]])
    same = np.broadcast_to(stack[0], stack.shape)
    np.testing.assert_allclose(operator.forward(np.ascontiguousarray(same)), alone.forward(stack[0]), rtol=RAYS)
    one, _ = operators(two_rt, scan, np.array([6.0]))
    np.testing.assert_array_equal(one.forward(stack[:1]), alone.forward(stack[0]))
    np.testing.assert_array_equal(one.adjoint(frames)[0], alone.adjoint(frames))


def test_states_come_back_and_help_each_other_by_a_price_of_change(rt, scan) -> None:
    truth, few = changing_object(), {"iterations": 12}
    result, resting = run(rt, scan, states=10, **few), run(rt, scan, "fista", **few)
    np.testing.assert_allclose(result.states.times_s, 8.0 * np.arange(10) + 4.0, atol=0.1)
    np.testing.assert_allclose(result.volume, result.states.volumes.mean(0), atol=1e-6)
    gains_db = np.subtract(psnr_db(result, truth), psnr_db(resting, truth))
    assert gains_db.min() > 2 and gains_db.mean() > 5
    assert result.states.volumes.min() >= 0
    apart, together = (np.mean(psnr_db(run(rt, scan, states=20, iterations=6, time_weight=w), truth)) for w in (0.0, 3.0))
    assert together > apart + 3


def test_resumed_runs_have_the_same_bits(rt, scan) -> None:
    plan, states = plan_run("changing", {"iterations": 6, "states": 5}), []
    whole = reconstruct(scan, plan, rt, report=lambda p: states.append(p.state()) if p.iteration == 3 else None)
    resumed = reconstruct(scan, plan, rt, resume=states[0])
    np.testing.assert_array_equal(resumed.states.volumes, whole.states.volumes)
    np.testing.assert_array_equal(resumed.volume, whole.volume)


def test_computed_frames_and_held_out_pixels_are_those_of_the_states(rt, scan) -> None:
    shown, plan = [], plan_run("changing", {"states": 5, "iterations": 8, "holdout": 2.0})
    result = reconstruct(scan, plan, rt, report=lambda p: shown.append(p.frames(2)) if p.iteration == 8 else None)
    assert max(pair.rms for pair in shown[0]) < 0.007  # 0.015 of the mean of the states
    titles = [re.search(r"RMS (.*) %", axes.get_title()) for axes in result.plot(scan, frame=2, device=rt).axes]
    (percent,) = (float(title[1]) for title in titles if title)
    assert percent < 0.7 * 100 * frame_pairs(rt, scan, result.volume, GRID, [2])[0].relative
    assert result.facts["held_out"]["holdout_rms"] < 0.007
    resting = reconstruct(scan, plan_run("fista", {"iterations": 8, "holdout": 2.0}), rt)
    assert resting.facts["held_out"]["holdout_rms"] > 0.01


def test_no_state_is_in_a_pause_nor_are_there_more_than_frames_and_small_subsets_are_joined(rt, scan) -> None:
    """Those of fewer than half a frame for each state."""
    eight, eighty = (run(rt, scan, states=20, iterations=1, subsets=n).states.volumes for n in (8, 80))
    np.testing.assert_array_equal(eight, eighty)
    times_s = np.concatenate([np.arange(40.0), 1000 + np.arange(40.0)])
    paused = replace(empty_scan(), frame_start_s=times_s)
    found = run(rt, paused, states=8, iterations=1).states.times_s
    np.testing.assert_allclose(found, [5, 15, 25, 35, 1005, 1015, 1025, 1035], atol=0.1)
    few = replace(empty_scan(3), projections=noise((3, *SHAPE)).astype(np.float32) ** 2)
    assert len(run(rt, few, iterations=1).states.times_s) == 3


def test_part_of_a_result_and_times_between_states() -> None:
    truth, inner = changing_object(), Grid((10, 10, 10), GRID.voxel_size_mm)
    part = Reconstruction(truth.volumes.mean(0), GRID, states=truth).within(inner)
    assert part.states.volumes.shape == (5, 10, 10, 10) and part.within(GRID) is part
    np.testing.assert_array_equal(part.states.volumes[2], truth.volumes[2, 5:15, 5:15, 5:15])
    np.testing.assert_allclose(truth.at(12.0), 0.75 * truth.volumes[0] + 0.25 * truth.volumes[1], atol=1e-6)
    np.testing.assert_array_equal(truth.at(-3.0), truth.volumes[0])
    np.testing.assert_array_equal(truth.at(99.0), truth.volumes[-1])
    assert truth.span_s == (0.0, 80.0)
