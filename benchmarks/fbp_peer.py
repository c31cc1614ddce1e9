"""Runs filtered backprojection by scikit-image, ASTRA's CPU or silx's OpenCL for fbp_peers.py, in a Python of its own.

    PEER/bin/python fbp_peer.py IN.npz OUT.npz skimage|astra|silx

IN: sino (rows, views, columns) and angle_rad (views,). OUT: volume (rows, y, x), and wall_s and processor_s of a run after a
short one."""

import sys
import time
from collections.abc import Callable

import numpy as np


def skimage(sino: np.ndarray, angle_rad: np.ndarray) -> Callable[[], np.ndarray]:
    from skimage.transform import iradon

    theta = -np.rad2deg(angle_rad + np.pi / 2)
    like = {"output_size": sino.shape[2], "filter_name": "ramp", "preserve_range": True}
    return lambda: np.stack([iradon(rows.T, theta, **like) for rows in sino])


def astra(sino: np.ndarray, angle_rad: np.ndarray) -> Callable[[], np.ndarray]:
    import astra as library

    side = sino.shape[2]
    geometry = library.create_proj_geom("parallel", 1.0, side, angle_rad + np.pi / 2)
    projector = library.create_projector("strip", geometry, library.create_vol_geom(side, side))

    def one(rows: np.ndarray) -> np.ndarray:
        frames = library.data2d.create("-sino", geometry, rows)
        volume = library.data2d.create("-vol", library.create_vol_geom(side, side))
        config = library.astra_dict("FBP") | {
            "ReconstructionDataId": volume, "ProjectionDataId": frames, "ProjectorId": projector
        }
        algorithm = library.algorithm.create(config)
        library.algorithm.run(algorithm)
        result = library.data2d.get(volume)[::-1].copy()
        library.algorithm.delete(algorithm)
        library.data2d.delete([frames, volume])
        return result

    return lambda: np.stack([one(rows) for rows in sino])


def silx(sino: np.ndarray, angle_rad: np.ndarray) -> Callable[[], np.ndarray]:
    from silx.opencl.backprojection import Backprojection

    views, columns = sino.shape[1:]
    angles = (angle_rad + np.pi / 2).astype(np.float32)
    method = Backprojection((views, columns), axis_position=(columns - 1) / 2, angles=angles, devicetype="ALL")
    return lambda: np.stack([method.filtered_backprojection(np.ascontiguousarray(rows, np.float32)) for rows in sino])


def main() -> None:
    given = np.load(sys.argv[1])
    make = {"skimage": skimage, "astra": astra, "silx": silx}[sys.argv[3]]
    sino, angle_rad = given["sino"], given["angle_rad"]
    make(sino[:, :8], angle_rad[:8])()  # this imports packages and builds kernels
    run = make(sino, angle_rad)
    wall_s, processor_s = time.perf_counter(), time.process_time()
    volume = run()
    wall_s, processor_s = time.perf_counter() - wall_s, time.process_time() - processor_s
    np.savez(sys.argv[2], volume=volume, wall_s=wall_s, processor_s=processor_s)


if __name__ == "__main__":
    main()
