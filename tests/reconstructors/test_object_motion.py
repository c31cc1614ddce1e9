"""Reconstructions of an object whose motion is known: nearer to its reference than without, resumed to the same bits."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, PerRow, Scan, Shutter
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, control_points
from phyradgs_cl.io import read_volume, write_deformation, write_scan
from phyradgs_cl.operators.warp.operator import projector_of
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors import METHODS, ObjectMotion, RunPlan, plan_run, reconstruct
from phyradgs_cl.reconstructors.plan import check_object_motion
from phyradgs_cl.reconstructors.projected import frame_pairs, spread_frames
from phyradgs_cl.reconstructors.result import HELD_OUT, Progress
from phyradgs_cl.reconstructors.splats import method as splatting
from phyradgs_cl.report.run import computed_views, load_run

pytestmark = pytest.mark.slow

GRID, SHAPE, FRAMES = Grid.cube(16, 2.0), (24, 24), 30


def breathing(amplitude_mm: float = 0.25) -> Deformation:
    """The upper part rises and falls, and moves along y a little later."""
    origin_mm, counts = control_points(GRID, 0.5)
    share = np.clip((origin_mm[2] + 0.5 * np.arange(counts[0]) + 1) / 2, 0, 1)[:, None, None]
    control_mm = np.zeros((2, *counts, 3))
    control_mm[0, ..., 2], control_mm[1, ..., 1] = amplitude_mm * share, -amplitude_mm / 3 * share
    times_s = np.linspace(0, 13, 100)
    phases = [1 - np.cos(np.pi * (times_s - 0.4 * r) / 4) ** 4 for r in range(2)]
    return Deformation(control_mm, origin_mm, 0.5, times_s, np.stack(phases, -1))


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    """Frames of a fine volume that moves, as a rolling shutter sees it from a gantry that turns."""
    geometry = ConeGeometry(5.0, 7.0, SHAPE, (4 / 24, 4 / 24))
    fine, start_s = GRID.finer(2), 0.4 * np.arange(FRAMES)
    orbit, shutter = CircularOrbit(geometry, ConstantSpeed(0.0, 2 * np.pi / 12)), Shutter(0.4, 0.3)
    truth = shepp_logan(0.9).voxelise(fine)
    empty = Scan(np.zeros((FRAMES, *SHAPE), np.float32), geometry, orbit, shutter, start_s, GRID)
    tables = [PerRow(6).cells(empty, f) for f in range(FRAMES)]
    frames = projector_of(rt, fine, tables, breathing())(rt, fine, SHAPE, tables).forward(truth)
    reference = truth.reshape(16, 2, 16, 2, 16, 2).mean((1, 3, 5))
    return replace(empty, projections=frames, reference=reference)


def plan_of(method: str, field: Deformation | None, **changes: object) -> RunPlan:
    motion = {} if method in ("fdk", "phyradgs", "r2") else {"motion": "per-row", "sub_intervals": 2}
    return plan_run(method, {**motion, **changes}, object_motion=field and ObjectMotion(field))


def error(scan: Scan, volume: np.ndarray) -> float:
    return float(np.sqrt(np.mean((volume - scan.reference) ** 2)))


@pytest.mark.parametrize(("method", "changes", "share"), [
    ("fista", {"iterations": 4}, 0.7), ("os-sart", {"iterations": 8}, 0.7), ("fdk", {"motion": "static"}, 0.8),
    ("fdk", {"motion": "per-row"}, 0.8), ("phyradgs", {"iterations": 240, "gaussians": 600}, 0.75),
])  # fmt: skip
def test_the_reference_is_nearer_and_no_bit_is_other_where_nothing_moves(rt, scan, method, changes, share) -> None:
    ignored, moved = (reconstruct(scan, plan_of(method, field, **changes), rt) for field in (None, breathing()))
    assert error(scan, moved.volume) < share * error(scan, ignored.volume)
    assert moved.gaussians is None or moved.gaussians.count > 300
    few = changes | ({"iterations": 8 if "gaussians" in changes else 2} if "iterations" in changes else {})
    plain, still = (reconstruct(scan, plan_of(method, field, **few), rt) for field in (None, breathing(0.0)))
    np.testing.assert_array_equal(still.volume, plain.volume)


@pytest.mark.parametrize("method", ["cgls", "fista", "phyradgs"])
def test_runs_resume_to_the_same_bits(rt, scan, method, monkeypatch) -> None:
    """All others, without a field: test_iterative.py."""
    more = {"fista": {"subvoxels": 1}, "phyradgs": {"gaussians": 200}}
    monkeypatch.setattr(splatting, "REPORT_EVERY", 2)  # of splats' iterations
    plan = plan_of(method, breathing(), iterations=3, **more.get(method, {}))

    def stop(progress: Progress) -> None:
        if progress.iteration == 2:
            raise KeyboardInterrupt

    whole, partial = reconstruct(scan, plan, rt), reconstruct(scan, plan, rt, report=stop)
    np.testing.assert_array_equal(reconstruct(scan, plan, rt, resume=partial.state).volume, whole.volume)
    with pytest.raises(InputError, match="object_motion"):
        reconstruct(scan, replace(plan, object_motion=ObjectMotion(breathing(0.2))), rt, resume=partial.state)


def test_held_out_pixels_are_compared_with_the_object_as_it_was(rt, scan) -> None:
    plans = (plan_of("os-sart", field, iterations=12, holdout=2.0) for field in (breathing(), None))
    moved, ignored = (reconstruct(scan, plan, rt).facts[HELD_OUT] for plan in plans)
    assert moved["holdout_rms"] < 0.75 * ignored["holdout_rms"]


UP_AND_DOWN = 4 * (-1.0) ** np.arange(7)[:, None, None, None]  # from one control point along z to the next
BAD = {
    "moves nothing in the scan's grid": lambda one: replace(one, origin_mm=(50.0, 0.0, 0.0)),
    "displacements of up to": lambda one: replace(one, control_mm=1000 * one.control_mm),
    "matter that folds": lambda one: replace(one, control_mm=one.control_mm * UP_AND_DOWN),
    "times from": lambda one: replace(one, times_s=1000 * one.times_s + 1e5),
}


def test_methods_of_objects_at_rest_and_fields_that_do_not_fit_are_refused_or_warned_of(rt, scan, caplog) -> None:
    for method in (name for name, method in METHODS.items() if not method.takes_deformation):
        with pytest.raises(InputError, match=f"--method {method}"):
            plan_run(method, object_motion=ObjectMotion(breathing()))
    with pytest.raises(InputError, match="extrapolate=reprojected"):
        reconstruct(scan, plan_of("fdk", breathing(), extrapolate="reprojected"), rt)
    for found, change in BAD.items():
        with pytest.raises(InputError, match=f"--object-motion.*{found}"):
            reconstruct(scan, plan_of("sirt", change(breathing()), iterations=1), rt)
    for share, is_warned in ((1.0, False), (0.7, True)):  # a part of the scan
        times_s = np.linspace(0, share * (scan.frame_start_s.max() + scan.shutter.span_s), len(breathing().times_s))
        check_object_motion(replace(breathing(), times_s=times_s), scan)
        assert ("the object rests" in caplog.text) == is_warned


def test_the_command(rt, cli, refused, scan, tmp_path) -> None:
    """The file is part of the provenance; estimates count its memory."""
    scan_file, field, output = (tmp_path / name for name in ("scan.h5", "field.h5", "volume.h5"))
    write_scan(scan_file, scan)
    write_deformation(field, breathing())
    run = ["reconstruct", scan_file, "-o", output, "--iterations", "2", "--method", "sirt", "--object-motion", field]
    assert cli.run([str(word) for word in run]) == 0
    assert read_volume(output).provenance["object_motion"] == str(field)
    pairs = frame_pairs(rt, scan, read_volume(output).values, GRID, spread_frames(FRAMES, 2), breathing())
    assert [pair.rms for pair in computed_views(load_run(output), rt, 2)] == [pair.rms for pair in pairs]
    field.rename(tmp_path / "lost.h5")
    assert computed_views(load_run(output), rt, 2) == []
    (tmp_path / "lost.h5").rename(field)
    refused([*run[:-3], "phyradgs", *run[-2:], "--motion", "centres"], "--object-motion", "--motion centres", "exact")
    refused([*run[:-1], scan_file], "/entry/deformation")
    refused([*run, "--rows", "0:8"], "--rows")
