"""Several processes (ranks) that work on one scan: launch, communication, shares of work."""

from phyradgs_cl.parallel.communicator import Alone, Communicator, failing_together, span
from phyradgs_cl.parallel.exact_sum import exact_sum
from phyradgs_cl.parallel.mpi import Launch, Mpi, launched, launched_ranks

__all__ = [
    "Alone",
    "Communicator",
    "Launch",
    "Mpi",
    "exact_sum",
    "failing_together",
    "launched",
    "launched_ranks",
    "span",
]
