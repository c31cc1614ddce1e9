"""Runs on many devices: dask.distributed's workers, one device each, on this machine or at a scheduler's."""

from phyradgs_cl.cluster.local import has_dask
from phyradgs_cl.cluster.pool import Lost, Pool, PoolState
from phyradgs_cl.cluster.process import forget_runtimes, runtime_of_process
from phyradgs_cl.cluster.workers import LOCAL, Workers

__all__ = [
    "LOCAL", "Lost", "Pool", "PoolState", "Workers", "forget_runtimes", "has_dask",
    "runtime_of_process"
]  # fmt: skip
