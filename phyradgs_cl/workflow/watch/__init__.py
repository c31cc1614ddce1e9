"""Scans reconstructed as they arrive in a folder, each once."""

from phyradgs_cl.workflow.watch.arrivals import Arrival, Arrivals
from phyradgs_cl.workflow.watch.service import WatchEvent, WatchJob, run_watch

__all__ = ["Arrival", "Arrivals", "WatchEvent", "WatchJob", "run_watch"]
