"""What every rank of tests/parallel/test_mpi.py does: python mpi_work.py SCAN OUT.npz; rank 0 keeps what came out."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from parallel.shared_runs import OPTIONS, started  # noqa: E402

from phyradgs_cl.acquisition import Exact  # noqa: E402
from phyradgs_cl.api import load_scan, reconstruct  # noqa: E402
from phyradgs_cl.parallel import launched_ranks  # noqa: E402
from phyradgs_cl.reconstructors import RunPlan
from phyradgs_cl.reconstructors import reconstruct as run_method  # noqa: E402
from phyradgs_cl.runtime import Runtime  # noqa: E402

SPLATS = {"micro-views": OPTIONS, "exact": replace(OPTIONS, motion=Exact())}
VOXELS = {
    "sirt": {"iterations": 5, "motion": "per-row"}, "os-sart": {"iterations": 3, "frames_per_subset": 4},
    "fista-tv": {"iterations": 5, "tv_iterations": 3}, "asd-pocs": {"iterations": 3},
}  # fmt: skip


def main() -> None:
    ranks = launched_ranks()
    rt, scan = Runtime(ranks=ranks), load_scan(sys.argv[1])
    kept: dict[str, np.ndarray] = {"size": np.array(ranks.size)}
    for name, options in SPLATS.items():
        kept[name] = run_method(scan, RunPlan("phyradgs", options, seed=1), rt).volume
    for name, options in VOXELS.items():
        volume = reconstruct(scan, name, device=rt, **options)
        again = reconstruct(scan, name, device=rt, **options)
        assert np.array_equal(volume.volume, again.volume), f"{name}: other bits in a second run"
        assert np.array_equal(volume.volume, ranks.bcast(volume.volume)), f"{name}: other bits on rank 0"
        kept[name] = volume.volume
    # dL/draw (11, G) of the first step, without jumps, across which a last digit makes a difference
    step = started(scan, replace(OPTIONS, l1_weight=0.0, tv_weight=0.0), rt)
    step.step()
    kept["gradient"] = rt.download(step.cloud.gradients)[:11, : step.cloud.count]
    if ranks.rank == 0:
        np.savez(sys.argv[2], **kept)


if __name__ == "__main__":
    main()
