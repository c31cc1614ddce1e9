"""Runs RTK's Joseph projectors for benchmarks/ray_speed.py, one on each request. Needs only itk-rtk and NumPy.

    python rtk_rays_peer.py FOLDER

FOLDER/task.npz has lengths in mm, gantry angles in degrees, a volume (Z, Y, X) and frames (F, rows, columns) in RTK's axes.
Every line of standard input, ``forward`` or ``adjoint``, runs that operator once. It keeps the result as FOLDER/NAME.npy and
answers with a line of JSON: wall and processor seconds of the operator itself."""

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


def image_of(values: np.ndarray, spacing_mm: float, is_stack: bool) -> Any:
    """Returns an ITK image of an array (z, y, x) about the origin. Frames of a stack are one apart."""
    image = itk.image_from_array(np.ascontiguousarray(values, np.float32))
    image.SetSpacing([spacing_mm, spacing_mm, 1.0 if is_stack else spacing_mm])
    origin = [-(n - 1) / 2 * spacing_mm for n in values.shape[::-1]]
    image.SetOrigin([*origin[:2], 0.0 if is_stack else origin[2]])
    return image


def geometry_of(task: dict[str, np.ndarray]) -> Any:
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    for angle in task["gantry_deg"]:
        geometry.AddProjection(float(task["sid_mm"]), float(task["sdd_mm"]), float(angle))
    return geometry


def run(name: str, task: dict[str, np.ndarray], geometry: Any) -> tuple[np.ndarray, dict[str, float]]:
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


def main() -> None:
    folder = Path(sys.argv[1])
    task = dict(np.load(folder / "task.npz"))
    geometry = geometry_of(task)
    threads = int(itk.MultiThreaderBase.GetGlobalDefaultNumberOfThreads())
    print(json.dumps({"version": importlib.metadata.version("itk-rtk"), "threads": threads}), flush=True)
    for line in sys.stdin:
        result, seconds = run(line.strip(), task, geometry)
        np.save(folder / f"{line.strip()}.npy", result)
        print(json.dumps(seconds), flush=True)


if __name__ == "__main__":
    main()
