"""estimate: what a reconstruction would take."""

from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.options import Scan
from phyradgs_cl.commands.run_options import GROUPS as GROUPS
from phyradgs_cl.commands.run_options import RunRequest, with_run_options
from phyradgs_cl.estimate import duration, estimate, seconds_around, seconds_since_start
from phyradgs_cl.reconstructors import Reconstruction, method_options
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.workflow import load_scan

EXAMPLE = "Example: phyradgs estimate scan.h5 --method fista-tv --motion per-row"


@with_run_options("seed", "tune")
def estimate_command(scan: Scan, request: RunRequest) -> None:
    """Say how long a reconstruction would take and how much memory, from a few iterations of it."""
    settings = request.settings()
    options = method_options(settings.method, settings.preset, settings.changes)
    loaded = load_scan(scan, settings.before.flats)
    with settings.naming_origins():
        rt = Runtime(settings.device, memory=settings.memory)
    before_s = seconds_since_start()  # a run will have started, and read the scan, as this did

    def around(result: Reconstruction) -> float:
        return before_s + seconds_around(scan, loaded, result)

    found = estimate(loaded, settings.method, options, rt, settings.before, around)
    say(f"{settings.method} on {rt.device.name}, from a trial of {duration(found.trial_seconds)}")
    say(found.text())
