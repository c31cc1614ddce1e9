"""The reference of the phantom study. It is made once for a size and seed, and kept beside the results."""

import json
from dataclasses import asdict

import numpy as np

from phyradgs_cl.acquisition import PROTOCOLS
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import read_volume, write_volume
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import ProgressReport, Reconstruction, RunPlan, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.signals import keep_finished_work
from tables.job import BenchJob, plain
from tables.phantom_case import PSEUDO, PSEUDO_VIEWS, PhantomCase
from tables.rows import Row


class PseudoTruth:
    """R2-Gaussian's volume from 64 stop-and-shoot projections, reconstructed when it is first asked for."""

    def __init__(self, job: BenchJob, rt: Runtime, seed: int, report: ProgressReport) -> None:
        self._job, self._rt, self._seed, self._report = job, rt, seed, report
        size = job.bench_size
        self._options = Row(PSEUDO, "r2").options(job.gaussians, size.iterations)
        self._identity = json.dumps(
            plain([size.voxels, size.pixels, job.axis, seed, PSEUDO_VIEWS, asdict(self._options)]),
            sort_keys=True,
        )
        name = f"pseudo_truth_{size.voxels}_{size.pixels}_i{size.iterations}_{job.axis}_s{seed}.h5"
        self.path = job.output / name
        self._volume: np.ndarray | None = None

    def volume_of(self) -> np.ndarray:
        """Returns the volume (z, y, x) float32 in 1/mm."""
        if self._volume is None:
            self._volume = self._stored()
        if self._volume is None:
            self._volume = self._made()
        return self._volume

    def _stored(self) -> np.ndarray | None:
        """Returns the volume of an earlier run with the same options, or None."""
        if not self.path.exists():
            return None
        try:
            stored = read_volume(self.path)
        except InputError:
            return None
        return stored.values if stored.provenance.get("identity") == self._identity else None

    def _made(self) -> np.ndarray:
        size, protocol = self._job.bench_size, PROTOCOLS["rapid"]
        case = PhantomCase(self._rt, size, protocol, self._job.axis, self._seed, self.volume_of)
        scan = case.scan(PSEUDO)
        with keep_finished_work():
            result = reconstruct(scan, RunPlan("r2", self._options, seed=self._seed), self._rt, report=self._report)
            refuse_interrupted(result)
            provenance = {"method": "r2", "views": PSEUDO_VIEWS, "identity": self._identity}
            metrics = compare(result.volume, case.truth)
            write_volume(self.path, result.volume, result.grid, provenance, None, metrics)
        return result.volume


def refuse_interrupted(result: Reconstruction) -> None:
    """Raises an error for a result that ended early: on Ctrl-C methods return an unfinished result."""
    if result.facts.get("interrupted_at") is not None:
        raise KeyboardInterrupt
