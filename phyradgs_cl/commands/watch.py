"""watch: scans reconstructed as they arrive."""

from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl import signals
from phyradgs_cl.commands.console import complain, say, scores
from phyradgs_cl.commands.files import file_argument, option
from phyradgs_cl.commands.run_options import GROUPS as GROUPS
from phyradgs_cl.commands.run_options import with_run_options
from phyradgs_cl.progress import Ticker
from phyradgs_cl.reconstructors import ProgressReport
from phyradgs_cl.settings import Settings
from phyradgs_cl.workflow.watch import WatchEvent, WatchJob, run_watch

EXAMPLE = (
    "Example: phyradgs watch incoming -o volumes --method fista-tv\n\n"
    "Kill and restart it at will: what is done stays done, and a run goes on from its checkpoint. Docs: cluster.md."
)
_SETTLE = "How long a file must not have changed; one renamed into place is taken at once."


@with_run_options("batch")
def watch_command(
    folder: Annotated[Path, file_argument("FOLDER", "Folder in which scans arrive, as *.h5.")],
    output: Annotated[
        Path, option("Folder for a volume, or an error, of each scan.", True, "--output", "-o", metavar="DIR")
    ],
    settings: Settings,
    once: Annotated[
        bool, option("End when every complete scan has its volume or its error.", True, "--once")
    ] = False,
    poll_s: Annotated[
        float, option("Between two looks at the folder.", True, "--poll-s", metavar="SECONDS")
    ] = 2.0,
    settle_s: Annotated[float, option(_SETTLE, True, "--settle-s", metavar="SECONDS")] = 5.0,
    checkpoint_every: Annotated[
        float, option("Keep a checkpoint of the run under way so often.", metavar="SECONDS")
    ] = 600.0,
) -> None:
    """Reconstruct the scans of a folder as they arrive, each once; failures are set aside with their message."""
    job = WatchJob(folder, output, settings.plan(), poll_s, settle_s, once, checkpoint_every)
    interrupted = f"interrupted: finished volumes are in {output}; the next start goes on from there"
    telling = _Telling(output)
    try:
        run_watch(job, settings.runtime, telling.tell, telling.report)
    except KeyboardInterrupt:
        telling.end_line()
        complain(interrupted)
        raise typer.Exit(signals.exit_status()) from None


class _Telling:
    """A counter for the scan under way, a line for each that is done or set aside."""

    def __init__(self, output: Path) -> None:
        self.output, self.ticker = output, Ticker("")

    def report(self, scan: Path) -> ProgressReport:
        self.ticker = Ticker(f"{scan.name}: iteration")
        return self.ticker.progress

    def tell(self, event: WatchEvent) -> None:
        self.end_line()
        if event.result is None:
            complain(f"{event.scan}: set aside in {self.output}: {event.error}")
            return
        facts = event.result.facts
        say(f"{self.output / event.scan.name}: {facts['method']}, {facts['seconds']:.1f} s{scores(event.metrics or {})}")

    def end_line(self) -> None:
        with self.ticker:
            pass
