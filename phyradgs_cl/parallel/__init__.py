"""Several processes (ranks) at work on one scan: how they were launched, how they communicate, who does what."""

from phyradgs_cl.parallel.communicator import Alone, Communicator
from phyradgs_cl.parallel.ending import failing_together
from phyradgs_cl.parallel.exact_sum import exact_sum
from phyradgs_cl.parallel.launch import Launch, launched
from phyradgs_cl.parallel.mpi import Mpi, launched_ranks
from phyradgs_cl.parallel.shares import span

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
