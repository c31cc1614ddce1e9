"""Which size of a volume fits the memory, where the one that is asked for does not."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import OutOfMemoryError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io.files import HOST_SHARE, free_bytes, host_bytes
from phyradgs_cl.runtime import Runtime

# Volumes that voxel methods hold at one time at most (docs/large.md), with two of the intensity model; they hold stacks of
# all frames too, and one buffer of three volumes.
_HELD = {"sirt": 8, "sart": 28, "os-sart": 28, "cgls": 11, "asd-pocs": 32, "fista-tv": 16, "fista": 20, "fused": 20}
_STACKS, _ONE_BUFFER = 12, 3
_OF_OTHERS = 4  # the result, and what it is made, checked and written from
_DEVICE_SHARE = 0.9
_ROUND = 8  # voxels


@contextmanager
def naming_size_that_fits(rt: Runtime, scan: Scan, method: str, options: Any) -> Iterator[None]:
    """A shortage of memory in the body comes out with the ``--size`` that fits, if one does. OutOfMemoryError at once for a
    volume that this machine cannot hold, not after the run."""
    size = _size_that_fits(rt, scan, method, options)
    try:
        volume_bytes, most_bytes = 4 * math.prod(scan.grid.shape), HOST_SHARE * host_bytes()
        if volume_bytes > most_bytes:
            found = f"{_times(scan.grid)} voxels (x y z), {volume_bytes / 2**30:.3g} GiB in one volume"
            raise OutOfMemoryError("memory of this machine", found, f"at most {most_bytes / 2**30:.3g} GiB")
        yield
    except OutOfMemoryError as error:
        if 0 < size < max(scan.grid.shape):
            error.remedy = "; ".join(part for part in (error.remedy, f"--size {size} fits") if part)
        raise


def _size_that_fits(rt: Runtime, scan: Scan, method: str, options: Any) -> int:
    """Voxels along the longest side of the scan's grid that the method has room for; 0 where there are none."""
    free, held = HOST_SHARE * free_bytes(), _HELD.get(method)
    voxels = (free - scan.projections.nbytes) / (4 * _OF_OTHERS)
    if held is not None:
        free = min(free, _DEVICE_SHARE * rt.ledger.limit_bytes)
        held += _of_prior(options.prior) if hasattr(options, "prior") else 0
        voxels = (free - _STACKS * scan.projections.nbytes) / (4 * held)
        voxels = min(voxels, rt.device.largest_allocation_bytes / (4 * _ONE_BUFFER))
    if not 0 < voxels < math.inf:
        return 0
    size = int(max(scan.grid.shape) * (voxels / math.prod(scan.grid.shape)) ** (1 / 3))
    return size - size % _ROUND if size > 2 * _ROUND else size


def _of_prior(prior: Any) -> int:
    from phyradgs_cl.reconstructors.voxels.priors import volumes_of  # which loads SciPy

    return volumes_of(prior)


def _times(grid: Grid) -> str:
    return "×".join(map(str, grid.shape[::-1]))
