"""Runs RTK's FDK and its Joseph projectors for rtk_fdk.py and ray_speed.py. Needs only itk-rtk and NumPy.

    python rtk_peer.py TASK.npz RESULT.npz
    python rtk_peer.py FOLDER

A task has RTK's geometry (lengths in mm, gantry angles in degrees, offsets (x, y)). The task of FDK has projections
(F, rows, columns) and a cube of `voxels` and `spacing_mm`. Its result has the volume in RTK's own axes, (seconds, processor
seconds) of every run, and the version.

FOLDER/task.npz is that of the projectors: a volume (Z, Y, X) and frames (F, rows, columns) in RTK's axes. Every line of
standard input, ``forward`` or ``adjoint``, runs that operator once. It keeps the result as FOLDER/NAME.npy and answers with
a line of JSON: wall and processor seconds of the operator itself."""

import importlib.metadata
import json
import sys
import time
from pathlib import Path
from typing import Any

import itk
import numpy as np
from itk import RTK as rtk

IMAGE = itk.Image[itk.F, 3]
FILTERS = {
    "forward": rtk.JosephForwardProjectionImageFilter[IMAGE, IMAGE],
    "adjoint": rtk.JosephBackProjectionImageFilter[IMAGE, IMAGE],
}


def geometry_of(task: Any) -> Any:
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    lengths_mm = float(task["sid_mm"]), float(task["sdd_mm"])
    detector, source = ([float(v) for v in task.get(f"{of}_offset_mm", (0, 0))] for of in ("projection", "source"))
    for angle in task["gantry_deg"]:
        geometry.AddProjection(*lengths_mm, float(angle), *detector, 0, 0, *source)
    return geometry


def image_of(values: np.ndarray, spacing_mm: float, is_stack: bool) -> Any:
    """Returns an ITK image of an array (z, y, x) about the origin. Frames of a stack are one apart, the first at 0."""
    image = itk.image_from_array(np.ascontiguousarray(values, np.float32))
    image.SetSpacing([spacing_mm, spacing_mm, 1.0 if is_stack else spacing_mm])
    origin = [-(n - 1) / 2 * spacing_mm for n in values.shape[::-1]]
    image.SetOrigin([*origin[:2], 0.0 if is_stack else origin[2]])
    return image


def reconstruct(task: Any) -> tuple[np.ndarray, tuple[float, float]]:
    """Returns the volume (RTK's Z, Y, X), and seconds and processor seconds for it. Reading and wrapping are not counted."""
    geometry = geometry_of(task)
    stack: Any = image_of(task["projections"], float(task["pixel_mm"]), True)
    empty = image_of(np.zeros((int(task["voxels"]),) * 3), float(task["spacing_mm"]), False)
    started, processor = time.perf_counter(), time.process_time()
    if bool(task["displaced"]):
        displaced = rtk.DisplacedDetectorImageFilter[IMAGE].New(Geometry=geometry)
        displaced.SetInput(stack)
        displaced.SetPadOnTruncatedSide(True)
        stack = displaced.GetOutput()
    if bool(task["short"]):
        parker = rtk.ParkerShortScanImageFilter[IMAGE].New(Geometry=geometry)
        parker.SetInput(stack)
        stack = parker.GetOutput()
    fdk = rtk.FDKConeBeamReconstructionFilter[IMAGE].New(Geometry=geometry)
    fdk.SetInput(0, empty)
    fdk.SetInput(1, stack)
    fdk.Update()
    seconds = (time.perf_counter() - started, time.process_time() - processor)
    return itk.array_from_image(fdk.GetOutput()), seconds


def project(name: str, task: dict[str, np.ndarray], geometry: Any) -> tuple[np.ndarray, dict[str, float]]:
    """Runs one operator on new images, because RTK adds to its first input."""
    volume, frames = task["volume"], task["frames"]
    if name == "forward":
        inputs = (np.zeros_like(frames), task["pixel_mm"], True), (volume, task["voxel_mm"], False)
    else:
        inputs = (np.zeros_like(volume), task["voxel_mm"], False), (frames, task["pixel_mm"], True)
    images = [image_of(values, float(spacing), is_stack) for values, spacing, is_stack in inputs]
    started = time.perf_counter(), time.process_time()
    operator = FILTERS[name].New(Geometry=geometry)
    for number, image in enumerate(images):
        operator.SetInput(number, image)
    operator.Update()
    wall, processor = time.perf_counter() - started[0], time.process_time() - started[1]
    return itk.array_from_image(operator.GetOutput()), {"wall_s": wall, "processor_s": processor}


def answer(folder: Path, version: str) -> None:
    """Runs the operators that standard input asks for."""
    task = dict(np.load(folder / "task.npz"))
    geometry = geometry_of(task)
    threads = int(itk.MultiThreaderBase.GetGlobalDefaultNumberOfThreads())
    print(json.dumps({"version": version, "threads": threads}), flush=True)
    for line in sys.stdin:
        result, seconds = project(line.strip(), task, geometry)
        np.save(folder / f"{line.strip()}.npy", result)
        print(json.dumps(seconds), flush=True)


def main() -> None:
    version = importlib.metadata.version("itk-rtk")
    if len(sys.argv) == 2:
        answer(Path(sys.argv[1]), version)
        return
    task = dict(np.load(sys.argv[1]))
    runs = [reconstruct(task) for _ in range(int(task["repeats"]))]
    np.savez(sys.argv[2], volume=runs[-1][0], seconds=[seconds for _, seconds in runs], version=version)


if __name__ == "__main__":
    main()
