"""estimate: what a reconstruction would take."""

import time

from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.options import Scan
from phyradgs_cl.commands.run_options import GROUPS as GROUPS
from phyradgs_cl.commands.run_options import with_run_options
from phyradgs_cl.estimate import duration, estimate, seconds_around
from phyradgs_cl.reconstructors import Reconstruction
from phyradgs_cl.settings import Settings
from phyradgs_cl.workflow import load_scan

EXAMPLE = "Example: phyradgs estimate scan.h5 --method fista-tv --motion per-row"


@with_run_options("seed", "tune")
def estimate_command(scan: Scan, settings: Settings) -> None:
    """Say how long a reconstruction would take and how much memory, from a few iterations of it."""
    plan = settings.plan()
    loaded = load_scan(scan, plan.preprocessing.flats)
    rt = settings.runtime()
    before_s = time.process_time()  # a run will start, and read the scan, as this command did

    def around(result: Reconstruction) -> float:
        return before_s + seconds_around(scan, loaded, result)

    found = estimate(loaded, plan, rt, around)
    say(f"{plan.method_name} on {rt.device.name}, from a trial of {duration(found.trial_seconds)}")
    say(found.text())
