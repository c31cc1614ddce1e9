"""Bad input at every name of the API: one line with subject and remedy, an InputError, and nothing half done."""

import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl
import pyopencl.array
import pytest
from scipy.sparse.linalg import cg, lsmr, lsqr

from phyradgs_cl import api
from phyradgs_cl.api import (
    CircularOrbit,
    ConeGeometry,
    ConstantSpeed,
    EncoderTable,
    Exact,
    FrameSweeps,
    Gaussians,
    Grid,
    InputError,
    LinearOperator,
    MicroViews,
    Operator,
    OwnTimes,
    PerRow,
    PoseTable,
    Reconstruction,
    Scan,
    Shutter,
    SpeedRamp,
    TimeCells,
    fly_scan,
    ray_operator,
    reconstruct,
    splat_operator,
    static_scan,
    voxel_operator,
)

CONE = ConeGeometry(5.0, 7.0, (6, 8), (0.2, 0.2))
FRAMES = np.zeros((4, 6, 8), np.float32)
ANGLES = [0.0, 10.0, 20.0, 30.0]
NAN = np.full((4, 6, 8), np.nan)
POSES = CONE.pose(np.deg2rad(ANGLES))
EXCHANGED = POSES[[0, 3]] + np.pad(2 * POSES[[0, 3], :3] / 5, ((0, 0), (0, 9)))  # source at 7 mm, panel at -2 mm
EXCHANGED[:, 3:6] += 4 * POSES[[0, 3], :3] / 5  # and at 2
ONE = np.ones(1)


class Nowhere:
    """A trajectory that gives no poses."""

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        return np.zeros((*time_s.shape, 3))


class Half:
    """A motion whose line weights sum to a half."""

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        whole = PerRow().cells(scan, frame)
        return replace(whole, weight=whole.weight / 2)


class OnePose:
    """A motion with fewer poses than cells."""

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        whole = PerRow().cells(scan, frame)
        return replace(whole, pose=whole.pose[:1])


class Frames:
    """A motion that gives no cells."""

    def cells(self, scan: Scan, frame: int) -> np.ndarray:
        return scan.projections[frame]


def fly(
    frames: Any = FRAMES, geometry: Any = CONE, angles: Any = ANGLES, exposure_deg: Any = 10.0, **more: Any
) -> Scan:
    return fly_scan(frames, geometry, angles, exposure_deg=exposure_deg, **more)


GOOD = fly()
BACKWARDS = replace(GOOD, trajectory=PoseTable([0.0, 9.0], EXCHANGED))
FLAT = np.zeros((11, 2))


@cache
def rays() -> LinearOperator:
    return ray_operator(GOOD)


@cache
def splats() -> Operator:
    return splat_operator(GOOD)


def on_device(other_context: bool = False) -> pyopencl.array.Array:
    """A volume that the device of ``rays`` holds, but not on its queue."""
    context = pyopencl.Context([rays().rt.device.handle]) if other_context else rays().queue.context
    return pyopencl.array.zeros(pyopencl.CommandQueue(context), rays().domain_shape, np.float32)


def volume_there() -> pyopencl.array.Array:
    return rays().to_device(np.zeros(rays().domain_shape))


def cloud(**parts: Any) -> Gaussians:
    """One Gaussian, with ``parts`` that are wrong."""
    rows = {"mean": np.zeros((1, 3)), "scale": np.ones((1, 3)), "quaternion": np.ones((1, 4)), "density": ONE}
    return Gaussians(**{**rows, **parts})


VOLUME = Reconstruction(np.zeros((4, 4, 4), np.float32), Grid.cube(4, 2.0))
ELSEWHERE = Reconstruction(VOLUME.volume, replace(VOLUME.grid, offset_mm=(0.0, 90.0, 0.0)))
CASES: dict[str, list[tuple[Callable[[], object], str]]] = {
    "fly_scan": [
        (lambda: fly(FRAMES[0]), r"frames: found shape \(6, 8\); expected shape \(any, 6, 8\)"),
        (lambda: fly(FRAMES[:0]), "frames: found no frame"),
        (lambda: fly(mask=np.ones((6, 8))), "mask: found every pixel masked"),
        (lambda: fly(NAN), "pixels: found no usable value"),
        (lambda: fly("frames.npy"), "frames: found 'frames.npy'; expected numbers"),
        (lambda: fly(geometry=(5.0, 7.0)), r"geometry: found \(5.0, 7.0\); expected a ConeGeometry"),
        (lambda: fly(angles=ANGLES[:3]), r"angles_deg: found shape \(3,\); expected shape \(4\)"),
        (lambda: fly(angles=[0, 1, 2, np.inf]), "angles_deg: found 1 NaN or infinite"),
        (lambda: fly(exposure_deg=0.0), "exposure_deg: found 0; .*use static_scan"),
        (lambda: fly(exposure_deg=-10.0), "exposure_deg: .*write exposure_deg=10"),
        (lambda: fly(exposure_deg="14"), "exposure_deg: found '14'"),
        (lambda: fly(readout="lines"), "readout: found 'lines'; expected one of 'rows', 'columns'"),
        (lambda: fly(readout_ratio=-1), "readout_ratio: found -1"),
        (lambda: fly(readout_direction=0), "readout direction: found 0"),
        (lambda: fly(readout_direction="top"), r"direction: found 'top'; expected 1 \(index 0 first\) or -1"),
        (lambda: fly(exposure_s=0.0), "exposure_s: found 0.0"),
        (lambda: fly(FRAMES.astype(np.uint16)), "frames: found whole numbers .*give flats="),
        (lambda: fly(quantity="counts"), "flats: found None beside counts"),
        (lambda: fly(quantity="photons"), "quantity: found 'photons'"),
        (lambda: fly(darks=FRAMES), "flats, darks: found some beside attenuation"),
        (lambda: fly(flats=FRAMES[:, :3]), r"flats: found shape \(4, 3, 8\)"),
        (lambda: fly(mask=np.ones((8, 6))), r"mask: found shape \(8, 6\); expected \(6, 8\) or \(4, 6, 8\)"),
        (lambda: fly(detektor_model="log"), "detektor_model: .*did you mean 'detector_model'"),
        (lambda: fly(readout_s=62), "readout_s: .*exposure_s, .*readout_ms, .*detector_model.*did you mean 'readout_ms'"),
        (lambda: fly(detector_model="linear"), "detector_model: found 'linear'"),
        (lambda: fly(grid=16), "grid: found 16; expected a Grid"),
        (lambda: fly(pixel_mask=FRAMES[0]), "pixel_mask: .*write mask="),
        (lambda: fly(FRAMES + 51), "frames: found values of up to 51 without flats; .*give flats="),
    ],
    "static_scan": [
        (lambda: static_scan(FRAMES, CONE, ANGLES[:2]), r"angles_deg: found shape \(2,\)"),
        (lambda: static_scan(FRAMES, CONE, ANGLES, exposure_deg=3.0), "exposure_deg: found no such option"),
        (lambda: static_scan(FRAMES, CONE, ANGLES, flat=1), "flat: .*quantity, .*did you mean 'flats'"),
        (lambda: static_scan(FRAMES, CONE, ANGLES, lag=2.0), "lag: found 2.0"),
        (lambda: static_scan(FRAMES + 4e4, CONE, ANGLES), "frames: found values of up to 40000 without flats"),
    ],
    "Scan": [
        (lambda: replace(GOOD, projections=NAN), "projections: found 192 NaN or infinite values"),
        (lambda: replace(GOOD, projections=[[1], [1, 2]]), "projections: found lists of unequal length"),
        (
            lambda: replace(GOOD, trajectory=3),
            r"trajectory: found 3; expected anything with pose\(frame, time_s\)",
        ),
        (lambda: replace(GOOD, shutter=1.0), "shutter: found 1.0; expected a Shutter"),
        (lambda: replace(GOOD, frame_start_s=[0.0]), r"frame_start_s: found shape \(1,\)"),
        (lambda: replace(GOOD, pixel_mask=np.ones(6)), r"pixel_mask: found shape \(6,\)"),
        (lambda: replace(GOOD, title=3), "title: found 3; expected text"),
        (lambda: replace(GOOD, reference=np.ones((2, 2, 2))), r"reference: found shape \(2, 2, 2\)"),
        (lambda: Scan.from_poses(FRAMES, POSES, is_fly=True), "is_fly: found no such option"),
        (lambda: Scan.from_poses(FRAMES.astype(np.uint16), POSES), "frames: found whole numbers .*−ln"),
        (lambda: Scan.from_poses(FRAMES + 51, POSES), "frames: found values of up to 51"),
        (lambda: Scan.from_astra(FRAMES.astype(int), POSES), "frames: found whole numbers"),
        (lambda: GOOD.plot(4), "frame: found 4; expected a number from 0 to 3"),
        (
            lambda: reconstruct(replace(GOOD, trajectory=Nowhere()), "fdk"),
            r"trajectory Nowhere: found shape \(2, 3\)",
        ),
    ],
    "ConeGeometry": [
        (
            lambda: ConeGeometry("5", 7.0, (6, 8), (1.0, 1.0)),
            "source_to_axis_mm: found '5'; expected numbers",
        ),
        (lambda: ConeGeometry(5.0, -7.0, (6, 8), (1.0, 1.0)), "source_to_detector_mm: found -7.0"),
        (lambda: ConeGeometry(7.0, 5.0, (6, 8), (1.0, 1.0)), "source_to_detector_mm: found 5; .*exchanged"),
        (
            lambda: ConeGeometry(5.0, 7.0, 6, (1.0, 1.0)),
            r"detector_shape: found shape \(\); expected shape \(2\)",
        ),
        (lambda: ConeGeometry(5.0, 7.0, (6, 8.5), (1.0, 1.0)), "detector_shape: .*two counts"),
        (lambda: ConeGeometry(5.0, 7.0, (6, 8), (1.0, 0.0)), "pixel_size_mm: .*two positive lengths"),
        (lambda: ConeGeometry(5.0, 7.0, (6, 8), (1.0, 1.0), (np.nan, 0)), "detector_offset_mm: found 1 NaN"),
    ],
    "Shutter": [
        (lambda: Shutter(-1.0), "exposure_s: found -1.0"),
        (lambda: Shutter("1"), "exposure_s: found '1'"),
        (lambda: Shutter(1.0, axis="lines"), "readout axis: found 'lines'"),
        (lambda: Shutter(1.0, pulse_s=(3.0, 1.0)), "pulse_s: found 3 to 4 s"),
        (lambda: Shutter(1.0, pulse_s=3.0), "pulse_s: found shape"),
    ],
    "CircularOrbit": [
        (lambda: CircularOrbit(CONE, 3.0), "kinematics: found 3.0"),
        (lambda: CircularOrbit(5.0, ConstantSpeed(0.0, 1.0)), "geometry: found 5.0"),
    ],
    "ConstantSpeed": [(lambda: ConstantSpeed(0.0, np.nan), "speed_rad_per_s: found 1 NaN")],
    "SpeedRamp": [(lambda: SpeedRamp(0.0, 1.0, "1"), "acceleration_rad_per_s2: found '1'")],
    "EncoderTable": [
        (lambda: EncoderTable([0.0, 1.0], [0.0]), r"encoder table: found shapes \(2,\) and \(1,\)"),
        (lambda: EncoderTable([0.0, 0.0], [0.0, 1.0]), "encoder table: found times that do not increase"),
        (lambda: EncoderTable([0.0, 1.0], [0.0, 1.0]).angle_rad(0, np.array([2.0])), "extend the table"),
    ],
    "FrameSweeps": [
        (lambda: FrameSweeps([0.0, 1.0], 1.0, [0.0], [1.0]), r"angle_start_rad: found shape \(1,\)")
    ],
    "PoseTable": [
        (lambda: PoseTable([0.0, 1.0], POSES), "pose table: found shapes"),
        (lambda: PoseTable([0.0, 1.0], np.zeros((2, 12))), "pose table: found parallel pixel steps"),
        (
            lambda: reconstruct(BACKWARDS, "fdk"),
            "pose table: found the grid behind the panel in every frame; .*axis and panel exchanged",
        ),
    ],
    "TimeCells": [
        (lambda: reconstruct(GOOD, "sirt", motion=OnePose()), r"motion OnePose: pose: found shape \(1, 12\)"),
    ],
    "Exact": [
        (lambda: Exact(segments=1.5), r"segments \(0.*found 1.5"),
        (lambda: Exact(time_error=0), "time_error: found 0"),
    ],
    "MicroViews": [(lambda: MicroViews(2.5), "strips: found 2.5; expected a whole number")],
    "OwnTimes": [(lambda: OwnTimes(0), "sub_intervals: found 0")],
    "PerRow": [(lambda: PerRow(0), "sub_intervals: found 0")],
    "LineMiddles": [(lambda: reconstruct(GOOD, "sirt", motion=api.LineMiddles()), "motion: found LineMiddles")],
    "Static": [(lambda: reconstruct(GOOD, "sirt", motion=api.Static), "motion: found the class Static")],
    "StaticStart": [
        (lambda: reconstruct(GOOD, "fdk", motion="static-start", strips=3), "strips: found motion .*leave strips out")
    ],
    "Motion": [
        (lambda: reconstruct(GOOD, "sirt", motion=Half()), "motion Half: found line weights that sum to 0.5"),
        (lambda: reconstruct(GOOD, "sirt", motion=Frames()), "motion Frames: found a ndarray"),
    ],
    "Grid": [
        (lambda: Grid(16, 1.0), "grid shape: found shape"),
        (lambda: Grid((4, 4, 4), (1.0, 1.0)), "grid voxel_size: found shape"),
        (lambda: Grid((4, 4, 4), (1.0, 1.0, -1.0)), "grid voxel_size: .*three positive lengths"),
        (lambda: Grid((1e6, 1e6, 1e6), (1, 1, 1)), "grid shape: .*voxels"),
        (lambda: Grid.cube(0, 2.0), "count: found 0"),
    ],
    "Gaussians": [
        (lambda: Gaussians.from_rows(np.zeros((10, 5))), r"rows: found shape \(10, 5\)"),
        (
            lambda: Gaussians(np.zeros((2, 3)), np.ones((2, 3)), np.ones((2, 3)), np.ones(2)),
            "quaternion: found shape",
        ),
        (lambda: Gaussians(np.zeros(3), ONE, ONE, ONE), "Gaussians' mean: found shape"),
        (lambda: cloud(scale=np.full((1, 3), -2.0)), r"Gaussians' scale: found -2; .*np.exp\(scale\)"),
        (lambda: cloud(density=np.array([np.inf])), "Gaussians' density: found 1 NaN or infinite"),
    ],
    "Reconstruction": [
        (lambda: Reconstruction(np.zeros((2, 2, 2)), VOLUME.grid), r"volume: found shape \(2, 2, 2\)"),
        (lambda: Reconstruction(np.zeros((2, 2, 2)), 2.0), "grid: found 2.0"),
        (lambda: VOLUME.plot("scan.h5"), "scan: found 'scan.h5'"),
        (lambda: VOLUME.plot(GOOD, frame=9), "frame: found 9"),
        (lambda: VOLUME.plot(GOOD, device="no such device"), "^device: found 'no such device'"),
    ],
    "calibrate": [
        (lambda: api.calibrate("scan.h5"), "scan: found 'scan.h5'; expected a Scan"),
        (lambda: api.calibrate(GOOD, "rol"), "what: found .rol"),
        (lambda: api.calibrate(GOOD, "roll", splines=6), "splines: found 6; expected with what wobble"),
        (lambda: api.calibrate(GOOD, ["roll"]), "what: found .*expected names in one text"),
        (lambda: api.calibrate(GOOD, "roll", others=GOOD), "others: found .*a list of Scans"),
        (lambda: api.calibrate(GOOD, "roll", others=[1]), "others: found 1; expected a Scan"),
        (lambda: api.calibrate(BACKWARDS), "pose table: found the grid behind the panel"),
        (lambda: api.calibrate(GOOD), "4 frames|12 columns|8 frames|columns"),
    ],
    "prepare": [
        (lambda: api.prepare("scan.h5"), "scan: found 'scan.h5'; expected a Scan"),
        (lambda: api.prepare(GOOD, "spark"), "steps: found .spark"),
        (lambda: api.prepare(GOOD, "rings", rings={"windo": 3}), "windo"),
        (lambda: api.prepare(GOOD, "rings", holdout=5), "^holdout: found 5.0, without a method"),
    ],
    "reconstruct": [
        (lambda: reconstruct(GOOD, "sirt", initial="volume.h5"), "initial: found .volume.h5."),
        (lambda: reconstruct(GOOD, "sirt", initial=np.zeros((2, 3))), "initial: found shape"),
        (lambda: reconstruct(GOOD, "fdk", initial=VOLUME), "initial: found method fdk; .*leave initial out"),
        (lambda: reconstruct(GOOD, "sirt", initial=ELSEWHERE), "initial: found a volume in .*meets the scan's"),
        (
            lambda: reconstruct("scan.h5"),
            "scan: found 'scan.h5'; expected a Scan; read a file with load_scan",
        ),
        (lambda: reconstruct(GOOD, "fkd"), "method: found 'fkd'.*did you mean 'fdk'"),
        (lambda: reconstruct(GOOD, 3), "method: found 3"),
        (lambda: reconstruct(GOOD, lambda scan: None), "with 1 parameters; expected a function"),
        (lambda: reconstruct(GOOD, lambda scan, options, rt: 3), "found a int as its result"),
        (lambda: reconstruct(GOOD, "nowhere:f"), "No module named 'nowhere'"),
        (lambda: reconstruct(GOOD, "sirt", iteration=3), "^method sirt: option iteration: .*did you mean 'iterations'"),
        (lambda: reconstruct(GOOD, "fdk", preset="quick"), "^preset: .*for method fdk; method .*phyradgs.* has it"),
        (lambda: reconstruct(GOOD, "phyradgs", iterations=-1), "^iterations: found -1"),
        (lambda: reconstruct(GOOD, "phyradgs", batch=9, iterations=1), "^batch: found 9"),
        (lambda: reconstruct(GOOD, "sirt", roi_mm=(0, 1)), r"^roi_mm: found"),
        (lambda: reconstruct(GOOD, "sirt", size=4, voxel_mm=1, roi_mm=2), "^size: .*size, voxel_mm and roi_mm"),
        (lambda: reconstruct(GOOD, "fista", prior="piccs"), "^prior piccs: found no prior image.*say initial"),
        (lambda: reconstruct(GOOD, "fista", prior=3), "option prior: found 3"),
        (lambda: reconstruct(GOOD, "fista", prior="math:pi"), "^prior: found 3.14.*a function"),
        (lambda: reconstruct(GOOD, "fista", prior=lambda volume, noise: volume[1:]), "^prior .*lambda.*: found shape"),
        (lambda: reconstruct(GOOD, "fista", prior=lambda volume, noise: volume * np.nan), "^prior .*lambda.*NaN"),
        (lambda: reconstruct(GOOD, "fista", prior=lambda volume, noise: "cleaned"), "^prior .*lambda.*: found"),
        (lambda: reconstruct(GOOD, "fista", prior=lambda volume: volume), r"^prior .*TypeError: .*takes 1 .*line \d+"),
        (lambda: reconstruct(GOOD, "sirt", tolerance=abs), "option tolerance: found <built-in function abs>"),
        (lambda: reconstruct(GOOD, "fista", detector_model=abs), "option detector_model: found <built-in function abs>"),
        (lambda: reconstruct(GOOD, "sirt", grid=ELSEWHERE.grid), "grid: found a box in .* that no ray meets"),
        (lambda: reconstruct(GOOD, prior_share=0.7), "^prior_share: found 0.7 with the prior dct.*prior=piccs"),
        (lambda: reconstruct(GOOD, "asd-pocs", prior_share=0.5), "^prior_share: found 0.5 without.*say initial"),
        (lambda: reconstruct(GOOD, prior="dtc"), "prior: found 'dtc'; expected one of .*'package.module:function'"),
        (lambda: reconstruct(GOOD, "sirt", grid=(8, 8, 8)), r"grid: found \(8, 8, 8\)"),
        (lambda: reconstruct(GOOD, "sirt", report=3), "report: found 3"),
        (lambda: reconstruct(GOOD, "sirt", on_interrupt="stop"), "on_interrupt: found 'stop'"),
        (lambda: reconstruct(GOOD, "sirt", resume=VOLUME), "resume: found a result that is complete"),
        (lambda: reconstruct(GOOD, "sirt", seed=-1), "seed: found -1"),
        (lambda: reconstruct(GOOD, "sirt", device="no such device"), "^device: found 'no such device'"),
    ],
    "simulate": [
        (lambda: api.simulate("elbow"), "elbow"),
        (lambda: api.simulate("jaws"), "phantom: found jaws, which is no file; .* did you mean 'jaw'"),
        (lambda: api.simulate("foot", detector_offset=(0, 1)), "no such option; did you mean 'detector_offset_mm'"),
        (lambda: api.simulate("foot", size=8, views=7.5), "^views: found 7.5; expected a whole number"),
        (lambda: api.simulate(np.ones((2, 2, 2))), "phantom: found"),
        (lambda: api.simulate("foot", scanner="none"), "none"),
        (lambda: api.simulate("foot", size=8, detector=8, jitter_deg=-1), "^jitter_deg: found -1"),
        (lambda: api.simulate("foot", size=8, noise="loud"), "^noise: found 'loud'"),
    ],
    "load_scan": [
        (lambda: api.load_scan("nowhere.h5"), "nowhere.h5"),
        (lambda: api.load_scan(3), "path: found 3"),
    ],
    "load_volume": [(lambda: api.load_volume("nowhere.h5"), "nowhere.h5")],
    "save_scan": [
        (lambda: api.save_scan("s.h5", VOLUME), "scan: found Reconstruction.*expected a Scan"),
        (
            lambda: api.save_scan("s.h5", replace(GOOD, trajectory=Nowhere())),
            "trajectory Nowhere: found shape",
        ),
    ],
    "save_volume": [
        (
            lambda: api.save_volume("v.h5", VOLUME.volume),
            r"result: .*for an array, Reconstruction\(volume, grid\)",
        ),
        (lambda: api.save_volume("v.png", VOLUME), "path: found output v.png; .*a suffix of .nii.*or .h5"),
        (lambda: api.save_volume("v.ply", VOLUME), "result:/entry/gaussians: found nothing there"),
        (lambda: api.save_volume("v.nii", VOLUME, {"psnr_db": 3.0}), "metrics: found some for v.nii"),
        (lambda: api.save_volume("v.npy", replace(VOLUME, volume=VOLUME.volume * np.nan)), "volume: found 64 NaN"),
    ],
    "compare": [
        (lambda: api.compare(np.ones((2, 2, 2)), np.ones((3, 3, 3))), "shape"),
        (lambda: api.compare(VOLUME.volume, GOOD), "reference: found a Scan; expected an array"),
    ],
    "ray_operator": [
        (lambda: ray_operator(GOOD, "exact"), "motion: found Exact.*PerRow"),
        (lambda: ray_operator("scan.h5"), "scan: found 'scan.h5'; expected a Scan; read a file with load_scan"),
        (lambda: ray_operator(GOOD, Half()), "motion Half: found line weights that sum to 0.5"),
    ],
    "splat_operator": [
        (lambda: splat_operator(GOOD, "quick"), "motion: found 'quick'.*micro-views"),
        (lambda: splat_operator(GOOD, cutoff_sigma=-1), "cutoff_sigma"),
        (lambda: splat_operator(GOOD, Frames()), "motion Frames: found a ndarray"),
        (lambda: splats()(np.zeros((10, 3))), r"rows: .*\(11, any\)"),
        (lambda: splats()(FLAT), "rows: found a scale"),
        (lambda: splats()(FLAT * np.nan), "rows: found .*NaN"),
        (lambda: splats().frames([1]).T(FRAMES[:1]), "T: .*call the operator first"),
        (lambda: splats().intensity.of_densities(Gaussians.from_rows(FLAT + 1)), "of_densities: .*linear"),
        (lambda: lsqr(splats(), FRAMES.ravel()), r"SplatProjection.* not linear in x; .*of_densities\(gaussians\)"),
        (lambda: lsmr(splats(), FRAMES.ravel()), "SplatProjection.* not linear in x"),
        (lambda: cg(splats().T @ splats(), ONE), "Operator.* not linear in x; .*vjp"),
    ],
    "voxel_operator": [
        (lambda: voxel_operator(GOOD.grid, cutoff_sigma=-1), "cutoff_sigma"),
        (lambda: voxel_operator(16), "grid: found 16; expected a Grid"),
        (lambda: voxel_operator(GOOD.grid).frames([0]), "frames: .*from something to frames"),
    ],
    "voxelise": [
        (lambda: api.voxelise(FLAT, GOOD.grid), "gaussians: .*from_rows"),
        (lambda: api.voxelise(Gaussians.from_rows(FLAT + 1), (8, 8, 8)), "grid: found"),
    ],
    "initial_gaussians": [
        (lambda: api.initial_gaussians(GOOD, -1), "count .*found -1"),
        (lambda: api.initial_gaussians(FRAMES), "scan: found .*expected a Scan"),
        (lambda: api.initial_gaussians(GOOD, seed=-1), "seed: found -1"),
    ],
    "Operator": [
        (lambda: rays().frames([4]), r"frames: found \[4\].*0 to 3"),
        (lambda: rays().frames([0.5]), r"frames: found \[0.5\]"),
        (lambda: rays().frames([True, False]), "frames: found"),
        (lambda: rays().frames(2), "frames: found 2"),
        (lambda: splats().frames([]), "frames: found"),
        (lambda: rays().T.frames([0]), "frames: .*from something to frames"),
        (lambda: rays().intensity.intensity, "intensity: .*line integrals"),
        (lambda: splats().intensity.intensity, "intensity: .*line integrals"),
        (lambda: rays().to_device("x"), "values: found str"),
        (lambda: rays().to_device(FRAMES[:, 0]), r"values: found shape \(4, 8\); expected \(7, 8, 8\) or \(4, 6, 8\)"),
        (lambda: rays().to_device(FRAMES + 1j), "values: .*complex"),
        (lambda: lsqr(rays().intensity, ONE), "Operator.* not linear in x"),
        (lambda: rays().T(FRAMES[:1]), r"frames: found shape \(1, 6, 8\)"),
    ],
    "LinearOperator": [
        (lambda: rays()(FRAMES), r"volume: found shape \(4, 6, 8\)"),
        (lambda: rays()("volume"), "volume: found str .*real numbers"),
        (lambda: rays()(np.zeros(rays().domain_shape, complex)), "volume: .*complex"),
        (lambda: rays()(on_device(other_context=True)), "volume: .*another OpenCL context.*to_device"),
        (lambda: rays()(on_device()), "volume: .*another queue"),
        (lambda: rays()(volume_there().astype(float)), "volume: .*float64"),
        (lambda: rays()(volume_there().transpose((2, 1, 0))), "volume: .*C order"),
    ],
    "move_views": [
        (lambda: api.move_views(GOOD, np.zeros((2, 3))), "views"),
        (lambda: api.move_views(FRAMES, np.zeros((4, 3))), "scan: found .*expected a Scan"),
    ],
    "pose_gradient": [
        (lambda: api.pose_gradient(GOOD, GOOD.reference, FRAMES[:1]), "by_frames"),
        (lambda: api.pose_gradient(GOOD, FRAMES, FRAMES), "x: found shape"),
        (lambda: api.pose_gradient(GOOD, Gaussians.from_rows(FLAT + 1), FRAMES, "quick"), "motion: found 'quick'"),
    ],
    "as_torch": [(lambda: api.as_torch(3), "torch|operator")],
}
# what is raised, reported or only described: there is nothing to give it
NO_INPUT = {"Calibration", "InputError", "PhyradgsError", "Progress", "Trajectory"}


def test_every_name_has_a_case() -> None:
    assert set(CASES) | NO_INPUT == set(api.__all__)


@pytest.mark.parametrize("name", CASES)
def test_bad_input_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for call, words in CASES[name]:
        with pytest.raises(InputError, match=words) as raised:
            call()
        said = str(raised.value)
        assert "\n" not in said and len(said) < 400, words
        assert "--" not in re.sub("'phyradgs .*?'", "", said), f"{said}: an option of the command line"
        assert str(pickle.loads(pickle.dumps(raised.value))) == said, words
        assert not list(tmp_path.iterdir()), words
