"""Several processes (ranks) that work on one scan: launch, communication, shares of work."""

from phyradgs_cl.parallel.exact_sum import exact_sum
from phyradgs_cl.parallel.ranks import Communicator, Launch, failing_together, launched, launched_ranks, span

__all__ = ["Communicator", "Launch", "exact_sum", "failing_together", "launched", "launched_ranks", "span"]
