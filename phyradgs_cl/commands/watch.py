"""watch: scans reconstructed as they arrive."""

from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl import signals
from phyradgs_cl.commands.console import complain, file_argument, option, say, scores
from phyradgs_cl.commands.options import CHECKPOINT_EVERY_S, RUN_GROUPS, CheckpointEvery, with_run_options
from phyradgs_cl.progress import Ticker
from phyradgs_cl.reconstructors import ProgressReport
from phyradgs_cl.settings import Settings
from phyradgs_cl.workflow.watch import WatchEvent, WatchJob, run_watch

EXAMPLES = {
    "watch": (
        "Example: phyradgs watch incoming -o volumes --method fista-tv\n\n"
        "Kill and restart it at will: finished volumes stay, and a run continues from its checkpoint. Docs: cluster.md."
    )
}
GROUPS = {"watch": {"Basics": (*RUN_GROUPS["Basics"], "once", "poll_s", "settle_s"), **dict(list(RUN_GROUPS.items())[1:])}}
_OUTPUT = "Folder for a volume, or an error, of each scan."
_ONCE = "End when every complete scan has its volume or its error."
_SETTLE = "Time for which a file must not have changed; a file renamed into place is complete at once."


@with_run_options("batch")
def watch_command(
    folder: Annotated[Path, file_argument("FOLDER", "Folder in which scans arrive, as *.h5.")],
    output: Annotated[Path, option(_OUTPUT, True, "--output", "-o", metavar="DIR")], settings: Settings,
    once: Annotated[bool, option(_ONCE, True, "--once")] = False,
    poll_s: Annotated[float, option("Interval between looks at the folder.", True, "--poll-s", metavar="SECONDS")] = 2.0,
    settle_s: Annotated[float, option(_SETTLE, True, "--settle-s", metavar="SECONDS")] = 5.0,
    checkpoint_every: CheckpointEvery = CHECKPOINT_EVERY_S,
) -> None:
    """Reconstruct the scans of a folder as they arrive, each once. A scan that fails leaves its error."""
    job = WatchJob(folder, output, settings.plan(), poll_s, settle_s, once, checkpoint_every)
    console = _Console(output)
    try:
        run_watch(job, settings.runtime, console.show, console.report)
    except KeyboardInterrupt:
        console.ticker.end_line()
        complain(f"interrupted: finished volumes are in {output}; the next start continues from there")
        raise typer.Exit(signals.exit_status()) from None


class _Console:
    """A counter for the present scan, and a line for each that is finished or has failed."""

    def __init__(self, output: Path) -> None:
        self.output, self.ticker = output, Ticker("")

    def report(self, scan: Path) -> ProgressReport:
        self.ticker = Ticker(f"{scan.name}: iteration")
        return self.ticker.progress

    def show(self, event: WatchEvent) -> None:
        self.ticker.end_line()
        if event.result is None:
            complain(f"{event.scan}: set aside in {self.output}: {event.error}")
            return
        facts = event.result.facts
        say(f"{self.output / event.scan.name}: {facts['method']}, {facts['seconds']:.1f} s{scores(event.metrics or {})}")
