"""Bad input at every name of the API: an InputError of a single line about its subject, and no file left."""

import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl
import pyopencl.array
import pytest

from phyradgs_cl import api
from phyradgs_cl.api import Gaussians, Grid, InputError, Scan, ray_operator, reconstruct, splat_operator

CONE = api.ConeGeometry(5.0, 7.0, (6, 8), (0.2, 0.2))
FRAMES = np.zeros((4, 6, 8), np.float32)
ANGLES = [0.0, 10.0, 20.0, 30.0]
NAN = np.full((4, 6, 8), np.nan)
ANGLES_RAD = np.deg2rad(ANGLES)
POSES = CONE.pose(ANGLES_RAD)
EXCHANGED = POSES[[0, 3]] + np.pad(2 * POSES[[0, 3], :3] / 5, ((0, 0), (0, 9)))  # source at 7 mm, panel at -2 mm
EXCHANGED[:, 3:6] += 4 * POSES[[0, 3], :3] / 5  # and at 2
ONE = np.ones(1)


def geometry(**changes: Any) -> SimpleNamespace:
    """TIGRE's description of the scanner, with ``changes`` that are wrong."""
    whole = {
        "mode": "cone", "DSO": 5.0, "DSD": 7.0, "nDetector": [6, 8], "dDetector": [0.2, 0.2], "nVoxel": [4, 4, 4],
        "dVoxel": [0.2, 0.2, 0.2],
    }  # fmt: skip
    return SimpleNamespace(**{**whole, **changes})


def from_tigre(geo: Any, angles: Any = ANGLES_RAD, frames: Any = FRAMES, **more: Any) -> Scan:
    return Scan.from_tigre(geo, angles, frames, **more)


def spoilt(name: str, change: Callable[[api.TimeCells], Any]) -> Any:
    """A motion of that name whose cells are changed."""
    return type(name, (), {"cells": lambda self, scan, frame: change(api.PerRow(5).cells(scan, frame))})()


HALF = spoilt("Half", lambda cells: replace(cells, weight=cells.weight / 2))
ONE_POSE = spoilt("OnePose", lambda cells: replace(cells, pose=cells.pose[:1]))
NO_CELLS = spoilt("Frames", lambda cells: FRAMES[0])
NOWHERE = type("Nowhere", (), {"pose": lambda self, frame, time_s: np.zeros((*time_s.shape, 3))})()  # no poses


def fly(frames: Any = FRAMES, geometry: Any = CONE, angles: Any = ANGLES, **more: Any) -> Scan:
    return api.fly_scan(frames, geometry, angles, **{"exposure_deg": 10.0, **more})


GOOD, STILL = fly(), api.static_scan(FRAMES, CONE, ANGLES)
BACKWARDS = replace(GOOD, trajectory=api.PoseTable([0.0, 9.0], EXCHANGED))
FLAT = np.zeros((11, 2))
MASKED = np.ma.masked_equal(FRAMES, 0)


class OnDevice:
    """An array as CuPy's, which NumPy cannot read."""

    shape, dtype, ndim = FRAMES.shape, FRAMES.dtype, 3

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise TypeError("Implicit conversion to a NumPy array is not allowed.")

    def __dlpack__(self, **_: Any) -> Any:
        raise BufferError("on cuda")

    def __dlpack_device__(self) -> tuple[int, int]:
        return 2, 0


AWAY = OnDevice()


def turned_by(length: float) -> np.ndarray:
    """Rows (11, 2) of Gaussians, of which one has a quaternion of that length."""
    rows = np.ones((11, 2))
    rows[6:10, 1] *= length / 2
    return rows


@cache
def rays() -> api.LinearOperator:
    return ray_operator(GOOD)


@cache
def splats() -> api.Operator:
    return splat_operator(GOOD)


def on_device(other_context: bool = False) -> pyopencl.array.Array:
    """A volume that the device of ``rays`` holds, but not on its queue."""
    context = pyopencl.Context([rays().rt.device.handle]) if other_context else rays().queue.context
    return pyopencl.array.zeros(pyopencl.CommandQueue(context), rays().domain_shape, np.float32)


def cloud(**parts: Any) -> Gaussians:
    """One Gaussian, with ``parts`` that are wrong."""
    rows = {"mean": np.zeros((1, 3)), "scale": np.ones((1, 3)), "quaternion": np.ones((1, 4)), "density": ONE}
    return Gaussians(**{**rows, **parts})


GRID = Grid.cube(4, 2.0)


def still(**changes: Any) -> api.Deformation:
    """A deformation that displaces nothing."""
    values = {"control_mm": np.zeros((1, 2, 2, 2, 3)), "origin_mm": (0, 0, 0), "spacing_mm": 1.0, "times_s": [0.0, 1.0]}
    return api.Deformation(**{**values, "weights": np.zeros((2, 1)), **changes})


VOLUME = api.Reconstruction(np.zeros((4, 4, 4), np.float32), Grid.cube(4, 2.0))
ELSEWHERE = api.Reconstruction(VOLUME.volume, replace(VOLUME.grid, offset_mm=(0.0, 90.0, 0.0)))
# fmt: off
ARGUMENTS: list[tuple[str, Callable[..., object], dict[str, list[Any]]]] = [
    ("fly_scan", fly, {
        "frames": [FRAMES[0], FRAMES[:0], "frames.npy", FRAMES.astype(np.uint16), FRAMES + 51],
        "angles": [ANGLES[:3], [0, 1, 2, np.inf]], "mask": [np.ones((6, 8)), np.ones((8, 6))], "geometry": [(5.0, 7.0)],
        "exposure_deg": [0.0, -10.0, "14", 40.0], "readout": ["lines"], "readout_ratio": [-1, 50 / 0.06],
        "exposure_s": [0.0], "quantity": ["photons"], "first": ["left"], "flats": [FRAMES[:, :3]], "readout_s": [62],
        "detector_model": ["linear"], "grid": [16], "pixel_mask": [FRAMES[0]],
    }),
    ("static_scan", partial(api.static_scan, FRAMES, CONE, ANGLES), {
        "flat": [1], "lag": [2.0], "grid": [Grid((1, 1, 1), (585.0,) * 3)],
    }),
    ("static_scan", partial(api.static_scan, FRAMES + 3e4, CONE, ANGLES), {"quantity": ["attenuation"]}),
    ("Scan", partial(replace, GOOD), {
        "projections": [NAN, [[1], [1, 2]]], "trajectory": [3], "shutter": [1.0], "frame_start_s": [[0.0]],
        "pixel_mask": [np.ones(6)], "title": [3], "reference": [np.ones((2, 2, 2))], "lag": [0.901],
    }),
    ("Shutter", partial(api.Shutter, 1.0), {"pulse_s": [(3.0, 1.0), 3.0], "readout_s": [-0.1]}),
    ("ConeGeometry", partial(replace, CONE), {
        "source_to_axis_mm": ["5", 0, np.nan], "source_to_detector_mm": [0, 4], "pixel_size_mm": [(0.5, 0.0), (0.5,)],
        "detector_shape": [(0, 5), 6, (6, 8.5)], "detector_offset_mm": [(np.inf, 0.0)],
    }),
    ("Exact", api.Exact, {"segments": [1.5], "time_error": [0]}),
    ("LineMiddles", partial(reconstruct, GOOD, "sirt"), {"motion": [api.LineMiddles()]}),
    ("Static", partial(reconstruct, GOOD, "sirt"), {"motion": [api.Static]}),
    ("Reconstruction", partial(VOLUME.plot, GOOD), {"frame": [9], "device": ["no such device"]}),
    ("calibrate", partial(api.calibrate, GOOD, "roll"), {"splines": [6], "others": [GOOD, [1]]}),
    ("prepare", partial(api.prepare, GOOD, "rings"), {"holdout": [5]}),
    ("reconstruct", partial(reconstruct, GOOD, "sirt"), {
        "initial": ["volume.h5", np.zeros((2, 3)), ELSEWHERE], "margin_mm": [-1, (1, 2)],
        "size": [0, 2.5, (4, 5), 10**400, 1e6], "voxel_mm": [0, 100],
        "roi_mm": [(0, 1), -3, (1, -1, -1, 1, -1, 1), (-1e12, 1, -1, 1, -1, 1)], "grid": [ELSEWHERE.grid, (8, 8, 8)],
        "report": [3], "on_interrupt": ["stop"], "resume": [VOLUME], "seed": [-1], "device": ["no such device"],
    }),
    ("reconstruct", partial(reconstruct, GOOD, "fdk"), {"initial": [VOLUME], "preset": ["quick"]}),
    ("reconstruct", partial(reconstruct, GOOD, "phyradgs"), {"iterations": [-1], "strips": [2.5, "two"], "preset": [""]}),
    ("reconstruct", partial(reconstruct, GOOD, "fista"), {
        "prior": ["math:pi", lambda volume, noise: volume[1:], lambda volume, noise: "cleaned", lambda volume: volume],
    }),
    ("reconstruct", partial(reconstruct, GOOD), {"prior_share": [0.7], "prior": ["dtc"]}),
    ("ParallelGeometry", partial(api.ParallelGeometry, (6, 8)), {"pixel_size_mm": [0.0]}),
    ("sum_frames", partial(api.sum_frames, GOOD), {"count": [0]}), ("simulate", api.simulate, {"phantom": ["elbow"]}),
    ("simulate", partial(api.simulate, "foot"), {
        "scanner": ["none"], "size": [0], "truncation": [2], "protocol": ["slow"], "views": [7.5], "jitter_deg": [-1],
        "noise": ["loud"], "exposure_deg": [5000.0], "motion_of_object": [3],
    }),
    ("splat_operator", partial(splat_operator, GOOD), {"cutoff_sigma": [-1]}),
    ("initial_gaussians", partial(api.initial_gaussians, GOOD), {"seed": [-1], "count": [-1]}),
    ("Scan", lambda **wrong: from_tigre(geometry(**wrong)), {
        "geo.mode": ["fan"], "geo.DSD": [None], "geo.rotDetector": [np.array([0.1, 0, 0])], "geo.DSO": [np.ones(3)],
        "geo.nVoxel": [[8, 8.5, 8]],
    }),
    ("Scan", partial(from_tigre, geometry()), {"angles": [AWAY, np.ones((4, 3))], "grid": [Grid.cube(4, 2.0)]}),
    ("Scan", partial(Scan.from_astra, FRAMES), {"vectors": [AWAY, np.ma.masked_less(POSES, 0), POSES[:, :9]]}),
    ("Gating", partial(api.Gating, times_s=[0, 1], values=[0, 1]), {
        "gating times_s": [[0, 0]], "gating is_phase": ["no"], "gating values": [np.zeros(3), 2 * [np.nan]],
    }),
    ("Deformation", still, {
        "deformation control_mm": [np.zeros((1, 2, 2, 2)), np.zeros((0, 2, 2, 2, 3))], "deformation times_s": [[]],
        "deformation origin_mm": [(0.0, 1.0)], "deformation spacing_mm": [0.0],
        "deformation weights": [np.full((2, 1), np.nan)],
    }),
    ("Gaussians", cloud, {
        "Gaussians' quaternion": [np.ones((1, 3)), np.zeros((1, 4))], "Gaussians' mean": [AWAY],
        "Gaussians' scale": [np.full((1, 3), -2.0)], "Gaussians' density": [np.array([np.inf])],
    }),
]
"""Of a name: a call, and wrong values of its arguments, which the error is about; before them, what it says first."""

CASES: dict[str, list[tuple[str, Callable[[], object]]]] = {
    "fly_scan": [("pixels", lambda: fly(NAN)), ("readout direction", lambda: fly(readout_direction=0)),
        ("flats", lambda: fly(quantity="counts")), ("flats, darks", lambda: fly(darks=FRAMES)),
        *((name, partial(fly, **{name: AWAY})) for name in ("frames", "flats", "mask"))],
    "static_scan": [*(("frames", partial(api.static_scan, one, CONE, ANGLES)) for one in (MASKED, list(MASKED), AWAY))],
    "Scan": [*((name, partial(replace, GOOD, **{name: MASKED})) for name in ("projections", "pixel_mask")),
        ("is_fly", lambda: replace(GOOD, is_fly="no")), ("vectors", lambda: Scan.from_astra(FRAMES, AWAY)),
        ("is_parallel", lambda: Scan.from_poses(FRAMES, POSES, is_parallel="no")), ("frame", lambda: GOOD.plot(4)),
        ("frames", lambda: Scan.from_astra(FRAMES.swapaxes(0, 1), POSES)),
        ("poses", lambda: Scan.from_poses(FRAMES, np.zeros((4, 12)))),
        ("trajectory Nowhere", lambda: reconstruct(replace(GOOD, trajectory=NOWHERE), "fdk"))],
    "ConeGeometry": [("pixel_size_mm", lambda: api.static_scan(FRAMES, api.ConeGeometry(3, 8, (6, 8), 15.6), ANGLES))],
    "calibrate": [("scan", lambda: api.calibrate(GOOD)), ("scan", lambda: api.calibrate("scan.h5")),
        ("what", lambda: api.calibrate(GOOD, "rol"))],
    "ParallelGeometry": [("trajectory", lambda: replace(GOOD, geometry=api.ParallelGeometry((6, 8), 0.2)))],
    "Shutter": [*(("", partial(api.Shutter, *given)) for given in (("1",), (-1.0,), (1.0, 0.1, "row")))],
    "CircularOrbit": [("kinematics", lambda: api.CircularOrbit(CONE, 3.0)),
        ("geometry", lambda: api.CircularOrbit(5.0, api.ConstantSpeed(0.0, 1.0)))],
    "ConstantSpeed": [("speed_rad_per_s", lambda: api.ConstantSpeed(0.0, np.nan))],
    "SpeedRamp": [("acceleration_rad_per_s2", lambda: api.SpeedRamp(0.0, 1.0, "1"))],
    "EncoderTable": [*(("encoder", partial(api.EncoderTable, times, [0, 1])) for times in ([0], [1, 0], [0, np.nan]))],
    "FrameSweeps": [("angle_start_rad", lambda: api.FrameSweeps([0.0, 1.0], 1.0, [0.0], [1.0]))],
    "PoseTable": [("pose table", lambda: api.PoseTable([0.0, 1.0], np.zeros((2, 12)))),
        ("is_parallel", lambda: api.PoseTable(range(4), POSES, is_parallel="no")),
        ("pose table", lambda: reconstruct(BACKWARDS, "fdk"))],
    "TimeCells": [("motion OnePose: pose", lambda: reconstruct(GOOD, "sirt", motion=ONE_POSE))],
    "MicroViews": [*(("", partial(api.MicroViews, *given)) for given in ((2.5,), (0, 1), (1, 0)))],
    "Centres": [("strips", lambda: api.Centres(0))], "OwnTimes": [("sub_intervals", lambda: api.OwnTimes(0))],
    "PerRow": [("sub_intervals", lambda: api.PerRow(-1))],
    "StaticStart": [("strips", lambda: reconstruct(GOOD, "fdk", motion="static-start", strips=3))],
    "Motion": [("motion Half", lambda: reconstruct(GOOD, "sirt", motion=HALF))],
    "Grid": [("count", lambda: Grid.cube(0, 2.0)), ("grid offset", lambda: Grid((2, 3, 4), (1, 1, 1), (0, np.inf, 0))),
        *(("grid shape", partial(Grid, shape, (1, 1, 1))) for shape in (16, (1e6, 1e6, 1e6), (0, 3, 4))),
        *(("grid voxel_size", partial(Grid, (2, 3, 4), size)) for size in ((1.0, 1.0), (1, 0, 1), (1, np.nan, 1)))],
    "Gating": [("gating", lambda: replace(GOOD, gating=np.zeros(4)))],
    "States": [("times of states", lambda: api.States([2.0, 1.0], np.zeros((2, 3, 3, 3)))),
        ("states", lambda: api.States([1.0], np.zeros((2, 3, 3, 3)))),
        ("time_s", lambda: api.States([1.0], np.zeros((1, 3, 3, 3))).at("now"))],
    "deformed": [*(("volume", partial(api.deformed, one, GRID, still(), [1.0])) for one in (FRAMES, MASKED, AWAY)),
        ("weights", lambda: api.deformed(np.zeros(GRID.shape), GRID, still(), [1.0, 2.0])),
        ("deformation", lambda: api.deformed(np.zeros(GRID.shape), GRID, "field.h5", [1.0]))],
    "load_deformation": [("nowhere.h5", lambda: api.load_deformation("nowhere.h5"))],
    "save_deformation": [("deformation", lambda: api.save_deformation("field.h5", GRID))],
    "ObjectMotion": [("motion of the object: kind", lambda: api.ObjectMotion("walking")),
        ("motion of the object: amplitude", lambda: api.ObjectMotion("sliding", 2).deformation(GRID, 0, 1))],
    "Gaussians": [("rows", lambda: Gaussians.from_rows(np.zeros((10, 5)))),
        ("Gaussians' mean", lambda: Gaussians.of_covariance(AWAY, np.eye(3)[None], ONE)),
        ("covariance", lambda: Gaussians.of_covariance(np.zeros((1, 3)), np.eye(3), ONE))],
    "Reconstruction": [("volume", lambda: api.Reconstruction(np.zeros((2, 2, 2)), VOLUME.grid)),
        ("scan", lambda: VOLUME.plot("scan.h5")),
        ("volume", lambda: api.Reconstruction(np.zeros(VOLUME.grid.shape, complex), VOLUME.grid)),
        *(("doubt", partial(replace, VOLUME, doubt=one)) for one in (MASKED, FRAMES)),
        *((name, partial(VOLUME.to_xarray, **{name: "no"})) for name in ("hu", "states")),
        ("states", lambda: replace(VOLUME, states=api.States([1.0], np.zeros((1, 3, 3, 3)))))],
    "prepare": [("scan", lambda: api.prepare("scan.h5")), ("steps", lambda: api.prepare(GOOD, "spark")),
        ("reconstruct: option rings: option windo", lambda: api.prepare(GOOD, "rings", rings={"windo": 3}))],
    "reconstruct": [("scan", lambda: reconstruct("scan.h5")),
        ("batch", lambda: reconstruct(GOOD, "phyradgs", batch=9, iterations=1)),
        *(("method", partial(reconstruct, GOOD, method)) for method in (
            "fkd", lambda scan: None, lambda scan, options, rt: 3, "nowhere:f")),
        ("size", lambda: reconstruct(GOOD, "sirt", size=4, voxel_mm=1, roi_mm=2)),
        ("prior piccs", lambda: reconstruct(GOOD, "fista", prior="piccs"))],
    "simulate": [("simulate: option dosis", lambda: api.simulate("foot", dosis=3)),
        ("phantom", lambda: api.simulate(np.ones((2, 2, 2)))),
        ("first", lambda: api.simulate("foot", first="left", readout_axis="rows"))],
    "load_scan": [("nowhere.h5", lambda: api.load_scan("nowhere.h5")), ("path", lambda: api.load_scan(3))],
    "load_volume": [("nowhere.h5", lambda: api.load_volume("nowhere.h5"))],
    "save_scan": [("scan", lambda: api.save_scan("s.h5", VOLUME))],
    "save_volume": [("result", lambda: api.save_volume("v.h5", VOLUME.volume)),
        ("path", lambda: api.save_volume("v.png", VOLUME)), ("hu", lambda: api.save_volume("v.nii", VOLUME, hu="no")),
        ("result:/entry/gaussians", lambda: api.save_volume("v.ply", VOLUME)),
        ("metrics", lambda: api.save_volume("v.nii", VOLUME, {"psnr_db": 3.0})),
        ("volume", lambda: api.save_volume("v.npy", replace(VOLUME, volume=VOLUME.volume * np.nan)))],
    "compare": [("result", lambda: api.compare(np.ones((2, 2, 2)), np.ones((3, 3, 3)))),
        *(("reference", partial(api.compare, VOLUME.volume, other)) for other in (GOOD, VOLUME.volume, MASKED)),
        ("volume", lambda: api.compare(MASKED, FRAMES + 1)),
        ("reference", lambda: api.compare(np.ones((4, 4)), np.ones((4, 4))))],
    "ray_operator": [("motion", lambda: ray_operator(GOOD, "exact")), ("scan", lambda: ray_operator("scan.h5"))],
    "splat_operator": [("affine", lambda: splat_operator(GOOD, affine="no")), ("rows", lambda: splats()(FLAT)),
        ("rows", lambda: splats()(np.ma.masked_equal(FLAT, 0))), ("rows", lambda: splats()(FLAT * np.nan)),
        *(("rows", partial(call, turned_by(length))) for length in (0, 1e-30, 1e15) for call in (
            lambda x: splats()(x), lambda x: splats().derivative(x), lambda x: splats().of_densities(x))),
        ("SplatProjection", lambda: splats().T(FRAMES)),
        ("of_densities", lambda: splats().intensity.of_densities(Gaussians.from_rows(FLAT + 1)))],
    "voxel_operator": [("rows", lambda: api.voxel_operator(GRID)(turned_by(1e-15))),
        ("grid", lambda: api.voxel_operator(16))],
    "voxelise": [("gaussians", lambda: api.voxelise(FLAT, GOOD.grid)),
        ("grid", lambda: api.voxelise(Gaussians.from_rows(FLAT + 1), (8, 8, 8)))],
    "initial_gaussians": [("scan", lambda: api.initial_gaussians(FRAMES))],
    "Operator": [("frames", lambda: rays().frames([4])), ("frames", lambda: rays().frames(2)),
        ("intensity", lambda: rays().intensity.intensity), ("values", lambda: rays().to_device(FRAMES[:, 0])),
        *(("values", lambda one=one: rays().to_device(one)) for one in ("x", MASKED, AWAY)),
        *(("frames", lambda one=one: rays().T(one)) for one in (MASKED, list(MASKED), AWAY)),
        ("frames", lambda: rays().T(FRAMES[:1]))],
    "LinearOperator": [("volume", lambda: rays() @ np.ma.masked_equal(np.zeros(rays().shape[1]), 0)),
        ("volume", lambda: rays()(FRAMES)), ("volume", lambda: rays()(on_device(other_context=True))),
        ("volume", lambda: rays().intensity.vjp(np.ma.masked_equal(np.zeros(rays().domain_shape), 0))),
        ("volume", lambda: rays()(on_device()))],
    "move_views": [("views", lambda: api.move_views(GOOD, np.zeros((2, 3)))),
        ("scan", lambda: api.move_views(FRAMES, np.zeros((4, 3)))),
        ("without_gauges", lambda: api.move_views(GOOD, np.zeros((4, 3)), without_gauges="no"))],
    "pose_gradient": [("x", lambda: api.pose_gradient(GOOD, FLAT, FRAMES)),
        ("by_frames", lambda: api.pose_gradient(GOOD, Gaussians.from_rows(FLAT + 1), NAN)),
        ("by_poses", lambda: splats().intensity.by_poses(Gaussians.from_rows(FLAT + 1), FRAMES))],
    "sum_frames": [("scan", lambda: api.sum_frames(FRAMES, 2)),
        ("lag", lambda: api.sum_frames(replace(GOOD, lag=0.1), 2)),
        ("readout", lambda: api.sum_frames(STILL, 2, readout="left")),
        ("scan", lambda: api.sum_frames(fly(readout_ratio=0.5), 2)),
        ("frame_start_s", lambda: api.sum_frames(replace(STILL, frame_start_s=np.arange(4.0) ** 2), 2))],
    "as_torch": [("", lambda: api.as_torch(3))],
}
"""Of a name: the subject of the error, and a call."""
# fmt: on
# what is raised, reported or only described: there is nothing to give it
NO_INPUT = {"Calibration", "InputError", "PhyradgsError", "Progress", "Trajectory"}
NAMES = sorted({*CASES, *(name for name, *_ in ARGUMENTS)})


def test_every_name_has_a_case() -> None:
    assert {*NAMES, *NO_INPUT} == set(api.__all__)


@pytest.mark.parametrize("name", NAMES)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    calls = [*CASES.get(name, [])]
    for of, function, arguments in ARGUMENTS:
        if of == name:
            wrong = [(key, {re.split("[ .]", key)[-1]: value}) for key, values in arguments.items() for value in values]
            calls += [(key, partial(function, **one)) for key, one in wrong]
    for subject, call in calls:
        with pytest.raises(InputError) as raised:
            call()
        error, text = raised.value, str(raised.value)
        assert error.subject.startswith(subject), text
        assert "\n" not in text and len(text) < 400, text
        assert "--" not in re.sub("'phyradgs .*?'", "", text), f"{text}: an option of the command line"
        assert str(pickle.loads(pickle.dumps(error))) == text
        assert not list(tmp_path.iterdir()), text
