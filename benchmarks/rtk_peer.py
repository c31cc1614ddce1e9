"""Runs RTK's FDK for benchmarks/rtk_fdk.py: one task in, one result out. Needs only itk-rtk and NumPy.

    python rtk_peer.py TASK.npz RESULT.npz

The task has RTK's geometry (lengths in mm, gantry angles in degrees, offsets (x, y)), projections (F, rows, columns), and a
cube of `voxels` and `spacing_mm`. The result has the volume in RTK's own axes, (seconds, processor seconds) of every run,
and the version."""

import importlib.metadata
import sys
import time
from typing import Any

import itk
import numpy as np
from itk import RTK as rtk

IMAGE = itk.Image[itk.F, 3]


def geometry_of(task: Any) -> Any:
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    detector_x, detector_y = (float(v) for v in task["projection_offset_mm"])
    source_x, source_y = (float(v) for v in task["source_offset_mm"])
    for angle in task["gantry_deg"]:
        geometry.AddProjection(
            float(task["sid_mm"]),
            float(task["sdd_mm"]),
            float(angle),
            detector_x,
            detector_y,
            0,
            0,
            source_x,
            source_y,
        )
    return geometry


def image_of(
    values: np.ndarray, spacing: tuple[float, float, float], centred: tuple[bool, bool, bool]
) -> Any:
    """Returns an ITK image of an array (z, y, x), centred about the origin along the axes (x, y, z) that ask for it."""
    image = itk.image_from_array(np.ascontiguousarray(values, np.float32))
    image.SetSpacing(spacing)
    count = values.shape[::-1]
    image.SetOrigin([-(n - 1) / 2 * d if c else 0.0 for n, d, c in zip(count, spacing, centred, strict=True)])
    return image


def reconstruct(task: Any) -> tuple[np.ndarray, tuple[float, float]]:
    """Returns the volume (RTK's Z, Y, X), and seconds and processor seconds for it. Reading and wrapping are not counted."""
    geometry = geometry_of(task)
    pixel = float(task["pixel_mm"])
    stack: Any = image_of(task["projections"], (pixel, pixel, 1.0), (True, True, False))
    voxels, spacing = int(task["voxels"]), float(task["spacing_mm"])
    empty = image_of(np.zeros((voxels,) * 3), (spacing,) * 3, (True,) * 3)
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


def main() -> None:
    task = dict(np.load(sys.argv[1]))
    runs = [reconstruct(task) for _ in range(int(task["repeats"]))]
    version = importlib.metadata.version("itk-rtk")
    np.savez(sys.argv[2], volume=runs[-1][0], seconds=[seconds for _, seconds in runs], version=version)


if __name__ == "__main__":
    main()
