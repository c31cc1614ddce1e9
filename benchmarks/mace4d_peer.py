"""Runs mbirtorch's 4D demonstration for benchmarks/mace4d.py. Needs only mbirtorch and NumPy.

    python mace4d_peer.py SIZE VIEWS RESULT.npz

The scan is that of the demonstration: a rack and pinion over two turns of a parallel beam, SIZE² pixels, 24 steps in time.
The result has `frames` (views, rows, columns), `angles` in rad, `middles` (the view in the middle of each window of MACE4D)
and volumes (windows, row, column, slice): `truth`, `mace4d` by MACE4D, and `fbp` by FBP of each window alone. It has the
processor seconds of both, compilation included."""

import sys
import time

import mbirtorch
import numpy as np


def main() -> None:
    size, views = int(sys.argv[1]), int(sys.argv[2])
    truth, frames, facts = mbirtorch.gen_demo_data_4d(
        model_type="parallel", num_views=views, num_rotations=2, num_det_rows=size, num_det_channels=size, num_steps=24
    )
    model = mbirtorch.MACE4DModel(
        mbirtorch.ParallelBeamModel(frames.shape, facts["angles"]), frames_per_rotation=8, frame_overlap_factor=2.0
    )
    windows, seconds = model.view_slices, {}
    started = time.process_time()
    mace4d, _ = model.recon(frames, max_iterations=10, seed=0)
    seconds["mace4d_seconds"] = time.process_time() - started
    started = time.process_time()
    fbp = [
        mbirtorch.ParallelBeamModel(frames[one].shape, facts["angles"][one]).recon_direct(frames[one]) for one in windows
    ]
    seconds["fbp_seconds"] = time.process_time() - started
    middles = np.array([(one.start + one.stop) // 2 for one in windows])
    np.savez(
        sys.argv[3], frames=frames, angles=facts["angles"], middles=middles, truth=truth[facts["step_of_view"][middles]],
        mace4d=mace4d, fbp=np.stack(fbp), version=mbirtorch.__version__, **seconds,
    )  # fmt: skip


if __name__ == "__main__":
    main()
