"""Runs RTK's motion-compensated FDK for benchmarks/rtk_moving.py. Needs only itk-rtk and NumPy.

    python rtk_moving_peer.py FOLDER TASK.npz RESULT.npz

It writes the scan of RTK's own test as RTK's files into FOLDER (geometry.xml, projections.mha, signal.txt): a sphere of 60
mm that holds a sphere of 8 mm, which goes from -8 to 8 mm along X and back in eight frames. The task has `field` (2, Z, Y,
X, 3) in mm, components X, Y, Z, of both ends of the cycle, `spacing_mm` of its voxels, and `repeats`. The result has the
volume (Z, Y, X), and the seconds and processor seconds of every run."""

import sys
import time
from pathlib import Path

import itk
import numpy as np
from itk import RTK as rtk

FRAMES, PIXELS, PIXEL_MM, VOXELS, VOXEL_MM = 128, 128, 4.0, (64, 32, 64), 2.0
IMAGE = itk.Image[itk.F, 3]


def source(size: tuple[int, ...], spacing_mm: tuple[float, ...], origin_mm: tuple[float, ...]) -> object:
    empty = rtk.ConstantImageSource[IMAGE].New()
    empty.SetSize(size)
    empty.SetSpacing(spacing_mm)
    empty.SetOrigin(origin_mm)
    return empty


def write_scan(folder: Path) -> tuple[object, object]:
    """Writes the files. Returns the geometry and the stack of projections."""
    geometry, frames = rtk.ThreeDCircularProjectionGeometry.New(), []
    first_mm = -(PIXELS - 1) / 2 * PIXEL_MM
    for n in range(FRAMES):
        view = rtk.ThreeDCircularProjectionGeometry.New()
        for one in (geometry, view):
            one.AddProjection(600.0, 1200.0, n * 360.0 / FRAMES, 0, 0, 0, 0, 20.0, 15.0)
        empty = source((PIXELS, PIXELS, 1), (PIXEL_MM,) * 3, (first_mm,) * 3)
        image = empty.GetOutput()
        centre_mm = 4.0 * (abs((4 + n) % 8 - 4.0) - 2.0)
        for density, radius_mm, x_mm in ((2.0, 60.0, 0.0), (-1.0, 8.0, centre_mm)):
            sphere = rtk.RayEllipsoidIntersectionImageFilter[IMAGE, IMAGE].New(Geometry=view)
            sphere.SetInput(image)
            sphere.SetDensity(density)
            sphere.SetAxis([radius_mm] * 3)
            sphere.SetCenter([x_mm, 0.0, 0.0])
            sphere.Update()
            image = sphere.GetOutput()
        frames.append(itk.array_from_image(image)[0])
    stack = itk.image_from_array(np.stack(frames))
    stack.SetSpacing([PIXEL_MM, PIXEL_MM, 1.0])
    stack.SetOrigin([first_mm, first_mm, 0.0])
    itk.imwrite(stack, str(folder / "projections.mha"))
    writer = rtk.ThreeDCircularProjectionGeometryXMLFileWriter.New()
    writer.SetObject(geometry)
    writer.SetFilename(str(folder / "geometry.xml"))
    writer.WriteFile()
    (folder / "signal.txt").write_text("".join(f"{n % 8 / 8}\n" for n in range(FRAMES)))
    return geometry, stack


def reconstruct(folder: Path, geometry: object, stack: object, field: np.ndarray, spacing_mm: float) -> tuple:
    """Returns the volume (Z, Y, X), and the seconds and processor seconds for it."""
    moved = itk.image_from_array(np.ascontiguousarray(field, np.float32), ttype=itk.Image[itk.Vector[itk.F, 3], 4])
    moved.SetSpacing([spacing_mm] * 3 + [1.0])
    moved.SetOrigin([-(n - 1) / 2 * spacing_mm for n in field.shape[3:0:-1]] + [0.0])
    deformation = rtk.CyclicDeformationImageFilter[type(moved), itk.Image[itk.Vector[itk.F, 3], 3]].New(Input=moved)
    deformation.SetSignalFilename(str(folder / "signal.txt"))
    warped = rtk.FDKWarpBackProjectionImageFilter[IMAGE, IMAGE, type(deformation)].New()
    warped.SetDeformation(deformation)
    warped.SetGeometry(geometry)
    fdk = rtk.FDKConeBeamReconstructionFilter[IMAGE].New(Geometry=geometry)
    empty = source(VOXELS, (VOXEL_MM,) * 3, tuple(-(n - 1) / 2 * VOXEL_MM for n in VOXELS))
    fdk.SetInput(0, empty.GetOutput())
    fdk.SetInput(1, stack)
    fdk.SetBackProjectionFilter(warped)
    started, processor = time.perf_counter(), time.process_time()
    fdk.Update()
    seconds = time.perf_counter() - started, time.process_time() - processor
    return np.array(itk.array_view_from_image(fdk.GetOutput())), seconds


def main() -> None:
    folder, task = Path(sys.argv[1]), dict(np.load(sys.argv[2]))
    geometry, stack = write_scan(folder)
    runs = [
        reconstruct(folder, geometry, stack, task["field"], float(task["spacing_mm"])) for _ in range(int(task["repeats"]))
    ]
    np.savez(sys.argv[3], volume=runs[-1][0], seconds=[seconds for _, seconds in runs])


if __name__ == "__main__":
    main()
